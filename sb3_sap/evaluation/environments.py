"""Making an environment by its id."""

from __future__ import annotations

import importlib
from contextlib import suppress
from typing import Any

import gymnasium as gym


def make_env(env_id: str, **options: Any) -> gym.Env[Any, Any]:
    """``gym.make``, which finds the tasks of highway-env and gymnasium-robotics as well."""
    find_environment(env_id)
    return gym.make(env_id, **options)


def find_environment(env_id: str) -> None:
    """Imports the libraries that register tasks, as far as they are installed, until ``env_id`` is registered."""
    for module in ("highway_env", "gymnasium_robotics"):
        if env_id not in gym.registry:
            with suppress(ModuleNotFoundError):
                importlib.import_module(module)
