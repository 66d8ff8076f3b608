"""Adds labels, the knowledge buffer K (saved with the replay buffer) and the AP predictor E (saved with the model)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, cast

import torch as th
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_sap.common.errors import check_at_least
from sb3_sap.common.functions import resolve
from sb3_sap.common.reward_shaping import Potential, RewardShaping
from sb3_sap.common.watching import WatchedEnvironmentMixin
from sb3_sap.permissibility import APFunction, does_not_lower
from sb3_sap.predictor.buffers import KnowledgeMixin, check_fits
from sb3_sap.predictor.building import make_predictor, make_replay_buffer
from sb3_sap.predictor.callbacks import PermissibilityCallback, contains_permissibility_callback
from sb3_sap.predictor.knowledge import KnowledgeBuffer
from sb3_sap.predictor.network import SUFFICIENT_ACCURACY
from sb3_sap.predictor.optimizer_state import check_same_optimizer, settings_of
from sb3_sap.predictor.schedule import check_growth, due


class LearnedPermissibilityMixin(WatchedEnvironmentMixin):
    """Gives an SB3 off-policy algorithm a knowledge buffer K and an AP predictor E (section 4.2).

    Only trains the predictor; action selection and policy updates are those of the base algorithm.

    :param ap_function: f(s, a | s'), an :class:`~sb3_sap.permissibility.APFunction` or its dotted name. ``None``:
        the labels come from ``potential`` if there is one, else from ``info["permissible"]``
    :param penalty: c, subtracted from the reward of a non-permissible action in the replay buffer alone: logged returns
        and evaluations have the reward of the environment. ``"auto"``: the root mean square of the rewards so far,
        ``"auto_0.5"``: half of it
    :param potential: Φ, a :class:`~sb3_sap.common.reward_shaping.Potential` or its dotted name: γ Φ(s') - Φ(s) is added
        to the reward in the replay buffer alone, and without an ``ap_function`` an action is permissible if it does
        not lower Φ
    :param knowledge_buffer_size: capacity of K
    :param validation_fraction: share of K kept for validation
    :param dataset_size: N_E, size of the balanced D_E drawn for each fit
    :param validation_size: size of the balanced validation sample
    :param min_per_class: examples of each class that K must hold before E is fitted, and for which a full K makes room
    :param refit_growth: refit and validate E when the step count has grown by this fraction, because a few new
        examples change it less and less, while a fit costs the same; 0 (paper): every step, or as often as
        ``predictor_gradient_steps`` says
    :param predictor_gradient_steps: maximum number of fits after each rollout, like ``gradient_steps`` of the base
        algorithm; -1: one for each vectorised step. ``None``: as many as the base's gradient steps, which for DQN
        are fewer than its timesteps; no maximum if ``refit_growth`` is above 0
    :param predictor_kwargs: arguments of :class:`~sb3_sap.predictor.network.PermissibilityPredictor`
    """

    def __init__(
        self,
        *args: Any,
        ap_function: APFunction | str | None = None,
        penalty: float | str = 0.0,
        potential: Potential | str | None = None,
        knowledge_buffer_size: int = 10_000,
        validation_fraction: float = 0.1,
        dataset_size: int = 512,
        validation_size: int = 200,
        min_per_class: int = 20,
        refit_growth: float = 0.0,
        predictor_gradient_steps: int | None = None,
        predictor_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ):
        self.ap_function = ap_function
        self.penalty = penalty
        self.potential = potential
        self.knowledge_buffer_size = knowledge_buffer_size
        self.validation_fraction = validation_fraction
        self.dataset_size = dataset_size
        self.validation_size = validation_size
        self.min_per_class = min_per_class
        self.refit_growth = refit_growth
        self.predictor_gradient_steps = predictor_gradient_steps
        self.predictor_kwargs = predictor_kwargs
        #: Balanced accuracy of E on its last validation sample; NaN before the first.
        self.validation_accuracy = float("nan")
        self._steps_of_earlier_learns = 0
        #: A typical raw observation of the training, noted when the model is saved.
        self.typical_observation: Any = None
        #: Describes the architecture of the predictor, whose saved weights fit no other.
        self._predictor_architecture: dict[str, Any] = {}
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        check_at_least(self, knowledge_buffer_size=4, min_per_class=1, dataset_size=2, validation_size=2)
        check_growth(self, "refit_growth")
        if self.predictor_gradient_steps is not None:
            check_at_least(self, predictor_gradient_steps=-1)
        if self.replay_buffer is None:
            self.replay_buffer = make_replay_buffer(self)
        # SB3 warns of a buffer class together with `n_steps`, which the buffer above has been given.
        self.replay_buffer_class = None
        # SB3 writes `n_steps` and `gamma` into this dictionary, where they would override those of a later `load`.
        given, self.replay_buffer_kwargs = self.replay_buffer_kwargs, dict(self.replay_buffer_kwargs)
        super()._setup_model()
        self.replay_buffer_kwargs = given
        self.replay_buffer_class = type(self.replay_buffer)
        self._set_label_source(cast(KnowledgeMixin, self.replay_buffer))
        self.predictor, self._predictor_architecture = make_predictor(self, self._predictor_architecture)

    @property
    def knowledge(self) -> KnowledgeBuffer:
        """K, which is filled by the replay buffer and saved with it."""
        return cast(KnowledgeMixin, self.replay_buffer).knowledge

    def _set_label_source(self, buffer: KnowledgeMixin) -> None:
        """Sets where a replay buffer takes its labels from, and what it adds to the reward."""
        potential = None if self.potential is None else resolve(self.potential, "potential")
        own = None if potential is None else does_not_lower(potential)
        buffer.ap_function = own if self.ap_function is None else resolve(self.ap_function, "ap_function")
        buffer.shaping = RewardShaping(self.penalty, potential, self.gamma)
        if buffer.shaping.penalises and buffer.ap_function is None and isinstance(buffer, HerReplayBuffer):
            raise ValueError(
                f"`penalty` = {self.penalty!r} needs an `ap_function` beside {type(buffer).__name__}, for a hindsight "
                'goal has no label in `info["permissible"]`: pass the AP function itself.'
            )
        buffer.images = self.images
        # With `permissible_actions` a model may do without labels of executed actions, but a penalty needs them.
        buffer.needs_labels = buffer.shaping.penalises or getattr(self, "permissible_actions", None) is None

    def set_random_seed(self, seed: int | None = None) -> None:
        super().set_random_seed(seed)
        if seed is not None and isinstance(self.replay_buffer, KnowledgeMixin):
            self.knowledge.seed(seed)

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        # Added here, because a user who forgot it would silently train the unguided algorithm.
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
        # The buffer of a copied model has lost its AP function.
        self._set_label_source(cast(KnowledgeMixin, self.replay_buffer))
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    @property
    def lifetime_steps(self) -> int:
        """Timesteps over the model's whole life, including those of earlier calls of ``learn``."""
        return self._steps_of_earlier_learns + self.num_timesteps

    def refits_due(self, before: int, now: int) -> int:
        """The number of fits that are due for the vectorised steps after ``before``, up to ``now``."""
        return due(self.refit_growth, before, now)

    @property
    def fits_per_rollout(self) -> float:
        """The maximum number of fits after a rollout."""
        steps: float | None = self.predictor_gradient_steps
        if steps is None:
            # At least one, for a base algorithm that does not train at all.
            steps = max(1, self.gradient_steps) if self.refit_growth == 0 <= self.gradient_steps else -1
        return steps if steps >= 0 else math.inf

    @property
    def predictor_accurate(self) -> bool:
        """Whether E passed the gate of section 4.3 on its last validation sample."""
        return self.validation_accuracy >= SUFFICIENT_ACCURACY

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        super().set_env(env, force_reset)
        self._set_label_source(cast(KnowledgeMixin, self.replay_buffer))

    # ---------------------------------------------------------------- saving

    def save(self, path: Any, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> None:
        """SB3's ``save``."""
        if isinstance(self.replay_buffer, KnowledgeMixin):
            seen = self.knowledge.typical_observation()
            self.typical_observation = self.typical_observation if seen is None else seen
        super().save(path, exclude, include)

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
            # Not a ValueError, which `load` would take for a sign of an old file and turn into a KeyError.
            raise TypeError(
                f"These parameters hold no AP predictor, so a plain algorithm saved them: build {type(self).__name__} "
                "with the same settings and call `model.set_parameters(path, exact_match=False)` to go on from them."
            )
        own_settings = settings_of(self.predictor.optimizer)
        check_same_optimizer(self.predictor.optimizer, load_path_or_dict)
        super().set_parameters(load_path_or_dict, exact_match, device)
        # The file provides the optimizer's running averages; learning rate and so on are those of this model.
        for group, settings in zip(self.predictor.optimizer.param_groups, own_settings, strict=True):
            group.update(settings)

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        previous = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded, self.replay_buffer = self.replay_buffer, previous  # which is kept if the check fails
        check_fits(cast(Any, loaded), self)
        self.replay_buffer = loaded
        self._set_label_source(cast(KnowledgeMixin, loaded))
