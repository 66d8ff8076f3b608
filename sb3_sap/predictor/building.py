"""Builds the predictor, the knowledge buffer and the replay buffer of a guided model from its settings."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

from sb3_sap.common.extractors import with_extractor
from sb3_sap.common.random import make_rng
from sb3_sap.common.torch_utils import own_generators
from sb3_sap.predictor.buffers import KnowledgeMixin, guided_buffer_class
from sb3_sap.predictor.knowledge import KnowledgeBuffer, PriorKnowledge
from sb3_sap.predictor.network import PermissibilityPredictor
from sb3_sap.predictor.optimizer_state import settings_of
from sb3_sap.predictor.parted import PartedKnowledge, PartedPriorKnowledge
from sb3_sap.predictor.risk import RiskKnowledge

#: Arguments whose defaults are the policy's, so that E extracts features from observations as the policy does.
SHARED = ("features_extractor_class", "features_extractor_kwargs", "normalize_images")
#: Arguments of the predictor that its saved weights and optimizer depend on.
ARCHITECTURE = (
    "net_arch",
    "activation_fn",
    "features_extractor_class",
    "features_extractor_kwargs",
    "normalize_images",
    "optimizer_class",
    "action_parts",
)
#: Keys that a hindsight replay buffer needs in an observation.
GOAL_KEYS = ("observation", "achieved_goal", "desired_goal")


def make_predictor(
    model: Any, saved: Mapping[str, Any], given: PermissibilityPredictor | None = None
) -> tuple[PermissibilityPredictor, dict[str, Any]]:
    """E with the model's ``predictor_kwargs``, and a description of its architecture.

    :param saved: the description of a saved predictor whose weights will be loaded; empty: there is none
    :param given: a predictor whose weights and arguments it takes over, as far as ``predictor_kwargs`` say nothing else
    :raise TypeError: for unknown arguments
    :raise ValueError: for another architecture than the saved one
    """
    own = with_extractor(model.predictor_kwargs)
    if "features_extractor_class" in own:  # the arguments of the policy's extractor would not fit it
        own = {"features_extractor_kwargs": {}, **own}
    of_parts = {} if model.action_parts is None else {"action_parts": model.parts.as_dict()}
    if getattr(model, "risk_discount", None) is not None:
        own = {**own, "threshold": 1.0 - model.risk_threshold}
    arguments = {name: getattr(model.policy, name) for name in SHARED} | own | of_parts
    known = inspect.signature(PermissibilityPredictor).parameters
    if given is not None:
        arguments = given.arguments | own | of_parts
        saved = {name: described(given.arguments[name]) for name in ARCHITECTURE}
    for name in arguments.keys() - known.keys():
        raise TypeError(
            f"`predictor_kwargs` holds {name!r}, but PermissibilityPredictor takes {', '.join(list(known)[2:])}."
        )
    architecture = {name: described(arguments.get(name, known[name].default)) for name in ARCHITECTURE}
    changed = [name for name in ARCHITECTURE if saved.get(name, architecture[name]) != architecture[name]]
    if changed:
        raise ValueError(
            f"`predictor_kwargs` change {', '.join(changed)} of a saved predictor, whose weights and optimizer "
            f"fit no other: build a new {type(model).__name__} with them, and give it the loaded policy with "
            "`new.policy.load_state_dict(loaded.policy.state_dict())`."
        )
    # Building E must not shift the global generator, or a run without guidance would differ from the base's.
    with own_generators(int(make_rng(model.seed, "predictor").integers(2**31)), model.device):
        predictor = PermissibilityPredictor(model.observation_space, model.action_space, **arguments)
    predictor = predictor.to(model.device)
    if given is not None:
        predictor.load_state_dict(given.state_dict())
        own_settings = settings_of(predictor.optimizer)
        predictor.optimizer.load_state_dict(given.optimizer.state_dict())
        for group, settings in zip(predictor.optimizer.param_groups, own_settings, strict=True):
            group.update(settings)
        predictor.about = given.about
        return predictor, architecture
    # Some optimizers, such as Adagrad, have a state from the start; loading it moves it to the device of the weights.
    predictor.optimizer.load_state_dict(predictor.optimizer.state_dict())
    return predictor, architecture


def make_knowledge(model: Any, prior: bool = False) -> KnowledgeBuffer:
    """An empty K of the model's size.

    :param prior: one for what is known from elsewhere
    :raise ValueError: if it has no room for ``min_per_class`` examples of each class
    """
    settings = (
        model.observation_space,
        int(np.prod(model.action_space.shape or (1,))),
        model.knowledge_buffer_size,
        model.validation_fraction,
        model.seed,
        model.min_per_class,
    )
    knowledge: KnowledgeBuffer
    if model.parts:
        knowledge = (PartedPriorKnowledge if prior else PartedKnowledge)(model.parts.names, *settings)
    elif prior:
        knowledge = PriorKnowledge(*settings)
    else:
        at_risk = getattr(model, "risk_discount", None) is not None
        knowledge = (RiskKnowledge if at_risk else KnowledgeBuffer)(*settings)
    room = knowledge.parts["train"].capacity // 2
    if model.min_per_class > room:
        raise ValueError(
            f"`min_per_class` = {model.min_per_class} can never be reached: `knowledge_buffer_size` = "
            f"{model.knowledge_buffer_size} has room for {room} training examples of each class."
        )
    return knowledge


def make_replay_buffer(model: Any, rows: int | None = None) -> KnowledgeMixin:
    """An empty R that feeds an empty K, of the requested class or the one that SB3 would have chosen.

    :param rows: a buffer for so many transitions from elsewhere instead, beside the model's own
    :raise ValueError: if the class does not fit the settings or the observations
    """
    buffer_class = guided_buffer_class(model.replay_buffer_class, model.observation_space, model.n_steps)
    kwargs: dict[str, Any] = dict(model.replay_buffer_kwargs)
    if issubclass(buffer_class, NStepReplayBuffer):
        kwargs = {"n_steps": model.n_steps, "gamma": model.gamma, **kwargs}
    if issubclass(buffer_class, HerReplayBuffer):
        kwargs["env"] = model.env
        missing = set(GOAL_KEYS).difference(getattr(model.observation_space, "spaces", {}))
        if missing:
            raise ValueError(
                f"`replay_buffer_class` = {buffer_class.__name__} needs Dict observations with "
                f"{', '.join(GOAL_KEYS)}, but {', '.join(sorted(missing))} is missing in "
                f"{model.observation_space}: leave it out, or use an environment with goals."
            )
    return buffer_class(
        model.buffer_size if rows is None else rows,
        model.observation_space,
        model.action_space,
        device=model.device,
        n_envs=model.n_envs if rows is None else 1,
        optimize_memory_usage=model.optimize_memory_usage and rows is None,
        knowledge=make_knowledge(model) if rows is None else model.knowledge,
        **kwargs,
    )


def described(value: Any) -> Any:
    """An argument of a network as text and numbers, which are equal again after saving and loading."""
    if isinstance(value, Mapping):
        return {str(key): described(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [described(inner) for inner in value]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    return getattr(value, "__qualname__", type(value).__qualname__)
