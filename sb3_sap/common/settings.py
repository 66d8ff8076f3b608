"""Settings of the paper that SB3's constructors lack, and SB3's settings in the form that YAML can hold."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self, cast

import torch as th
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, update_learning_rate

from sb3_sap.common.action_noise import make_action_noise
from sb3_sap.common.environment import EnvironmentMixin
from sb3_sap.common.errors import check_at_least
from sb3_sap.common.extractors import with_extractor
from sb3_sap.common.saving import SavingMixin
from sb3_sap.common.schedules import as_schedule
from sb3_sap.common.signatures import merged_signature

#: Training steps of the paper's main experiment (section 5.2).
PAPER_STEPS = 15_000


class SettingsMixin(EnvironmentMixin, SavingMixin, OffPolicyAlgorithm):
    """Goes before an SB3 off-policy algorithm in the bases of a class.

    :param actor_learning_rate: learning rate of the actor, a number or an SB3 schedule; the paper's is a tenth of the
        critic's (section 5.1). ``None``: ``learning_rate``. A schedule may be written as in YAML:
        ``"lin_0.001"`` falls linearly from 0.001 to 0 over the training
    :param action_noise: besides an SB3 ``ActionNoise``, its description as YAML can write it:
        ``{"type": "normal", "sigma": 0.1}`` or ``{"type": "ornstein-uhlenbeck", "sigma": 0.3, "theta": 0.6, "dt": 1}``
    :param policy_kwargs: SB3's; ``features_extractor_class`` may be a dotted name
    """

    #: Settings that may be numbers, schedules or ``"lin_<number>"``.
    schedules: ClassVar[tuple[str, ...]] = ("learning_rate", "actor_learning_rate")

    def __init__(
        self,
        policy: Any,
        env: Any,
        *args: Any,
        actor_learning_rate: float | Schedule | str | None = None,
        **kwargs: Any,
    ):
        self.actor_learning_rate: Any = actor_learning_rate
        # Copies, because SB3 writes into these dictionaries.
        kwargs["replay_buffer_kwargs"] = dict(kwargs.get("replay_buffer_kwargs") or {})
        kwargs["policy_kwargs"] = with_extractor(kwargs.get("policy_kwargs"))
        super().__init__(policy, env, *args, **kwargs)

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        if any(base is OnPolicyAlgorithm for base in cls.__mro__):
            raise TypeError(
                f"{cls.__name__} puts {cls.__bases__[0].__name__} before an on-policy algorithm, which has no replay "
                "buffer to learn from: choose an off-policy one, such as SAC or DQN."
            )
        # The constructors pass *args and **kwargs on; editors and API pages should show the whole list.
        cls.__signature__ = merged_signature(cls)  # type: ignore[attr-defined]

    def _setup_model(self) -> None:
        # Here and not in the constructor, because `load(**kwargs)` bypasses the constructor.
        check_at_least(self, buffer_size=1, batch_size=1, n_steps=1)
        for name in self.schedules:
            setattr(self, name, as_schedule(getattr(self, name), name))
        action_noise: Any = self.action_noise
        if isinstance(action_noise, Mapping):
            self.action_noise = make_action_noise(action_noise, self.action_space)
        elif action_noise is not None and not isinstance(action_noise, ActionNoise):
            raise TypeError(
                f"`action_noise` must be an ActionNoise of SB3's or its description, such as "
                f'{{"type": "normal", "sigma": 0.1}}, but is {action_noise!r}.'
            )
        elif isinstance(action_noise, VectorizedActionNoise) and action_noise.n_envs != self.n_envs:
            # The model was saved with another number of environments: SB3 wraps the noise anew when it learns.
            self.action_noise = action_noise.base_noise
        super()._setup_model()
        if self.discrete and self.actor_learning_rate is not None:
            raise ValueError(
                f"`actor_learning_rate` = {self.actor_learning_rate!r}, but {type(self).__name__} has no actor: "
                "set `learning_rate`."
            )

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        super()._update_learning_rate(optimizers)
        if self.actor_learning_rate is None:
            return
        rate = FloatSchedule(self.actor_learning_rate)(self._current_progress_remaining)
        update_learning_rate(cast(Any, self.actor).optimizer, rate)
        self.logger.record("train/actor_learning_rate", rate)

    def learn(
        self,
        total_timesteps: int = PAPER_STEPS,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str | None = None,
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """SB3's ``learn``; without arguments it runs the paper's 15,000 steps."""
        if self.env is None:
            raise ValueError("This model has no environment to learn in: load it with one, or call `set_env` first.")
        return super().learn(
            total_timesteps,
            callback,
            log_interval,
            tb_log_name or type(self).__name__,
            reset_num_timesteps,
            progress_bar,
        )
