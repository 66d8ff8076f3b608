"""Making an environment by its id."""

from __future__ import annotations

import importlib
from typing import Any

import gymnasium as gym


def make_env(env_id: str, **options: Any) -> gym.Env[Any, Any]:
    """``gym.make``, which finds highway-env's tasks as well."""
    find_environment(env_id)
    return gym.make(env_id, **options)


def find_environment(env_id: str) -> None:
    """Imports highway_env, which registers its tasks, if ``env_id`` is not registered."""
    if env_id not in gym.registry:
        importlib.import_module("highway_env")
