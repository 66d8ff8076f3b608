"""Statistics of SB3's ``VecNormalize`` beside a model file, for a policy that runs without its environment.

A model file does not hold them, and a policy that learned on normalised observations acts at random on raw ones.
"""

from __future__ import annotations

import pickle
import re
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.vec_env import VecNormalize

#: Name of the file in RL Zoo and in SB3's examples.
FILE_NAME = "vecnormalize.pkl"


class NormalisedPolicy:
    """Normalises raw observations as in the training of the policy, with constant statistics.

    :param policy: takes normalised observations
    :param path: the file of the statistics
    :raise FileNotFoundError: if there is none
    :raise ValueError: if it holds no statistics, or those of other observations
    """

    def __init__(self, policy: BasePolicy, path: Path):
        self.policy, self.path = policy, path
        self.statistics = load_statistics(path, policy.observation_space)

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray[Any, Any], Any]:
        """The policy's ``predict`` on the normalised observation, one or a batch."""
        normalised: Any = self.statistics.normalize_obs(observation)
        return self.policy.predict(normalised, state, episode_start, deterministic)


def load_statistics(path: Path, space: spaces.Space[Any]) -> VecNormalize:
    """Reads what ``VecNormalize.save`` wrote, which runs code that the file contains, and compares the shapes."""
    if not path.is_file():
        raise FileNotFoundError(f"There is no file {path}: give the one that `VecNormalize.save` or RL Zoo wrote.")
    try:
        with path.open("rb") as file:
            statistics = pickle.load(file)
    except Exception as error:  # whatever the bytes of another file make pickle do
        raise ValueError(f"{path} cannot be read ({error}): give what `VecNormalize.save` or RL Zoo wrote.") from error
    if not isinstance(statistics, VecNormalize):
        raise ValueError(
            f"{path} holds no VecNormalize but a {type(statistics).__name__}: give what `VecNormalize.save` or RL Zoo "
            "wrote."
        )
    if shapes(statistics.observation_space) != shapes(space):
        raise ValueError(
            f"{path} normalises observations of shape {shapes(statistics.observation_space)}, but the model takes "
            f"{shapes(space)}: give the statistics that were saved with this model."
        )
    return statistics


def shapes(space: spaces.Space[Any]) -> Any:
    """The shape of the observations, or one for each key."""
    return {key: shapes(part) for key, part in space.items()} if isinstance(space, spaces.Dict) else space.shape


def find_statistics(model: Path) -> Path | None:
    """Finds the statistics of a model file where SB3's ``CheckpointCallback``, RL Zoo and this package save them.

    :raise ValueError: if several files could be meant
    """
    folder = model.parent
    names = [model.with_suffix("") / FILE_NAME, model.with_name(FILE_NAME)]
    checkpoint = re.fullmatch(r"(.+)_(\d+_steps)", model.stem)
    if checkpoint:
        names.insert(0, model.with_name("{}_vecnormalize_{}.pkl".format(*checkpoint.groups())))
    # RL Zoo keeps them in `ENV_ID/`, with the settings of the run; its models lie beside that folder.
    found = [path for path in names if path.is_file()][:1] or [
        path for path in sorted(folder.glob(f"*/{FILE_NAME}")) if path.with_name("config.yml").is_file()
    ]
    if len(found) > 1:
        raise ValueError(f"{model} may belong to {' or '.join(map(str, found))}: name one with `--vecnormalize`.")
    return found[0] if found else None


def with_statistics(
    policy: BasePolicy, model: Path, learned_normalised: bool | None, given: Path | None
) -> BasePolicy | NormalisedPolicy:
    """The policy, wrapped with the statistics that are given, or found beside the model, if it needs any.

    :param learned_normalised: whether the model learned on normalised observations; ``None``: unknown
    """
    path = given or (None if learned_normalised is False else find_statistics(model))
    if path is None:
        if learned_normalised:
            raise ValueError(
                f"{model} learned on normalised observations, whose statistics the file does not hold: give them with "
                f"`--vecnormalize FILE`, or put the {FILE_NAME} that `VecNormalize.save` writes beside it."
            )
        return policy
    normalised = NormalisedPolicy(policy, path)
    if learned_normalised is False and normalised.statistics.norm_obs:
        raise ValueError(f"{model} learned on raw observations: leave `--vecnormalize` out.")
    return normalised
