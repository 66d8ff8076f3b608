"""A Stable-Baselines3 extension that learns which actions are permissible while it learns to act."""

from sb3_sap import envs

__version__ = "0.1.0"

__all__ = ["envs"]
