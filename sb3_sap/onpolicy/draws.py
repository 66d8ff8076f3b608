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
from sb3_sap.predictor.pairs import judge


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
        #: The draws in each state of the rollout: those before they are squashed, their log-densities, E's verdicts.
        self._drawn = Remembered()

    def distribution(self, obs: Any, distribution: Distribution, executed: th.Tensor | None = None) -> Distribution:
        # The object is the policy's own, and used again.
        guided = copy.copy(distribution)
        shares: list[th.Tensor] = []
        guided.get_actions = partial(self.first_permissible, obs, distribution, shares)  # type: ignore[method-assign]
        guided.log_prob = partial(self.log_prob, obs, distribution, shares)  # type: ignore[method-assign]
        return guided

    def losses(self, obs: Any, distribution: Distribution) -> th.Tensor:
        """softplus(−E(s, mode)), the cross-entropy of the mode under E, had it been labelled permissible."""
        assert self.predictor is not None
        features = self.predictor.features(obs).detach()
        return F.softplus(-self.predictor.logits(features, self.bounds.executed(distribution.mode(), straight=True)))

    @th.no_grad()
    @flush_denormals()
    def first_permissible(
        self, obs: Any, distribution: Distribution, shares: list[th.Tensor] | None = None, deterministic: bool = False
    ) -> th.Tensor:
        """(n, action_dim). The first draw is the policy's own; the others are drawn in one call.

        :param shares: gets (n,) log Z, if all states are met for the first time
        :param deterministic: the mode, or the candidate nearest to it among stratified ones of a fixed seed
        """
        assert self.predictor is not None
        proposed = distribution.get_actions(deterministic=deterministic)
        features = self.predictor.features(obs)
        if deterministic or self.n_candidates == 1:
            candidates = proposed[:, None]
            permitted = self._permits(features, candidates)
            if self.n_candidates > 1 and not permitted.all():
                candidates = th.cat([candidates, self._around(proposed)], dim=1)
                permitted = self._permits(features, candidates)
        else:
            # In all states, because the share of them that is permitted says how dense the executed action is.
            plain, density = self._draws(distribution)
            bijector = getattr(distribution, "bijector", None)
            drawn = plain if bijector is None else bijector.forward(plain)
            candidates = th.cat([proposed[:, None], drawn], dim=1)
            permitted = self._permits(features, candidates)
            if not self.predicts:
                self._remember(obs, plain, density, permitted[:, 1:], shares)
        first = permitted.int().argmax(dim=1)  # where none is permitted, the first
        found, proposed_permitted = permitted.any(dim=1), permitted[:, 0]
        self.record("sap/rejection_rate", ~proposed_permitted)
        if self.n_candidates > 1 and not proposed_permitted.all():
            self.record("sap/fallback_rate", ~found[~proposed_permitted])
        return candidates[th.arange(len(first), device=self.device), first]

    def _remember(
        self,
        obs: Any,
        plain: th.Tensor,
        density: th.Tensor,
        permitted: th.Tensor,
        shares: list[th.Tensor] | None,
    ) -> None:
        """Keeps the draws in n states, of which those of the first time count."""
        draws = th.cat([plain.flatten(1), density, permitted.to(density.dtype)], dim=1).cpu().numpy()
        states = keys_of(obs)
        new = self._drawn.add_new(states, draws)
        if shares is not None and new:
            share = permitted.to(density.dtype).mean(dim=1)
            shares.append(th.where(share > 0, share, 1).log())

    def log_prob(self, obs: Any, distribution: Distribution, shares: list[th.Tensor], actions: th.Tensor) -> th.Tensor:
        """(n,) log π(a) − log Z of executed continuous actions, Z being estimated from the draws of the rollout.

        Z is the share of draws that E permits; in an update, where the policy has changed since they were drawn, each
        counts as much as it has become more likely, so that both sides of PPO's ratio have their Z. Without it, an
        error of the value would draw the policy towards or away from what E permits, for the expected score of the
        executed actions is ∇ log Z, and not zero (`measurements/continuous_choice.py`). Where all draws are permitted,
        or none is, so that the executed action is the policy's own, Z is 1.

        :param shares: (n,) log Z, if the draws were made from this very distribution
        """
        log_prob = distribution.log_prob(actions)
        if shares:
            return log_prob - shares[0]
        known, draws = self._drawn.known(keys_of(obs))
        n = self.n_candidates - 1
        counts = draws[:, -n:].sum(axis=1) if known else np.zeros(0)
        some = (counts > 0) & (counts < n)
        if not some.any():
            return log_prob
        rows = th.as_tensor(np.asarray(known)[some], device=log_prob.device)
        plain, density, permitted = th.as_tensor(draws[some], device=log_prob.device).tensor_split([-2 * n, -n], dim=1)
        change = _log_density(distribution, plain.reshape(len(rows), n, -1), rows) - density
        log_share = change.masked_fill(permitted < 0.5, -th.inf).logsumexp(dim=1) - math.log(n)
        return log_prob.index_add(0, rows, -log_share)

    def _permits(self, features: th.Tensor, candidates: th.Tensor) -> th.Tensor:
        """(m, N) bool, which of N actions in m states E permits."""
        assert self.predictor is not None
        m, n, dim = candidates.shape
        executed = self.bounds.executed(candidates.reshape(m * n, dim)).reshape(m, n, dim)
        return judge(self.predictor, features, executed) > 0

    def _draws(self, distribution: Any) -> tuple[th.Tensor, th.Tensor]:
        """(n, N - 1, action_dim) further draws, before they are squashed, and their log-densities, (n, N - 1)."""
        # gSDE's own noise is the same at every call: this is its distribution over many.
        mean, deviation = distribution.distribution.mean, distribution.distribution.stddev
        shape = (len(mean), self.n_candidates - 1, mean.shape[1])
        noise = th.randn(shape, generator=self._generator, device=mean.device)
        return mean[:, None] + deviation[:, None] * noise, _standard_log_density(noise, deviation)

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
    mean, deviation = normal.mean[rows], normal.stddev[rows]
    return _standard_log_density((plain - mean[:, None]) / deviation[:, None], deviation)


def _standard_log_density(noise: th.Tensor, deviation: th.Tensor) -> th.Tensor:
    """(m, N) log-densities of what (m, N, action_dim) standard normal noise draws with (m, action_dim) deviations."""
    constant = noise.shape[2] * math.log(math.sqrt(2 * math.pi))
    return -0.5 * noise.square().sum(dim=2) - (deviation.log().sum(dim=1, keepdim=True) + constant)
