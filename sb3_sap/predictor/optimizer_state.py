"""The state of the predictor's optimizer in saved parameters."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from torch.optim import Optimizer


def settings_of(optimizer: Optimizer) -> list[dict[str, Any]]:
    """Learning rate, weight decay and so on of each parameter group, without the parameters."""
    return [{name: value for name, value in group.items() if name != "params"} for group in optimizer.param_groups]


def check_same_optimizer(optimizer: Optimizer, saved: Mapping[str, Any]) -> None:
    """Checks that saved parameters are those of the same optimizer class.

    :param saved: as in a model file, with the key ``"predictor.optimizer"`` if there was a predictor
    :raise TypeError: if they belong to another optimizer
    """
    own = settings_of(optimizer)[0].keys()
    for group in saved.get("predictor.optimizer", {"param_groups": []})["param_groups"]:
        names = group.keys() - {"params"}
        if names - own and own - names:  # names on one side only come from another version of torch
            raise TypeError(
                f"These parameters hold the state of another optimizer than the predictor's "
                f"{type(optimizer).__name__}: build the model with the `predictor_kwargs` of the saved one."
            )
