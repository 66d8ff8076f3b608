"""Uses the package and every extra with the lowest versions that setup.cfg admits: `make lowest` runs this.

pytest does not collect it, since it needs an environment of its own, which it first compares with the bounds.
"""

import os
import subprocess
import sys
import tempfile
import time
from importlib import metadata
from pathlib import Path

import gymnasium as gym
import torch as th
from packaging.requirements import Requirement
from packaging.version import Version
from stable_baselines3.common.monitor import Monitor

import sb3_sap
from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.check.check import check_permissibility
from sb3_sap.cli.main import main
from sb3_sap.evaluation import make_env
from sb3_sap.guidance.mixin import ActionPermissibilityMixin
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS
from sb3_sap.plots import plot_permissibility, return_curves, save
from sb3_sap.tasks import fetch_reach

ROOT = Path(__file__).resolve().parents[1]
LANE = "sap/LaneKeeping-v0"
MOUNTAIN_CAR = "sb3_sap.tasks.mountain_car"
STEPS = 200


def versions():
    """Installed versions are the lower bounds; only torch may be newer, because its old builds are large."""
    newer = []
    declared = {line.partition(";")[0] for line in metadata.requires("sb3-sap")}  # without the extras' markers
    for requirement in map(Requirement, sorted(declared)):
        [bound] = [one.version for one in requirement.specifier if one.operator == ">="]
        installed = metadata.version(requirement.name)
        print(f"{requirement.name} {installed}")
        if requirement.name != "torch" and Version(installed) != Version(bound):
            newer.append(f"{requirement.name}: {installed} is installed, but {bound} is admitted")
    assert not newer, "\n".join(newer)


def algorithms():
    """Each algorithm learns; a guided one fits its predictor, and is saved, loaded and plotted."""
    for name, algorithm in ALGORITHMS.items():
        discrete = name in ("dqn_ap", "qrdqn_ap")
        env = gym.make("MountainCar-v0", max_episode_steps=50) if discrete else gym.make(LANE)
        settings = {"learning_starts": 50, "policy_kwargs": {"net_arch": [16]}, "tensorboard_log": "boards"}
        guided = issubclass(algorithm, ActionPermissibilityMixin)
        if guided:
            settings |= {
                "dataset_size": 32,
                "min_per_class": 2,
                "refit_growth": 0.05,
                "predictor_kwargs": {"net_arch": [16]},
            }
            settings |= {"ap_function": MOUNTAIN_CAR if discrete else None}  # lane keeping labels its steps itself
        model = algorithm("MlpPolicy", Monitor(env, f"monitors/{name}"), seed=1, **settings).learn(STEPS)
        model.save(name)
        loaded = algorithm.load(name)
        assert loaded.num_timesteps == STEPS
        if guided:
            save(plot_permissibility(loaded), Path(f"{name}.png"))
    save(return_curves({name: f"monitors/{name}" for name in ("dqn_ap", "qrdqn_ap")}), Path("returns.png"))
    assert not check_permissibility(gym.make("MountainCar-v0"), MOUNTAIN_CAR).advice


def on_policy():
    """Each on-policy algorithm learns, and is saved and loaded."""
    for name, algorithm in ON_POLICY_ALGORITHMS.items():
        policy = "MlpLstmPolicy" if "lstm" in name else "MlpPolicy"
        settings = {"n_steps": 50, "min_per_class": 2}
        if not name.startswith("trpo"):  # which takes no loss
            settings["permissibility_coef"] = 1.0
        algorithm(policy, gym.make(LANE), seed=1, **settings).learn(STEPS).save(name)
        assert algorithm.load(name).num_timesteps == STEPS


def robotics():
    """A task of gymnasium-robotics can be made and labelled."""
    env = make_env("FetchReach-v4")
    before, _ = env.reset(seed=0)
    after, *_ = env.step(env.action_space.sample())
    obs, next_obs = ({key: value[None] for key, value in side.items()} for side in (before, after))
    assert fetch_reach(obs, env.action_space.sample()[None], next_obs).shape == (1,)


def minigrid():
    """A task of MiniGrid can be made, and labels its actions."""
    env = gym.make("sap/MiniGrid-v0", task="Empty-5x5")
    env.reset(seed=0)
    assert [env.step(action)[4]["permissible"] for action in (0, 2)] == [True, False]


def commands():
    """The commands that each extra is for, as a user types them."""
    lane = ["--algo", "ddpg_ap", "--env", LANE, "-n", str(STEPS)]
    grid = ["--simulator", "highway", "--steps", "100", "--seeds", "1", "--tracks", "g-track-3", "--out", "results"]
    study = ["--storage", "study.log", "--study-name", "lowest", "--max-total-trials", "2", "--n-evaluations", "1"]
    compared = ["--ap-function", MOUNTAIN_CAR, "--steps", "60", "--seeds", "2", "--episodes", "1"]
    for line in (
        ["demo", "--steps", "300"],
        ["push-to-hub", "demo_output", "--repo-id", "me/car", "--dry-run"],
        ["train", *lane, "-P", "--eval-freq", "100", "--eval-episodes", "1"],
        ["plot", "train", "-a", "ddpg_ap", "-e", LANE, "-f", "logs", "-w", "1", "--save-figures", "figures"],
        ["optimize", *lane, *study, "--guidance-only", "--eval-episodes", "1"],
        ["compare", "MountainCar-v0", *compared],
        ["benchmark", "run", *grid, "--configurations", "ddpg_ap:fast", "sbx_sac:default"],
        ["benchmark", "summary", *grid, "--configurations", "ddpg_ap:fast", "sbx_sac:default"],
    ):
        assert main(line) == 0, line


def cluster():
    """The benchmark on Dask, and the driver of PostgreSQL, whose server is not needed for that."""
    import distributed
    import psycopg

    assert psycopg.pq.__impl__ == "binary"
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as local:
        workers = ["--backend", "dask", "--scheduler", local.scheduler_address]
        grid = ["--simulator", "highway", "--steps", "50", "--seeds", "1", "--tracks", "g-track-3", "--out", "cluster"]
        assert main(["benchmark", "run", *grid, "--configurations", "ddpg", *workers]) == 0


def tools():
    """The site, and tests with the plugins that they need."""
    for module in (
        ["sphinx", "-q", "-W", "--keep-going", "-b", "html", ROOT / "docs", "site"],
        ["pytest", "-q", "-n", "1", "-p", "no:cacheprovider", ROOT / "tests" / "predictor" / "test_knowledge.py"],
        # Tables, Parquet, Minari and `imitation`.
        ["pytest", "-q", "-n", "1", "-p", "no:cacheprovider", ROOT / "tests" / "transitions"],
    ):
        subprocess.run([sys.executable, "-m", *map(str, module)], check=True)


if __name__ == "__main__":
    th.set_num_threads(1)
    print(f"sb3_sap {sb3_sap.__version__} with Python {sys.version.split()[0]}, torch {th.__version__}")
    versions()
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for check in (algorithms, on_policy, robotics, minigrid, commands, cluster, tools):
            print(f"\n== {check.__doc__}", flush=True)
            begin = time.monotonic()
            check()
            print(f"== {time.monotonic() - begin:.0f} s", flush=True)
        os.chdir(ROOT)
