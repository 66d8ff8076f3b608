"""The Python code that a comparison hands to its user."""

from __future__ import annotations

import importlib
import inspect
from typing import Any

from sb3_sap.algorithms import GUIDED_ALGORITHMS, base_of
from sb3_sap.benchmark.learners import CLASSES
from sb3_sap.comparison.ways import Way
from sb3_sap.comparison.worker import Job


def lines(way: Way, job: Job, policy: str, ap_function: Any, potential: Any) -> str:
    """A script that trains with one way.

    :param job: with the user's settings alone
    :param policy: SB3's name of the policy
    :param ap_function: as the user gave it: a function, its dotted name, or None
    :param potential: the same
    """
    imports, arguments, own = ["import gymnasium as gym"], ["seed=0"], job.settings
    if way.name == "base":
        module, _, cls = CLASSES[base_of(job.algo)].partition(":")
        imports.append(f"from {module} import {cls}")
        known = inspect.signature(getattr(importlib.import_module(module), cls)).parameters
        own = {name: value for name, value in own.items() if name in known}  # not those of guidance
        if (noise := way.settings.get("action_noise")) and "action_noise" not in job.settings:
            imports = ["import numpy as np", *imports, "from stable_baselines3.common.noise import NormalActionNoise"]
            arguments.append(
                "action_noise=NormalActionNoise(np.zeros(env.action_space.shape), "
                f"{noise['sigma']} * np.ones(env.action_space.shape))"
            )
    else:
        cls = GUIDED_ALGORITHMS[job.algo].__name__
        names = [cls]
        if ap_function is not None:
            arguments.append(f"ap_function={_imported(ap_function, imports)}")
        elif potential is not None and way.name != "shaping":
            names.append("does_not_lower")
            arguments.append(f"ap_function=does_not_lower({_imported(potential, imports)})")
        if way.name == "shaping":
            arguments.append(f"potential={_imported(potential, imports)}")
        names += ["preset"] if "preset(" in way.code else []
        imports.append(f"from sb3_sap import {', '.join(names)}")
        # A keyword may not be given twice.
        both = {name: value for name, value in job.settings.items() if name in way.settings}
        arguments.append(way.code + (f" | {_written(both, imports)}" if both else ""))
        own = {name: value for name, value in own.items() if name not in both}
    arguments += [f"{name}={_written(value, imports)}" for name, value in own.items()]
    options = "".join(f", {name}={_written(value, imports)}" for name, value in job.env_kwargs.items())
    maker = f"gym.make({job.env!r}{options})" if isinstance(job.env, str) else f"{job.env.__name__}({options[2:]})"
    return "\n".join(
        [
            *imports,
            "",
            f"env = {maker}",
            f"model = {cls}(",
            f'    "{policy}",',
            "    env,",
            *(f"    {argument}," for argument in arguments),
            ")",
            f"model.learn({job.steps:_}, progress_bar=True)",
            'model.save("model")',
        ]
    )


def _written(value: Any, imports: list[str]) -> str:
    """A setting as Python; the imports of classes and functions in it are added."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key!r}: {_written(one, imports)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(_written(one, imports) for one in value) + "]"
    return _imported(value, imports) if hasattr(value, "__qualname__") else repr(value)


def _imported(function: Any, imports: list[str]) -> str:
    """The name of a function, whose import is added unless it was defined in a script or notebook."""
    dotted = function if isinstance(function, str) else f"{function.__module__}.{function.__qualname__}"
    module, _, name = dotted.rpartition(".")
    if module != "__main__":
        imports.append(f"from {module} import {name}")
    return name
