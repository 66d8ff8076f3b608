"""Screens ways to use the label: a run for each task, variant and seed, and a row of JSON for each run.

    python measurements/screening.py --out results/screening/runs.jsonl --tasks lane-ddpg --variants all --seeds 100 103

Runs that the file holds are not made again. The prototypes here are not in the package; what wins is built there.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.her import HerReplayBuffer
from torch.nn import functional as F

from sb3_sap import DDPGAP, DQNAP, SACAP, TD3AP, RescaleExtractor, preset, tasks
from sb3_sap.evaluation import drive_lap
from sb3_sap.guidance.values import q_values
from sb3_sap.predictor.pairs import query_candidates
from sb3_sap.presets import load_config, settings_in


class Arm(gym.Env[Any, Any]):
    """A planar arm with a sparse reward: 1 for each step with its tip within ``near`` of the goal, for 50 steps."""

    def __init__(self, joints: int = 6, turn: float = 0.15, near: float = 0.1):
        self.joints, self.turn, self.near = joints, turn, near
        self.observation_space = gym.spaces.Box(-2, 2, (2 * joints + 4,), np.float32)
        self.action_space = gym.spaces.Box(-1, 1, (joints,), np.float32)

    def _observation(self) -> Any:
        angles = np.cumsum(self.angles)
        tip = np.array([np.cos(angles).sum(), np.sin(angles).sum()]) / self.joints
        self.distance = float(np.linalg.norm(self.goal - tip))
        return np.array([*np.cos(self.angles), *np.sin(self.angles), *tip, *(self.goal - tip)], np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self.angles = self.np_random.uniform(-0.5, 0.5, self.joints)
        direction, radius = self.np_random.uniform(-np.pi, np.pi), self.np_random.uniform(0.3, 0.9)
        self.goal = radius * np.array([np.cos(direction), np.sin(direction)])
        self.steps = 0
        return self._observation(), {}

    def step(self, action: Any) -> Any:
        self.angles = self.angles + self.turn * np.clip(action, -1, 1)
        self.steps += 1
        obs = self._observation()
        reached = self.distance < self.near
        return obs, float(reached), False, self.steps >= 50, {"is_success": reached}


def comes_no_further(obs: Any, actions: Any, next_obs: Any) -> Any:
    """Permissible: the tip is no further from the goal than before."""
    return np.linalg.norm(next_obs[:, -2:], axis=1) <= np.linalg.norm(obs[:, -2:], axis=1)


def hand_comes_no_further(obs: Any, actions: Any, next_obs: Any) -> Any:
    """Permissible: the hand is no further from the goal than before, or within the 5 cm that count as success."""
    before, after = (np.linalg.norm(o["achieved_goal"] - o["desired_goal"], axis=1) for o in (obs, next_obs))
    return (after <= before) | (after < 0.05)


def plain_dqn(env_id: str) -> dict[str, Any]:
    """The settings of a task's entry without those of guidance, for ten thousand steps."""
    own = ("ap_function", "actor_permissibility_coef", "refit_growth")
    return {key: value for key, value in settings_in(load_config("dqn_ap")[env_id]).items() if key not in own}


ARM: Any = Arm
gym.register("Arm-v0", ARM)
gym.register("Arm4-v0", ARM, kwargs={"joints": 4, "turn": 0.2, "near": 0.2})

