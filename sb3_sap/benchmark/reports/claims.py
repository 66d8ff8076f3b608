"""The results that section 5.2 of the paper states in sentences, each with our figure and a verdict."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from sb3_sap.benchmark.reports import verdicts
from sb3_sap.benchmark.reports.pages import made_by, markdown, write_text
from sb3_sap.benchmark.reports.results import Results
from sb3_sap.benchmark.reports.verdicts import AP, AP_CE2, CE1, CE2, DDPG, LONG_EPISODE, RISEN, SPEED, Judge, ordered

DEFINITIONS = f"""All figures are those of the paper's five algorithms with the paper's settings, as medians over seeds
(accuracies and rewards: as means).

- The *moving average* is that of the reward over the last 100 training steps. It has *risen* when it reaches
  {RISEN:.0%} of the default speed, {RISEN * SPEED:g} km/h, and is *stable* from the step after which it never falls
  below that again.
- The *fluctuation* is the standard deviation of the moving average over the second half of the training.
- A *considerable distance* is an episode of {LONG_EPISODE} steps or more. An episode is *lost* if it ends with the car
  off the road or facing backwards.
"""

ADAM = """The predictors of DDPG-AP and DDPG-(AP+CE2) are fitted by Adam and without weight decay, the preset
`paper_adam`.
"""


@dataclass(frozen=True)
class Claim:
    """A sentence of the paper and the criterion by which it is judged."""

    sentence: str
    steps: int  # of the paper's training
    criterion: str
    judge: Judge


CLAIMS = [
    Claim(
        "Fig. 4a: DDPG-AP's moving average increases very rapidly compared to the others.",
        15_000,
        "risen before all others",
        verdicts.smallest(verdicts.risen_at, AP),
    ),
    Claim(
        "Fig. 4a: it gets stable more quickly, around 2,500 steps.",
        15_000,
        "stable before all others, and by step 2,500",
        verdicts.smallest(verdicts.stable_from, AP, 2_500),
    ),
    Claim(
        "Fig. 4a: DDPG and DDPG-CE1 are quite unstable.",
        15_000,
        "each fluctuates more than twice as much as DDPG-AP",
        ordered(verdicts.fluctuation, (AP, DDPG), (AP, CE1), factor=2, digits=2),
    ),
    Claim(
        "Fig. 4a: DDPG-CE2 is better than DDPG and DDPG-CE1.",
        15_000,
        "fluctuates less than both",
        ordered(verdicts.fluctuation, (CE2, DDPG), (CE2, CE1), digits=2),
    ),
    Claim(
        "Fig. 4a: DDPG-(AP+CE2) is more stable than DDPG-CE2.",
        15_000,
        "fluctuates less",
        ordered(verdicts.fluctuation, (AP_CE2, CE2), digits=2),
    ),
    Claim(
        "Fig. 4a: DDPG-AP is the most stable of all.",
        15_000,
        "fluctuates least",
        ordered(verdicts.fluctuation, *((AP, other) for other in (DDPG, CE1, CE2, AP_CE2)), digits=2),
    ),
    Claim(
        "Fig. 4b: DDPG took more than 120 episodes to drive a considerable distance.",
        15_000,
        "the first such episode comes after the 120th",
        verdicts.more_than_120,
    ),
    Claim(
        "Fig. 4b: DDPG-CE1 and DDPG-CE2 learn that quicker than DDPG.",
        15_000,
        "in fewer episodes",
        ordered(verdicts.first_long_episode, (CE1, DDPG), (CE2, DDPG)),
    ),
    Claim(
        "Fig. 4b: DDPG-(AP+CE2) never goes off the track after 20 episodes.",
        15_000,
        "so in every seed",
        verdicts.never_lost_after(AP_CE2, 20),
    ),
    Claim(
        "Fig. 4b: DDPG-AP never goes off the track after 25 episodes.",
        15_000,
        "so in every seed",
        verdicts.never_lost_after(AP, 25),
    ),
    Claim(
        "Fig. 5: the accuracy is always above 70 %.",
        15_000,
        "no validation of the first 5,000 steps below",
        verdicts.always_above_70,
    ),
    Claim(
        "Fig. 5: it is 80 % on average.", 15_000, "mean of the first 5,000 steps at least 79.5 %", verdicts.average_80
    ),
    Claim("Table 2, 3k: DDPG completes no lap.", 3_000, "in no seed on no track", verdicts.no_lap),
    Claim(
        "Table 2, 3k: DDPG-CE1 completes the laps with very low reward.",
        3_000,
        "all laps done, less than 60 % of DDPG-AP's reward",
        verdicts.ce1_low,
    ),
    Claim(
        "Table 2, 3k: DDPG-AP and DDPG-(AP+CE2) complete the laps.",
        3_000,
        "all laps of all seeds done",
        verdicts.laps_done({AP: True, AP_CE2: True}),
    ),
    Claim(
        "Table 2, 3k: DDPG-CE2 completes all but Spring.",
        3_000,
        "every other lap done, not every lap of Spring",
        verdicts.ce2_but_spring,
    ),
    Claim("Table 2, 3k: DDPG-CE2 has the highest reward.", 3_000, "highest on every track", verdicts.highest(CE2)),
    Claim(
        "Table 2, 15k: all but DDPG and DDPG-CE1 stay on all test tracks.",
        15_000,
        "these two miss laps, the others none",
        verdicts.laps_done({DDPG: False, CE1: False, CE2: True, AP: True, AP_CE2: True}),
    ),
    Claim(
        "Table 2, 15k: DDPG-AP has the highest total reward on all test tracks.",
        15_000,
        "highest on every track",
        verdicts.highest(AP),
    ),
    Claim(
        "Table 2, 15k: DDPG-CE2's reward is below DDPG-AP's and DDPG-(AP+CE2)'s.",
        15_000,
        "the mean over tracks is below both",
        verdicts.ce2_below,
    ),
]


def judged(results: dict[int, Results]) -> pd.DataFrame:
    """A row for every claim; there is no verdict where results of one of the five algorithms are missing.

    :param results: by training steps
    """
    five = {DDPG, CE1, CE2, AP, AP_CE2}
    rows = []
    for claim in CLAIMS:
        found = results.get(claim.steps)
        if found is None or not five <= set(found.names):
            figure, verdict = "", "not run"
        else:
            figure, good = claim.judge(found.only(sorted(five)))
            verdict = "**reproduced**" if good else "not reproduced"
        rows.append([claim.sentence, f"{claim.steps:,}", claim.criterion, figure, verdict])
    return pd.DataFrame(rows, columns=["the paper says", "steps", "reproduced if", "ours", "verdict"])


def claims(results: dict[int, Results], path: Path, command: str, reading: str = "paper") -> None:
    """Writes the page of all claims.

    :param results: by training steps
    :param reading: the preset of the configurations with a predictor: ``"paper"`` or ``"paper_adam"``
    """
    simulator = next(iter(results.values())).simulator
    made = [f"{steps:,} steps. {made_by(found, command)}" for steps, found in results.items()]
    title = f"# The claims of section 5.2 ({simulator})\n"
    parts = [title, DEFINITIONS, *([ADAM] if reading == "paper_adam" else [])]
    table = judged({steps: found.renamed(reading, "paper") for steps, found in results.items()})
    write_text(path, "\n".join([*parts, markdown(table), *made]))
