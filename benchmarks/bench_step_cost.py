"""What guidance costs for each training step: every guided algorithm beside its own base at equal settings.

The two models of a pair train in turn, 50 steps at a time, on TORCS in one process and thread, so that whatever else
the machine does meets both; processor time is counted. The parts are measured inside the guided model. Below the cost
of fitting E lies that of its matrix products alone, which no other way of writing the same fit avoids.

Usage: python benchmarks/bench_step_cost.py [--steps 600] [--pairs ddpg:fast ddpg:paper …]
"""

import argparse
import inspect
import time
from collections import defaultdict
from typing import Any

import gymnasium as gym
import torch as th

import sb3_sap.exploration
from sb3_sap.benchmark.learners import algorithm_class, make_model
from sb3_sap.callbacks import PermissibilityCallback
from sb3_sap.presets import preset

PAIRS = ("ddpg:paper", "ddpg:fast", "td3:fast", "sac:fast", "tqc:fast", "crossq:fast")
CHUNK, WARM_UP = 50, 300
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
    guided: Any = sb3_sap.exploration.ActionPermissibilityMixin
    guided._guide = timed("Algorithm 1", guided._guide)
    sb3_sap.exploration.permissible_actor_step = timed("teach the actor", sb3_sap.exploration.permissible_actor_step)


def build(algo: str, settings: dict):
    env = gym.make("sap/TorcsLaneKeeping-v0", track="wheel-2", laps=None)
    known = inspect.signature(algorithm_class(algo)).parameters  # a base takes what it knows of its guided settings
    return make_model(algo, env, {name: value for name, value in settings.items() if name in known}, seed=100)


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
            if number:  # nobody asks for the gradient of the observation
                y @ weight
    return (time.process_time() - begun) / repeats


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--pairs", nargs="+", default=PAIRS)
    options = parser.parse_args()
    if options.steps < CHUNK or options.steps % CHUNK:
        parser.error(f"--steps must be a multiple of {CHUNK}, got {options.steps}.")
    th.set_num_threads(1)
    watch_the_parts()
    parts = ("fit E", "validate E", "teach the actor", "Algorithm 1")
    header = ["pair", "base, ms/step", "guided, ms/step", "ratio", *(f"{part}, ms" for part in parts)]
    print(f"| {' | '.join(header)} | E's matrix products, ms |")
    print("|" + "---|" * (5 + len(parts)))
    for pair in options.pairs:
        base, name = pair.split(":")
        settings = preset(name, f"{base}_ap", 3_000)
        models = [build(algo, settings) for algo in (base, f"{base}_ap")]
        for model in models:
            model.learn(WARM_UP)
        seconds.clear()
        predictor: Any = models[1].predictor
        fitted = int(predictor.n_updates)
        spent = [0.0, 0.0]
        for _ in range(options.steps // CHUNK):
            for number, model in enumerate(models):
                begun = time.process_time()
                model.learn(CHUNK, reset_num_timesteps=False)
                spent[number] += time.process_time() - begun
        plain, guided = (1000 * each / options.steps for each in spent)
        shares = " | ".join(f"{1000 * seconds[part] / options.steps:.2f}" for part in parts)
        batches = (int(predictor.n_updates) - fitted) / options.steps
        products = 1000 * batches * products_of_a_batch(predictor)
        print(f"| {pair} | {plain:.2f} | {guided:.2f} | {guided / plain:.2f} | {shares} | {products:.2f} |", flush=True)


if __name__ == "__main__":
    main()