LANE = {"env": "sap/TorcsLaneKeeping-v0", "options": {"track": "wheel-2", "laps": None}, "penalty": 50.0, "label": None}
TUNED_TD3 = {"policy_kwargs": {"net_arch": [128, 256]}, "learning_rate": 0.002, "gamma": 0.95, "tau": 0.01}
FETCH = {
    **{"policy_kwargs": {"net_arch": [64, 64]}, "learning_rate": 1e-3, "gamma": 0.95, "tau": 0.02},
    **{"batch_size": 128, "replay_buffer_class": HerReplayBuffer, "replay_buffer_kwargs": {"n_sampled_goal": 4}},
}
MCC = {"policy_kwargs": {"net_arch": [64, 64], "features_extractor_class": RescaleExtractor}}
#: Per task: class, environment, settings of the base, label, penalty c, and the steps after which it is evaluated.
TASKS: dict[str, dict[str, Any]] = {
    "lane-ddpg": {**LANE, "class": DDPGAP, "settings": {}, "evaluations": (250, 500, 1000)},
    "lane-td3": {**LANE, "class": TD3AP, "settings": {**TUNED_TD3, "batch_size": 64}, "evaluations": (250, 500, 1000)},
    "lane-sac": {**LANE, "class": SACAP, "settings": preset("tuned", "sac"), "evaluations": (250, 500, 1000)},
    "mcc-ddpg": {
        **{"env": "MountainCarContinuous-v0", "class": DDPGAP, "settings": MCC, "penalty": 1.0},
        **{"label": tasks.mountain_car_continuous, "evaluations": (500, 1000, 2000, 3000)},
    },
    "arm-td3": {
        **{"env": "Arm-v0", "class": TD3AP, "settings": {"gamma": 0.95}, "penalty": 0.05},
        **{"label": comes_no_further, "evaluations": (1000, 2000, 4000)},
    },
    "arm4-td3": {
        **{"env": "Arm4-v0", "class": TD3AP, "settings": {"gamma": 0.9, "learning_rate": 1e-3}, "penalty": 0.05},
        **{"label": comes_no_further, "evaluations": (1000, 2000, 3000)},
    },
    "mc-dqn": {
        **{"env": "MountainCar-v0", "class": DQNAP, "settings": plain_dqn("MountainCar-v0"), "penalty": 1.0},
        **{"label": tasks.mountain_car, "evaluations": (2000, 4000, 6000, 10000)},
    },
    "acro-dqn": {
        **{"env": "Acrobot-v1", "class": DQNAP, "settings": plain_dqn("Acrobot-v1"), "penalty": 1.0},
        **{"label": tasks.acrobot, "evaluations": (1000, 2000, 4000, 6000, 10000)},
    },
    "reach-td3": {
        **{"env": "FetchReach-v4", "class": TD3AP, "penalty": 0.5, "label": hand_comes_no_further},
        **{"settings": FETCH, "evaluations": (1000, 2000, 3000, 4000)},
    },
    "pend-ddpg": {
        **{"env": "Pendulum-v1", "class": DDPGAP, "settings": {"learning_rate": 1e-3}, "penalty": 2.0},
        **{"label": tasks.pendulum_torque, "evaluations": (1000, 2000, 3000, 4000)},
    },
}
#: The predictor of preset "fast".
PREDICTOR = {
    **{"refit_growth": 0.005, "dataset_size": 256, "n_candidates": 32},
    "predictor_kwargs": {"batch_size": 64, "optimizer_kwargs": {"fused": True}},
}
DISCRETE = {"actor_permissibility_coef": 1.0, "refit_growth": 0.02, "teaching_growth": 0.0}
LOSS = {"actor_permissibility_coef": 3.0, "teaching_growth": 0.0}
#: Per variant: whether E is used at all, α, settings, the penalty as a share of the task's, the coefficient of the loss
#: within the base's own actor step (`hook`), how actions are replaced (`mode`: "near" the nearest permissible of
#: candidates around the policy; "argq" the best by the critics of the policy's action and permissible ones around it),
#: the probability of uniform actions while E is inaccurate (`explore`), Gaussian noise, whether the next action of the
#: target is chosen like "argq" (`target`), and whether the loss fades with the share of labelled mistakes that the
#: critics prefer to the policy's action (`trust`).
VARIANTS: dict[str, dict[str, Any]] = {
    "base": {"off": True},
    "noise": {"off": True, "noise": 0.1},
    "pen": {"off": True, "pen": 1},
    "pen4": {"off": True, "pen": 0.25},
    "pen+noise": {"off": True, "pen": 1, "noise": 0.1},
    "fast": {"alpha": 0.9, "settings": LOSS},
    "fast+pen": {"alpha": 0.9, "settings": LOSS, "pen": 1},
    "hook": {"hook": 1.0},
    "hook+pen": {"hook": 1.0, "pen": 1},
    "hook+pen+noise": {"hook": 1.0, "pen": 1, "noise": 0.1},
    "hook3+pen+noise": {"hook": 3.0, "pen": 1, "noise": 0.1},
    "hookL+pen+noise": {"hook": 1.0, "pen": 1, "noise": 0.1, "fade": 1.0},
    "hookL+pen4+noise": {"hook": 1.0, "pen": 0.25, "noise": 0.1, "fade": 1.0},
    "hookL+spread+noise": {"hook": 1.0, "spread": 1.0, "noise": 0.1, "fade": 1.0},
    "pen4+noise": {"off": True, "pen": 0.25, "noise": 0.1},
    "spread+noise": {"off": True, "spread": 1.0, "noise": 0.1},
    "rms+noise": {"off": True, "spread": 1.0, "square": True, "noise": 0.1},
    "hookL+rms+noise": {"hook": 1.0, "spread": 1.0, "square": True, "noise": 0.1, "fade": 1.0},
    "rms4+noise": {"off": True, "spread": 0.25, "square": True, "noise": 0.1},
    "hookH+rms4+noise": {"hook": 1.0, "spread": 0.25, "square": True, "noise": 0.1, "fade": 2.0},
    "rms": {"off": True, "spread": 1.0, "square": True},
    "spread3+noise": {"off": True, "spread": 3.0, "noise": 0.1},
    "hookT+pen+noise": {"hook": 1.0, "pen": 1, "noise": 0.1, "trust": True},
    "near+pen+u": {"alpha": 0.9, "pen": 1, "mode": "near", "explore": 0.3},
    "near+pen+u+noise": {"alpha": 0.9, "pen": 1, "mode": "near", "explore": 0.3, "noise": 0.1},
    "hook+near+pen+u": {"alpha": 0.9, "hook": 1.0, "pen": 1, "mode": "near", "explore": 0.3},
    "hook+near+pen+u+noise": {"alpha": 0.9, "hook": 1.0, "pen": 1, "mode": "near", "explore": 0.3, "noise": 0.1},
    "guided": {"alpha": 0.9},
    "guided+pen": {"alpha": 0.9, "pen": 1},
    "loss": {"settings": DISCRETE},
    "loss+pen": {"settings": DISCRETE, "pen": 1},
    "guided+loss": {"alpha": 0.9, "settings": DISCRETE},
    "guided+loss+pen": {"alpha": 0.9, "settings": DISCRETE, "pen": 1},
    "argq": {"alpha": 1.0, "mode": "argq", "explore": 0.3},
    "argq+pen": {"alpha": 1.0, "mode": "argq", "pen": 1, "explore": 0.3},
    "argqT+pen": {"alpha": 1.0, "mode": "argq", "explore": 0.3, "target": True, "pen": 1},
}


