"""Adds the algorithms and their search spaces to rl_zoo3; ``import sb3_sap`` registers the environments."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import rl_zoo3.utils
from rl_zoo3 import ALGOS
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from sb3_contrib import TRPO
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_sap.algorithms import ALGORITHMS
from sb3_sap.guidance.mixin import ActionPermissibilityMixin
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS
from sb3_sap.zoo.configs import evaluation_options
from sb3_sap.zoo.spaces import (
    convert_crossq_params,
    guided_converter,
    guided_sampler,
    on_policy_sampler,
    sample_crossq_params,
)

#: rl_zoo3's names of its algorithms.
BASES: dict[type, str] = {algorithm: name for name, algorithm in ALGOS.items()}


def register() -> None:
    """Adds every algorithm of this package to rl_zoo3's tables; a second call changes nothing."""
    samplers: dict[str, Any] = HYPERPARAMS_SAMPLER
    converters: dict[str, Any] = HYPERPARAMS_CONVERTER
    # rl_zoo3 2.9.2 has no space for CrossQ, which it knows.
    samplers["crossq"], converters["crossq"] = sample_crossq_params, convert_crossq_params
    for name, algorithm in ALGORITHMS.items():
        base = next(BASES[cls] for cls in algorithm.__mro__ if cls in BASES)
        ALGOS[name], samplers[name], converters[name] = algorithm, samplers[base], converters[base]
        if issubclass(algorithm, ActionPermissibilityMixin):
            samplers[name] = guided_sampler(samplers[base])
            converters[name] = guided_converter(converters[base])
    for name, on_policy in ON_POLICY_ALGORITHMS.items():
        base = next(BASES[cls] for cls in on_policy.__mro__ if cls in BASES)
        has_loss = not issubclass(on_policy, TRPO)  # whose step has no place for it
        ALGOS[name] = on_policy
        samplers[name], converters[name] = (
            on_policy_sampler(samplers[base], has_loss),
            guided_converter(converters[base]),
        )


@contextmanager
def small_buffers() -> Iterator[None]:
    """Loads models with tiny buffers, for commands that do not train.

    rl_zoo3 2.9.2 does so for the off-policy algorithms that `enjoy` and `record_video` know by name, and allocates the
    whole buffer of every other.
    """
    before = dict(ALGOS)
    ALGOS.update(
        {name: _with_small_buffers(cls) for name, cls in before.items() if issubclass(cls, OffPolicyAlgorithm)}
    )
    try:
        yield
    finally:
        ALGOS.update(before)


@contextmanager
def saved_env_options() -> Iterator[None]:
    """Lets rl_zoo3's `record_video` make the environment with the options of the run's entry, as its `enjoy` does."""
    make: Any = rl_zoo3.utils.create_test_env

    def make_with_options(*args: Any, **kwargs: Any) -> Any:
        given = kwargs.pop("env_kwargs", None) or {}
        return make(*args, env_kwargs={**evaluation_options(kwargs["hyperparams"]), **given}, **kwargs)

    rl_zoo3.utils.create_test_env = make_with_options
    try:
        yield
    finally:
        rl_zoo3.utils.create_test_env = make


def _with_small_buffers(algorithm: type[OffPolicyAlgorithm]) -> type[OffPolicyAlgorithm]:
    small: dict[str, Any] = {"buffer_size": 1, "optimize_memory_usage": False}
    if issubclass(algorithm, ActionPermissibilityMixin):
        small |= {"knowledge_buffer_size": 20, "validation_fraction": 0.5, "min_per_class": 1}

    def load(cls: type, *args: Any, **kwargs: Any) -> OffPolicyAlgorithm:
        return algorithm.load(*args, **kwargs | small)

    return type(algorithm.__name__, (algorithm,), {"load": classmethod(load)})
