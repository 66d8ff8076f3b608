"""Of a policy's continuous actions, the first draw that E permits."""

from __future__ import annotations

import copy
import math
from functools import partial
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.distributions import Distribution
from torch.nn import functional as F

from sb3_sap.common.torch_utils import flush_denormals
from sb3_sap.guidance.candidates import stratified_candidates
from sb3_sap.onpolicy.bounds import Bounds
from sb3_sap.onpolicy.guide import Guide
from sb3_sap.onpolicy.states import Remembered, keys_of


class DrawingGuide(Guide):
    """Executes the first of ``n_candidates`` draws from a continuous policy that E permits.

    If E permits none, it is the first draw. The executed action has the density π · 1[E > 0] / Z (:meth:`log_prob`).

    :param n_candidates: number of draws
    :param squashed: whether the policy's actions are scaled to [-1, 1]
    :param seed: of the further draws, which take nothing from the policy's generator
    """

    def __init__(self, *args: Any, n_candidates: int, squashed: bool, seed: int = 0, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.n_candidates = n_candidates
        self.bounds = Bounds(self.space, squashed, self.device)
        self._generator = th.Generator(self.device).manual_seed(seed)
        #: Draws in each state of the rollout of which E permits some and rejects some: those before they are squashed,
        #: their log-densities, and E's verdicts.
        self._drawn = Remembered()

    def distribution(self, obs: Any, distribution: Distribution, executed: th.Tensor | None = None) -> Distribution:
        # The object is the policy's own, and used again.
        guided = copy.copy(distribution)
        guided.get_actions = partial(self.first_permissible, obs, distribution)  # type: ignore[method-assign]
        guided.log_prob = partial(self.log_prob, obs, distribution)  # type: ignore[method-assign]
        return guided

    def losses(self, obs: Any, distribution: Distribution) -> th.Tensor:
        """softplus(−E(s, mode)), the cross-entropy of the mode under E, had it been labelled permissible."""
        assert self.predictor is not None
        features = self.predictor.features(obs).detach()
        return F.softplus(-self.predictor.logits(features, self.bounds.executed(distribution.mode(), straight=True)))

    @th.no_grad()
    @flush_denormals()
    def first_permissible(self, obs: Any, distribution: Distribution, deterministic: bool = False) -> th.Tensor:
        """(n, action_dim). The first draw is the policy's own; the others are drawn in one call.

        :param deterministic: the mode, or the candidate nearest to it among stratified ones of a fixed seed
        """
        assert self.predictor is not None
        proposed = distribution.get_actions(deterministic=deterministic)
        features = self.predictor.features(obs)
        if deterministic or self.n_candidates == 1:
            permitted = self._permits(features, proposed[:, None])
            candidates = proposed[:, None]
            if self.n_candidates > 1 and not permitted.all():
                candidates = th.cat([candidates, self._around(proposed)], dim=1)
                permitted = self._permits(features, candidates)
        else:
            # In all states, because the share of them that is permitted says how dense the executed action is.
            plain = self._draws(distribution)
            bijector = getattr(distribution, "bijector", None)
            drawn = plain if bijector is None else bijector.forward(plain)
            candidates = th.cat([proposed[:, None], drawn], dim=1)
            permitted = self._permits(features, candidates)
            if not self.predicts:
                self._remember(obs, distribution, plain, permitted[:, 1:])
        rejected = ~permitted[:, 0]
        self.record("sap/rejection_rate", rejected)
        if rejected.any() and self.n_candidates > 1:
            self.record("sap/fallback_rate", ~permitted[rejected].any(dim=1))
        # Where none is permitted, the first.
        return candidates[th.arange(len(candidates), device=self.device), permitted.int().argmax(dim=1)]

    def _remember(self, obs: Any, distribution: Distribution, plain: th.Tensor, permitted: th.Tensor) -> None:
        some = permitted.any(dim=1) & ~permitted.all(dim=1)
        if not some.any():
            return
        density = _log_density(distribution, plain)
        found = th.cat([plain.flatten(1), density, permitted.to(density.dtype)], dim=1)[some].cpu().numpy()
        states = [state for state, kept in zip(keys_of(obs), some.tolist(), strict=True) if kept]
        self._drawn.rows(states, lambda new: found[new])

    def log_prob(self, obs: Any, distribution: Distribution, actions: th.Tensor) -> th.Tensor:
        """(n,) log π(a) − log Z of executed continuous actions, Z being estimated from the draws of the rollout.

        Z is the share of draws that E permits; in an update, where the policy has changed since they were drawn, each
        counts as much as it has become more likely, so that both sides of PPO's ratio have their Z. Without it, an
        error of the value would draw the policy towards or away from what E permits, for the expected score of the
        executed actions is ∇ log Z, and not zero (`measurements/continuous_choice.py`). Where all draws are permitted,
        or none is, so that the executed action is the policy's own, Z is 1.
        """
        log_prob = distribution.log_prob(actions)
        known, draws = self._drawn.known(keys_of(obs))
        if not known:
            return log_prob
        rows, n = th.as_tensor(known, device=log_prob.device), self.n_candidates - 1
        plain, density, permitted = th.as_tensor(draws, device=log_prob.device).tensor_split([-2 * n, -n], dim=1)
        change = _log_density(distribution, plain.reshape(len(rows), n, -1), rows) - density
        log_share = change.masked_fill(permitted < 0.5, -th.inf).logsumexp(dim=1) - math.log(n)
        return log_prob.index_add(0, rows, -log_share)

    def _permits(self, features: th.Tensor, candidates: th.Tensor) -> th.Tensor:
        """(m, N) bool, which of N actions in m states E permits."""
        assert self.predictor is not None
        m, n, dim = candidates.shape
        executed = self.bounds.executed(candidates.reshape(m * n, dim))
        return self.predictor.logits(features.repeat_interleave(n, dim=0), executed).reshape(m, n) > 0

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
        order = th.cdist(self.bounds.executed(proposed), candidates).argsort(dim=1)
        return self.bounds.of_policy(candidates[order])


def _log_density(distribution: Any, plain: th.Tensor, rows: Any = slice(None)) -> th.Tensor:
    """(m, N) log-densities of (m, N, action_dim) draws, before they are squashed, in the states of ``rows``."""
    normal = distribution.distribution
    mean, deviation = normal.mean[rows, None], normal.stddev[rows, None]
    # As torch's Normal computes it, without its checks, which take longer.
    densities = -((plain - mean) ** 2) / (2 * deviation**2) - deviation.log() - math.log(math.sqrt(2 * math.pi))
    return densities.sum(dim=2)  # type: ignore[no-any-return]