def prototype(base: Any, variant: dict[str, Any]) -> Any:
    """The class of a variant."""

    class Prototype(base):  # type: ignore[misc, valid-type]
        def _setup_model(self) -> None:
            super()._setup_model()
            self.spread, self.preferred_mistakes, self.hooked = 0.0, 0.5, 0
            self.batch: Any = None
            sample = self.replay_buffer.sample

            def remember(*args: Any, **kwargs: Any) -> Any:
                drawn = sample(*args, **kwargs)
                self.batch = drawn.observations
                return drawn

            self.replay_buffer.sample = remember
            if variant.get("spread"):
                self._scale_penalty()
            if variant.get("hook"):
                self.actor.optimizer.register_step_pre_hook(self._add_loss)
            if variant.get("target"):
                self._choose_next_actions()

        def _scale_penalty(self) -> None:
            """Lets the penalty follow the standard deviation of the rewards so far, or their root mean square."""
            add, rewards = self.replay_buffer.add, [0.0, 0.0, 0.0]

            def scaled(obs: Any, next_obs: Any, action: Any, reward: Any, *args: Any, **kwargs: Any) -> None:
                for value in reward:
                    rewards[0] += 1
                    rewards[1] += float(value)
                    rewards[2] += float(value) ** 2
                mean = 0.0 if variant.get("square") else rewards[1] / rewards[0]
                c = variant["spread"] * (max(0.0, rewards[2] / rewards[0] - mean**2) ** 0.5 or 1.0)
                self.replay_buffer.shaping = replace(self.replay_buffer.shaping, penalty=c)
                add(obs, next_obs, action, reward, *args, **kwargs)

            self.replay_buffer.add = scaled

        def _mean_action(self, obs: Any) -> Any:
            self.actor.set_training_mode(False)
            stochastic = hasattr(self.actor, "action_log_prob")
            actions = self.actor(obs, deterministic=True) if stochastic else self.actor(obs)
            self.actor.set_training_mode(True)
            return actions

        @th.no_grad()
        def _measure(self) -> None:
            """The spread of Q over random actions, and how often the critics prefer a labelled mistake."""
            actions = th.rand(8, len(self.batch), self.action_space.shape[0]) * 2 - 1
            spread = th.stack([q_values(self, self.batch, a) for a in actions]).std(0).mean().item()
            self.spread = 0.9 * self.spread + 0.1 * spread if self.spread else spread
            if variant.get("trust") and self.knowledge.counts("train")[0] > 20:
                slots = self.knowledge.rng.choice(self.knowledge.parts["train"].slots(0), 128)
                obs, mistakes = (
                    th.as_tensor(a[slots]) for a in (self.knowledge.observations[""], self.knowledge.actions)
                )
                preferred = q_values(self, obs, mistakes) > q_values(self, obs, self._mean_action(obs))
                self.preferred_mistakes = 0.9 * self.preferred_mistakes + 0.1 * preferred.float().mean().item()

        def _add_loss(self, *_: Any) -> None:
            """Adds the gradient of β · spread · softplus(-E(s, μ(s))) to the base's own, before its optimizer steps."""
            if not self.predictor_accurate or self.batch is None:
                return
            if self.hooked % 10 == 0:
                self._measure()
            self.hooked += 1
            loss = F.softplus(-self.predictor(self.batch, self._mean_action(self.batch))).mean()
            loss = loss * variant["hook"] * self.spread
            if variant.get("fade"):
                done = 1 - self._current_progress_remaining
                loss = loss * max(0.0, 1 - variant["fade"] * done)
            if variant.get("trust"):
                loss = loss * max(0.0, 1 - 2 * self.preferred_mistakes)
            parameters = [p for p in self.actor.parameters() if p.requires_grad]
            for p, g in zip(parameters, th.autograd.grad(loss, parameters, allow_unused=True), strict=True):
                if g is not None:
                    p.grad = g if p.grad is None else p.grad + g

        def _around(self, mean: Any, n: int) -> Any:
            scale = np.exp(self.exploration_rng.uniform(np.log(0.03), np.log(2.0), (len(mean), n, 1)))
            noise = self.exploration_rng.standard_normal((len(mean), n, mean.shape[1]))
            return np.clip(mean[:, None] + scale * noise, -1, 1).astype(np.float32)

        @th.no_grad()
        def guide(self, actions: Any) -> Any:
            mode = variant.get("mode")
            if mode is None:
                return super().guide(actions)
            mean = actions.reshape(len(actions), -1).astype(np.float32)
            if mode != "argq" and self.exploration_rng.random() >= self.current_alpha:
                return None
            if mode == "argq" and not self.predictor_accurate:
                return None
            obs, _ = self.policy.obs_to_tensor(self._last_obs)
            features = self.predictor.features(obs)
            candidates = np.concatenate([mean[:, None], self._around(mean, 16 if mode == "argq" else 32)], axis=1)
            permitted = query_candidates(self.predictor, features, candidates) > 0
            if mode == "near":
                score = -np.linalg.norm(candidates - mean[:, None], axis=2)
                score[~permitted] = -np.inf
                score[~permitted.any(axis=1), 0] = 0
            else:
                permitted[:, 0] = True
                m, n, d = candidates.shape
                every = obs[np.repeat(np.arange(m), n)]
                score = q_values(self, every, th.as_tensor(candidates.reshape(m * n, d))).numpy().reshape(m, n)
                score[~permitted] = -np.inf
            return candidates[np.arange(len(mean)), score.argmax(axis=1)].reshape(actions.shape)

        def _choose_next_actions(self) -> None:
            """Lets the target take the best of μ'(s') and permissible actions around it."""
            forward, n = self.actor_target.forward, 4

            def best(obs: Any) -> Any:
                mean = forward(obs)
                if th.is_grad_enabled() or not self.predictor_accurate:
                    return mean
                m, d = mean.shape
                scale = th.exp(th.empty(m, n, 1).uniform_(float(np.log(0.03)), 0.0))
                around = (mean[:, None] + scale * th.randn(m, n, d)).clamp(-1, 1)
                candidates = th.cat([mean[:, None], around], dim=1)
                every, flat = obs.repeat_interleave(n + 1, 0), candidates.reshape(-1, d)
                q = th.cat(self.critic_target(every, flat), dim=1).min(1).values.reshape(m, n + 1).clone()
                own = q[:, 0].clone()
                q[self.predictor(every, flat).reshape(m, n + 1) <= 0] = -th.inf
                q[:, 0] = own
                return candidates[th.arange(m), q.argmax(1)]

            self.actor_target.forward = best

        def _sample_action(self, learning_starts: int, action_noise: Any = None, n_envs: int = 1) -> Any:
            if self.lifetime_steps < self.noise_steps:
                return super()._sample_action(learning_starts, action_noise, n_envs)
            explore = variant.get("explore", 0.0)
            if explore and not self.predictor_accurate and self.exploration_rng.random() < explore:
                uniform = self.exploration_rng.uniform(-1, 1, (n_envs, *self.action_space.shape)).astype(np.float32)
                return self.unscale_actions(uniform), uniform
            actions, scaled = super()._sample_action(learning_starts, action_noise, n_envs)
            if noise := variant.get("noise"):
                scaled = scaled + self.exploration_rng.normal(0, noise, scaled.shape)
                scaled = np.clip(scaled, -1, 1).astype(np.float32)
                actions = self.unscale_actions(scaled)
            return actions, scaled

    Prototype.__name__ = base.__name__
    return Prototype


