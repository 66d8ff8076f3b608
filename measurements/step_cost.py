"""Measures what guidance costs per training step: every guided algorithm beside its base with the same settings.

The first table has the settings of presets; with ``--bare`` it has the defaults of the constructors, SB3's and ours.

The two models of a pair train in turn, 50 steps at a time, on TORCS in one process and thread, so that other work on
the machine affects both. Processor time is measured over the whole training but its first 50 steps, whose actions are
random. The parts are measured inside the guided model. The matrix products of E are a lower bound of the cost of
fitting it, which no other implementation of the same fit avoids.

python measurements/step_cost.py [--pairs ddpg:fast 'td3:fast[teaching_growth=0]' …]   # writes .csv and .md
python measurements/step_cost.py --bare   # writes a further .csv and the second table of the .md
"""

import argparse
import inspect
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import gymnasium as gym
import pandas as pd
import torch as th

from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.benchmark.configurations import Configuration, parse_configuration
from sb3_sap.benchmark.learners import algorithm_class, make_model, settings_of
from sb3_sap.benchmark.provenance import provenance
from sb3_sap.benchmark.reports.pages import markdown, write_csv, write_text
from sb3_sap.guidance import auxiliary_update
from sb3_sap.guidance.mixin import ActionPermissibilityMixin
from sb3_sap.predictor.callbacks import PermissibilityCallback

PAIRS = (
    *("ddpg:paper", "ddpg:fast", "td3:fast", "sac:fast", "tqc:fast", "crossq:fast"),
    *("td3:fast[teaching_growth=null]", "sac:fast[teaching_growth=0]"),
    *(f"{algo}:base+loss" for algo in ("ddpg", "td3", "sac", "tqc")),
)
#: Bases for ``--bare``; those with discrete actions learn MountainCar, the others lane keeping on TORCS.
BARE = ("ddpg", "td3", "sac", "tqc", "crossq", "dqn", "qrdqn")
HEADINGS = ("# With the settings of presets", "# As the constructors give them")
CHUNK = 50
PARTS = ("fit E", "validate E", "auxiliary loss", "Algorithm 1")
seconds: defaultdict[str, float] = defaultdict(float)


def timed(name, function):
    def wrapper(*args, **kwargs):
        begun = time.process_time()
        try:
            return function(*args, **kwargs)
        finally:
            seconds[name] += time.process_time() - begun

    return wrapper


def watch_the_parts() -> None:
    callback: Any = PermissibilityCallback
    callback.fit = timed("fit E", callback.fit)
    callback.validate = timed("validate E", callback.validate)
    guided: Any = ActionPermissibilityMixin
    guided.guide = timed("Algorithm 1", guided.guide)
    auxiliary_update.permissible_actor_step = timed("auxiliary loss", auxiliary_update.permissible_actor_step)


def build(algo: str, settings: dict):
    env = gym.make("sap/TorcsLaneKeeping-v0", track="wheel-2", laps=None)
    known = inspect.signature(algorithm_class(algo)).parameters  # a base has no settings of guidance
    return make_model(algo, env, {name: value for name, value in settings.items() if name in known}, seed=100)


def build_bare(algo: str) -> Any:
    guided: Any = ALGORITHMS[f"{algo.removesuffix('_ap')}_ap"]
    cls = guided if algo.endswith("_ap") else guided.__bases__[-1]
    if guided.discrete:
        labels = {"ap_function": "sb3_sap.tasks.mountain_car"} if cls is guided else {}
        return cls("MlpPolicy", gym.make("MountainCar-v0"), seed=100, **labels)
    return cls("MlpPolicy", gym.make("sap/TorcsLaneKeeping-v0", track="wheel-2", laps=None), seed=100)


def see_the_whole(model: Any, steps: int) -> None:
    """Schedules see the whole training, not the chunk of it that is being measured."""

    def update(done: int, _: int) -> None:
        model._current_progress_remaining = 1 - done / steps

    model._update_current_progress_remaining = update


