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

#: Of the random transitions, the share that is never trained on; the fits of the classifier, and the examples of each.
HELD_OUT, FITS, DATASET_SIZE = 0.2, 120, 512
#: Examples of each class that there must be, in training and held out.
MIN_EXAMPLES = 10
#: Shuffles over which the loss of accuracy of an action dimension is averaged.
N_SHUFFLES = 5


class FlattenEntries(BaseFeaturesExtractor):
    """Concatenates all entries of a ``Dict``, flattened; images may have any size and layout."""

    def __init__(self, observation_space: spaces.Dict):
        super().__init__(observation_space, sum(get_flattened_obs_dim(s) for s in observation_space.spaces.values()))

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        return th.cat([entry.flatten(start_dim=1) for entry in observations.values()], dim=1)


class Foresight(NamedTuple):
    """Balanced accuracies on examples that were never trained on."""

    accuracy: float
    #: Of the same classifier, to which every action is zero.
    accuracy_without_action: float
    #: Accuracy that is lost when one dimension of the action is shuffled among the examples.
    action_informs: tuple[float, ...]


def foresee(
    env: gym.Env[Any, Any], obs: Observations, actions: np.ndarray[Any, Any], labels: BoolArray, seed: int
) -> Foresight | None:
    """Fits E as a model does, on a part of the examples, and measures it on the others; None: a class is too rare.

    :param obs: (n, *obs_shape), raw
    :param actions: (n, *action_shape), in the environment's units
    :param labels: (n,)
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
    sighted, blind = _classifier(env, seed), _classifier(env, seed, fused=True)
    for _ in range(FITS):
        examples = knowledge.sample(DATASET_SIZE)
        sighted.fit(examples)
        blind.fit(_without_action(examples))
    held_out = knowledge.sample(n, "validation")
    accuracy = _accuracy(sighted, held_out)
    rng = np.random.default_rng(seed)
    informs = tuple(
        accuracy - float(np.mean([_accuracy(sighted, _shuffled(held_out, i, rng)) for _ in range(N_SHUFFLES)]))
        for i in range(actions.shape[1])
    )
    return Foresight(accuracy, _accuracy(blind, _without_action(held_out)), informs)


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
