"""Reads YAML in which ``1e-3`` is a number, as in YAML 1.2 and in Python; PyYAML's own loader takes it for a word."""

from __future__ import annotations

import re
from typing import Any

import yaml


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """PyYAML's safe loader with numbers like ``1e-3``."""


_NUMBER = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _NUMBER, list("-+0123456789"))


def read_yaml(text: str) -> Any:
    """The value that a text stands for.

    :raise yaml.YAMLError: if the text is not YAML
    """
    return yaml.load(text, _Loader)
