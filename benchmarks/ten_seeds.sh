#!/usr/bin/env bash
# The paper's five algorithms with the `paper` preset, ten seeds, 3,000 steps each, on the embedded simulator.
# Runs already finished are skipped, so a stopped batch goes on where it was. Usage: benchmarks/ten_seeds.sh [FOLDER] [JOBS]
set -euo pipefail
folder=${1:-runs/ten_seeds} jobs=${2:-2}
export OMP_NUM_THREADS=1
for seed in 0 1 2 3 4 5 6 7 8 9; do
    for algo in ddpg ddpg_ce1 ddpg_ce2 ddpg_ap ddpg_ap_ce2; do
        [ -e "$folder/$algo-$seed/evaluation.json" ] || echo "$algo $seed"
    done
done | xargs -r -P "$jobs" -n 2 sh -c 'python -m sb3_sap.cli demo --algo "$1" --seed "$2" --preset paper --steps 3000 \
    --no-animation --out "$0/$1-$2" >/dev/null && echo "$1 $2 done"' "$folder"
python "$(dirname "$0")/summarise_demos.py" "$folder"
