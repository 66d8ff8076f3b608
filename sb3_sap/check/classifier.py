"""How well a quickly fitted E predicts the labels of random steps, and how much of that is due to the action."""

from __future__ import annotations

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import get_flattened_obs_dim
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor, FlattenExtractor

from sb3_sap.common.arrays import BoolArray, Observations
from sb3_sap.predictor.knowledge import KnowledgeBuffer, LabelledActions
from sb3_sap.predictor.network import PermissibilityPredictor

#: Share of the random transitions that is held out, number of fits of the classifier, and examples in each fit.
HELD_OUT, FITS, DATASET_SIZE = 0.2, 120, 512
#: Minimum number of examples of each class, for training and held out.
MIN_EXAMPLES = 10
#: Shuffles of an action dimension over which the loss of accuracy is averaged.
N_SHUFFLES = 5


class FlattenEntries(BaseFeaturesExtractor):
    """Concatenates all entries of a ``Dict``, flattened; images may have any size and layout."""

    def __init__(self, observation_space: spaces.Dict):
        super().__init__(observation_space, sum(get_flattened_obs_dim(s) for s in observation_space.spaces.values()))

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return th.cat([entry.flatten(start_dim=1) for entry in observations.values()], dim=1)


class ClassifierResult(NamedTuple):
    """Balanced accuracies on examples that were never trained on."""

    #: Of a classifier that sees observation and action.
    accuracy: float
    #: Of one that is trained and tested with every action set to zero.
    accuracy_without_action: float
    #: For each action dimension, the accuracy that the first loses when it is shuffled among the examples.
    action_informs: tuple[float, ...]


def fit_classifier(
    env: gym.Env[Any, Any], obs: Observations, actions: np.ndarray[Any, Any], labels: BoolArray, seed: int
) -> ClassifierResult | None:
    """Fits E, as a guided model does, on a part of the examples and measures its accuracy on the others.

    :param obs: (n, *obs_shape), raw
    :param actions: (n, *action_shape), in the environment's units
    :param labels: (n,)
    :return: ``None`` if one of the classes is too rare
    """
    space: Any = env.action_space
    n = len(labels)
    if isinstance(space, spaces.Box):
        actions = 2 * (actions - space.low) / (space.high - space.low) - 1
    actions = actions.reshape(n, -1)
    knowledge = KnowledgeBuffer(env.observation_space, actions.shape[1], 2 * n, HELD_OUT, seed)
    knowledge.add(obs, actions, labels)
    if min(min(knowledge.counts("train")), min(knowledge.counts("validation"))) < MIN_EXAMPLES:
        return None
    full, blind = _classifier(env, seed), _classifier(env, seed, fused=True)
    for _ in range(FITS):
        examples = knowledge.sample(DATASET_SIZE)
        full.fit(examples)
        blind.fit(_without_action(examples))
    held_out = knowledge.sample(n, "validation")
    accuracy = _accuracy(full, held_out)
    rng = np.random.default_rng(seed)
    informs = tuple(
        accuracy - float(np.mean([_accuracy(full, _shuffled(held_out, i, rng)) for _ in range(N_SHUFFLES)]))
        for i in range(actions.shape[1])
    )
    return ClassifierResult(accuracy, _accuracy(blind, _without_action(held_out)), informs)


def _classifier(env: gym.Env[Any, Any], seed: int, **optimizer_kwargs: Any) -> PermissibilityPredictor:
    keyed = isinstance(env.observation_space, spaces.Dict)
    with th.random.fork_rng(devices=[]):  # without touching the caller's generator
        th.default_generator.manual_seed(seed)
        return PermissibilityPredictor(
            env.observation_space,
            env.action_space,
            features_extractor_class=FlattenEntries if keyed else FlattenExtractor,
            optimizer_kwargs=optimizer_kwargs,
        )


def _accuracy(classifier: PermissibilityPredictor, examples: LabelledActions) -> float:
    return float(np.mean(classifier.recall(examples)))


def _without_action(examples: LabelledActions) -> LabelledActions:
    return examples._replace(actions=np.zeros_like(examples.actions))


def _shuffled(examples: LabelledActions, dimension: int, rng: np.random.Generator) -> LabelledActions:
    actions = examples.actions.copy()
    actions[:, dimension] = rng.permutation(actions[:, dimension])
    return examples._replace(actions=actions)
