"""Tables from a folder of finished demo runs named ALGO-SEED.

python benchmarks/summarise_demos.py FOLDER [--out docs/results/lane_keeping_paper_3k]   # writes .csv and .md
"""

import argparse
import json
from pathlib import Path

import numpy as np
import pandas as pd

from sb3_sap.benchmark.pages import markdown
from sb3_sap.files import atomic_path
from sb3_sap.statistics import bootstrap_interval, interquartile_mean

ORDER = ["ddpg", "ddpg_ce1", "ddpg_ce2", "ddpg_ap", "ddpg_ap_ce2"]


def collect(folder: Path) -> pd.DataFrame:
    """One row for every run and test track."""
    rows = []
    for path in sorted(folder.glob("*/evaluation.json")):
        algo, _, seed = path.parent.name.rpartition("-")
        training = pd.read_csv(path.parent / "training.csv")
        accuracy = training["validation_accuracy"]
        run = {
            "algo": algo,
            "seed": int(seed),
            "off_track_episodes": int(training["off_track"].sum()),
            "episodes": int(training["episode"].iloc[-1]) + 1,
            "last_off_track_step": int(training.loc[training["off_track"], "step"].max()),
            "accuracy_mean": accuracy.mean(),
            "accuracy_share_above_70": (accuracy.dropna() >= 0.7).mean(),
        }
        rows += [run | lap for lap in json.loads(path.read_text())]
    return pd.DataFrame(rows)


def summarise(laps: pd.DataFrame) -> pd.DataFrame:
    """One row for every algorithm."""
    rows = []
    for algo in ORDER:
        of_algo = laps[laps["algo"] == algo]
        if of_algo.empty:
            continue
        # (seeds, tracks)
        scores = of_algo.pivot(index="seed", columns="track", values="score").to_numpy()
        low, high = bootstrap_interval(scores)
        runs = of_algo.groupby("seed").first()
        rows.append(
            {
                "algorithm": algo,
                "seeds": len(runs),
                "laps done": f"{of_algo['lap_done'].sum()} of {len(of_algo)}",
                "S, interquartile mean": f"{interquartile_mean(scores):.3f} [{low:.3f}, {high:.3f}]",
                "S, worst seed": f"{scores.mean(axis=1).min():.3f}",
                "times off the road (median)": f"{runs['off_track_episodes'].median():.0f}",
                "last time off the road, step (median)": f"{runs['last_off_track_step'].median():.0f}",
                "predictor accuracy": ""
                if runs["accuracy_mean"].isna().all()
                else f"{runs['accuracy_mean'].mean():.3f}",
                "… at or above 70 %": ""
                if runs["accuracy_mean"].isna().all()
                else f"{np.nanmean(runs['accuracy_share_above_70']):.0%}",
            }
        )
    return pd.DataFrame(rows)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("docs/results/lane_keeping_paper_3k"))
    options = parser.parse_args()
    laps = collect(options.folder)
    with atomic_path(options.out.with_suffix(".csv")) as temporary:
        laps.to_csv(temporary, index=False)
    text = markdown(summarise(laps))
    with atomic_path(options.out.with_suffix(".md")) as temporary:
        temporary.write_text(text, encoding="utf-8")
    print(text)
