"""What is compared: the columns of the benchmark, and the short language in which they are written."""

from __future__ import annotations

import difflib
import json
import re
from dataclasses import dataclass
from typing import Any

import yaml

#: ``algo``, ``algo:preset`` or ``algo:preset[key=value,…]``.
_COLUMN = re.compile(r"(?P<algo>\w+)(:(?P<preset>\w+))?(\[(?P<overrides>.+)\])?")

PAPER = ["ddpg:paper", "ddpg_ce1:paper", "ddpg_ce2:paper", "ddpg_ap:paper", "ddpg_ap_ce2:paper"]
PEERS = ["ddpg", "td3", "sac", "tqc", "crossq"]
_GUIDED = ["ddpg_ap", "td3_ap", "sac_ap", "tqc_ap", "crossq_ap"]

#: Names that stand for several columns.
GROUPS: dict[str, list[str]] = {
    # the five of Table 2, with the paper's settings
    "paper": PAPER,
    # what a user would pick today, as its library leaves it and tuned for this task
    "peers": [f"{algo}:{preset}" for preset in ("default", "tuned") for algo in PEERS],
    # guided, as the constructor leaves it and as fast as it gets
    "guided": ["ddpg_ap:default", *(f"{algo}:fast" for algo in _GUIDED)],
    # what the README shows
    "headline": [
        *("tqc_ap:fast", "tqc:tuned", "tqc:default", "sac_ap:fast", "sac:tuned", "sac:default"),
        *("td3_ap:fast", "td3:tuned", "td3:default", "ddpg_ap:fast", "ddpg_ap:default", "ddpg:default"),
        *("ddpg_ap:paper", "ddpg:paper", "linear"),
    ],
    # the peers in JAX, which people pick for wall-clock
    "sbx": [f"sbx_{algo}:{preset}" for preset in ("default", "tuned") for algo in PEERS],
    # one thing changed at a time in DDPG-AP
    "ablations": [
        "ddpg_ap:default",
        "ddpg_ap:tuned",
        *(f"ddpg_ap:default[alpha={alpha}]" for alpha in (0, 0.5, 1)),
        *(f"ddpg_ap:default[alpha_low={alpha}]" for alpha in (0, 0.9)),
        *(f"ddpg_ap:default[t_k={t_k}]" for t_k in (20, 150, 500)),
        *(f"ddpg_ap:default[dataset_size={n}]" for n in (128, 2000)),
        *(f"ddpg_ap:default[n_candidates={n}]" for n in (8, 32)),
        "ddpg_ap:default[predictor_kwargs.optimizer_class=SGD,predictor_kwargs.learning_rate=0.01]",
        *(f"ddpg_ap:default[predictor_kwargs.weight_decay={decay}]" for decay in (0, 0.01)),
        *(f"ddpg_ap:default[actor_permissibility_coef={beta}]" for beta in (0.3, 1, 3)),
        *(f"ddpg_ap:default[candidate_selection={name}]" for name in ("nearest", "highest_q", "most_permissible")),
        "ddpg_ap_unbalanced:default",
        "ddpg_ap_proposed:default",
        "ddpg_ap:paper",
        "ddpg_ap:paper[actor_permissibility_coef=1]",
    ],
    # what the paper leaves open, read otherwise, one thing at a time: why does our DDPG drive so soon?
    "readings": [
        "ddpg:paper",
        *(f"ddpg:paper[env.off_track_reward={reward}]" for reward in (0, -20)),
        *(f"ddpg:paper[env.{start}]" for start in ("random_start=true", "start=race")),
        *(f"ddpg:paper[env.control_step={seconds}]" for seconds in (0.1, 0.4)),
        "ddpg:paper[action_noise=null]",
        "ddpg:paper[action_noise={type: ornstein-uhlenbeck, theta: 0.15, sigma: 0.2, dt: 0.01}]",
        "ddpg:paper[train_freq=4]",
        *(
            f"{column}[policy_kwargs.features_extractor_class=sb3_sap.benchmark.ablated.{units}]"
            for units, columns in (("TorcsKeras", ["ddpg:paper", "ddpg_ap:paper"]), ("KilometresPerHour", PAPER))
            for column in columns
        ),
    ],
    # the actor taught after every update of it, or as often as E is fitted and as long as there is guidance
    "lessons": [
        *("ddpg_ap:fast", "ddpg_ap:default[actor_permissibility_coef=1.0,refit_growth=0.005]", "ddpg:tuned"),
        *("td3_ap:fast", "td3_ap:fast[teaching_growth=null]", "td3:tuned"),
        *("sac_ap:fast[teaching_growth=0]", "sac_ap:fast", "sac:tuned"),
    ],
    # faster, and from anywhere on the track, with nothing tuned for it
    "harder": [
        *(
            f"{column}[{condition}]"
            for condition in ("env.speed=80", "env.random_start=true")
            for algo in ("ddpg", "sac", "tqc")
            for column in (f"{algo}_ap:fast", f"{algo}:tuned")
        ),
        "linear[env.speed=80]",
    ],
}
#: Columns of controllers that learn nothing, and have no presets.
CONTROLLERS = ("linear", "rule")
#: Overrides that belong to the run: a training of its own length, and only the first so many seeds.
RUN = ("steps", "seeds")
GROUPS["all"] = [*PAPER, *GROUPS["guided"], *GROUPS["peers"], *GROUPS["sbx"], "linear"]


