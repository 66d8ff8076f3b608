"""Settings of the paper that SB3's constructors lack, and conveniences shared by every algorithm here."""

from __future__ import annotations

import difflib
import inspect
import re
import warnings
from collections.abc import Callable, Mapping
from io import BufferedIOBase
from numbers import Integral, Real
from pathlib import Path
from typing import Any, ClassVar, Self, cast

import cloudpickle
import numpy as np
import torch as th
from gymnasium import spaces
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.noise import (
    ActionNoise,
    NormalActionNoise,
    OrnsteinUhlenbeckActionNoise,
    VectorizedActionNoise,
)
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule, LinearSchedule, update_learning_rate
from stable_baselines3.common.vec_env import VecEnv

from sb3_sap.action_spaces import check_action_space, check_observation_space
from sb3_sap.features import with_extractor
from sb3_sap.vec_envs import channels_last, check_wrappers

#: Training steps of the paper's main experiment (section 5.2).
PAPER_STEPS = 15_000
#: RL Zoo's way to write a schedule that falls evenly to 0.
LINEAR = r"lin_\d+\.?\d*(e-?\d+)?"
#: Arguments that are functions of the user's.
FUNCTIONS = ("ap_function", "constraint", "permissible_actions")
#: Settings of SB3's whose effect a saved file holds, in a built network or the state of an optimizer.
HELD = ("ent_coef", "use_sde")
NOISES: dict[str, Callable[..., ActionNoise]] = {
    "normal": NormalActionNoise,
    "ornstein-uhlenbeck": OrnsteinUhlenbeckActionNoise,
}


