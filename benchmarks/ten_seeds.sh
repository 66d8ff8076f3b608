#!/usr/bin/env bash
# The paper's algorithms with the `paper` preset, ten seeds, 3,000 steps each.
# Runs already finished are skipped, so a stopped batch goes on where it was.
# Usage: benchmarks/ten_seeds.sh FOLDER highway|torcs RESULT [JOBS] [ALGO ...]
set -euo pipefail
folder=$1 simulator=$2 result=$3 jobs=${4:-2}
algos=${*:5}
export OMP_NUM_THREADS=1
for seed in 0 1 2 3 4 5 6 7 8 9; do
    for algo in ${algos:-ddpg ddpg_ce1 ddpg_ce2 ddpg_ap ddpg_ap_ce2}; do
        [ -e "$folder/$algo-$seed/evaluation.json" ] || echo "$algo $seed"
    done
done | xargs -r -P "$jobs" -n 2 sh -c 'python -m sb3_sap.cli demo --simulator "$1" --algo "$2" --seed "$3" \
    --preset paper --steps 3000 --no-animation --out "$0/$2-$3" >/dev/null && echo "$2 $3 done"' "$folder" "$simulator"
python "$(dirname "$0")/summarise_demos.py" "$folder" --out "$result"
