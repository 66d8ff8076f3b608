"""The file of an AP predictor: weights, architecture and spaces as plain data, so that reading it runs no code."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common import torch_layers
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_sap.common import extractors
from sb3_sap.common.files import atomic_path
from sb3_sap.common.space_data import space_from_data, space_to_data

#: Where the names of classes in a file are looked up, and nowhere else.
_MODULES: dict[str, tuple[Any, ...]] = {
    "activation_fn": (nn,),
    "optimizer_class": (th.optim,),
    "features_extractor_class": (torch_layers, extractors),
}
FORMAT = 1


def write_predictor(predictor: Any, path: str | Path) -> None:
    """Writes a :class:`~sb3_sap.predictor.network.PermissibilityPredictor`.

    :raise ValueError: if it has arguments that plain data cannot express
    """
    arguments = predictor._get_constructor_parameters()
    spaces = {name: space_to_data(arguments.pop(name)) for name in ("observation_space", "action_space")}
    for name, modules in _MODULES.items():
        cls = arguments[name]
        arguments[name] = cls.__name__
        if not any(getattr(module, cls.__name__, None) is cls for module in modules):
            arguments[name] = f"{cls.__module__}.{cls.__qualname__}"  # which only the reader can pass
    data = {
        "format": FORMAT,
        "spaces": spaces,
        "arguments": arguments,
        "weights": predictor.state_dict(),
        "optimizer": predictor.optimizer.state_dict(),
        "about": predictor.about,
    }
    with atomic_path(Path(path)) as temporary:
        th.save(data, temporary)
        try:
            th.load(temporary, weights_only=True)
        except pickle.UnpicklingError as error:
            raise ValueError(
                "This AP predictor has arguments that a file of plain data cannot hold, such as objects in "
                "`features_extractor_kwargs` or `optimizer_kwargs`: save the whole model instead."
            ) from error


def read_predictor(cls: Any, path: str | Path, device: Any = "auto", **arguments: Any) -> Any:
    """Reads what `write_predictor` wrote; nothing in the file is executed.

    :param cls: the class of the predictor
    :param arguments: in place of those of the file, for instance a ``features_extractor_class`` of one's own
    :raise ValueError: with one sentence, if the file holds no predictor
    """
    from stable_baselines3.common.utils import get_device

    if not Path(path).is_file():
        raise FileNotFoundError(f"There is no file {path}.")
    try:
        data = th.load(path, map_location=get_device(device), weights_only=True)
    except Exception as error:  # whatever a file of another kind makes torch raise
        raise ValueError(f"{path} holds no AP predictor: it is not a file that `predictor.save` wrote.") from error
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise ValueError(f"{path} holds no AP predictor that this version of sb3_sap can read.")
    found = {**data["arguments"], **arguments}
    for name, modules in _MODULES.items():
        if isinstance(found[name], str):
            classes = [getattr(module, found[name]) for module in modules if hasattr(module, found[name])]
            if not classes:
                raise ValueError(
                    f"The AP predictor of {path} was built with {name} = {found[name]}, which is not of torch, SB3 or "
                    f"sb3_sap: pass it, as in PermissibilityPredictor.load(path, {name}=...)."
                )
            found[name] = classes[0]
    predictor = cls(*(space_from_data(data["spaces"][name]) for name in ("observation_space", "action_space")), **found)
    predictor.load_state_dict(data["weights"])
    predictor = predictor.to(get_device(device))
    predictor.optimizer.load_state_dict(data["optimizer"])
    predictor.about = data["about"]
    return predictor


def check_same_spaces(predictor: Any, observation_space: Any, action_space: Any) -> None:
    """Raises a ``ValueError`` if a predictor is of other spaces."""
    for name, own in (("observation_space", observation_space), ("action_space", action_space)):
        other = getattr(predictor, name)
        if own != other:
            raise ValueError(
                f"The AP predictor is of the {name} {other}, but here it is {own}: it can only be used with the same "
                "spaces."
            )


def statistics_of(env: VecNormalize | None) -> dict[str, Any] | None:
    """How observations are normalised, as plain data; None: they are not."""
    if env is None or not env.norm_obs:
        return None
    moments = env.obs_rms if isinstance(env.obs_rms, dict) else {"": env.obs_rms}
    return {
        "moments": {key: [th.as_tensor(one.mean), th.as_tensor(one.var)] for key, one in moments.items()},
        "clip_obs": float(env.clip_obs),
    }


def check_statistics(saved: dict[str, Any] | None, env: VecNormalize | None) -> None:
    """Checks that observations are normalised as they were when E was fitted.

    :raise ValueError: if they are not
    """
    own = statistics_of(env)
    if saved is None and own is None:
        return
    if own is None:
        raise ValueError(
            "This AP predictor was fitted to normalised observations, but this environment has no VecNormalize: wrap "
            "it with the same statistics, `VecNormalize.load(path, env)`."
        )
    if saved is None:
        raise ValueError(
            "This AP predictor was fitted to raw observations, but VecNormalize changes those of this environment: "
            "leave VecNormalize out, or use `norm_obs=False`."
        )
    same = saved["moments"].keys() == own["moments"].keys() and all(
        np.allclose(a, b, rtol=0.1, atol=1e-3)
        for key in own["moments"]
        for a, b in zip(saved["moments"][key], own["moments"][key], strict=True)
    )
    if not same:
        raise ValueError(
            "This AP predictor was fitted to observations that were normalised with other statistics: load them with "
            "`VecNormalize.load(path, env)`, as they were saved beside it."
        )
