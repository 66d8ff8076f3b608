"""rl_zoo3's command line, which is read from ``sys.argv`` only and whose values are Python."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rl_zoo3.utils

#: rl_zoo3's class, which `NamedStoreDict` replaces there.
STORE_DICT: Any = rl_zoo3.utils.StoreDict


class NamedStoreDict(STORE_DICT):  # type: ignore[misc]
    """``key:value`` pairs whose values are Python, with an error that names the one that is not."""

    def __call__(self, parser: Any, namespace: Any, values: Any, option_string: Any = None) -> None:
        for pair in values:
            key, colon, value = pair.partition(":")
            try:
                super().__call__(parser, namespace, [pair], option_string)
            except Exception as error:
                quoted = f"{key}:\"'{value}'\"" if colon else "alpha:0.7"
                parser.error(f"{option_string} {pair}: {value!r} is no Python ({error}); write it like {quoted}")
        super().__call__(parser, namespace, values, option_string)


@contextmanager
def command_line(command: str, arguments: list[str]) -> Iterator[None]:
    """Puts arguments for rl_zoo3 into ``sys.argv``, from which alone it reads them."""
    before, sys.argv = sys.argv, [f"sb3-sap {command}", *arguments]
    try:
        yield
    finally:
        sys.argv = before
