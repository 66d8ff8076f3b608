"""Plots for any guided model, and for training runs of any algorithm."""

from sb3_sap.evaluation.plots import return_curves, save
from sb3_sap.evaluation.predictor_plots import plot_permissibility

__all__ = ["plot_permissibility", "return_curves", "save"]
