"""User functions: importing them by their dotted names, and whether a saved model can hold them."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, TypeVar

import cloudpickle

F = TypeVar("F", bound=Callable[..., Any])


def resolve(function: F | str, argument: str) -> F:
    """Returns ``function``, importing it first when it is a dotted name such as ``"package.module.function"``.

    :param argument: the name of the constructor argument, for the error message
    """
    if callable(function):
        return function
    parts = function.split(".") if isinstance(function, str) else []
    if len(parts) < 2 or not all(map(str.isidentifier, parts)):
        raise TypeError(
            f"`{argument}` must be a function or its dotted name 'package.module.function', but is {function!r}."
        )
    try:
        found = getattr(importlib.import_module(".".join(parts[:-1])), parts[-1])
    except (ImportError, AttributeError) as error:
        raise ValueError(
            f"`{argument}`: {function!r} cannot be imported ({error}): give 'package.module.function' "
            "of a module that is on the Python path."
        ) from error
    if not callable(found):
        raise TypeError(f"`{argument}`: {function!r} names a {type(found).__name__}, but must name a function.")
    return found  # type: ignore[no-any-return]


def can_be_pickled(value: Any) -> bool:
    """Whether a saved model can hold a value."""
    try:
        cloudpickle.dumps(value)
    except Exception:  # whatever an object's own pickling raises
        return False
    return True
