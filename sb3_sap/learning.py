"""A model that learns permissibility beside acting: it owns K and E, trains them through a callback, and saves them."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import MaybeCallback
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_sap.buffers import UNKNOWN, KnowledgeMixin, guided_buffer_class, reaches_clip
from sb3_sap.callbacks import PermissibilityCallback, contains_permissibility_callback
from sb3_sap.features import with_extractor
from sb3_sap.generators import make_rng
from sb3_sap.growth import check_growth, due
from sb3_sap.knowledge import KnowledgeBuffer
from sb3_sap.permissibility import APFunction, resolve
from sb3_sap.predictor import PermissibilityPredictor
from sb3_sap.settings import SettingsMixin, check_at_least

#: Validation accuracy from which E is good enough (section 4.3).
SUFFICIENT_ACCURACY = 0.7


class LearnedPermissibilityMixin(SettingsMixin):
    """Gives an SB3 off-policy algorithm a knowledge buffer K and an AP predictor E (section 4.2).

    What is done with E is another's business: the model acts and learns as its base does.

    :param ap_function: f(s, a | s'), an :class:`~sb3_sap.permissibility.APFunction` or its dotted name. ``None``:
        the labels come from ``info["permissible"]``
    :param knowledge_buffer_size: capacity of K
    :param validation_fraction: share of K kept for validation
    :param dataset_size: N_E, size of the balanced D_E drawn for each fit
    :param validation_size: size of the balanced validation sample
    :param min_per_class: examples of each class that K must hold before E is fitted, and makes room for when it is full
    :param refit_growth: E is fitted and validated each time that the steps taken have grown by this share, for what few
        new examples can change in it is soon little, but the cost of a fit stays; 0, the paper's, at every step
    :param predictor_kwargs: arguments of :class:`~sb3_sap.predictor.PermissibilityPredictor`
    """

    def __init__(
        self,
        *args: Any,
        ap_function: APFunction | str | None = None,
        knowledge_buffer_size: int = 10_000,
        validation_fraction: float = 0.1,
        dataset_size: int = 512,
        validation_size: int = 200,
        min_per_class: int = 20,
        refit_growth: float = 0.0,
        predictor_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ):
        self.ap_function = ap_function
        self.knowledge_buffer_size = knowledge_buffer_size
        self.validation_fraction = validation_fraction
        self.dataset_size = dataset_size
        self.validation_size = validation_size
        self.min_per_class = min_per_class
        self.refit_growth = refit_growth
        self.predictor_kwargs = predictor_kwargs
        #: Balanced accuracy of E on its last validation sample; NaN before the first.
        self.validation_accuracy = float("nan")
        self._steps_of_earlier_learns = 0
        #: Whether the observations of the last training were normalised.
        self.learned_normalised = False
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        check_at_least(self, knowledge_buffer_size=4, min_per_class=1, dataset_size=2, validation_size=2)
        check_growth(self, "refit_growth")
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        # SB3 warns about any buffer class beside n_steps; the buffer above was given n_steps.
        self.replay_buffer_class = None
        # It writes n_steps and gamma into these, where they would outlive a `load` with others.
        own, self.replay_buffer_kwargs = self.replay_buffer_kwargs, dict(self.replay_buffer_kwargs)
        super()._setup_model()
        self.replay_buffer_kwargs = own
        self.replay_buffer_class = type(self.replay_buffer)
        # A network of our own must not shift the global generator, or runs would no longer compare to the base's.
        with th.random.fork_rng(devices=[]):
            th.default_generator.manual_seed(int(make_rng(self.seed, "predictor").integers(2**31)))
            self.predictor = self._make_predictor().to(self.device)

    def _make_replay_buffer(self) -> KnowledgeMixin:
        buffer_class = guided_buffer_class(self.replay_buffer_class, self.observation_space, self.n_steps)
        kwargs: dict[str, Any] = dict(self.replay_buffer_kwargs)
        if issubclass(buffer_class, NStepReplayBuffer):
            kwargs = {"n_steps": self.n_steps, "gamma": self.gamma, **kwargs}
        if issubclass(buffer_class, HerReplayBuffer):
            kwargs["env"] = self.env
        knowledge = KnowledgeBuffer(
            self.observation_space,
            int(np.prod(self.action_space.shape or (1,))),
            self.knowledge_buffer_size,
            self.validation_fraction,
            self.seed,
            self.min_per_class,
        )
        room = knowledge.parts["train"].capacity // 2
        if self.min_per_class > room:
            raise ValueError(
                f"`min_per_class` = {self.min_per_class} can never be reached: `knowledge_buffer_size` = "
                f"{self.knowledge_buffer_size} has room for {room} training examples of each class."
            )
        return buffer_class(
            self.buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            optimize_memory_usage=self.optimize_memory_usage,
            knowledge=knowledge,
            ap_function=self._resolved_ap_function(),
            **kwargs,
        )

    def _resolved_ap_function(self) -> APFunction | None:
        return None if self.ap_function is None else resolve(self.ap_function, "ap_function")

    def _make_predictor(self) -> PermissibilityPredictor:
        # Unless told otherwise E turns observations into features as the policy does.
        shared = ("features_extractor_class", "features_extractor_kwargs", "normalize_images")
        own = with_extractor(self.predictor_kwargs)
        if "features_extractor_class" in own:  # which the other's arguments would not fit
            own = {"features_extractor_kwargs": {}, **own}
        arguments = {name: getattr(self.policy, name) for name in shared} | own
        known = inspect.signature(PermissibilityPredictor).parameters
        for name in arguments.keys() - known.keys():
            raise TypeError(
                f"`predictor_kwargs` holds {name!r}, but PermissibilityPredictor takes {', '.join(list(known)[2:])}."
            )
        return PermissibilityPredictor(self.observation_space, self.action_space, **arguments)

    def set_random_seed(self, seed: int | None = None) -> None:
        super().set_random_seed(seed)
        if seed is not None and isinstance(self.replay_buffer, KnowledgeMixin):
            self.replay_buffer.knowledge.seed(seed)

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        # Installed here and not by the user, who would get the unguided algorithm by forgetting it.
        if not contains_permissibility_callback(callback):
            if not isinstance(callback, (list, BaseCallback)):
                callback = ConvertCallback(callback)
            callback = [PermissibilityCallback(), *(callback if isinstance(callback, list) else [callback])]
        return super()._init_callback(callback, progress_bar)

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if reset_num_timesteps:
            self._steps_of_earlier_learns += self.num_timesteps
        self.learned_normalised = self._vec_normalize_env is not None
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    @property
    def life_steps(self) -> int:
        """Steps taken over the model's whole life."""
        return self._steps_of_earlier_learns + self.num_timesteps

    def _store_transition(
        self,
        replay_buffer: Any,
        buffer_action: np.ndarray[Any, Any],
        new_obs: Any,
        reward: np.ndarray[Any, Any],
        dones: np.ndarray[Any, Any],
        infos: list[dict[str, Any]],
    ) -> None:
        # Of an episode's last observation VecNormalize keeps the clipped value alone, which nothing can be told from.
        if self._vec_normalize_env is not None:
            for info in infos:
                last = info.get("terminal_observation")
                if last is not None and reaches_clip(self._vec_normalize_env, last):
                    info[UNKNOWN] = True
        super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)

    def refits_due(self, before: int, now: int) -> int:
        """How many fits belong to the steps after ``before``, up to ``now``."""
        return due(self.refit_growth, before, now)

    @property
    def predictor_suffices(self) -> bool:
        """Whether E was right often enough on its last validation sample."""
        return self.validation_accuracy >= SUFFICIENT_ACCURACY

    # ---------------------------------------------------------------- saving

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        state_dicts, variables = super()._get_torch_save_params()
        return [*state_dicts, "predictor", "predictor.optimizer"], variables

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "predictor"]

    def set_parameters(
        self, load_path_or_dict: Any, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        if not isinstance(load_path_or_dict, dict):
            _, load_path_or_dict, _ = load_from_zip_file(load_path_or_dict, device=device, load_data=False)
        if exact_match and "predictor" not in load_path_or_dict:
            # Not a ValueError: `load` takes that for an old file and buries it under a KeyError.
            raise TypeError(
                f"These parameters hold no AP predictor, so a plain algorithm saved them: build {type(self).__name__} "
                "with the same settings and call `model.set_parameters(path, exact_match=False)` to go on from them."
            )
        super().set_parameters(load_path_or_dict, exact_match, device)

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        own = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded = self.replay_buffer
        if not isinstance(loaded, KnowledgeMixin):
            self.replay_buffer = own
            raise TypeError(
                f"The file holds a plain {type(loaded).__name__} without a knowledge buffer: "
                f"load one saved by {type(self).__name__}."
            )
        loaded.ap_function = self._resolved_ap_function()
