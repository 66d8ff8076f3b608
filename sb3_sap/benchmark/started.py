"""Algorithms that begin with what is known from elsewhere, for the comparison of starts."""

from __future__ import annotations

from typing import Any, Self

from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_sap.algorithms import DDPGAP, SACAP
from sb3_sap.benchmark.cloning import clone
from sb3_sap.benchmark.logs import guide, log
from sb3_sap.evaluation.environments import make_env
from sb3_sap.evaluation.laps import ENVIRONMENTS
from sb3_sap.guidance.taught_policy import CRITIC_STEPS
from sb3_sap.presets import preset
from sb3_sap.transitions.sources import batches_of, joined

#: What a run begins with: nothing; the predictor of the source, which teaches the policy; its policy, or both; its
#: transitions with their rewards; beside those a policy that imitates all of its actions, or the permissible ones, or
#: that E has taught; or the controller of the log as a guide.
STARTS = ("nothing", "predictor", "policy", "policy_predictor", "replay", "cloned", "imitated", "taught", "guided")
#: Those that teach the policy what E permits.
TAUGHT = ("predictor", "taught")
#: Where it comes from: an agent on the embedded simulator, or a log of the simulator or the task of the run itself.
SOURCES = ("embedded", "log", "wrong", "region", "random")
#: Steps of the agent.
AGENT_STEPS = 1_000
#: Timesteps for which a policy that imitates a log stays as it is, and one that E has taught.
HOLD, HOLD_TAUGHT = 150, 50


class StartedMixin:
    """Goes before a guided algorithm. Without a start other than nothing it is that algorithm.

    :param start: one of `STARTS`
    :param source: one of `SOURCES`; from a log there is no policy to take over
    :param source_simulator: that of the log of lane keeping
    """

    def __init__(
        self,
        *args: Any,
        start: str = "nothing",
        source: str = "embedded",
        source_simulator: str = "torcs",
        **kwargs: Any,
    ):
        possible = {"guided": source == "log", "policy": source == "embedded", "policy_predictor": source == "embedded"}
        if start not in STARTS or source not in SOURCES or not possible.get(start, True):
            raise ValueError(f"There is no start {start!r} from the source {source!r}.")
        self.start, self.source, self.source_simulator = start, source, source_simulator
        if start not in ("nothing", "guided"):
            kwargs |= {"learning_starts": 0, "t_k": 0}
        super().__init__(*args, **{"ap_function": "sb3_sap.envs.ap_function"} | kwargs)

    def learn(self, total_timesteps: int = 1_000, callback: MaybeCallback = None, **kwargs: Any) -> Self:
        """SB3's ``learn``, before which the start is prepared."""
        if self.num_timesteps == 0 and self.start != "nothing":  # type: ignore[attr-defined]
            self._prepare()
        return super().learn(total_timesteps, callback, **kwargs)  # type: ignore[misc, no-any-return]

    def _prepare(self: Any) -> None:
        task = self.env.get_attr("spec")[0].id
        simulator = self.source_simulator if task in ENVIRONMENTS.values() else task
        donor: Any = None
        transitions: Any
        if self.start == "guided":
            self.guide_policy = guide(simulator)
            return
        if self.source == "embedded":
            donor = agent(type(self).__mro__[2], self.seed)
            transitions = donor.replay_buffer
        else:
            transitions = log(self.source, simulator, self.seed)
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
            imitates = self.start == "imitated"
            self.teach_policy(hold=HOLD if imitates else HOLD_TAUGHT, imitate=imitates)


def agent(cls: Any, seed: int) -> Any:
    """An agent of a class after its training on the embedded simulator."""
    env = make_env(ENVIRONMENTS["highway"], track="wheel-2", laps=None)
    settings = preset("fast", cls, AGENT_STEPS) | {"ap_function": "sb3_sap.envs.ap_function"}
    return cls("MlpPolicy", env, seed=seed, device="cpu", **settings).learn(AGENT_STEPS)


class DDPGAPStarted(StartedMixin, DDPGAP):  # type: ignore[misc]
    """DDPG-AP with a start."""


class SACAPStarted(StartedMixin, SACAP):  # type: ignore[misc]
    """SAC-AP with a start."""
