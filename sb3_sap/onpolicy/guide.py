"""The judgement of E about the actions of a policy: masks of finite actions, and the choice of continuous ones."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.distributions import Distribution
from stable_baselines3.common.logger import Logger

from sb3_sap.common.arrays import BoolArray, rows_of
from sb3_sap.common.spaces import joint_actions
from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.guidance.candidates import stratified_candidates
from sb3_sap.onpolicy.masks import MaskedDistribution, index_of, joint_log_probs
from sb3_sap.predictor.network import PermissibilityPredictor

#: Maximum number of pairs of a state and an action that E judges at once, which bounds the memory of its layers.
PAIRS_AT_ONCE = 32_768
#: Number of actions from which their share of E's first layer is computed once for all states.
MANY_ACTIONS = 64


class Guide:
    """Restricts a policy's distribution to what E and the known masks permit.

    Where E permits none of the actions that are known to be permissible, all of those are.

    :param predictor: E, which must not change while a rollout is collected and learned from; ``None``: masks alone
    :param space: the action space
    :param n_candidates: number of draws from a continuous policy, of which the first permissible one is executed
    :param squashed: whether the policy's actions are scaled to [-1, 1]
    :param device: of the policy
    :param predicts: whether ``predict`` is guided, too
    :param seed: of the further draws, which take nothing from the policy's generator
    """

    def __init__(
        self,
        predictor: PermissibilityPredictor | None,
        space: spaces.Space[Any],
        n_candidates: int,
        squashed: bool,
        device: th.device,
        predicts: bool = False,
        seed: int = 0,
    ):
        self.predictor = predictor
        self.space = space
        self.n_candidates = n_candidates
        self.squashed = squashed
        self.predicts = predicts
        #: Where rates are recorded; ``None``: nowhere.
        self.logger: Logger | None = None
        #: The known masks of the states in which actions are chosen, (n, k); ``None``: there are none, or the update
        #: evaluates actions that were chosen before.
        self.known_masks: Callable[[], BoolArray] | None = None
        self._judged: dict[bytes, int] = {}  # the row of each state in the next
        self._table: BoolArray = np.zeros((0, 0), dtype=bool)  # E's verdicts on all actions, with room for more
        self._verdicts_held = 0
        #: The known masks of the rollout's states.
        self.known: dict[bytes, BoolArray] = {}
        self._generator = th.Generator(device).manual_seed(seed)
        #: Draws from a continuous policy in each state of the rollout: what was drawn, its log-density, E's verdicts.
        self._drawn: dict[bytes, tuple[th.Tensor, th.Tensor, th.Tensor]] = {}
        self.actions: th.Tensor | None = None
        if not isinstance(space, spaces.Box):
            actions = joint_actions(space)
            self.actions = th.as_tensor(actions.reshape(len(actions), -1).astype(np.int64), device=device)

    def distribution(self, obs: Any, distribution: Distribution, executed: th.Tensor | None = None) -> Distribution:
        """A policy's distribution, guided.

        :param obs: n observation tensors
        :param distribution: of the policy in these states
        :param executed: (n, *action_shape) actions to be evaluated, which were chosen with the same E
        """
        if self.actions is None:
            # The object is the policy's own, and used again.
            guided = copy.copy(distribution)
            guided.get_actions = partial(self.first_permissible, obs, distribution)  # type: ignore[method-assign]
            guided.log_prob = partial(self.log_prob, obs, distribution)  # type: ignore[method-assign]
            return guided
        mask = self.mask(obs)
        if executed is not None:
            # Where a state is judged anew, E's verdict at the border may depend on the size of the batch.
            mask[th.arange(len(mask), device=mask.device), index_of(self.space, executed)] = True
        if mask.all():
            return distribution
        log_probs = joint_log_probs(distribution, self.actions)
        if executed is None:
            rejected = log_probs.detach().masked_fill(mask, -th.inf).exp().sum(dim=1)
            self._record("sap/rejection_rate", rejected.mean().item())
        return MaskedDistribution(log_probs, mask, self.space, self.actions)

    def mask(self, obs: Any) -> th.Tensor:
        """(n, k) bool, which of all k actions are permitted in n states."""
        assert self.actions is not None
        states = _rows_as_bytes(obs)
        known = self._known_of(states)
        if self.predictor is None:
            mask = np.ones((len(states), len(self.actions)), dtype=bool) if known is None else known
        else:
            mask = self._verdicts(obs, states)
            if known is not None:
                both = mask & known
                mask = np.where(both.any(axis=1, keepdims=True), both, known)
        return th.as_tensor(mask, device=self.actions.device)

    def _verdicts(self, obs: Any, states: list[bytes]) -> BoolArray:
        """E's masks. A state is judged once in a rollout, and keeps its mask in the update, before which E changes."""
        assert self.actions is not None
        assert self.predictor is not None
        new = [row for row, state in enumerate(states) if state not in self._judged]
        if new:
            unseen = obs if len(new) == len(states) else rows_of(obs, new)
            judged = permitted(self.predictor, unseen, self.actions).cpu().numpy()
            first = self._verdicts_held
            self._verdicts_held += len(new)
            if self._verdicts_held > len(self._table):
                more = np.zeros((self._verdicts_held, judged.shape[1]), dtype=bool)
                self._table = np.concatenate([self._table, more]) if first else more
            self._table[first : self._verdicts_held] = judged
            self._judged.update(zip((states[row] for row in new), range(first, self._verdicts_held), strict=True))
        return self._table[[self._judged[state] for state in states]]

    def _known_of(self, states: list[bytes]) -> BoolArray | None:
        """The known masks, (n, k): those of now, or in an update those of the rollout."""
        if self.known_masks is not None:
            masks = self.known_masks()
            for state, mask in zip(states, masks, strict=True):
                # What VecNormalize clips may look the same to the policy and have another mask.
                self.known[state] = mask | self.known.get(state, mask)
            return masks
        if not self.known:
            return None
        assert self.actions is not None
        anything = np.ones(len(self.actions), dtype=bool)
        unknown = [state for state in states if state not in self.known]
        if any(state.strip(b"\0") for state in unknown):  # zeros pad the sequences of recurrent policies
            raise RuntimeError(
                "The update evaluates an observation in which no action was chosen, so that its mask is not known: "
                "`permissible_actions` cannot be used with a rollout buffer that changes observations."
            )
        return np.stack([self.known.get(state, anything) for state in states])

    @th.no_grad()
    @flush_denormals()
    def first_permissible(self, obs: Any, distribution: Distribution, deterministic: bool = False) -> th.Tensor:
        """(n, action_dim) the first of ``n_candidates`` draws from a continuous policy that E permits.

        If E permits none, it is the first draw. The first draw is the policy's own; the others are drawn in one call.
        The executed action has the density π · 1[E > 0] / Z (:meth:`log_prob`).

        :param deterministic: the mode, or the candidate nearest to it among stratified ones of a fixed seed
        """
        assert self.predictor is not None
        proposed = distribution.get_actions(deterministic=deterministic)
        features = self.predictor.features(obs)
        rejected = self.predictor.logits(features, self.scaled(proposed)) <= 0
        self._record("sap/rejection_rate", rejected.float().mean().item())
        if self.n_candidates == 1:
            return proposed
        if deterministic:
            rows = rejected.nonzero().flatten()
            candidates = self._around(proposed[rows])  # (m, N, dim)
            verdicts = self._permits(features[rows], candidates)
        else:
            # In all states, because the share of them that is permitted says how dense the executed action is.
            plain = self._draws(distribution)
            bijector = getattr(distribution, "bijector", None)
            drawn = plain if bijector is None else bijector.forward(plain)
            permitted = self._permits(features, drawn)
            if not self.predicts:
                density = _log_density(distribution, plain)
                for row, state in enumerate(_rows_as_bytes(obs)):
                    self._drawn.setdefault(state, (plain[row], density[row], permitted[row]))
            rows = rejected.nonzero().flatten()
            candidates, verdicts = drawn[rows], permitted[rows]
        if len(rows) == 0:
            return proposed
        found = verdicts.any(dim=1)
        self._record("sap/fallback_rate", 1 - found.float().mean().item())
        first = verdicts.int().argmax(dim=1)
        guided = proposed.clone()
        guided[rows[found]] = candidates[found, first[found]]
        return guided

    def log_prob(self, obs: Any, distribution: Distribution, actions: th.Tensor) -> th.Tensor:
        """(n,) log π(a) − log Z of executed continuous actions, Z being estimated from the draws of the rollout.

        Z is the share of draws that E permits; in an update, where the policy has changed since they were drawn, each
        counts as much as it has become more likely, so that both sides of PPO's ratio have their Z. Without it, an
        error of the value would draw the policy towards or away from what E permits, for the expected score of the
        executed actions is ∇ log Z, and not zero (`measurements/continuous_choice.py`). Where all draws are permitted,
        or none is, so that the executed action is the policy's own, Z is 1.
        """
        log_prob = distribution.log_prob(actions)
        known = [(row, self._drawn[state]) for row, state in enumerate(_rows_as_bytes(obs)) if state in self._drawn]
        known = [(row, draws) for row, draws in known if draws[2].any() and not draws[2].all()]
        if not known:
            return log_prob
        rows = th.as_tensor([row for row, _ in known], device=log_prob.device)
        plain, density, permitted = (th.stack(parts) for parts in zip(*(draws for _, draws in known), strict=True))
        change = _log_density(distribution, plain, rows) - density
        log_share = change.masked_fill(~permitted, -th.inf).logsumexp(dim=1) - math.log(plain.shape[1])
        return log_prob.index_add(0, rows, -log_share)

    def _permits(self, features: th.Tensor, candidates: th.Tensor) -> th.Tensor:
        """(m, N) bool, which of N actions in m states E permits."""
        assert self.predictor is not None
        m, n, dim = candidates.shape
        scaled = self.scaled(candidates.reshape(m * n, dim))
        return self.predictor.logits(features.repeat_interleave(n, dim=0), scaled).reshape(m, n) > 0

    def _draws(self, distribution: Any) -> th.Tensor:
        """(n, N - 1, action_dim) further draws, before they are squashed."""
        # gSDE's own noise is the same at every call: this is its distribution over many.
        normal = distribution.distribution
        shape = (len(normal.mean), self.n_candidates - 1, normal.mean.shape[1])
        noise = th.randn(shape, generator=self._generator, device=normal.mean.device)
        return normal.mean[:, None] + normal.stddev[:, None] * noise  # type: ignore[no-any-return]

    def _around(self, proposed: th.Tensor) -> th.Tensor:
        """(m, N, action_dim) candidates from the whole space, the nearest to the proposed actions first."""
        ones = np.ones((1, proposed.shape[1]), np.float32)
        candidates = th.as_tensor(stratified_candidates(np.random.default_rng(0), -ones, ones, self.n_candidates)[0])
        candidates = candidates.to(proposed.device)
        order = th.cdist(self.scaled(proposed), candidates).argsort(dim=1)
        return candidates[order] if self.squashed else self._unscaled(candidates[order])

    def scaled(self, actions: th.Tensor) -> th.Tensor:
        """(n, action_dim) what is executed of a policy's continuous actions, scaled to [-1, 1]."""
        return actions if self.squashed else self.scaled_freely(actions).clamp(-1, 1)

    def scaled_freely(self, actions: th.Tensor) -> th.Tensor:
        """The same without the clipping to the bounds."""
        low, high = self._bounds(actions)
        return 2 * (actions - low) / (high - low) - 1

    def _unscaled(self, actions: th.Tensor) -> th.Tensor:
        low, high = self._bounds(actions)
        return low + (actions + 1) / 2 * (high - low)

    def _bounds(self, actions: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        assert isinstance(self.space, spaces.Box)
        bounds = (self.space.low.reshape(-1), self.space.high.reshape(-1))
        low, high = (th.as_tensor(bound, dtype=actions.dtype, device=actions.device) for bound in bounds)
        return low, high

    def _record(self, name: str, value: float) -> None:
        if self.logger is not None:
            self.logger.record_mean(name, value)


def _log_density(distribution: Any, plain: th.Tensor, rows: Any = slice(None)) -> th.Tensor:
    """(m, N) log-densities of (m, N, action_dim) draws, before they are squashed, in the states of ``rows``."""
    normal = distribution.distribution
    mean, deviation = normal.mean[rows, None], normal.stddev[rows, None]
    # As torch's Normal computes it, without its checks, which take longer.
    densities = -((plain - mean) ** 2) / (2 * deviation**2) - deviation.log() - math.log(math.sqrt(2 * math.pi))
    return densities.sum(dim=2)  # type: ignore[no-any-return]


def _rows_as_bytes(obs: Any) -> list[bytes]:
    """What tells each of n states from the others, for the policy, whose networks have single precision."""
    tensors = obs.values() if isinstance(obs, dict) else [obs]
    arrays = [(value.float() if value.is_floating_point() else value).cpu().numpy() for value in tensors]
    flat = [np.ascontiguousarray(array).reshape(len(array), -1).view(np.uint8) for array in arrays]
    joined = np.concatenate(flat, axis=1)
    return joined.view(f"V{joined.shape[1]}").ravel().tolist()


@th.no_grad()
@flush_denormals()
def permitted(predictor: PermissibilityPredictor, obs: Any, actions: th.Tensor) -> th.Tensor:
    """(n, k) bool, which of k actions E permits in n states; where it permits none, all.

    :param obs: n observation tensors
    :param actions: (k, action_dim)
    """
    features, k = predictor.features(obs), len(actions)
    parts = th.split(features, max(1, PAIRS_AT_ONCE // k))
    if k < MANY_ACTIONS:
        pairs = ((part.repeat_interleave(k, dim=0), actions.repeat(len(part), 1)) for part in parts)
        logits = [predictor.logits(*pair).reshape(-1, k) for pair in pairs]
    else:
        logits = predictor.logits_of_each(parts, actions)
    mask = th.cat(logits) > 0
    return mask | ~mask.any(dim=1, keepdim=True)