@dataclass(frozen=True)
class Column:
    """An algorithm with a preset, and what is set otherwise: ``ddpg_ap:paper[alpha=0.5]``."""

    algo: str
    preset: str = "default"
    overrides: tuple[tuple[str, str], ...] = ()

    @property
    def name(self) -> str:
        """As it is written, in one way only."""
        changed = ",".join(f"{key}={value}" for key, value in self.overrides)
        return (f"{self.algo}:{self.preset}" if self.learns else self.algo) + (f"[{changed}]" if changed else "")

    @property
    def learns(self) -> bool:
        """Whether there is a training."""
        return self.algo not in CONTROLLERS

    @property
    def changes(self) -> dict[str, Any]:
        """The overrides' values, by dotted name."""
        return {key: yaml.safe_load(value) for key, value in self.overrides if key not in RUN}

    def of_run(self, name: str, default: int) -> int:
        """The run's own steps or seeds, else the default."""
        value = yaml.safe_load(dict(self.overrides).get(name, str(default)))
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"In the column {self.name}, {name} must be 1 or more, but is {value!r}.")
        return value


def parse_column(text: str) -> Column:
    """Reads one column."""
    match = _COLUMN.fullmatch(text)
    if match is None:
        raise ValueError(f"A column is written algo:preset or algo:preset[key=value,…], but {text!r} is not.")
    overrides = []
    for part in _split(match["overrides"] or ""):
        key, equals, value = part.partition("=")
        if not equals or not key.strip() or not value.strip():
            raise ValueError(f"In the column {text!r}, {part!r} is not of the form key=value.")
        overrides.append((key.strip(), _value(value)))
    return Column(match["algo"], match["preset"] or "default", tuple(overrides))


def parse_columns(texts: list[str]) -> list[Column]:
    """Reads columns and names of groups, in the order given, each column once."""
    names = [name for text in texts for name in GROUPS.get(text, [text])]
    return list(dict.fromkeys(map(parse_column, names)))


def unknown_algorithm(algo: str, known: list[str]) -> ValueError:
    """The error for a column whose algorithm does not exist."""
    near = difflib.get_close_matches(algo, [*known, *GROUPS], n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(known)} or {', '.join(GROUPS)}."
    return ValueError(f"There is no algorithm or group {algo!r}: {hint}")


def _split(text: str) -> list[str]:
    """Parts between commas, those inside brackets or braces left alone."""
    parts, depth = [""], 0
    for character in text:
        depth += (character in "[{") - (character in "]}")
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part for part in parts if part]


def _value(text: str) -> str:
    """A value as YAML writes it, in JSON, where one value has one spelling; a word stays a word."""
    try:
        value: Any = yaml.safe_load(text)
    except yaml.YAMLError:
        raise ValueError(f"{text!r} is not a value as YAML writes it.") from None
    if isinstance(value, str):
        try:
            value = float(value)  # YAML takes 1e-3 for a word
        except ValueError:
            return str(value)
    return json.dumps(value, separators=(",", ":"))
