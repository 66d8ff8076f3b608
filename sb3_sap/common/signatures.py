"""The whole list of parameters of constructors that pass ``**kwargs`` on, for editors and API pages."""

from __future__ import annotations

import inspect


def merged_signature(cls: type) -> inspect.Signature:
    """The parameters of every ``__init__`` along the MRO, as far as ``**kwargs`` carries them on."""
    found: dict[str, inspect.Parameter] = {}
    for base in cls.__mro__:
        if "__init__" not in vars(base):
            continue
        parameters = list(inspect.signature(vars(base)["__init__"]).parameters.values())[1:]
        passes_on = any(p.kind is p.VAR_KEYWORD for p in parameters)
        for parameter in parameters:
            # What a mixin adds is keyword-only; its other parameters are those it hands to SB3.
            if not passes_on or parameter.kind is parameter.KEYWORD_ONLY:
                found.setdefault(parameter.name, parameter)
        if not passes_on:
            break
    return inspect.Signature(sorted(found.values(), key=lambda parameter: parameter.kind))
