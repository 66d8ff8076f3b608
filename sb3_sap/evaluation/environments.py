"""Making an environment by its id."""

from __future__ import annotations

import importlib
import warnings
from contextlib import suppress
from typing import Any

import gymnasium as gym

#: How the names of gymnasium-robotics' tasks begin.
ROBOTICS = ("Adroit", "AntMaze", "Fetch", "FrankaKitchen", "Hand", "PointMaze")


def make_env(env_id: str, **options: Any) -> gym.Env[Any, Any]:
    """``gym.make``, which finds the tasks of highway-env and gymnasium-robotics as well."""
    find_environment(env_id)
    return gym.make(env_id, **options)


def find_environment(env_id: str) -> None:
    """Imports the library that registers an environment's task, if it is installed and ``env_id`` is not registered."""
    if env_id in gym.registry:
        return
    module = "gymnasium_robotics" if env_id.startswith(ROBOTICS) else "highway_env"
    with suppress(ModuleNotFoundError), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # gymnasium-robotics warns of tasks that nobody has asked for
        importlib.import_module(module)
