"""Rollouts of a guided on-policy algorithm, and its predictions."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar, cast

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_sap.guidance.masks import known_masks_of, masks_at
from sb3_sap.onpolicy.choosing import make_guide
from sb3_sap.onpolicy.guide import Guide
from sb3_sap.onpolicy.known import KnownMasks
from sb3_sap.onpolicy.labels import LabelCallback, shaped_rewards
from sb3_sap.onpolicy.policy import GuidedPolicyMixin
from sb3_sap.onpolicy.settings import OnPolicySettingsMixin


class GuidedRolloutsMixin(OnPolicySettingsMixin):
    """Guides the policy while a rollout is collected, and in ``predict``."""

    _of_this_process: ClassVar[tuple[str, ...]] = (
        *OnPolicySettingsMixin._of_this_process,
        "_label_callback",
        "_rollout_guide",
    )

    def __init__(self, *args: Any, **kwargs: Any):
        self._rollout_guide: Guide | None = None  # of the rollout in progress, and thus of its update
        self._label_callback = LabelCallback()
        super().__init__(*args, **kwargs)

    def collect_rollouts(self, env: VecEnv, callback: BaseCallback, rollout_buffer: Any, n_rollout_steps: int) -> Any:
        """SB3's ``collect_rollouts``, guided while E is accurate, with the labels' share in the stored rewards."""
        asks = bool(self.alpha) and self._judges
        # Of K's generator, which is saved with the model.
        draws = asks and isinstance(self.action_space, spaces.Box)
        seed = int(self.knowledge.rng.integers(2**31)) if draws else 0
        guided = asks or self._permissible_actions is not None
        guide = self._rollout_guide = self._guide(asks, seed=seed) if guided else None
        self.logger.record("sap/alpha", float(asks))
        with self._guided_by(guide), shaped_rewards(rollout_buffer, self._label_callback):
            if guide is not None and (source := self._permissible_actions) is not None:
                guide.known.now = lambda: known_masks_of(source, self.action_space, self.raw_last_obs())
            try:
                return super().collect_rollouts(env, callback, rollout_buffer, n_rollout_steps)
            finally:
                if guide is not None:
                    guide.known.now = None

    @property
    def _judges(self) -> bool:
        """Whether E is accurate enough for anything to follow its verdicts."""
        return self.predictor.fitted and self.predictor_accurate

    def _guide(
        self, asks: bool = True, predicts: bool = False, seed: int = 0, known: KnownMasks | None = None
    ) -> Guide:
        """:param asks: whether E is asked; else there are known masks alone"""
        guide = make_guide(self, self.predictor if asks else None, known, predicts, seed)
        guide.logger = None if predicts else self.logger
        return guide

    @contextmanager
    def _guided_by(self, guide: Guide | None) -> Iterator[None]:
        """Within the block, the policy is guided; ``None``: it is not."""
        policy = cast(GuidedPolicyMixin, self.policy)
        before, policy.guide = policy.guide, guide
        try:
            yield
        finally:
            policy.guide = before

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray[Any, Any], ...] | None = None,
        episode_start: np.ndarray[Any, Any] | None = None,
        deterministic: bool = False,
        guided: bool | None = None,
    ) -> tuple[np.ndarray[Any, Any], tuple[np.ndarray[Any, Any], ...] | None]:
        """SB3's ``predict``.

        ``permissible_actions`` hold here, too.

        :param guided: restrict the policy to what E permits, as soon as E was fitted; by default where its rollouts
            are masked, for finite actions with ``alpha=1`` while E is accurate: an action that was masked has no
            gradient, so that the policy alone might take one that it never tried
        """
        if guided is None:
            guided = bool(self.alpha) and self._judges and not isinstance(self.action_space, spaces.Box)
        asks, source = guided and self.predictor.fitted, self._permissible_actions
        if not asks and source is None:
            return super().predict(observation, state, episode_start, deterministic)
        guide = self._guide(asks, predicts=True)
        if source is not None:
            masks = masks_at(self, source, observation)
            guide.known.now = lambda: masks
        with self._guided_by(guide):
            return super().predict(observation, state, episode_start, deterministic)
