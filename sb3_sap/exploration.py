"""How a guided model chooses actions while training: Algorithm 1 over SB3's off-policy algorithms."""

from __future__ import annotations

import inspect
import warnings
from typing import Any, ClassVar, cast

import numpy as np
import torch as th
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, ConvertCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.save_util import load_from_zip_file
from stable_baselines3.common.type_aliases import MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_sap.actor_loss import permissible_actor_step
from sb3_sap.buffers import KnowledgeMixin, guided_buffer_class
from sb3_sap.callbacks import PermissibilityCallback, contains_permissibility_callback
from sb3_sap.constraints import ConstrainedExplorationMixin
from sb3_sap.generators import make_rng
from sb3_sap.knowledge import KnowledgeBuffer
from sb3_sap.permissibility import APFunction, FloatArray, resolve
from sb3_sap.predictor import PermissibilityPredictor, flush_denormals

#: Validation accuracy from which the actor listens with probability α (section 4.3).
SUFFICIENT_ACCURACY = 0.7


class ActionPermissibilityMixin(ConstrainedExplorationMixin):
    """Guides an SB3 off-policy algorithm with a learned AP predictor (Algorithm 1).

    Goes before the algorithm in the bases of a class. ``predict`` stays the policy alone, so that every evaluation
    tool of SB3 measures what was learned; both buffers hold the action that was executed.

    :param ap_function: f(s, a | s'), an :class:`~sb3_sap.permissibility.APFunction` or its dotted name. ``None``:
        the labels come from ``info["permissible"]``
    :param alpha: α, probability of consulting E once it is good enough
    :param alpha_low: the same while E's balanced validation accuracy is below 70 % (the paper gives no value)
    :param t_k: steps with noise and without guidance, counted over the model's whole life. ``None``:
        ``learning_starts``, whose uniform random steps count inside it
    :param n_candidates: N of line 8, the size of A_st
    :param knowledge_buffer_size: capacity of K
    :param validation_fraction: share of K kept for validation
    :param dataset_size: N_E, size of the balanced D_E drawn for each fit
    :param validation_size: size of the balanced validation sample
    :param min_per_class: examples of each class that K must hold before E is fitted
    :param actor_permissibility_coef: β of the permissible actor loss, a number or an SB3 schedule; 0 is the paper's
        method (see :func:`~sb3_sap.actor_loss.permissible_actor_step`). It acts while E is good enough for ``alpha``
    :param predictor_kwargs: arguments of :class:`~sb3_sap.predictor.PermissibilityPredictor`
    """

    #: Whether the policy explores by itself, so that the steps before t_k need no action noise.
    stochastic_policy: ClassVar[bool] = False

    def __init__(
        self,
        *args: Any,
        ap_function: APFunction | str | None = None,
        alpha: float = 0.9,
        alpha_low: float = 0.5,
        t_k: int | None = None,
        n_candidates: int = 128,
        knowledge_buffer_size: int = 10_000,
        validation_fraction: float = 0.1,
        dataset_size: int = 512,
        validation_size: int = 200,
        min_per_class: int = 20,
        actor_permissibility_coef: float | Schedule = 0.0,
        predictor_kwargs: dict[str, Any] | None = None,
        **kwargs: Any,
    ):
        self.ap_function = ap_function
        self.alpha = alpha
        self.alpha_low = alpha_low
        self.t_k = t_k
        self.n_candidates = n_candidates
        self.knowledge_buffer_size = knowledge_buffer_size
        self.validation_fraction = validation_fraction
        self.dataset_size = dataset_size
        self.validation_size = validation_size
        self.min_per_class = min_per_class
        self.actor_permissibility_coef = actor_permissibility_coef
        self.predictor_kwargs = predictor_kwargs
        #: Balanced accuracy of E on its last validation sample; NaN before the first.
        self.validation_accuracy = float("nan")
        self._steps_of_earlier_learns = 0
        super().__init__(*args, **kwargs)

    # ---------------------------------------------------------------- construction

    def _setup_model(self) -> None:
        self._check_settings()
        if self.replay_buffer is None:
            self.replay_buffer = self._make_replay_buffer()
        # SB3 warns about any buffer class beside n_steps; the buffer above was given n_steps.
        self.replay_buffer_class = None
        super()._setup_model()
        self.replay_buffer_class = type(self.replay_buffer)
        # A network of our own must not shift the global generator, or runs would no longer compare to the base's.
        with th.random.fork_rng(devices=[]):
            th.default_generator.manual_seed(int(make_rng(self.seed, "predictor").integers(2**31)))
            self.predictor = self._make_predictor().to(self.device)

    def _check_settings(self) -> None:
        for name in ("alpha", "alpha_low"):
            probability = getattr(self, name)
            if not (isinstance(probability, (int, float)) and 0 <= probability <= 1):
                raise ValueError(f"`{name}` is a probability from 0 to 1, but is {probability!r}.")
        if self.t_k is not None and self.t_k < 0:
            raise ValueError(f"`t_k` is a number of steps, 0 or more, but is {self.t_k}.")
        least = {"n_candidates": 1, "min_per_class": 1, "dataset_size": 2, "validation_size": 2}
        for name, minimum in least.items():
            if getattr(self, name) < minimum:
                raise ValueError(f"`{name}` must be at least {minimum}, but is {getattr(self, name)}.")
        if self.noise_steps > self.learning_starts and self.action_noise is None and not self.stochastic_policy:
            warnings.warn(
                f"`t_k` = {self.t_k} is beyond `learning_starts` = {self.learning_starts}, but there is no "
                "`action_noise`: between the two a deterministic policy does not explore.",
                stacklevel=2,
            )

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
        arguments = {name: getattr(self.policy, name) for name in shared} | dict(self.predictor_kwargs or {})
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

    # ---------------------------------------------------------------- learning

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
        return super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        # Installed here and not by the user, who would get the unguided algorithm by forgetting it.
        if not contains_permissibility_callback(callback):
            if not isinstance(callback, (list, BaseCallback)):
                callback = ConvertCallback(callback)
            callback = [PermissibilityCallback(), *(callback if isinstance(callback, list) else [callback])]
        return super()._init_callback(callback, progress_bar)

    @property
    def noise_steps(self) -> int:
        """t_k, or ``learning_starts`` where it was left open."""
        return self.learning_starts if self.t_k is None else self.t_k

    @property
    def current_alpha(self) -> float:
        """α as E's validation accuracy allows it (section 4.3)."""
        return self.alpha if self.predictor_suffices else min(self.alpha_low, self.alpha)

    @property
    def predictor_suffices(self) -> bool:
        """Whether E was right often enough on its last validation sample."""
        return self.validation_accuracy >= SUFFICIENT_ACCURACY

    def train(self, gradient_steps: int, batch_size: int = 64) -> None:
        super().train(gradient_steps, batch_size)
        coef = FloatSchedule(self.actor_permissibility_coef)(self._current_progress_remaining)
        if coef == 0 or not self.predictor_suffices:
            return
        for _ in range(gradient_steps):
            loss = permissible_actor_step(
                self.actor,
                self.predictor,
                cast(KnowledgeMixin, self.replay_buffer),
                coef,
                batch_size,
                self._vec_normalize_env,
            )
            self.logger.record_mean("sap/actor_loss", loss)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray[Any, Any], np.ndarray[Any, Any]]:
        if self._steps_of_earlier_learns + self.num_timesteps < self.noise_steps:
            return super()._sample_action(learning_starts, action_noise, n_envs)  # Alg. 1, lines 1-4
        # After t_k there is neither noise nor, in a second `learn()`, another uniform warm-up.
        action, scaled = super()._sample_action(0, None, n_envs)  # Alg. 1, line 1
        if self.predictor.fitted:
            guided = self._guide(scaled)
            if guided is not None:
                return self.policy.unscale_action(guided), guided
        return action, scaled

    @th.no_grad()
    @flush_denormals()
    def _guide(self, actions: np.ndarray[Any, Any]) -> np.ndarray[Any, Any] | None:
        """Lines 5 to 14 of Algorithm 1, for all environments at once.

        :param actions: (n_envs, *action_shape) the actor's actions, scaled
        :return: the same with rejected ones replaced; None where nothing changed
        """
        shape, actions = actions.shape, actions.reshape(len(actions), -1)
        consulted = np.flatnonzero(self._rng.random(len(actions)) < self.current_alpha)  # Alg. 1, line 5
        self.logger.record_mean("sap/consultation_rate", len(consulted) / len(actions))
        if len(consulted) == 0:
            return None
        obs, _ = self.policy.obs_to_tensor(cast(Any, self._last_obs))
        features = self.predictor.features(obs)
        logits = self.predictor.logits(features[consulted], th.as_tensor(actions[consulted], device=self.device))
        rejected = consulted[(logits <= 0).cpu().numpy()]  # Alg. 1, lines 6-7
        self.logger.record_mean("sap/rejection_rate", len(rejected) / len(consulted))
        if len(rejected) == 0:
            return None
        low, high = (b.reshape(actions.shape)[rejected] for b in self._allowed_interval(len(actions)))
        candidates = stratified_candidates(self._rng, low, high, self.n_candidates)  # Alg. 1, line 8
        permissible = self._permissible(features[rejected], candidates)  # Alg. 1, line 9
        found = permissible.any(axis=1)  # Alg. 1, line 10
        self.logger.record_mean("sap/fallback_rate", 1 - found.mean())
        guided = actions.copy()
        for i in np.flatnonzero(found):
            guided[rejected[i]] = self._rng.choice(candidates[i, permissible[i]])  # Alg. 1, line 11
        return guided.reshape(shape)

    def _permissible(self, features: th.Tensor, candidates: FloatArray) -> np.ndarray[Any, np.dtype[np.bool_]]:
        """E's verdict on (n, N, action_dim) candidates for (n, features_dim) features: (n, N) bool."""
        n, n_candidates, _ = candidates.shape
        actions = th.as_tensor(candidates, device=self.device).flatten(0, 1)
        logits = self.predictor.logits(features.repeat_interleave(n_candidates, dim=0), actions)
        return (logits > 0).cpu().numpy().reshape(n, n_candidates)

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


def stratified_candidates(rng: np.random.Generator, low: FloatArray, high: FloatArray, n: int) -> FloatArray:
    """Low-variance uniform sampling (section 4.3): one draw from each of n equal strata of every dimension.

    In one dimension the candidates come in ascending order; in more, the strata of the dimensions are paired at
    random, which is Latin hypercube sampling.

    :param low: (m, action_dim) lower bounds
    :param high: (m, action_dim) upper bounds
    :return: (m, n, action_dim) candidates, float32
    """
    m, dim = low.shape
    strata = np.broadcast_to(np.arange(n)[:, None], (m, n, dim))
    if dim > 1:
        strata = rng.permuted(strata, axis=1)
    unit = (strata + rng.random((m, n, dim))) / n  # (m, n, action_dim) in [0, 1)
    return (low[:, None] + unit * (high - low)[:, None]).astype(np.float32)
