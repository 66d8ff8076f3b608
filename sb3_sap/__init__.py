"""A Stable-Baselines3 extension that learns which actions are permissible while it learns to act."""

__version__ = "0.1.0"