def products_of_a_batch(predictor: Any, repeats: int = 200) -> float:
    """Seconds of the matrix products in one gradient step of E: forward, and backward by weights and by inputs."""
    layers = [layer.weight.detach() for layer in predictor.head if isinstance(layer, th.nn.Linear)]
    inputs = [th.rand(predictor.batch_size, weight.shape[1]) for weight in layers]
    outputs = [th.rand(predictor.batch_size, weight.shape[0]) for weight in layers]
    begun = time.process_time()
    for _ in range(repeats):
        for number, (weight, x, y) in enumerate(zip(layers, inputs, outputs, strict=True)):
            x @ weight.t()
            y.t() @ x
            if number:  # the gradient of the observation is not needed
                y @ weight
    return (time.process_time() - begun) / repeats


def measure(pair: str, steps: int) -> dict[str, object]:
    """One row: milliseconds per step of both models, and of the parts of the guided one."""
    if pair in BARE:
        models = [build_bare(algo) for algo in (pair, f"{pair}_ap")]
    else:
        base = parse_configuration(pair)
        guided = Configuration(f"{base.algo}_ap", base.preset, base.overrides)
        settings = settings_of(guided, "torcs", steps)
        models = [build(algo, settings) for algo in (base.algo, guided.algo)]
    for model in models:
        see_the_whole(model, steps)
    spent = [0.0, 0.0]
    seconds.clear()
    for done in range(0, steps, CHUNK):
        for number, model in enumerate(models):
            begun = time.process_time()
            model.learn(CHUNK, reset_num_timesteps=done == 0)
            spent[number] += (time.process_time() - begun) * (done > 0)  # the first steps are random
    predictor: Any = models[1].predictor
    seconds["E's matrix products"] = int(predictor.n_updates) * products_of_a_batch(predictor)
    alone, with_e = (1000 * each / (steps - CHUNK) for each in spent)
    row: dict[str, object] = {"pair": pair, "base, ms": f"{alone:.2f}", "guided, ms": f"{with_e:.2f}"}
    row["ratio"] = f"{with_e / alone:.2f}"
    return row | {f"{part}, ms": f"{1000 * seconds[part] / steps:.2f}" for part in (*PARTS, "E's matrix products")}


def replace_section(path: Path, number: int, text: str) -> None:
    """Writes one of the two tables of the page and keeps the other."""
    page = path.read_text(encoding="utf-8") if path.is_file() else ""
    first, _, second = page.partition(f"{HEADINGS[1]}\n\n")
    sections = [first.removeprefix(f"{HEADINGS[0]}\n\n").strip(), second.strip()]
    sections[number] = text.strip()
    write_text(path, "\n\n".join(part for pair in zip(HEADINGS, sections, strict=True) for part in pair) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--pairs", nargs="+", default=PAIRS)
    parser.add_argument("--bare", action="store_true", help=f"the defaults of {', '.join(BARE)} instead")
    parser.add_argument("--out", type=Path, default=Path("results/step_cost.csv"))
    options = parser.parse_args()
    if options.steps < 2 * CHUNK or options.steps % CHUNK:
        parser.error(f"--steps must be a multiple of {CHUNK}, from {2 * CHUNK} on, got {options.steps}.")
    th.set_num_threads(1)
    watch_the_parts()
    rows = []
    csv = options.out.with_stem(f"{options.out.stem}_bare") if options.bare else options.out
    for pair in BARE if options.bare else options.pairs:
        rows.append(measure(pair, options.steps))
        print(rows[-1], flush=True)
        table, made = pd.DataFrame(rows), provenance()
        write_csv(csv, table)
        of = f"{options.steps:,} steps, on {made['machine']}, {made['date']}, revision {made['revision']}."
        replace_section(
            options.out.with_suffix(".md"), options.bare, f"{markdown(table)}\nProcessor time of a step over {of}\n"
        )


if __name__ == "__main__":
    main()
