"""Optuna's search spaces for guided algorithms: guidance first, then the predictor, then the base's own space."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import optuna
from rl_zoo3.hyperparams_opt import convert_offpolicy_params

Params = dict[str, Any]
#: (trial, n_actions, n_envs, additional_args) -> hyperparameters, as rl_zoo3 calls it.
Sampler = Callable[[optuna.Trial, int, int, Params], Params]
Converter = Callable[[Params], Params]

#: Smallest and largest t_k, as shares of a run, between which it is sampled on a log scale. The paper's are 1/20 and
#: 1/30.
T_K_SHARES = (1 / 60, 1 / 3)
#: Length of a run where none is given: the paper's short one.
DEFAULT_STEPS = 3_000
#: Settings sampled as powers of 2, because small differences do not matter.
POWERS = ("n_candidates", "dataset_size")
#: Settings of guidance that are sampled as they are.
OWN = ("alpha", "t_k", "alpha_low", "actor_permissibility_coef", "permissibility_coef", "predictor_epochs")
#: Prefix of a trial's parameters that belong to ``predictor_kwargs``.
PREDICTOR_PREFIX = "predictor_"


def t_k_range(n_timesteps: int) -> tuple[int, int]:
    """The smallest and the largest t_k that is tried."""
    low, high = (max(1, round(share * n_timesteps)) for share in T_K_SHARES)
    return low, high


def sample_guidance(trial: optuna.Trial, n_timesteps: int) -> Params:
    """The two parameters of Algorithm 1. alpha 0 is no guidance, so that a study may find guidance useless."""
    low, high = t_k_range(n_timesteps)
    return {"alpha": trial.suggest_float("alpha", 0.0, 1.0), "t_k": trial.suggest_int("t_k", low, high, log=True)}


def sample_predictor(trial: optuna.Trial) -> Params:
    """Settings of E, of the candidates and of the auxiliary loss."""
    return {
        "actor_permissibility_coef": trial.suggest_float("actor_permissibility_coef", 0.0, 3.0),
        "alpha_low": trial.suggest_float("alpha_low", 0.0, 1.0),
        **_sample_fits(trial),
    }


def sample_on_policy(trial: optuna.Trial, has_loss: bool) -> Params:
    """Settings of an on-policy algorithm. alpha 0 without the loss is no guidance.

    :param has_loss: whether the algorithm has a place for the loss
    """
    sampled: Params = {"alpha": trial.suggest_categorical("alpha", [0, 1])}
    if has_loss:
        sampled["permissibility_coef"] = trial.suggest_float("permissibility_coef", 0.0, 5.0)
    sampled["predictor_epochs"] = trial.suggest_float("predictor_epochs", 1.0, 20.0, log=True)
    return sampled | _sample_fits(trial)


def _sample_fits(trial: optuna.Trial) -> Params:
    return {
        "n_candidates_pow": trial.suggest_int("n_candidates_pow", 4, 8),
        "dataset_size_pow": trial.suggest_int("dataset_size_pow", 7, 11),
        "predictor_optimizer_class": trial.suggest_categorical("predictor_optimizer_class", ["Adam", "SGD"]),
        "predictor_learning_rate": trial.suggest_float("predictor_learning_rate", 1e-4, 3e-2, log=True),
        "predictor_weight_decay": trial.suggest_float("predictor_weight_decay", 1e-6, 1e-1, log=True),
    }


def guided_sampler(base: Sampler) -> Sampler:
    """The space of a guided algorithm, given its base's. ``additional_args["guidance_only"]``: alpha and t_k alone."""

    def sample(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: Params) -> Params:
        guidance = sample_guidance(trial, additional_args.get("n_timesteps", DEFAULT_STEPS))
        if additional_args.get("guidance_only"):
            return guidance
        return guidance | _convert_own(sample_predictor(trial)) | base(trial, n_actions, n_envs, additional_args)

    return sample


def on_policy_sampler(base: Sampler, has_loss: bool) -> Sampler:
    """The space of a guided on-policy algorithm, given its base's."""

    def sample(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: Params) -> Params:
        own = _convert_own(sample_on_policy(trial, has_loss))
        return own | base(trial, n_actions, n_envs, additional_args)

    return sample


def guided_converter(base: Converter) -> Converter:
    """Turns the numbers of a stored trial into hyperparameters, so that ``--trial-id`` replays it."""

    def convert(sampled: Params) -> Params:
        own = {name: value for name, value in sampled.items() if _is_own(name)}
        rest = {name: value for name, value in sampled.items() if not _is_own(name)}
        return _convert_own(own) | (base(rest) if rest else {})

    return convert


def _is_own(name: str) -> bool:
    return name in OWN or name.removesuffix("_pow") in POWERS or name.startswith(PREDICTOR_PREFIX)


def _convert_own(sampled: Params) -> Params:
    params: Params = {}
    for name, value in sampled.items():
        if name.startswith(PREDICTOR_PREFIX) and name not in OWN:
            params.setdefault("predictor_kwargs", {})[name.removeprefix(PREDICTOR_PREFIX)] = value
        elif name.removesuffix("_pow") in POWERS:
            params[name.removesuffix("_pow")] = 2**value
        else:
            params[name] = value
    return params


def sample_crossq_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: Params) -> Params:
    """rl_zoo3's space of SAC without the target network, which CrossQ does not have."""
    return convert_crossq_params(
        {
            "one_minus_gamma": trial.suggest_float("one_minus_gamma", 1e-4, 0.1, log=True),
            "learning_rate": trial.suggest_float("learning_rate", 1e-5, 2e-3, log=True),
            "batch_size_pow": trial.suggest_int("batch_size_pow", 5, 9),
            "train_freq": trial.suggest_int("train_freq", 1, 10),
            "net_arch": trial.suggest_categorical("net_arch", ["small", "medium", "big"]),
        }
    )


def convert_crossq_params(sampled: Params) -> Params:
    """Converts like rl_zoo3 for every other off-policy algorithm."""
    converted: Params = convert_offpolicy_params(sampled)
    return converted
