"""What every command of ``sb3-sap`` shares: errors as one sentence, and flags that must be whole numbers."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from gymnasium.error import Error as GymnasiumError


def run_command(command: Callable[[], int]) -> int:
    """Runs a command and returns its exit code; an expected error is printed as one sentence."""
    try:
        return command()
    except KeyboardInterrupt:
        print("sb3-sap: interrupted; what was written so far is kept.", file=sys.stderr)
        return 130
    except (ValueError, TypeError, OSError, RuntimeError, ImportError, GymnasiumError) as error:
        print(f"sb3-sap: error: {error}", file=sys.stderr)
        return 1


def positive(text: str) -> int:
    """Parses the value of a flag that must be a whole number of at least 1."""
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError(f"must be 1 or more, but is {number}")
    return number


def not_negative(text: str) -> int:
    """Parses the value of a flag that must be a whole number of at least 0."""
    number = int(text)
    if number < 0:
        raise argparse.ArgumentTypeError(f"must be 0 or more, but is {number}")
    return number
