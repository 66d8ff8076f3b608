"""``sb3-sap compare``: which use of a label is worth it on a user's own environment."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from sb3_sap.algorithms import guided_name
from sb3_sap.common.command_line import not_negative, positive
from sb3_sap.common.yaml_text import read_yaml


def add_compare(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds the command to the main parser."""
    text = "base, reward penalty, shaping, E and Algorithm 1 on your own environment: which one is worth it"
    command = commands.add_parser("compare", help=text, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
    command.add_argument("env", metavar="ENV_ID", help="a registered environment, or module:ENV_ID")
    command.add_argument(
        "--ap-function", metavar="MODULE.FUNCTION", help="f(s, a | s'); without it info['permissible']"
    )
    command.add_argument("--potential", metavar="MODULE.FUNCTION", help="a potential of states, to compare shaping too")
    command.add_argument("--algo", type=_algorithm, metavar="NAME", help="such as sac_ap or ppo; by default SAC or DQN")
    command.add_argument("--minutes", type=float, default=10.0, help="how long the comparison may take, about")
    command.add_argument("--steps", type=positive, help="training steps of each run, instead of a time")
    command.add_argument("--seeds", type=positive, default=5, metavar="N", help="runs of each way")
    command.add_argument("--first-seed", type=not_negative, default=0, metavar="SEED", help="the first of their seeds")
    command.add_argument("--episodes", type=positive, default=5, metavar="N", help="episodes of an evaluation")
    command.add_argument("--jobs", type=positive, metavar="N", help="runs side by side; by default one per processor")
    command.add_argument("--settings", type=_mapping, default={}, metavar="YAML", help="of the base: '{gamma: 0.95}'")
    command.add_argument("--env-kwargs", type=_mapping, default={}, metavar="YAML", help="arguments of the environment")
    command.add_argument("--out", type=Path, default=Path("comparison"), help="folder for table, curves and script")
    command.set_defaults(run=run)


def run(options: argparse.Namespace, console: Console) -> int:
    """Compares, prints the table, the decision and the lines to paste."""
    try:
        from sb3_sap.comparison import compare
    except ModuleNotFoundError as error:
        raise ValueError(f"sb3-sap compare needs {error.name}: pip install 'sb3-sap[benchmark]'.") from error
    given = {name: value for name, value in vars(options).items() if name not in ("run", "env")}
    result = compare(options.env, given.pop("ap_function"), console=console, **given)
    table = Table(*result.table.columns)
    for row in result.table.astype(str).to_numpy():
        table.add_row(*row)
    console.print(table)
    console.print(result.decision, soft_wrap=True, markup=False)
    console.print(f"\nTo train with it ({shlex.quote(str(options.out / 'train.py'))}):\n", soft_wrap=True, markup=False)
    console.print(result.code, soft_wrap=True, markup=False)
    console.print(f"\nCurves, table and script are in {options.out}/.", soft_wrap=True, markup=False)
    return 0


def _algorithm(name: str) -> str:
    try:
        return guided_name(name)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _mapping(text: str) -> dict[str, Any]:
    value = read_yaml(text)
    if not isinstance(value, dict):
        raise argparse.ArgumentTypeError(f"must be a YAML mapping such as '{{gamma: 0.95}}', but is {text!r}")
    return value
