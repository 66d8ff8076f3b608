"""What share of a good policy's actions a label refuses: mistakes are counted in excess of it."""

from __future__ import annotations

import pandas as pd

from sb3_sap.benchmark.linear import GAINS, LinearFeedback
from sb3_sap.benchmark.reports.results import Results
from sb3_sap.evaluation.environments import make_env
from sb3_sap.evaluation.laps import ENVIRONMENTS
from sb3_sap.evaluation.statistics import interquartile_mean

#: Steps of linear feedback, from the start of the training track.
STEPS = 1_000


def reference_share(results: Results, scores: pd.DataFrame) -> float:
    """The share of non-permissible actions of linear feedback, or else of the policy that ended best.

    :param scores: columns ``configuration``, ``seed``, ``checkpoint`` and ``score``
    """
    if results.simulator in ENVIRONMENTS:
        return _of_linear_feedback(results.simulator)
    final = scores[scores["checkpoint"] == scores.groupby("configuration")["checkpoint"].transform("max")]
    best = final.groupby("configuration")["score"].apply(lambda values: interquartile_mean(values.to_numpy())).idxmax()
    laps = results.final_laps()
    return float(1 - laps[laps["configuration"] == best]["permissible"].astype(float).mean())


def _of_linear_feedback(simulator: str) -> float:
    env = make_env(ENVIRONMENTS[simulator], track="wheel-2", laps=None)
    policy = LinearFeedback(**GAINS[simulator])
    obs, _ = env.reset(seed=0)
    refused = 0
    for _ in range(STEPS):
        obs, _, terminated, truncated, info = env.step(policy.predict(obs)[0])
        refused += not info["permissible"]
        if terminated or truncated:
            obs, _ = env.reset()
    env.close()
    return refused / STEPS
