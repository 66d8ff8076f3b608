"""Evaluation: laps, policies loaded from files, plots and statistics."""

from sb3_sap.evaluation.environments import make_env
from sb3_sap.evaluation.laps import drive_lap
from sb3_sap.evaluation.policies import load_policy

__all__ = ["drive_lap", "load_policy", "make_env"]
