"""Configurations, such as ``ddpg_ap:paper[alpha=0.5]``: an algorithm, a preset, and overrides of its settings.

Presets may be joined, as in ``ddpg_ap:base+loss``: later ones override earlier ones.
"""

from __future__ import annotations

import difflib
import json
import re
from dataclasses import dataclass
from typing import Any

import yaml

from sb3_sap.benchmark.groups import GROUPS
from sb3_sap.common.yaml_text import read_yaml

#: ``algo``, ``algo:preset`` or ``algo:preset[key=value,…]``.
_CONFIGURATION = re.compile(r"(?P<algo>\w+)(:(?P<preset>\w+(\+\w+)*))?(\[(?P<overrides>.+)\])?")

#: Controllers that do not learn and have no presets: linear feedback, the look-ahead oracle, and the driver of racing
#: that is written down.
CONTROLLERS = ("linear", "oracle", "scripted")
#: Overrides of the run instead of a setting: its number of training steps, and how many of the seeds are run.
RUN_OPTIONS = ("steps", "seeds")


@dataclass(frozen=True)
class Configuration:
    """An algorithm with a preset and overrides of its settings: ``ddpg_ap:paper[alpha=0.5]``."""

    algo: str
    preset: str = "default"
    overrides: tuple[tuple[str, str], ...] = ()

    @property
    def name(self) -> str:
        """The canonical spelling, which `parse_configuration` reads back."""
        changed = ",".join(f"{key}={value}" for key, value in self.overrides)
        return (f"{self.algo}:{self.preset}" if self.learns else self.algo) + (f"[{changed}]" if changed else "")

    @property
    def learns(self) -> bool:
        """Whether the configuration is trained."""
        return self.algo not in CONTROLLERS

    @property
    def changes(self) -> dict[str, Any]:
        """Values of the overridden settings by dotted name."""
        return {key: read_yaml(value) for key, value in self.overrides if key not in RUN_OPTIONS}

    def run_option(self, name: str, default: int) -> int:
        """The value of one of `RUN_OPTIONS`, or the default.

        :raise ValueError: if the value is not a whole number of 1 or more
        """
        value = read_yaml(dict(self.overrides).get(name, str(default)))
        if not isinstance(value, int) or value < 1:
            raise ValueError(f"In the configuration {self.name}, {name} must be 1 or more, but is {value!r}.")
        return value


def parse_configuration(text: str) -> Configuration:
    """Reads one configuration.

    :raise ValueError: if the text is not of the form ``algo:preset[key=value,…]``
    """
    match = _CONFIGURATION.fullmatch(text)
    if match is None:
        raise ValueError(f"A configuration is written algo:preset or algo:preset[key=value,…], but {text!r} is not.")
    overrides = []
    for part in _split(match["overrides"] or ""):
        key, equals, value = part.partition("=")
        if not equals or not key.strip() or not value.strip():
            raise ValueError(f"In the configuration {text!r}, {part!r} is not of the form key=value.")
        overrides.append((key.strip(), _value(value)))
    return Configuration(match["algo"], match["preset"] or "default", tuple(overrides))


def parse_configurations(texts: list[str]) -> list[Configuration]:
    """Reads configurations and names of groups in the order given, and keeps each configuration once."""
    names = [name for text in texts for name in GROUPS.get(text, [text])]
    return list(dict.fromkeys(map(parse_configuration, names)))


def unknown_algorithm(algo: str, known: list[str]) -> ValueError:
    """The error for a configuration whose algorithm does not exist."""
    near = difflib.get_close_matches(algo, [*known, *GROUPS], n=1)
    hint = f"did you mean {near[0]!r}?" if near else f"choose from {', '.join(known)} or {', '.join(GROUPS)}."
    return ValueError(f"There is no algorithm or group {algo!r}: {hint}")


def _split(text: str) -> list[str]:
    """Splits at commas, except inside brackets and braces."""
    parts, depth = [""], 0
    for character in text:
        depth += (character in "[{") - (character in "]}")
        if character == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += character
    return [part for part in parts if part]


def _value(text: str) -> str:
    """Rewrites a YAML value as JSON, in which a value has one spelling; a word remains as it is."""
    try:
        value: Any = read_yaml(text)
    except yaml.YAMLError:
        raise ValueError(f"{text!r} is not a value as YAML writes it.") from None
    return value if isinstance(value, str) else json.dumps(value, separators=(",", ":"))
