#!/usr/bin/env bash
# The paper's algorithms with a preset, ten seeds, 3,000 steps each.
# Runs already finished are skipped, so a stopped batch goes on where it was.
# Usage: benchmarks/ten_seeds.sh FOLDER highway|torcs PRESET RESULT [JOBS] [ALGO ...]
set -euo pipefail
folder=$1 simulator=$2 preset=$3 result=$4 jobs=${5:-2}
algos=${*:6}
export OMP_NUM_THREADS=1
for seed in 0 1 2 3 4 5 6 7 8 9; do
    for algo in ${algos:-ddpg ddpg_ce1 ddpg_ce2 ddpg_ap ddpg_ap_ce2}; do
        [ -e "$folder/$algo-$seed/evaluation.json" ] || echo "$algo $seed"
    done
done | xargs -r -P "$jobs" -n 2 sh -c 'python -m sb3_sap.cli demo --simulator "$1" --algo "$3" --seed "$4" \
    --preset "$2" --steps 3000 --no-animation --out "$0/$3-$4" >/dev/null && echo "$3 $4 done"' "$folder" "$simulator" "$preset"
python "$(dirname "$0")/summarise_demos.py" "$folder" --out "$result"
