"""``sb3-sap predictor``: fits, evaluates and shows an AP predictor without training an agent."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

from gymnasium import spaces
from rich.console import Console
from rich.table import Table
from stable_baselines3.common.preprocessing import is_image_space

from sb3_sap.algorithms import DDPGAP, DQNAP
from sb3_sap.common.command_line import not_negative, positive
from sb3_sap.common.extractors import RescaleExtractor
from sb3_sap.common.yaml_text import read_yaml
from sb3_sap.evaluation.environments import make_env
from sb3_sap.onpolicy.algorithms import PPOAP
from sb3_sap.predictor.measuring import measure
from sb3_sap.predictor.network import PermissibilityPredictor


def add_predictor(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds ``sb3-sap predictor``."""
    text = "fit, evaluate or show an AP predictor, from logs alone"
    actions = commands.add_parser("predictor", help=text, description=f"{text}.").add_subparsers(
        title="commands", required=True, metavar="COMMAND"
    )
    fit = _command(actions, "fit", "fit a predictor to transitions and write it to a file", _fit)
    fit.add_argument("log", nargs="+", help="tables, replay buffers, trajectories, .npz files, ids of Minari data")
    fit.add_argument("--out", type=Path, default=Path("predictor.pt"), metavar="FILE", help="where it is written")
    fit.add_argument("--epochs", type=positive, default=50, metavar="N", help="maximum number of passes")
    fit.add_argument("--patience", type=positive, default=5, metavar="N", help="passes without progress until it ends")
    fit.add_argument("--examples", type=positive, default=100_000, metavar="N", help="labelled actions kept, at random")
    fit.add_argument("--net-arch", type=positive, nargs="+", default=[128, 256], metavar="N", help="hidden layers")
    fit.add_argument("--seed", type=not_negative, default=0, help="of everything random")
    _add_labels(fit)
    evaluate = _command(actions, "evaluate", "balanced accuracy and calibration on transitions", _evaluate)
    evaluate.add_argument("file", type=Path, help="what `fit` or `model.save_predictor` wrote")
    evaluate.add_argument("log", nargs="+", help="transitions, as for `fit`")
    _add_labels(evaluate)
    show = _command(actions, "show", "spaces, architecture and accuracy of a predictor", _show)
    show.add_argument("file", type=Path, help="what `fit` or `model.save_predictor` wrote")


def _command(actions: Any, name: str, text: str, run: Any) -> argparse.ArgumentParser:
    command: argparse.ArgumentParser = actions.add_parser(
        name, help=text, description=f"{text}.", formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    command.set_defaults(run=run)
    return command


def _add_labels(command: argparse.ArgumentParser) -> None:
    """Adds the options that say what the transitions are of, and which of them are permissible."""
    command.add_argument("--env", required=True, metavar="ENV_ID", help="environment of the transitions")
    command.add_argument("--env-kwargs", type=read_yaml, default={}, metavar="YAML", help="its arguments")
    command.add_argument("--ap-function", metavar="MODULE.FUNCTION", help="f(s, a | s'); by default labels of the log")
    command.add_argument("--action-parts", type=read_yaml, metavar="YAML", help="parts of the action with own labels")
    command.add_argument("--columns", type=Path, metavar="FILE", help="YAML file that names the columns of a table")


def _model(options: argparse.Namespace, **settings: Any) -> Any:
    """An untrained model of the environment, which reads and labels the transitions."""
    env = make_env(options.env, **options.env_kwargs)
    finite = isinstance(env.action_space, spaces.Discrete)
    algorithm: Any = DQNAP if finite else DDPGAP if isinstance(env.action_space, spaces.Box) else PPOAP
    policy, architecture = "MlpPolicy", {"net_arch": options.net_arch} if "net_arch" in options else {}
    if isinstance(env.observation_space, spaces.Dict):
        policy = "MultiInputPolicy"
    elif is_image_space(env.observation_space):
        policy = "CnnPolicy"
    elif "net_arch" in options and isinstance(env.observation_space, spaces.Box):
        # Logs are in the units of a machine, and a network hardly tells hundredths from one another.
        architecture["features_extractor_class"] = RescaleExtractor
    if algorithm is not PPOAP:
        settings["buffer_size"] = 1
    settings |= {"ap_function": options.ap_function, "action_parts": options.action_parts}
    settings |= {"predictor_kwargs": architecture}
    return algorithm(policy, env, device="cpu", **settings)


def _read(model: Any, options: argparse.Namespace, console: Console) -> None:
    for source in options.log:
        report = model.add_knowledge(
            source, into="knowledge", columns=options.columns, progress_bar=console.is_terminal
        )
        console.print(f"{source}: {report}", soft_wrap=True, markup=False)


def _fit(options: argparse.Namespace, console: Console) -> int:
    model = _model(options, seed=options.seed, knowledge_buffer_size=options.examples)
    _read(model, options, console)
    report = model.fit_predictor(options.epochs, options.patience, progress_bar=console.is_terminal)
    model.save_predictor(options.out)
    console.print(str(report), soft_wrap=True, markup=False)
    console.print(
        f"Written to {options.out}. To begin with it: {type(model).__name__}(..., predictor={str(options.out)!r})",
        soft_wrap=True,
        markup=False,
    )
    return 0


def _evaluate(options: argparse.Namespace, console: Console) -> int:
    model = _model(options, knowledge_buffer_size=100_000, predictor=options.file)
    _read(model, options, console)
    prior = model.knowledge.prior
    fewest = min(prior.counts("train"))
    if fewest == 0:
        raise ValueError("The transitions are all of one class, so that accuracy cannot be told.")
    report = measure(model.predictor, prior.sample_own(2 * fewest, "train"))
    console.print(str(report), soft_wrap=True, markup=False)
    return 0


def _show(options: argparse.Namespace, console: Console) -> int:
    predictor = PermissibilityPredictor.load(options.file, "cpu")
    accuracy, statistics = predictor.about.get("accuracy", math.nan), predictor.about.get("statistics")
    of_parts = zip(predictor.parts.names, predictor.accuracies.tolist(), strict=True) if predictor.parts else ()
    table = Table("", str(options.file))
    for name, value in {
        "observations": predictor.observation_space,
        "actions": predictor.action_space,
        "normalised": "no" if statistics is None else "with statistics of VecNormalize, which must be the same",
        "hidden layers": ", ".join(map(str, predictor.arguments["net_arch"])),
        "parameters": f"{sum(p.numel() for p in predictor.parameters()):,}",
        "gradient steps": f"{int(predictor.n_updates):,}",
        "balanced accuracy": "not known" if math.isnan(accuracy) else f"{accuracy:.3f}",
        **{f"  of {name}": "not known" if math.isnan(one) else f"{one:.3f}" for name, one in of_parts},
    }.items():
        table.add_row(name, str(value))
    console.print(table)
    return 0
