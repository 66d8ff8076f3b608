"""One run of the benchmark: everything that decides its result, and the grid of runs of several configurations."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from sb3_sap.benchmark.configurations import Configuration
from sb3_sap.benchmark.learners import algorithm_class, defaults_of, environment_of, is_on_policy, settings_of
from sb3_sap.benchmark.paper import TEST_TRACKS
from sb3_sap.benchmark.task_settings import entry, evaluations
from sb3_sap.evaluation.laps import ENVIRONMENTS

#: Training steps after which the actor drives a lap of each test track; another evaluation ends the training.
CHECKPOINTS = (100, 150, 200, 250, 350, 500, 750, 1000, 1500, 2000, 3000, 5000, 7500, 10000, 12500, 15000)
#: Options of the training environment that define the task, so that the test laps are driven with them as well.
TASK_OPTIONS = ("speed", "control_step", "car")
#: Controllers that act alike whatever the seed.
DETERMINISTIC = ("linear", "scripted")


@dataclass(frozen=True)
class Run:
    """Everything that decides the result of a run: equal runs have equal results."""

    simulator: str  # a key of `ENVIRONMENTS`, or the id of an environment beyond lane keeping
    algo: str
    settings: dict[str, Any]  # constructor arguments
    defaults: dict[str, Any]  # the constructor's defaults of all other arguments
    training: dict[str, Any]  # options of the training environment
    steps: int
    seed: int
    tracks: list[str]  # beyond lane keeping: seeds of the evaluation episodes
    checkpoints: list[int]
    at_the_end: list[str] = field(
        default_factory=list
    )  # those of the tracks that are driven at the last checkpoint only

    @property
    def task(self) -> dict[str, Any]:
        """Options of the environments in which the test laps are driven."""
        return {name: value for name, value in self.training.items() if name in TASK_OPTIONS}

    @property
    def name(self) -> str:
        """The name under which the result is stored."""
        return name_of(self.description())

    def description(self) -> dict[str, Any]:
        """The run as JSON holds it."""
        described: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        if not self.at_the_end:
            del described["at_the_end"]  # as in results that are older than this field
        return described


def name_of(description: Mapping[str, Any]) -> str:
    """The name of a run: its algorithm, a hash of its description, and its seed.

    Runs that differ only in their seed have names that differ only in the seed. The constructor's defaults are not
    hashed, because a later release may add a parameter.

    :param description: as returned by `Run.description`
    """
    text = json.dumps({**description, "seed": None, "defaults": None}, sort_keys=True)
    return f"{description['algo']}-{hashlib.sha256(text.encode()).hexdigest()[:10]}-seed{description['seed']}"


def make_run(
    configuration: Configuration,
    simulator: str,
    steps: int,
    seed: int,
    tracks: Iterable[str] = TEST_TRACKS,
    at_the_end: Iterable[str] = (),
) -> Run:
    """The run of a configuration and a seed, with the settings of its preset.

    :param simulator: a key of `ENVIRONMENTS`, or the id of an environment beyond lane keeping
    :param steps: training steps, unless the configuration has its own
    :param tracks: tracks of the test laps, or seeds of the evaluation episodes
    :param at_the_end: those of the tracks whose laps are so long that they are driven at the last checkpoint only
    :raise ValueError: if the configuration has no such algorithm, preset or setting
    """
    tracks, steps = list(tracks), configuration.run_option("steps", steps)
    settings = settings_of(configuration, simulator, steps)
    if simulator in ENVIRONMENTS:
        training = {"track": "wheel-2", "laps": None} | environment_of(configuration)
        if not configuration.learns:  # nothing is random either
            steps = seed = 0
        checkpoints = sorted({point for point in CHECKPOINTS if point < steps} | {steps})
    else:
        training = entry(configuration.algo, simulator).get("env_kwargs", {}) | environment_of(configuration)
        steps = steps if configuration.learns else 0
        checkpoints = evaluations(steps) if configuration.learns else [0]
    defaults = defaults_of(configuration, settings)
    if configuration.learns and is_on_policy(algorithm_class(configuration.algo)):
        checkpoints = _after_rollouts(checkpoints, (defaults | settings)["n_steps"])
    return Run(
        simulator,
        configuration.algo,
        settings,
        defaults,
        training,
        steps,
        seed,
        tracks,
        checkpoints,
        [track for track in at_the_end if track in tracks],
    )


def _after_rollouts(checkpoints: list[int], n_steps: int) -> list[int]:
    """The ends of the rollouts, after which an on-policy algorithm learns, that follow checkpoints; the last stays."""
    *earlier, last = checkpoints
    ends = {math.ceil(point / n_steps) * n_steps for point in earlier}
    return sorted({end for end in ends if end < last} | {last})


def make_grid(
    configurations: list[Configuration],
    simulator: str,
    steps: int,
    seeds: Iterable[int],
    tracks: Iterable[str] = TEST_TRACKS,
    at_the_end: Iterable[str] = (),
) -> dict[Configuration, list[Run]]:
    """The runs of every configuration, one for each seed; controllers that are deterministic have one run."""
    seeds, tracks = list(seeds), list(tracks)
    return {
        configuration: [
            make_run(configuration, simulator, steps, seed, tracks, at_the_end)
            for seed in (
                seeds[: configuration.run_option("seeds", len(seeds))]
                if configuration.algo not in DETERMINISTIC
                else [0]
            )
        ]
        for configuration in configurations
    }
