"""Named settings, read from ``zoo_configs``: one source of truth for constructors, commands and RL Zoo."""

from __future__ import annotations

import re
from importlib import resources
from typing import Any

from sb3_sap.common.errors import is_number, nearest
from sb3_sap.common.yaml_text import read_yaml

#: Keys of an RL Zoo configuration that RL Zoo reads itself; all others are arguments of the constructor.
RUNNER_KEYS = frozenset(
    {
        "callback",
        "env_kwargs",
        "env_wrapper",
        "frame_stack",
        "monitor_kwargs",
        "n_envs",
        "n_timesteps",
        "noise_std",
        "noise_type",
        "normalize",
        "policy",
        "vec_env_wrapper",
    }
)
#: Timesteps up to which the entry ``<preset>-3k`` applies, because the paper chooses t_k by the length of the run.
SHORT_RUN = 3_000
#: Entries named like a Gymnasium environment are not presets.
_ENVIRONMENT = re.compile(r"/|-v\d+$")


def algorithms() -> list[str]:
    """The algorithms that have settings, by their RL Zoo names."""
    folder = resources.files("sb3_sap") / "zoo_configs"
    return sorted(entry.name.removesuffix(".yml") for entry in folder.iterdir() if entry.name.endswith(".yml"))


def load_config(algo: str) -> dict[str, dict[str, Any]]:
    """All entries of an algorithm's YAML file."""
    _check("algo", algo, algorithms())
    text = (resources.files("sb3_sap") / "zoo_configs" / f"{algo}.yml").read_text(encoding="utf-8")
    entries: dict[str, dict[str, Any]] = read_yaml(text)
    return entries


def preset_names(algo: str | type) -> list[str]:
    """The presets of an algorithm, ``"default"`` among them: the entries that are not named after an environment.

    :param algo: the algorithm, a class of this package or its RL Zoo name
    """
    entries = load_config(_zoo_name(algo))
    return [name for name in entries if not _ENVIRONMENT.search(name) and not name.endswith("-3k")]


def preset(name: str, algo: str | type | None = None, steps: int | None = None) -> dict[str, Any]:
    """Constructor arguments: ``TQCAP("MlpPolicy", env, **preset("penalty", TQCAP))``.

    :param name: ``"penalty"``, the label as a reward penalty; ``"loss"``, a loss on the predictor beside it;
        ``"default"``, the constructor's settings, which guide; ``"paper"``, the values of section 5.1;
        ``"paper_adam"``, the same with E fitted by Adam; ``"tuned"``, the best settings of a baseline on lane keeping;
        ``"fast"``, the same with guidance
    :param algo: the algorithm, a class of this package, one derived from it, or its RL Zoo name. ``None``: DDPG-AP,
        for the paper's presets only
    :param steps: planned timesteps of the training: a short one may have settings of its own. ``None``: a long one
    :raise TypeError: if ``steps`` is not a number
    :raise ValueError: if the preset or the algorithm is unknown, or the algorithm is missing
    """
    if algo is None:
        if name not in ("paper", "paper_adam"):
            _check("name", name, list(dict.fromkeys(known for each in algorithms() for known in preset_names(each))))
            raise ValueError(
                f"The preset {name!r} differs from algorithm to algorithm: name yours, as in preset({name!r}, TQCAP) "
                f"or preset({name!r}, 'tqc_ap')."
            )
        algo = "ddpg_ap"
    algo = _zoo_name(algo)
    _check("name", name, preset_names(algo))
    if not (steps is None or is_number(steps)):
        raise TypeError(f"`steps` must be a number of training steps, but is {steps!r}.")
    entries = load_config(algo)
    short = f"{name}-3k"
    entry = entries[short if steps is not None and steps <= SHORT_RUN and short in entries else name]
    return settings_in(entry)


def settings_in(entry: dict[str, Any]) -> dict[str, Any]:
    """The constructor arguments among an entry's keys."""
    return {key: value for key, value in entry.items() if key not in RUNNER_KEYS}


def _zoo_name(algo: str | type) -> str:
    """The RL Zoo name of an algorithm, or of the algorithm of this package that a class is derived from."""
    if not isinstance(algo, type):
        return algo
    # Here, so that commands read presets without loading every algorithm.
    from sb3_sap.algorithms import ALGORITHMS
    from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS

    names: dict[type, str] = {known: name for name, known in (*ALGORITHMS.items(), *ON_POLICY_ALGORITHMS.items())}
    for ancestor in algo.__mro__:
        if ancestor in names:
            return names[ancestor]
    raise ValueError(
        f"`algo` = {algo.__name__} is neither an algorithm of sb3_sap nor derived from one: pass such a class, or one "
        f"of the names {', '.join(map(repr, algorithms()))}."
    )


def _check(argument: str, value: str, known: list[str]) -> None:
    if value not in known:
        raise ValueError(f"`{argument}` = {value!r} is unknown: {nearest(value, known)}")
