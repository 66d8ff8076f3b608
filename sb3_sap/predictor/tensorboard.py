"""A layout for TensorBoard's tab "Custom Scalars": the metrics of the method on one page."""

from __future__ import annotations

from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

#: Category → chart → kind of chart and its metrics.
LAYOUT = {
    "action permissibility": {
        "AP predictor: validation accuracy": [
            "Multiline",
            [
                "sap/validation_accuracy",
                "sap/validation_accuracy_permissible",
                "sap/validation_accuracy_non_permissible",
            ],
        ],
        "guidance: how often": [
            "Multiline",
            ["sap/alpha", "sap/consultation_rate", "sap/rejection_rate", "sap/fallback_rate"],
        ],
        "permissible actions": ["Multiline", ["sap/permissible_rate"]],
        "losses": ["Multiline", ["sap/predictor_loss", "sap/auxiliary_loss"]],
    },
    "learning": {
        "return": ["Multiline", ["rollout/ep_rew_mean", "eval/mean_reward"]],
    },
}


def add_layout(logger: Logger) -> None:
    """Writes the layout if a logger writes to TensorBoard."""
    for output in logger.output_formats:
        if isinstance(output, TensorBoardOutputFormat):
            output.writer.add_custom_scalars(LAYOUT)
