"""What off-policy and on-policy algorithms share: the settings of K and E, and the saving of E with the model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_sap.common.action_parts import ActionParts
from sb3_sap.common.arrays import FloatArray
from sb3_sap.common.entropy import entropy_weight
from sb3_sap.common.errors import check_at_least
from sb3_sap.common.functions import resolve
from sb3_sap.common.reward_shaping import Potential, RewardShaping
from sb3_sap.common.watching import WatchedEnvironmentMixin
from sb3_sap.permissibility import APFunction, does_not_lower
from sb3_sap.predictor.building import make_predictor
from sb3_sap.predictor.events import Event, event_source
from sb3_sap.predictor.judging import SUFFICIENT_ACCURACY
from sb3_sap.predictor.knowledge import KnowledgeBuffer, LabelledActions
from sb3_sap.predictor.labelling import Labels
from sb3_sap.predictor.network import PermissibilityPredictor
from sb3_sap.predictor.optimizer_state import check_same_optimizer, settings_of
from sb3_sap.predictor.pending import Pending


class LearnedPredictorMixin(WatchedEnvironmentMixin):
    """Gives an SB3 algorithm an AP predictor E (section 4.2), saved with the model.

    Where K is held, and when E is fitted, is for subclasses to say.

    :param ap_function: f(s, a | s'), an :class:`~sb3_sap.permissibility.APFunction` or its dotted name. ``None``:
        the labels come from ``event`` or ``potential`` if there is one, else from ``info["permissible"]``
    :param event: in place of an AP function, what makes mistakes of the last ``horizon`` actions up to its own step:
        ``"terminated"``, a true termination; any other string without a dot, a key of ``info`` whose value is above 0
        there, such as ``"cost"``; or an :class:`~sb3_sap.predictor.events.Event`, a function of single transitions, or
        its dotted name. An action is permissible once ``horizon`` steps, its own included, have passed without an
        event, or its episode has terminated without one. What an episode that is cut off leaves open is not labelled
    :param horizon: h, the number of steps, its own included, over which an action is judged. With more than 1 the AP
        function gets a window, f(s_t, a_t | s_{t+1}, ..., s_{t+h}): its ``next_obs`` has shape (n, h, *obs_shape),
        where an episode that ended repeats its last observation, whether it terminated or was truncated. Labels and
        penalties come with the last of these steps, penalties as long as the transition is still stored
    :param penalty: c, subtracted from the reward of a non-permissible action in the reward that is learned from alone:
        logged returns and evaluations have the reward of the environment. ``"auto"``: the root mean square of the
        rewards so far, or the entropy coefficient that SAC, TQC or CrossQ begins with, where that is larger;
        ``"auto_0.5"``: half of it
    :param potential: Φ, a :class:`~sb3_sap.common.reward_shaping.Potential` or its dotted name: γ Φ(s') - Φ(s) is added
        to the reward that is learned from alone, and without an ``ap_function`` or an ``event`` an action is
        permissible if it does not lower Φ
    :param action_parts: names of parts of the action with their dimensions, such as ``{"steering": [0], "pedal":
        [1]}``, which have labels of their own: the AP function then returns (n, k), ``info["permissible"]`` holds (k,)
        bool, and a part that E rejects is replaced alone. A penalty is subtracted once for each part. ``None``: the
        action is labelled as a whole
    :param knowledge_buffer_size: capacity of K, with parts for each of them
    :param validation_fraction: share of K kept for validation
    :param dataset_size: N_E, size of the balanced D_E drawn for each fit
    :param validation_size: size of the balanced validation sample
    :param min_per_class: examples of each class that K must hold before E is fitted, and for which a full K makes room
    :param predictor_kwargs: arguments of :class:`~sb3_sap.predictor.network.PermissibilityPredictor`
    """

    predictor: PermissibilityPredictor

    def __init__(
        self,
        *args: Any,
        ap_function: APFunction | str | None = None,
        event: Event | str | None = None,
        horizon: int = 1,
        penalty: float | str = 0.0,
        potential: Potential | str | None = None,
        action_parts: Mapping[str, Sequence[int]] | None = None,
        knowledge_buffer_size: int = 10_000,
        validation_fraction: float = 0.1,
        dataset_size: int = 512,
        validation_size: int = 200,
        min_per_class: int = 20,
        predictor_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ):
        self.ap_function = ap_function
        self.event = event
        self.horizon = horizon
        self.penalty = penalty
        self.potential = potential
        self.action_parts = action_parts
        self.knowledge_buffer_size = knowledge_buffer_size
        self.validation_fraction = validation_fraction
        self.dataset_size = dataset_size
        self.validation_size = validation_size
        self.min_per_class = min_per_class
        self.predictor_kwargs = predictor_kwargs
        #: Balanced accuracy of E on its last validation sample; NaN before the first.
        self.validation_accuracy = float("nan")
        self._steps_of_earlier_learns = 0
        #: A typical raw observation of the training, noted when the model is saved.
        self.typical_observation: Any = None
        #: Describes the architecture of the predictor, whose saved weights fit no other.
        self._predictor_architecture: dict[str, Any] = {}
        super().__init__(*args, **kwargs)

    def _check_knowledge_settings(self) -> None:
        check_at_least(self, knowledge_buffer_size=4, min_per_class=1, dataset_size=2, validation_size=2)
        for name in ("event", "potential"):
            if self.parts and self.ap_function is None and getattr(self, name) is not None:
                raise ValueError(
                    f"`{name}` labels the action as a whole: with `action_parts` give an `ap_function` for each part."
                )

    @property
    def parts(self) -> ActionParts:
        """The parts of the action that have labels of their own; none without ``action_parts``."""
        return ActionParts.of(self.action_parts, self.action_space)

    def _setup_model(self) -> None:
        self._check_knowledge_settings()
        super()._setup_model()
        self.predictor, self._predictor_architecture = make_predictor(self, self._predictor_architecture)

    @property
    def knowledge(self) -> KnowledgeBuffer:
        """K."""
        raise NotImplementedError

    def _holds_knowledge(self) -> bool:
        """Whether there is a K, which a model may lack while it is built or loaded."""
        raise NotImplementedError

    def _label_holder(self) -> Labels:
        """What knows where labels come from."""
        raise NotImplementedError

    def _set_label_source(self, holder: Labels) -> None:
        """Sets where the holder of K takes its labels from, and what they add to the reward."""
        self._check_label_source()
        potential = None if self.potential is None else resolve(self.potential, "potential")
        own = None if potential is None or self.event is not None else does_not_lower(potential)
        holder.event = None if self.event is None else event_source(self.event)
        if self.event is None and self.horizon == 1:
            holder.pending = None
        elif holder.pending is None or holder.pending.horizon != self.label_horizon:
            holder.pending = Pending(self.label_horizon)
        holder.ap_function = own if self.ap_function is None else resolve(self.ap_function, "ap_function")
        gamma: float = self.gamma  # type: ignore[attr-defined]
        holder.shaping = RewardShaping(self.penalty, potential, gamma, entropy_weight(self))
        holder.images = self.images
        # With `permissible_actions` a model may do without labels of executed actions, but a penalty needs them.
        holder.needs_labels = holder.shaping.penalises or getattr(self, "permissible_actions", None) is None

    @property
    def label_horizon(self) -> int:
        """The number of steps, its own included, over which an action is labelled."""
        return self.horizon

    def _check_label_source(self) -> None:
        check_at_least(self, horizon=1)
        if self.ap_function is not None and self.event is not None:
            raise ValueError(
                "`ap_function` and `event` were both given, but labels come from one of them: leave one out, or let "
                "the AP function say what the event says."
            )
        if self.horizon > 1 and self.ap_function is None and self.event is None:
            raise ValueError(
                f"`horizon` = {self.horizon} needs an `ap_function` or an `event`, because the labels of `potential` "
                'and of `info["permissible"]` are of single steps: give one of them, or leave `horizon` out.'
            )

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
        last_obs: Any = self._last_obs
        found = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        pending = self._label_holder().pending
        if pending is not None and self._last_obs is not last_obs:  # the environments were reset
            pending.clear()
        return found

    @property
    def lifetime_steps(self) -> int:
        """Timesteps over the model's whole life, including those of earlier calls of ``learn``."""
        return self._steps_of_earlier_learns + self.num_timesteps

    @property
    def predictor_accurate(self) -> bool:
        """Whether E, or its output for any part of the action, passed the gate of section 4.3 on its last validation
        sample.
        """
        if self.parts:
            return bool(self.predictor.trusted.any())
        return self.validation_accuracy >= SUFFICIENT_ACCURACY

    def draw_examples(self) -> tuple[LabelledActions, FloatArray | None]:
        """What E is fitted to next, and the weight of each example; ``None``: all weigh the same."""
        return self.knowledge.sample(self.dataset_size, env=self.get_vec_normalize_env()), None

    def after_fit(self) -> None:
        """Called after each fit of E."""

    # ---------------------------------------------------------------- saving

    def save(self, path: Any, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> None:
        """SB3's ``save``."""
        if self._holds_knowledge():
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
