"""Labels the steps of a rollout, and adds what they are worth to the rewards that are learned from."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.callbacks import BaseCallback

from sb3_sap.common.arrays import BoolArray, FloatArray, copy_observation
from sb3_sap.predictor.labelling import set_row, take_in


class LabelCallback(BaseCallback):
    """Adds each executed action to K. An on-policy model of this package adds one automatically.

    SB3 calls ``on_step`` after the environment's step and before the transition is stored, with all that a label needs
    among its local variables.
    """

    model: Any  # an OnPolicyPermissibilityMixin

    def __init__(self) -> None:
        super().__init__()
        #: (n_envs,) labels of each step of the rollout; empty if there are none.
        self.labels: list[BoolArray] = []
        #: What the last step adds to the rewards that are learned from, (n_envs,); ``None``: nothing.
        self.added: FloatArray | None = None

    def _on_rollout_start(self) -> None:
        self.labels = []

    def _on_step(self) -> bool:
        model, normalize = self.model, self.model.get_vec_normalize_env()
        infos, rewards = self.locals["infos"], self.locals["rewards"]
        if normalize is None:
            obs, new_obs = model._last_obs, self.locals["new_obs"]
        else:
            obs, new_obs = model._last_original_obs, normalize.get_original_obs()
            rewards = normalize.get_original_reward()
            model._last_original_obs = new_obs  # SB3 updates it for off-policy algorithms alone
        next_obs = copy_observation(new_obs)
        for i, info in enumerate(infos):
            # Under VecNormalize `take_in` finds the raw one.
            if "terminal_observation" in info and normalize is None:
                set_row(next_obs, i, info["terminal_observation"])
        actions = self.locals["clipped_actions"]
        if isinstance(model.action_space, spaces.Box):
            actions = model.policy.scale_action(actions)
        labels, added = take_in(
            model.labelled, model.action_space, obs, next_obs, actions, rewards, self.locals["dones"], infos
        )
        if labels is not None:
            self.labels.append(labels)
        if added is not None and normalize is not None and normalize.norm_reward:
            added = normalize.normalize_reward(rewards + added) - normalize.normalize_reward(rewards)
        self.added = added
        return True


@contextmanager
def shaped_rewards(rollout_buffer: RolloutBuffer, labels: LabelCallback) -> Iterator[None]:
    """Within the block, the rollout buffer stores rewards with what the labels add.

    The array that SB3 passes on stays as it is: other callbacks may read it, VecNormalize may hold it, and it may be of
    whole numbers, which cannot take a fraction.
    """
    add = rollout_buffer.add

    def shaped_add(obs: Any, action: Any, reward: Any, *args: Any, **kwargs: Any) -> None:
        add(obs, action, reward if labels.added is None else reward + labels.added, *args, **kwargs)

    rollout_buffer.add = shaped_add  # type: ignore[method-assign]
    try:
        yield
    finally:
        del rollout_buffer.add
