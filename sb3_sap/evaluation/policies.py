"""Loading a policy without its algorithm and its environment."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, cast

from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.save_util import load_from_zip_file

from sb3_sap.evaluation.normalisation import NormalisedPolicy, with_statistics


def load_policy(path: str | Path, vecnormalize: str | Path | None = None) -> BasePolicy | NormalisedPolicy:
    """Loads the policy alone from a model file, whichever SB3 algorithm saved it; it takes raw observations.

    :param vecnormalize: statistics of SB3's ``VecNormalize``; ``None``: those beside the model, where RL Zoo and SB3's
        ``CheckpointCallback`` save them, unless the model is known to have learned on raw observations
    """
    path, vecnormalize = Path(path), None if vecnormalize is None else Path(vecnormalize)
    if not path.is_file():
        raise FileNotFoundError(f"There is no model file {path}: give the .zip that `model.save` or the demo wrote.")
    try:
        data, params, _ = load_from_zip_file(path, device="cpu")
    except (ValueError, EOFError, zipfile.BadZipFile, RuntimeError, KeyError) as error:
        raise ValueError(f"{path} is not a whole model file ({error}): save the model again.") from error
    if data is None or params is None or "policy" not in params:
        raise ValueError(f"{path} holds no SB3 policy: give a file that `model.save` wrote.")
    policy: BasePolicy = data["policy_class"](
        data["observation_space"], data["action_space"], lambda _: 0.0, **data["policy_kwargs"]
    )
    policy.load_state_dict(cast(dict[str, Any], params["policy"]))
    policy.set_training_mode(False)
    return with_statistics(policy, path, data.get("learned_normalised"), vecnormalize)
