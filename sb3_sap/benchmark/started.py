"""Algorithms that begin with what is known from elsewhere, for the comparison of starts."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Self

import numpy as np
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_sap.algorithms import DDPGAP, SACAP
from sb3_sap.benchmark.cloning import clone
from sb3_sap.benchmark.linear import GAINS, LinearFeedback
from sb3_sap.evaluation.environments import make_env
from sb3_sap.evaluation.laps import ENVIRONMENTS
from sb3_sap.guidance.taught_policy import CRITIC_STEPS
from sb3_sap.presets import preset
from sb3_sap.transitions.batch import Transitions
from sb3_sap.transitions.sources import batches_of, joined

#: What a run begins with: nothing; the predictor of the source, which teaches the policy; its policy, or both; its
#: transitions with their rewards; beside those a policy that imitates all of its actions, or the permissible ones, or
#: that E has taught.
STARTS = ("nothing", "predictor", "policy", "policy_predictor", "replay", "cloned", "imitated", "taught")
#: Those that teach the policy what E permits.
TAUGHT = ("predictor", "taught")
#: Where it comes from: an agent on the embedded simulator; on the simulator of the run itself a linear controller with
#: noise, the same with one label in ten wrong, the same without steps left of the centre line, or random actions.
SOURCES = ("embedded", "log", "wrong", "region", "random")
#: Steps of the agent, and of the logs.
AGENT_STEPS, LOG_STEPS = 1_000, 20_000
#: Standard deviation of the noise of the linear controller.
NOISE = 0.3
#: Timesteps for which a policy that was taught or cloned stays as it is.
HOLD = 150


class StartedMixin:
    """Goes before a guided algorithm. Without a start other than nothing it is that algorithm.

    :param start: one of `STARTS`
    :param source: one of `SOURCES`; from a log there is no policy to take over
    :param source_simulator: that of the log
    """

    def __init__(
        self,
        *args: Any,
        start: str = "nothing",
        source: str = "embedded",
        source_simulator: str = "torcs",
        **kwargs: Any,
    ):
        if start not in STARTS or source not in SOURCES or (source != "embedded" and "policy" in start):
            raise ValueError(f"There is no start {start!r} from the source {source!r}.")
        self.start, self.source, self.source_simulator = start, source, source_simulator
        if start != "nothing":
            kwargs |= {"learning_starts": 0, "t_k": 0}
        if start in TAUGHT:  # on design seeds they lapsed once the loss had faded
            kwargs |= {"permissibility_coef": 1.0}
        super().__init__(*args, ap_function="sb3_sap.envs.ap_function", **kwargs)  # type: ignore[call-arg]

    def learn(self, total_timesteps: int = 1_000, callback: MaybeCallback = None, **kwargs: Any) -> Self:
        """SB3's ``learn``, before which the start is prepared."""
        if self.num_timesteps == 0 and self.start != "nothing":  # type: ignore[attr-defined]
            self._prepare()
        return super().learn(total_timesteps, callback, **kwargs)  # type: ignore[misc, no-any-return]

    def _prepare(self: Any) -> None:
        donor: Any = None
        transitions: Any
        if self.source == "embedded":
            donor = agent(type(self).__mro__[2], self.seed)
            transitions = donor.replay_buffer
        else:
            transitions = log(self.source, self.source_simulator, self.seed)
        if "policy" in self.start and donor is not None:
            self.policy.load_state_dict(donor.policy.state_dict())
        if self.start == "cloned":
            self.add_knowledge(transitions, into="replay")
            clone(self, joined(list(batches_of(transitions))))
            self.held_until, self.released_at = HOLD, 2 * HOLD
            self._teach_critics(CRITIC_STEPS)
            return
        if self.start in ("replay", "imitated", "taught"):
            self.add_knowledge(transitions, into="replay" if self.start == "replay" else "both")
        elif donor is None:
            self.add_knowledge(transitions, into="knowledge")
        if self.start in ("imitated", "taught") or (donor is None and self.start == "predictor"):
            self.fit_predictor()
        elif "predictor" in self.start:
            donor.fit_predictor()
            self.predictor_kwargs: Any = {}
            self.set_predictor(donor.predictor)
        if self.start in (*TAUGHT, "imitated"):
            self.teach_policy(hold=HOLD, imitate=self.start == "imitated")


def agent(cls: Any, seed: int) -> Any:
    """An agent of a class after its training on the embedded simulator."""
    env = make_env(ENVIRONMENTS["highway"], track="wheel-2", laps=None)
    settings = preset("fast", cls, AGENT_STEPS) | {"ap_function": "sb3_sap.envs.ap_function"}
    return cls("MlpPolicy", env, seed=seed, device="cpu", **settings).learn(AGENT_STEPS)


def log(kind: str, simulator: str, seed: int) -> Transitions:
    """What a linear controller with noise, or random actions, did on a simulator."""
    env, rng = make_env(ENVIRONMENTS[simulator], track="wheel-2", laps=None), np.random.default_rng([seed, 28])
    driver, rows = LinearFeedback(**GAINS[simulator]), []
    obs, _ = env.reset(seed=seed)
    for _ in range(LOG_STEPS):
        action = driver.predict(obs)[0] + rng.normal(0, NOISE, 1) if kind != "random" else rng.uniform(-1, 1, 1)
        action = np.clip(action, -1, 1).astype(np.float32)
        next_obs, reward, terminated, truncated, info = env.step(action)
        rows.append(
            (obs, action, next_obs, reward, terminated or truncated, truncated and not terminated, info["permissible"])
        )
        obs = env.reset()[0] if terminated or truncated else next_obs
    env.close()
    columns = [np.array(column) for column in zip(*rows, strict=True)]
    made = Transitions(*columns)
    if kind == "wrong":
        return replace(made, labels=np.logical_xor(columns[-1], rng.random(len(made)) < 0.1))
    return made.rows(np.asarray(made.obs)[:, 1] <= 0) if kind == "region" else made


class DDPGAPStarted(StartedMixin, DDPGAP):  # type: ignore[misc]
    """DDPG-AP with a start."""


class SACAPStarted(StartedMixin, SACAP):  # type: ignore[misc]
    """SAC-AP with a start."""
