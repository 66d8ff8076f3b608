"""Saving and loading: functions that no file can hold, settings that cannot change, errors for unusable files."""

from __future__ import annotations

import difflib
import inspect
import warnings
from io import BufferedIOBase
from pathlib import Path
from typing import Any, ClassVar, Self

import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.type_aliases import GymEnv

from sb3_sap.common.functions import can_be_pickled

#: Arguments of the constructor that hold user functions.
FUNCTIONS = ("ap_function", "constraint", "event", "guide_policy", "permissible_actions", "potential")
#: SB3's settings that `load` cannot change, because the file holds a network or an optimizer's state built with them.
HELD = ("ent_coef", "use_sde")


class SavingMixin(BaseAlgorithm):
    """Checks what is saved and loaded. Goes before an SB3 algorithm in the bases of a class."""

    #: Settings that `load` cannot change.
    held: ClassVar[tuple[str, ...]] = HELD

    def __init__(self, *args: Any, **kwargs: Any):
        self._held: dict[str, Any] = {}
        self._unsaved: list[str] = []
        super().__init__(*args, **kwargs)

    def _setup_model(self) -> None:
        # Here and not in the constructor, because `load(**kwargs)` bypasses the constructor.
        held = {name: getattr(self, name) for name in self.held if hasattr(self, name)}
        for name in held:
            if self._held.get(name, held[name]) != held[name]:
                raise ValueError(
                    f"`{name}` = {held[name]!r} cannot be changed by `load`, because the file holds what {name} = "
                    f"{self._held[name]!r} has become: leave it out, or build a new {type(self).__name__}."
                )
        self._held = held
        self._unsaved = [name for name in FUNCTIONS if not can_be_pickled(getattr(self, name, None))]
        for name in self._unsaved:
            warnings.warn(
                f"`{name}` {getattr(self, name)!r} cannot be pickled, so that saved models will not hold it: give a "
                f"function of a module or its dotted name, or pass it again, `load(path, {name}=...)`.",
                stacklevel=2,
            )
        super()._setup_model()  # type: ignore[safe-super]

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *self._unsaved]

    @classmethod
    def load(
        cls,
        path: str | Path | BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> Self:
        """SB3's ``load``, with a clear error for an unusable file; a ``seed`` among ``kwargs`` is applied."""
        known = inspect.signature(cls).parameters
        if "predictor" in kwargs:
            raise TypeError("`load` restores the AP predictor of the file: call `model.set_predictor(...)` afterwards.")
        for name in kwargs.keys() - known.keys():
            if near := difflib.get_close_matches(name, known, n=1, cutoff=0.75):
                raise TypeError(f"`load` was given the unknown setting `{name}`: did you mean `{near[0]}`?")
        try:
            model = super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except AssertionError as error:
            # A file truncated after an embedded torch archive still looks like a valid zip file.
            if "in the saved file" not in str(error):
                raise
            raise ValueError(
                f"The file {path} holds no whole model: was it cut short, or not written by save?"
            ) from error
        except (KeyError, AttributeError) as error:
            raise ValueError(
                f"The file {path} holds no model that {cls.__name__} can take over ({error}): load it with "
                "the class that saved it."
            ) from error
        if kwargs.get("seed") is not None:
            model.set_random_seed(kwargs["seed"])  # in place of the generators that the file holds
        return model
