"""A trained model on the Hugging Face Hub, with a card of its training command and its results."""

from __future__ import annotations

import argparse
import json
import shlex
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from rich.console import Console
from stable_baselines3.common.policies import BasePolicy

from sb3_sap import __version__
from sb3_sap.cli.card import CARD, PREDICTOR, USE, USE_NORMALISED, env_arguments
from sb3_sap.cli.options import add_vecnormalize
from sb3_sap.common.command_line import positive
from sb3_sap.common.errors import nearest
from sb3_sap.common.files import atomic_path
from sb3_sap.evaluation.environments import make_env
from sb3_sap.evaluation.laps import ENVIRONMENTS
from sb3_sap.evaluation.normalisation import FILE_NAME, NormalisedPolicy
from sb3_sap.evaluation.policies import load_policy

#: Files of `sb3-sap demo`, besides the model, that are uploaded.
EXTRAS = ("lap.gif", "learning_curve.png", "predictor.png", "evaluation.json", "training.csv", "predictor.pt")


@dataclass(frozen=True)
class Trained:
    """A trained model, and what is known of its run."""

    model: Path
    algo: str
    env_id: str
    command: str
    laps: tuple[dict[str, Any], ...] = ()  # the rows of evaluation.json
    env_kwargs: Mapping[str, Any] = field(default_factory=dict)
    vecnormalize: Path | None = None  # statistics that were given


def find_trained(
    path: Path, algo: str | None, env_id: str | None, command: str | None, vecnormalize: Path | None = None
) -> Trained:
    """Reads what a run saved; arguments override what is found.

    :param path: the output folder of ``sb3-sap demo`` or of ``sb3-sap train``, or the .zip of any model of this package
    :raise FileNotFoundError: if there is no model
    :raise ValueError: if something is neither found nor given
    """
    from sb3_sap.algorithms import ALGORITHMS

    zoo = _zoo_run(path)
    model = path / zoo.get("model", "model.zip") if path.is_dir() else path
    if not model.is_file():
        raise FileNotFoundError(f"There is no model {model}: give the output folder of a run, or a model's .zip.")
    run, laps = zoo | _read_json(model.with_name("run.json"), {}), _read_json(model.with_name("evaluation.json"), [])
    simulator = run.get("simulator")
    given: dict[str, Any] = {
        "algo": algo or run.get("algo"),
        "env": env_id or (ENVIRONMENTS[simulator] if simulator else run.get("env")),
        "command": command or run.get("command"),
    }
    missing = [f"--{name}" for name, value in given.items() if not value]
    if missing:
        raise ValueError(f"{model} does not say how it was made: add {' and '.join(missing)}.")
    if given["algo"] not in ALGORITHMS:
        raise ValueError(f"--algo {given['algo']!r} is unknown: {nearest(given['algo'], ALGORITHMS)}")
    kwargs = run.get("env_kwargs", {})
    return Trained(model, given["algo"], given["env"], given["command"], tuple(laps), kwargs, vecnormalize)


def _zoo_run(folder: Path) -> dict[str, Any]:
    """Model, algo, env, its options and command, which RL Zoo saved in `ENV_ID/`; empty if it saved none."""
    found = next(folder.glob("*/command.txt"), None)
    if found is None:
        return {}
    words = found.read_text(encoding="utf-8").split()  # RL Zoo joins its arguments without quotes
    parser = argparse.ArgumentParser(add_help=False)
    parser.add_argument("--algo")
    parser.add_argument("--env")
    named, _ = parser.parse_known_args(words)
    # without the folders of the machine: `python /…/bin/sb3-sap train …`, or `python -m sb3_sap.zoo train …`
    words[:2] = ["python", "-m"] if words[1] == "-m" else [Path(words[1]).name]
    best = folder / "best_model.zip"
    model = best.name if best.is_file() else f"{found.parent.name}.zip"
    return {
        "model": model,
        "algo": named.algo,
        "env": named.env,
        "env_kwargs": _zoo_env_kwargs(found.parent),
        "command": shlex.join(words),
    }


def _zoo_env_kwargs(folder: Path) -> dict[str, Any]:
    """Options of the environment from the run's entry or command line, except the laps."""
    saved: dict[str, Any] = {}
    for name in ("config.yml", "args.yml"):  # RL Zoo's own files, with Python objects in them
        options = dict(yaml.unsafe_load((folder / name).read_text(encoding="utf-8"))).get("env_kwargs")
        saved = saved if options is None else dict(options)
    return {name: value for name, value in saved.items() if name != "laps"}


