"""A policy that is taught before the first step, and held while the critics learn about it (not in the paper)."""

from __future__ import annotations

import itertools
import math
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger
from torch import nn

from sb3_sap.guidance.auxiliary_update import AuxiliaryLossMixin
from sb3_sap.guidance.teaching import cloning_step, taught_step, valuing_step
from sb3_sap.predictor.judging import SUFFICIENT_ACCURACY

#: Networks that are held still together.
ACTORS = ("actor", "actor_target")
#: Networks of the policy, and those of the target that follow them.
TARGETS = (("actor", "actor_target"), ("q_net", "q_net_target"), ("quantile_net", "quantile_net_target"))
#: Gradient steps of the critics on transitions that are known before the first step.
CRITIC_STEPS = 2_000
#: Gradient steps of the critics on what E says, and how much more an action is worth to them that E permits, in root
#: mean squares of the rewards.
VALUE_STEPS, WORTH = 1_000, 3.0
#: Share of the hold after which they take them, so that rewards are known.
REWARDS_SEEN = 0.1


def tensors(module: nn.Module) -> list[th.Tensor]:
    """What a module has learned: parameters and buffers."""
    return [*module.parameters(), *module.buffers()]


class TaughtPolicyMixin(AuxiliaryLossMixin):
    """Lets a policy begin with what is known to be permissible: see :meth:`teach_policy`."""

    def __init__(self, *args: Any, **kwargs: Any):
        #: Timestep, counted like ``t_k``, up to which a taught actor stays as it is; -1: it does not.
        self.held_until = -1
        #: Timestep from which on it moves as far as its gradients say.
        self.released_at = -1
        #: Timestep at which critics that know nothing learn what E says; -1: they do not.
        self.valued_at = -1
        super().__init__(*args, **kwargs)

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        if 0 <= self.valued_at <= self.lifetime_steps:
            self.valued_at = -1
            if self.predictor_accurate:
                self._teach_values()
        if self.lifetime_steps >= self.released_at:
            super().train(gradient_steps, batch_size)
            return
        # At once, the first steps of Adam would all go the same way, and past what the critics are right about.
        share = max(0, self.lifetime_steps - self.held_until) / (self.released_at - self.held_until)
        with self._held_back(share):
            super().train(gradient_steps, batch_size)

    @contextmanager
    def _held_back(self, share: float = 0.0) -> Iterator[None]:
        """At the end of the block the actor, and what entropy is worth to it, keep a share of their changes."""
        policy: Any = self.policy
        held = [parameter for name in ACTORS if hasattr(policy, name) for parameter in tensors(getattr(policy, name))]
        coef: Any = getattr(self, "log_ent_coef", None)
        held += [] if coef is None else [coef]
        before = [tensor.detach().clone() for tensor in held]
        try:
            yield
        finally:  # also where the user interrupts a training
            with th.no_grad():
                for tensor, old in zip(held, before, strict=True):
                    tensor.copy_(old.lerp(tensor, share) if share and old.is_floating_point() else old)

    def teach_policy(
        self, steps: int = 1_000, hold: int = 0, imitate: bool | None = None, critic_steps: int | None = None
    ) -> float:
        """Teaches the policy what is permissible, before the first step.

        A continuous actor imitates the permissible actions of :meth:`add_knowledge`, or else of K. If there are none,
        it moves to what E permits, no further than it demands (:func:`~sb3_sap.guidance.teaching.taught_step`), in the
        states that came with the predictor. The values of discrete actions learn to prefer what E permits
        (:func:`~sb3_sap.guidance.auxiliary_loss.preference_loss`). Target networks follow.

        Critics learn of a held actor from its own actions alone, and then believe that any other would be as good.
        Those of an actor that E has taught therefore learn first that an action which E permits is worth more than one
        which it does not, by `WORTH` times the root mean square of the first rewards.

        :param steps: gradient steps
        :param hold: timesteps from now on for which a continuous actor stays as it was taught, while the critics learn
            what its actions are worth: at first they would lead it astray
        :param imitate: whether a continuous actor imitates, or is taught by E whatever is known. ``None``: it imitates
            if permissible actions are known
        :param critic_steps: gradient steps in which the critics learn from the transitions of :meth:`add_knowledge`
            what the actions of a held actor are worth. ``None``: `CRITIC_STEPS` if it is held and the replay buffer has
            such transitions, else none
        :return: the mean loss of the last tenth of the steps of the policy
        :raise ValueError: if no state is known, or E was not fitted; to imitate, if no permissible action is known;
            for ``critic_steps``, if no transitions are known or the actor is not held
        """
        if steps < 1:
            raise ValueError(f"`steps` must be at least 1, but is {steps!r}.")
        if imitate and self.discrete:
            raise ValueError("`imitate` needs continuous actions: leave it out.")
        held = hold > 0 and not self.discrete
        knows = held and any(buffer.size() > 0 for buffer in getattr(self.replay_buffer, "prior", ()))
        if critic_steps is None:
            critic_steps = CRITIC_STEPS if knows else 0
        elif critic_steps < 0 or (critic_steps > 0 and not knows):
            raise ValueError(
                f"`critic_steps` = {critic_steps!r} needs continuous actions, a `hold` above 0 and transitions with "
                "rewards: call `add_knowledge` first, or leave it out."
            )
        if imitate is None:
            imitate = not self.discrete and self.knows_permissible
        if not imitate and self.predictor.fitted and not self.predictor_accurate:
            warnings.warn(
                f"The AP predictor teaches the policy, but its balanced accuracy is {self.validation_accuracy:.0%}, "
                f"below the {SUFFICIENT_ACCURACY:.0%} from which its verdicts are trusted: give it more labelled "
                "actions and call `fit_predictor` first.",
                stacklevel=2,
            )
        losses, n = [], self.predictor.batch_size
        lessons: Any = self.known_actions(n) if imitate else self.known_states(n)
        for lesson in itertools.islice(lessons, steps):
            if imitate:
                losses.append(cloning_step(self.actor, *lesson))
            elif self.discrete:
                losses.append(self._permissible_step(lesson, 1.0))
            else:
                losses.append(taught_step(self.actor, self.predictor, lesson))
        for own, target in TARGETS:
            if getattr(self, own, None) is not None and getattr(self, target, None) is not None:
                getattr(self, target).load_state_dict(getattr(self, own).state_dict())
        self.held_until = self.lifetime_steps + hold if held else -1
        self.released_at = self.held_until + hold if held else -1
        self.valued_at = self.lifetime_steps + math.ceil(REWARDS_SEEN * hold) if held and not (imitate or knows) else -1
        self._teach_critics(critic_steps)
        return float(np.mean(losses[-max(1, steps // 10) :]))

    def _teach_values(self) -> None:
        """Trains the critics alone, on what E says of random actions."""
        model, n = cast(Any, self), self.predictor.batch_size
        rewards = model.replay_buffer.sample(n, env=model._vec_normalize_env).rewards
        worth = WORTH * rewards.square().mean().sqrt().item()
        shape = (n, int(np.prod(cast(Any, self.action_space.shape))))
        for observations in itertools.islice(self.known_states(n), VALUE_STEPS):
            tried = self.exploration_rng.uniform(-1, 1, shape).astype(np.float32)
            valuing_step(model, self.predictor, observations, th.as_tensor(tried, device=self.device), worth)
        if getattr(model, "critic_target", None) is not None:  # CrossQ has none
            model.critic_target.load_state_dict(model.critic.state_dict())

    def _teach_critics(self, steps: int) -> None:
        """Trains the critics alone, on what is in the replay buffer."""
        model = cast(Any, self)
        outputs, updates = getattr(model, "_logger", None), self._n_updates
        model._logger = Logger(None, [])  # ``learn`` opens the outputs of the user
        try:
            for _ in range(steps):
                with self._held_back():  # after each step, because the target follows the actor
                    super(AuxiliaryLossMixin, self).train(gradient_steps=1, batch_size=self.batch_size)
        finally:
            self._n_updates = updates  # by which the auxiliary loss counts updates of the actor
            if outputs is None:
                del model._logger
            else:
                model._logger = outputs
