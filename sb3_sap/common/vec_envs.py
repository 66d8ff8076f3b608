"""Raw observations of an environment, read through SB3's wrappers of vectorised environments."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.preprocessing import maybe_transpose
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper, VecNormalize, VecTransposeImage

from sb3_sap.common.arrays import same_observation

#: Key of ``info`` for an episode's last observation as it was before VecNormalize.
RAW_LAST = "sap_raw_terminal_observation"


def wrappers(env: VecEnv) -> Iterator[VecEnvWrapper]:
    """The wrappers around a vectorised environment, the outermost first."""
    while isinstance(env, VecEnvWrapper):
        yield env
        env = env.venv


def unwrapped(env: VecEnv) -> VecEnv:
    """The vectorised environment inside of all wrappers."""
    return env.unwrapped


def check_wrappers(env: VecEnv) -> None:
    """Checks the order of wrappers, for some of which SB3's algorithms confuse normalised and raw observations.

    :raise ValueError: for such an order
    """
    above: list[VecEnvWrapper] = []
    normalising = 0
    for wrapper in wrappers(env):
        normalising += isinstance(wrapper, VecNormalize)
        if normalising == 0:
            above.append(wrapper)
    if normalising > 1:
        raise ValueError(
            "`env` is wrapped in VecNormalize twice, so that neither holds the raw observations and rewards that the "
            "replay buffer needs: use one VecNormalize with `norm_obs` and `norm_reward`."
        )
    changing = [wrapper for wrapper in above if wrapper.observation_space != wrapper.venv.observation_space]
    if normalising and changing:
        name = type(changing[-1]).__name__
        raise ValueError(
            f"`env` is wrapped in {name} on top of VecNormalize, below which the replay buffer takes its raw "
            f"observations: wrap the environment the other way round, VecNormalize({name}(env, ...), ...)."
        )


def never_updated(normalize: VecNormalize) -> bool:
    """Whether the statistics of observations were never updated."""
    statistics = normalize.obs_rms if isinstance(normalize.obs_rms, dict) else {"": normalize.obs_rms}
    return all(one.count < 1 for one in statistics.values())


def channels_last(env: VecEnv) -> tuple[str, ...]:
    """The images that the environment gives channels last and the policy sees channels first.

    :return: their keys in a ``Dict`` observation; ``("",)`` where the observation itself is such an image
    """
    for wrapper in wrappers(env):
        if isinstance(wrapper, VecTransposeImage) and not wrapper.skip:
            return tuple(getattr(wrapper, "image_space_keys", ("",)))
    return ()


def environment_layout(obs: Any, images: Iterable[str]) -> Any:
    """Observations as the policy sees them, in the environment's own layout.

    :param obs: one observation or a batch, or such an array for each key
    :param images: what :func:`channels_last` found
    """
    if isinstance(obs, dict):
        return {**obs, **{key: np.moveaxis(obs[key], -3, -1) for key in images}}
    return np.moveaxis(obs, -3, -1) if images else obs


def policy_layout(obs: Any, space: Any) -> Any:
    """Observations in either layout, as the policy sees them.

    :param space: the policy's
    """
    if isinstance(obs, dict):
        return {key: maybe_transpose(np.asarray(value), space[key]) for key, value in obs.items()}
    return maybe_transpose(np.asarray(obs), space)


def unnormalized(normalize: VecNormalize, obs: Any, space: Any) -> Any:
    """Raw observations, as far as they can be recovered from normalised ones, in the environment's dtype.

    :param obs: a batch, as VecNormalize gave it
    :param space: the environment's
    """
    raw = normalize.unnormalize_obs(obs)
    if isinstance(raw, dict):
        return {key: _as_dtype(value, space[key].dtype) for key, value in raw.items()}
    return _as_dtype(raw, space.dtype)


def _as_dtype(values: Any, dtype: Any) -> Any:
    return (np.rint(values) if np.issubdtype(dtype, np.integer) else values).astype(dtype)


def is_at(env: VecEnv, normalize: VecNormalize | None, obs: Any, raw_obs: Any) -> bool:
    """Whether environments are still in the states in which a model last saw them, as far as can be observed.

    :param obs: the last observations that the model saw
    :param raw_obs: the same before VecNormalize
    """
    if normalize is not None:
        return same_observation(normalize.get_original_obs(), raw_obs)
    return not isinstance(env, DummyVecEnv) or same_observation(env._obs_from_buf(), obs)


def shares_environment(env: VecEnv, other: object) -> bool:
    """Whether ``other``, an environment or a vector of them, steps the same environments as ``env``."""
    return bool(_identities(env) & _identities(other))


def _identities(env: object) -> set[int]:
    if isinstance(env, VecEnv):
        inner = unwrapped(env)
        envs = inner.envs if isinstance(inner, DummyVecEnv) else []
        return {id(inner), *(id(one.unwrapped) for one in envs)}
    return {id(env.unwrapped)} if isinstance(env, gym.Env) else set()


@contextmanager
def watched_steps(env: VecEnv, normalize: VecNormalize | None) -> Iterator[list[int]]:
    """Counts the steps and resets of a vectorised environment within a ``with`` block.

    It also puts each episode's last observation, as it was before VecNormalize, into ``info``; SB3 would recover it
    from a rounded and clipped one. Methods are replaced and no wrapper is added, because SB3 compares the wrappers
    with those of evaluation environments.

    :param env: the model's
    :param normalize: its VecNormalize, if there is one
    :return: a list whose only entry is the number of steps and resets so far, whoever called them
    """
    inner = env if normalize is None else normalize.venv
    calls = [0]
    step_wait, reset = inner.step_wait, inner.reset

    def watched_step_wait() -> Any:
        calls[0] += 1
        obs, rewards, dones, infos = step_wait()
        for info in infos if normalize is not None else ():
            if "terminal_observation" in info:
                info[RAW_LAST] = info["terminal_observation"]
        return obs, rewards, dones, infos

    def watched_reset() -> Any:
        calls[0] += 1
        return reset()

    before = dict(vars(inner))
    try:
        inner.step_wait, inner.reset = watched_step_wait, watched_reset  # type: ignore[method-assign]
        yield calls
    finally:
        for name in ("step_wait", "reset"):
            delattr(inner, name)
            if name in before:
                setattr(inner, name, before[name])