def build(task: dict[str, Any], variant: dict[str, Any], seed: int) -> Any:
    """The model of a run."""
    alpha = variant.get("alpha", 0.0)
    own = {"refit_growth": 0.5} if variant.get("off") else {**PREDICTOR, **variant.get("settings", {})}
    settings = {**task["settings"], **own, "alpha": alpha, "alpha_low": min(alpha, 0.5)}
    settings |= {"penalty": variant.get("pen", 0) * task["penalty"], "ap_function": task["label"]}
    if task["env"].startswith("Fetch"):
        import gymnasium_robotics

        gym.register_envs(gymnasium_robotics)
    env = gym.make(task["env"], **task.get("options", {}))
    policy = "MultiInputPolicy" if isinstance(env.observation_space, gym.spaces.Dict) else "MlpPolicy"
    return prototype(task["class"], variant)(policy, env, seed=seed, device="cpu", **settings)


def evaluate(model: Any, task: dict[str, Any]) -> list[float]:
    """S of two unseen tracks, the share of thirty episodes that end in success, or the mean return of five episodes."""
    if "Lane" in task["env"]:
        return [drive_lap(model, track, "torcs").score for track in ("eroad", "g-track-3")]
    env, arm = gym.make(task["env"]), task["env"].startswith(("Arm", "Fetch"))
    values = []
    for seed in range(30 if arm else 5):
        obs, _ = env.reset(seed=10_000 + seed)
        info: dict[str, Any] = {}
        done, total = False, 0.0
        while not done:
            obs, reward, terminated, truncated, info = env.step(model.predict(obs, deterministic=True)[0])
            total, done = total + float(reward), bool(terminated or truncated)
        values.append(float(info["is_success"]) if arm else total)
    return [float(np.mean(values))]


