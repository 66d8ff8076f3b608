"""A layout for TensorBoard: what belongs to the method on one page, under "Custom Scalars"."""

from __future__ import annotations

from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

#: Category → chart → the kind of chart and what is drawn in it.
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
        "losses": ["Multiline", ["sap/predictor_loss", "sap/actor_loss"]],
    },
    "learning": {
        "return": ["Multiline", ["rollout/ep_rew_mean", "eval/mean_reward"]],
    },
}


def add_layout(logger: Logger) -> None:
    """Writes the layout where a logger writes to TensorBoard; else nothing."""
    for output in logger.output_formats:
        if isinstance(output, TensorBoardOutputFormat):
            output.writer.add_custom_scalars(LAYOUT)
