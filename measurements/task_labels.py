"""What the labels of three tasks refuse of a good policy, which no label has influenced, and of random actions.

    python measurements/task_labels.py

The good policies are a proportional controller of the hand (FetchReach), pure pursuit of the middle of the lane on a
racetrack without other cars, and the shortest way through an empty grid.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_sap import tasks
from sb3_sap.evaluation import make_env
from sb3_sap.presets import load_config

#: Seeds of the episodes.
SEEDS = range(100, 110)
#: Distance ahead of the point that is pursued, m.
AHEAD = 4.0
#: Turn right once, after five steps forward.
WAY = [2] * 5 + [1] + [2] * 5

Policy = Callable[[Any, Any, int], Any]  # of the environment, the observation and the step


def reach(env: Any, obs: Any, step: int) -> Any:
    """Moves the hand straight to its goal."""
    gap = obs["desired_goal"] - obs["achieved_goal"]
    return np.append(np.clip(10 * gap, -1, 1), 0).astype(np.float32)


def pursue(env: Any, obs: Any, step: int) -> Any:
    """Steers on the circle through a point on the middle of the lane ahead."""
    car, network = env.unwrapped.vehicle, env.unwrapped.road.network
    lane, index = car.lane, car.lane_index
    along = lane.local_coordinates(car.position)[0] + AHEAD
    while along > lane.length:
        along -= lane.length
        index = network.next_lane(index, None, car.position, np.random.RandomState(0))
        lane = network.get_lane(index)
    way = np.array(lane.position(along, 0)) - car.position
    curvature = 2 * np.sin(np.arctan2(way[1], way[0]) - car.heading) / np.linalg.norm(way)
    slip = np.arcsin(np.clip(curvature * car.LENGTH / 2, -1, 1))  # highway-env's bicycle model
    return np.clip(np.arctan(2 * np.tan(slip)) / (np.pi / 4), -1, 1).reshape(1).astype(np.float32)


def walk(env: Any, obs: Any, step: int) -> Any:
    """The shortest way to the goal of Empty-8x8."""
    return WAY[step]


def one_row(obs: Any) -> Any:
    """A batch of one observation."""
    return {key: value[None] for key, value in obs.items()} if isinstance(obs, dict) else obs[None]


def refused(env_id: str, options: dict[str, Any], policy: Policy | None, label: Any) -> tuple[float, float]:
    """Share of a policy's actions that are refused, and its mean return; without a policy, of random actions."""
    env = make_env(env_id, **options)
    labels: list[Any] = []
    returns = []
    for seed in SEEDS:
        obs, _ = env.reset(seed=seed)
        actions = env.action_space
        actions.seed(seed)
        done, total, step = False, 0.0, 0
        while not done:
            action = actions.sample() if policy is None else policy(env, obs, step)
            next_obs, reward, terminated, truncated, info = env.step(action)
            if label is None:
                labels.append(info["permissible"])
            else:
                before, after = (one_row(side) for side in (obs, next_obs))
                labels.append(np.all(label(before, np.asarray(action)[None], after)))
            obs, done, total, step = next_obs, terminated or truncated, total + float(reward), step + 1
        returns.append(total)
    return 1 - float(np.mean(labels)), float(np.mean(returns))


def main() -> None:
    """Prints a row for each label."""
    track = load_config("sac_ap")["racetrack-v0"]["env_kwargs"]
    empty = {"config": {**track["config"], "other_vehicles": 0}}
    print("label | refused of a good policy | its mean return | refused of random actions", flush=True)
    for name, env_id, options, policy, label in (
        ("fetch_reach", "FetchReach-v4", {}, reach, tasks.fetch_reach),
        ("fetch_reach_axes", "FetchReach-v4", {}, reach, tasks.fetch_reach_axes),
        ("racetrack", "racetrack-v0", empty, pursue, tasks.racetrack),
        ("sap/MiniGrid-v0", "sap/MiniGrid-v0", {"task": "Empty-8x8"}, walk, None),
    ):
        good, total = refused(env_id, options, policy, label)
        random, _ = refused(env_id, options, None, label)
        print(f"{name} | {good:.1%} | {total:.2f} | {random:.1%}", flush=True)


if __name__ == "__main__":
    main()
