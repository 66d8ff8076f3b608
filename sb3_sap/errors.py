"""What the user got wrong, told in one sentence."""

from __future__ import annotations

import argparse
import difflib
import sys
from collections.abc import Callable, Iterable
from numbers import Real

from gymnasium.error import Error as EnvironmentProblem


def run_command(command: Callable[[], int]) -> int:
    """Runs a command and returns its exit code; an error that the user can mend becomes one sentence."""
    try:
        return command()
    except KeyboardInterrupt:
        print("sb3-sap: interrupted; what was written so far is kept.", file=sys.stderr)
        return 130
    except (ValueError, TypeError, OSError, RuntimeError, ImportError, EnvironmentProblem) as error:
        print(f"sb3-sap: error: {error}", file=sys.stderr)
        return 1


def positive(text: str) -> int:
    """A flag's value that must be a whole number of 1 or more."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be 1 or more, but is {number}")
    return number


def not_negative(text: str) -> int:
    """A flag's value that must be a whole number of 0 or more."""
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"must be 0 or more, but is {number}")
    return number


def is_number(value: object) -> bool:
    """Whether a setting is a real number, whatever its annotation promises."""
    return isinstance(value, Real)


def nearest(value: object, known: Iterable[str]) -> str:
    """The end of a sentence that calls ``value`` unknown: the valid name nearest to it, or all of them."""
    names = list(known)
    near = difflib.get_close_matches(str(value), names, n=1)
    return f"did you mean {near[0]!r}?" if near else f"choose one of {', '.join(map(repr, names))}."
