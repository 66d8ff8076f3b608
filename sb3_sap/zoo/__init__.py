"""RL Zoo's commands with the algorithms and environments of this package.

rl_zoo3 is imported only when one of them runs.
"""

from __future__ import annotations

#: The commands, each with its line of the help.
COMMANDS = {
    "train": "train with RL Zoo",
    "enjoy": "watch or measure what RL Zoo trained",
    "optimize": "tune hyperparameters with Optuna; several workers may share a study",
    "retest": "train a study's winners and the defaults on fresh seeds, and compare them",
    "record-video": "film what RL Zoo trained",
    "plot": "draw: plot train | all | file (RL Zoo's), plot study (a report of a study)",
}


def main(arguments: list[str] | None = None) -> int:
    """Runs one of the commands and returns its exit code."""
    import sys

    from sb3_sap.common.command_line import run_command

    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        from sb3_sap.zoo.commands import run
    except ModuleNotFoundError as error:
        print(f"sb3-sap: error: RL Zoo is not installed ({error}): pip install sb3-sap[zoo].", file=sys.stderr)
        return 1
    return run_command(lambda: run(arguments))