class SettingsMixin(OffPolicyAlgorithm):
    """Goes before an SB3 off-policy algorithm in the bases of a class.

    :param actor_learning_rate: of the actor alone, a number or an SB3 schedule; the paper's actor learns ten times
        slower than its critic (section 5.1). ``None``: ``learning_rate``. A schedule may be written as in YAML, too:
        ``"lin_0.001"`` falls evenly from 0.001 to 0 over the training
    :param action_noise: besides an SB3 ``ActionNoise``, its description as YAML can write it:
        ``{"type": "normal", "sigma": 0.1}`` or ``{"type": "ornstein-uhlenbeck", "sigma": 0.3, "theta": 0.6, "dt": 1}``
    :param policy_kwargs: SB3's; ``features_extractor_class`` may be a dotted name
    """

    #: Whether the algorithm chooses among finitely many actions; known of SB3's and sb3-contrib's bases.
    discrete: ClassVar[bool] = False
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
        self._held: dict[str, Any] = {}
        #: The images that the environment gives channels last, and the user's functions see so.
        self.images: tuple[str, ...] = ()
        if env is not None:
            env = maybe_make_env(env, kwargs.get("verbose", 0))
            check_action_space(type(self).__name__, env.action_space, self.discrete)
            check_observation_space(type(self).__name__, env.observation_space)
            if policy == "MultiInputPolicy" and not isinstance(env.observation_space, spaces.Dict):
                raise ValueError(
                    f"`policy` 'MultiInputPolicy' is for Dict observations, but these are {env.observation_space}: use "
                    "'MlpPolicy', or 'CnnPolicy' for images."
                )
        # SB3 writes into the dictionaries that it is given.
        kwargs["replay_buffer_kwargs"] = dict(kwargs.get("replay_buffer_kwargs") or {})
        kwargs["policy_kwargs"] = with_extractor(kwargs.get("policy_kwargs"))
        try:
            super().__init__(policy, env, *args, **kwargs)
        except AssertionError as error:
            if "NatureCNN" not in str(error):
                raise
            raise ValueError(
                f"`policy` {policy!r} is for images (uint8, from 0 to 255), but the observations are "
                f"{env.observation_space}: use 'MlpPolicy', or a `features_extractor_class` of your own."
            ) from error

    def __init_subclass__(cls, **kwargs: Any):
        super().__init_subclass__(**kwargs)
        if any(base is OnPolicyAlgorithm for base in cls.__mro__):
            raise TypeError(
                f"{cls.__name__} puts {cls.__bases__[0].__name__} before an on-policy algorithm, which has no replay "
                "buffer to learn from: choose an off-policy one, such as SAC or DQN."
            )
        if issubclass(cls, (DQN, QRDQN)):
            cls.discrete = True
        # The constructors here pass *args and **kwargs on; editors and API pages show the whole list.
        cls.__signature__ = merged_signature(cls)  # type: ignore[attr-defined]

    def _setup_model(self) -> None:
        # Here and not in the constructor, which what `load` is given passes by.
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
            # Saved with other environments: SB3 makes one for these when it learns.
            self.action_noise = action_noise.base_noise
        held = {name: getattr(self, name) for name in HELD if hasattr(self, name)}
        for name in held:
            if self._held.get(name, held[name]) != held[name]:
                raise ValueError(
                    f"`{name}` = {held[name]!r} cannot be changed by `load`, because the file holds what {name} = "
                    f"{self._held[name]!r} has become: leave it out, or build a new {type(self).__name__}."
                )
        self._held = held
        self._look_at(self.env)
        self._unsaved = [name for name in FUNCTIONS if not can_be_pickled(getattr(self, name, None))]
        for name in self._unsaved:
            warnings.warn(
                f"`{name}` {getattr(self, name)!r} cannot be pickled, so that saved models will not hold it: give a "
                f"function of a module or its dotted name, or pass it again, `load(path, {name}=...)`.",
                stacklevel=2,
            )
        super()._setup_model()
        if self.discrete and self.actor_learning_rate is not None:
            raise ValueError(
                f"`actor_learning_rate` = {self.actor_learning_rate!r}, but {type(self).__name__} has no actor: "
                "set `learning_rate`."
            )

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *self._unsaved]

    def _look_at(self, env: VecEnv | None) -> None:
        """Takes from an environment's wrappers what the user's functions have to see."""
        if env is not None:
            check_wrappers(env)
            self.images = channels_last(env)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        super().set_env(env, force_reset)
        self._look_at(self.env)

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

    @classmethod
    def load(
        cls,
        path: str | Path | BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """SB3's ``load``, which says so when a file was cut short, and heeds a new ``seed``."""
        known = inspect.signature(cls).parameters
        for name in kwargs.keys() - known.keys():
            if near := difflib.get_close_matches(name, known, n=1, cutoff=0.75):
                raise TypeError(f"`load` was given the unknown setting `{name}`: did you mean `{near[0]}`?")
        try:
            model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except AssertionError as error:
            # Cut short behind one of torch's files, which are archives themselves, a file still passes for an archive.
            if "in the saved file" not in str(error):
                raise
            raise ValueError(
                f"The file {path} holds no whole model: was it cut short, or not written by save?"
            ) from error
        except (KeyError, AttributeError) as error:
            raise ValueError(
                f"The file {path} holds no model that {cls.__name__} can take over ({error}): load it with "
                "the class that saved it."
            ) from error
        if kwargs.get("seed") is not None:
            model.set_random_seed(kwargs["seed"])  # in place of the generators that the file holds
        return model


def can_be_pickled(value: Any) -> bool:
    """Whether a saved model can hold a value."""
    try:
        cloudpickle.dumps(value)
    except Exception:  # whatever an object's own pickling raises
        return False
    return True


def check_at_least(model: Any, **minima: int) -> None:
    """Refuses settings of a model that are no whole numbers, or too small."""
    for name, minimum in minima.items():
        value = getattr(model, name)
        if not isinstance(value, Integral) or value < minimum:
            raise ValueError(f"`{name}` must be a whole number of at least {minimum}, but is {value!r}.")


def as_schedule(value: Any, argument: str) -> Any:
    """A number or schedule as it is; of RL Zoo's ``"lin_<number>"`` the schedule that falls from that number to 0.

    :param argument: the name of the constructor argument, for the error message
    """
    if isinstance(value, Real) or callable(value) or (value is None and argument == "actor_learning_rate"):
        return value
    if not (isinstance(value, str) and re.fullmatch(LINEAR, value)):
        raise ValueError(f'`{argument}` must be a number, a schedule or "lin_<number>", but is {value!r}.')
    return LinearSchedule(float(value.removeprefix("lin_")), 0.0, 1.0)


def make_action_noise(description: Mapping[str, Any], action_space: spaces.Space[Any]) -> ActionNoise:
    """Builds the noise that a mapping describes, with the dimension of the action space."""
    settings = dict(description)
    kind = settings.pop("type", None)
    if kind not in NOISES:
        raise ValueError(f"`action_noise` has type {kind!r}, but must be one of {', '.join(map(repr, NOISES))}.")
    if "sigma" not in settings:
        raise ValueError("`action_noise` needs 'sigma', the scale of the noise in scaled actions (-1 to 1).")
    if not np.all(np.isreal(settings["sigma"])) or np.any(np.asarray(settings["sigma"]) < 0):
        raise ValueError(f"`action_noise`: 'sigma' must be a number of at least 0, but is {settings['sigma']!r}.")
    ones = np.ones(action_space.shape or ())
    mean = settings.pop("mean", 0.0) * ones
    try:
        return NOISES[kind](mean, settings.pop("sigma") * ones, **settings)
    except TypeError as error:
        raise ValueError(f"`action_noise` of type {kind!r}: {error}.") from error


def merged_signature(cls: type) -> inspect.Signature:
    """The parameters of every ``__init__`` along the MRO, as far as ``**kwargs`` carries them on."""
    found: dict[str, inspect.Parameter] = {}
    for base in cls.__mro__:
        if "__init__" not in vars(base):
            continue
        parameters = list(inspect.signature(vars(base)["__init__"]).parameters.values())[1:]
        passes_on = any(p.kind is p.VAR_KEYWORD for p in parameters)
        for parameter in parameters:
            # What a mixin adds is keyword-only; its other parameters are those it hands to SB3.
            if not passes_on or parameter.kind is parameter.KEYWORD_ONLY:
                found.setdefault(parameter.name, parameter)
        if not passes_on:
            break
    return inspect.Signature(sorted(found.values(), key=lambda parameter: parameter.kind))
