"""A model that learns permissibility beside acting: it owns K and E, trains them through a callback, and saves them."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterable, Mapping
from typing import Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_sap.buffers import KnowledgeMixin, check_fits, guided_buffer_class
from sb3_sap.callbacks import PermissibilityCallback, contains_permissibility_callback
from sb3_sap.features import with_extractor
from sb3_sap.generators import make_rng
from sb3_sap.growth import check_growth, due
from sb3_sap.knowledge import KnowledgeBuffer
from sb3_sap.permissibility import APFunction, resolve
from sb3_sap.predictor import PermissibilityPredictor
from sb3_sap.settings import check_at_least
from sb3_sap.watching import WatchedEnvironmentMixin

#: What hindsight goals need in an observation.
GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")
#: Arguments of the predictor that its saved weights and optimizer depend on.
BUILT = (
    "net_arch",
    "activation_fn",
    "features_extractor_class",
    "features_extractor_kwargs",
    "normalize_images",
    "optimizer_class",
)
#: Validation accuracy from which E is good enough (section 4.3).
SUFFICIENT_ACCURACY = 0.7


class LearnedPermissibilityMixin(WatchedEnvironmentMixin):
    """Gives an SB3 off-policy algorithm a knowledge buffer K and an AP predictor E (section 4.2).

    What is done with E is another's business: the model acts and learns as its base does.

    :param ap_function: f(s, a | s'), an :class:`~sb3_sap.permissibility.APFunction` or its dotted name. ``None``:
        the labels come from ``info["permissible"]``
    :param knowledge_buffer_size: capacity of K
    :param validation_fraction: share of K kept for validation
    :param dataset_size: N_E, size of the balanced D_E drawn for each fit
    :param validation_size: size of the balanced validation sample
    :param min_per_class: examples of each class that K must hold before E is fitted, and makes room for when it is full
    :param refit_growth: E is fitted and validated each time that the number of steps has grown by this fraction,
        because a few new examples soon change little in it, while the cost of a fit stays; 0: after every step, or as
        often as ``predictor_gradient_steps`` says
    :param predictor_gradient_steps: fits, at most, after each rollout, as ``gradient_steps`` of the base; -1: one for
        each vectorised step. ``None``: as many as the base's gradient steps, which of DQN are fewer than its steps;
        with a ``refit_growth`` above 0 that alone decides
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
        predictor_gradient_steps: int | None = None,
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
        self.predictor_gradient_steps = predictor_gradient_steps
        self.predictor_kwargs = predictor_kwargs
        #: Balanced accuracy of E on its last validation sample; NaN before the first.
        self.validation_accuracy = float("nan")
        self._steps_of_earlier_learns = 0
        #: A raw observation amid those of the training, noted when the model is saved.
        self.typical_observation: Any = None
        #: What the predictor was built with: a saved one fits no other.
        self._predictor_built: dict[str, Any] = {}
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        check_at_least(self, knowledge_buffer_size=4, min_per_class=1, dataset_size=2, validation_size=2)
        check_growth(self, "refit_growth")
        if self.predictor_gradient_steps is not None:
            check_at_least(self, predictor_gradient_steps=-1)
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        # SB3 warns about any buffer class beside n_steps; the buffer above was given n_steps.
        self.replay_buffer_class = None
        # It writes n_steps and gamma into these, where they would outlive a `load` with others.
        own, self.replay_buffer_kwargs = self.replay_buffer_kwargs, dict(self.replay_buffer_kwargs)
        super()._setup_model()
        self.replay_buffer_kwargs = own
        self.replay_buffer_class = type(self.replay_buffer)
        self._connect(cast(KnowledgeMixin, self.replay_buffer))
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
            missing = set(GOAL_KEYS).difference(getattr(self.observation_space, "spaces", {}))
            if missing:
                raise ValueError(
                    f"`replay_buffer_class` = {buffer_class.__name__} needs Dict observations with "
                    f"{', '.join(GOAL_KEYS)}, but {', '.join(sorted(missing))} is missing in "
                    f"{self.observation_space}: leave it out, or use an environment with goals."
                )
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
            **kwargs,
        )

    def _connect(self, buffer: KnowledgeMixin) -> None:
        """Tells a buffer where its labels come from."""
        buffer.ap_function = None if self.ap_function is None else resolve(self.ap_function, "ap_function")
        buffer.images = self.images
        # What is ruled out beforehand can do without labels of what was executed.
        buffer.needs_labels = getattr(self, "permissible_actions", None) is None

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
        built = {name: described(arguments.get(name, known[name].default)) for name in BUILT}
        changed = [name for name in BUILT if self._predictor_built.get(name, built[name]) != built[name]]
        if changed:
            raise ValueError(
                f"`predictor_kwargs` change {', '.join(changed)} of a saved predictor, whose weights and optimizer "
                f"fit no other: build a new {type(self).__name__} with them, and give it the loaded policy with "
                "`new.policy.load_state_dict(loaded.policy.state_dict())`."
            )
        self._predictor_built = built
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
        self._connect(cast(KnowledgeMixin, self.replay_buffer))  # a copied model's buffer has lost its function
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    @property
    def life_steps(self) -> int:
        """Steps taken over the model's whole life."""
        return self._steps_of_earlier_learns + self.num_timesteps

    def refits_due(self, before: int, now: int) -> int:
        """How many fits belong to the steps after ``before``, up to ``now``."""
        return due(self.refit_growth, before, now)

    @property
    def fits_per_rollout(self) -> float:
        """How many fits may follow a rollout, whatever is due."""
        steps: float | None = self.predictor_gradient_steps
        if steps is None:
            # A base that does not train at all leaves E one fit.
            steps = max(1, self.gradient_steps) if self.refit_growth == 0 <= self.gradient_steps else -1
        return steps if steps >= 0 else math.inf

    @property
    def predictor_suffices(self) -> bool:
        """Whether E was right often enough on its last validation sample."""
        return self.validation_accuracy >= SUFFICIENT_ACCURACY

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        super().set_env(env, force_reset)
        self._connect(cast(KnowledgeMixin, self.replay_buffer))

    # ---------------------------------------------------------------- saving

    def save(self, path: Any, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> None:
        """SB3's ``save``."""
        if isinstance(self.replay_buffer, KnowledgeMixin):
            seen = self.replay_buffer.knowledge.typical_observation()
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
            # Not a ValueError: `load` takes that for an old file and buries it under a KeyError.
            raise TypeError(
                f"These parameters hold no AP predictor, so a plain algorithm saved them: build {type(self).__name__} "
                "with the same settings and call `model.set_parameters(path, exact_match=False)` to go on from them."
            )
        optimizer = self.predictor.optimizer
        own = [{name: value for name, value in group.items() if name != "params"} for group in optimizer.param_groups]
        for group in load_path_or_dict.get("predictor.optimizer", {"param_groups": []})["param_groups"]:
            saved = group.keys() - {"params"}
            if saved - own[0].keys() and own[0].keys() - saved:  # one alone is another version of torch
                raise TypeError(
                    f"These parameters hold the state of another optimizer than the predictor's "
                    f"{type(optimizer).__name__}: build the model with the `predictor_kwargs` of the saved one."
                )
        super().set_parameters(load_path_or_dict, exact_match, device)
        # The file brings the optimizer's running averages; its settings are those of this model.
        for group, settings in zip(optimizer.param_groups, own, strict=True):
            group.update(settings)

    def load_replay_buffer(self, path: Any, truncate_last_traj: bool = True) -> None:
        own = self.replay_buffer
        super().load_replay_buffer(path, truncate_last_traj)
        loaded, self.replay_buffer = self.replay_buffer, own
        check_fits(cast(Any, loaded), self)
        self.replay_buffer = loaded
        self._connect(cast(KnowledgeMixin, loaded))


def described(value: Any) -> Any:
    """An argument of a network in words and numbers, which stay the same when a model is saved and loaded."""
    if isinstance(value, Mapping):
        return {str(key): described(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [described(inner) for inner in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return getattr(value, "__qualname__", type(value).__qualname__)