def prepare(trained: Trained, repo_id: str, folder: Path, n_episodes: int = 10) -> list[Path]:
    """Writes what will be uploaded into a folder, the model card last, and returns the files.

    :param n_episodes: episodes to evaluate where the run saved no laps
    """
    import stable_baselines3
    from huggingface_hub import EvalResult, ModelCard, ModelCardData
    from huggingface_hub.utils import validate_repo_id  # type: ignore[attr-defined]
    from huggingface_sb3 import EnvironmentName, ModelName

    from sb3_sap.algorithms import ALGORITHMS

    validate_repo_id(repo_id)
    class_name = ALGORITHMS[trained.algo].__name__
    filename = ModelName(trained.algo, EnvironmentName(trained.env_id)).filename
    policy = load_policy(trained.model, trained.vecnormalize)
    sources, use = {filename: trained.model}, USE
    if isinstance(policy, NormalisedPolicy):
        sources[FILE_NAME], use = policy.path, USE_NORMALISED
    sources |= {name: trained.model.with_name(name) for name in EXTRAS}
    files = []
    for name, source in sources.items():
        if source.is_file():
            with atomic_path(folder / name) as temporary:
                shutil.copyfile(source, temporary)
            files.append(folder / name)
    metric, value, results = _laps(trained) if trained.laps else _episodes(policy, trained, n_episodes)
    data = ModelCardData(
        library_name="stable-baselines3",
        license="mit",
        tags=[trained.env_id, "reinforcement-learning", "deep-reinforcement-learning", "stable-baselines3", "sb3_sap"],
        model_name=trained.algo,
        eval_results=[
            EvalResult(
                task_type="reinforcement-learning",
                dataset_type=trained.env_id,
                dataset_name=trained.env_id,
                metric_type=metric,
                metric_value=value,
            )
        ],
    )
    pictures = [name for name in EXTRAS[:3] if folder / name in files]
    text = CARD.format(
        algo=trained.algo,
        env_id=trained.env_id,
        class_name=class_name,
        pictures="".join(f"\n\n![{Path(name).stem.replace('_', ' ')}]({name})" for name in pictures),
        results=results,
        use=use.format(
            class_name=class_name,
            repo_id=repo_id,
            filename=filename,
            statistics=FILE_NAME,
            env_arguments=env_arguments(trained.env_id, trained.env_kwargs),
        ),
        predictor=PREDICTOR.format(repo_id=repo_id) if folder / "predictor.pt" in files else "",
        command=trained.command,
        version=__version__,
        sb3_version=stable_baselines3.__version__,
    )
    card = ModelCard.from_template(data, template_str=text)
    with atomic_path(folder / "README.md") as temporary:
        card.save(temporary)
    return [*files, folder / "README.md"]


def _laps(trained: Trained) -> tuple[str, str, str]:
    mean = sum(lap["score"] for lap in trained.laps) / len(trained.laps)
    rows = [f"| {lap['track']} | {lap['covered']:.1%} | {lap['score']:.3f} |" for lap in trained.laps]
    note = "One lap of each track with the policy alone; S is the total reward relative to a perfect lap."
    table = "\n".join(["| track | covered | S |", "| --- | --- | --- |", *rows])
    return "mean_score", f"{mean:.3f}", f"{note}\n\n{table}"


def _episodes(policy: BasePolicy | NormalisedPolicy, trained: Trained, n: int) -> tuple[str, str, str]:
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    env = Monitor(make_env(trained.env_id, **trained.env_kwargs))
    env.reset(seed=0)
    mean, deviation = evaluate_policy(policy, env, n)
    env.close()
    value = f"{mean:.2f} +/- {deviation:.2f}"
    return "mean_reward", value, f"Mean return of {n} episodes with the policy alone: **{value}**."


def _read_json(path: Path, default: Any) -> Any:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else default


def add_push_to_hub(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Adds ``sb3-sap push-to-hub``."""
    command = commands.add_parser(
        "push-to-hub",
        help="publish a model with its results on the Hugging Face Hub",
        description="Writes a model card with results and the command of the run, and uploads both with the model, by "
        "SB3's own integration. Log in beforehand with `hf auth login`, or set HF_TOKEN.",
    )
    command.add_argument("path", type=Path, help="the output folder of `sb3-sap demo` or `train`, or a model's .zip")
    command.add_argument("--repo-id", required=True, help="repository on the Hub, such as YOU/ddpg_ap-LaneKeeping")
    command.add_argument("--algo", help="the algorithm, where the folder does not say it")
    command.add_argument("--env", help="the environment's id, where the folder does not say it")
    command.add_argument("--command", help="the command that trained the model, where the folder does not say it")
    command.add_argument(
        "--episodes", type=positive, default=10, help="episodes to evaluate where the run saved no laps (10)"
    )
    add_vecnormalize(command)
    command.add_argument("--out", type=Path, help="folder of the files to upload; by default `hub` beside the model")
    command.add_argument("--dry-run", action="store_true", help="write the files without uploading them")
    command.set_defaults(run=_push_to_hub)


def _push_to_hub(options: argparse.Namespace, console: Console) -> int:
    try:
        from huggingface_sb3 import push_to_hub
    except ModuleNotFoundError as error:
        raise ImportError(f"The Hub's integration is not installed ({error}): pip install sb3-sap[hub].") from error
    trained = find_trained(options.path, options.algo, options.env, options.command, options.vecnormalize)
    folder = options.out or trained.model.parent / "hub"
    files = prepare(trained, options.repo_id, folder, options.episodes)
    console.print(f"{', '.join(file.name for file in files)} are in [bold]{folder}/[/]")
    if not options.dry_run:
        for file in files:  # the card comes last: once it is there, so is everything that it speaks of
            push_to_hub(options.repo_id, str(file), commit_message=f"Add {file.name}")
    return 0