class Evaluations(BaseCallback):
    """Collects a row at each evaluation."""

    model: Any

    def __init__(self, task: dict[str, Any]):
        super().__init__()
        self.evaluated, self.lost = task, 0
        self.rows: list[dict[str, Any]] = []

    def _on_step(self) -> bool:
        self.lost += sum(bool(info.get("off_track")) for info in self.locals["infos"])
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps not in self.evaluated["evaluations"]:
            return
        bad, good = self.model.knowledge.seen
        row = {"step": self.num_timesteps, "score": evaluate(self.model, self.evaluated), "bad": bad / (bad + good)}
        row |= {"lost": self.lost, "acc": self.model.validation_accuracy, "qs": self.model.spread}
        self.rows.append(row | {"unsound": self.model.preferred_mistakes})


def run(job: tuple[str, str, int]) -> dict[str, Any]:
    """One run; an error becomes its result."""
    task, variant, seed = job
    th.set_num_threads(1)
    warnings.simplefilter("ignore")
    begun, callback = time.time(), Evaluations(TASKS[task])
    result = {"task": task, "variant": variant, "seed": seed, "rows": callback.rows}
    try:
        build(TASKS[task], VARIANTS[variant], seed).learn(max(TASKS[task]["evaluations"]), callback)
    except Exception as error:
        return result | {"error": f"{type(error).__name__}: {error}"}
    return result | {"seconds": time.time() - begun}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--tasks", nargs="+", choices=list(TASKS), required=True)
    parser.add_argument("--variants", nargs="+", choices=[*VARIANTS, "all"], default=["all"])
    parser.add_argument("--seeds", nargs=2, type=int, metavar=("FIRST", "LAST"), required=True)
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    variants = list(VARIANTS) if "all" in options.variants else options.variants
    lines = options.out.read_text(encoding="utf-8").splitlines() if options.out.exists() else []
    done = {(r["task"], r["variant"], r["seed"]) for r in map(json.loads, lines) if "error" not in r}
    os.environ["OMP_NUM_THREADS"] = "1"  # of the processes that follow
    first, last = options.seeds
    jobs = [(t, v, s) for s in range(first, last + 1) for t in options.tasks for v in variants if (t, v, s) not in done]
    with (
        multiprocessing.get_context("spawn").Pool(options.jobs) as pool,
        options.out.open("a", encoding="utf-8") as file,
    ):
        for result in pool.imap_unordered(run, jobs):
            file.write(json.dumps(result) + "\n")
            file.flush()
            print(
                result["task"], result["variant"], result["seed"], result.get("error", result["rows"][-1:]), flush=True
            )


if __name__ == "__main__":
    main()
