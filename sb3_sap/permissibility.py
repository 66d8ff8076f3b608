"""The AP function f(s, a | s') of section 4.1: the user's knowledge of which executed actions were mistakes."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from sb3_sap.common.arrays import BoolArray, FloatArray, Observations, copy_observation
from sb3_sap.common.reward_shaping import PotentialError, RewardScale, RewardShaping, query_potential


class APFunction(Protocol):
    """Labels a batch of executed actions, Definition 3.

    An action that is labelled False can never be part of an optimal solution; one that is labelled True is
    merely not known to be bad.

    :param obs: s, raw (never normalised) observations, (n, *obs_shape)
    :param actions: a, in the units of the environment's action space, (n, *action_shape)
    :param next_obs: s', the true next observations (never those after an automatic reset), (n, *obs_shape); for a model
        with a ``horizon`` h above 1 the h observations that follow, (n, h, *obs_shape), where an episode that ended,
        terminated or truncated, repeats its last one
    :return: (n,) bool, True where the action was permissible; with ``action_parts`` (n, k), one label for each of k
        parts
    """

    def __call__(self, obs: Observations, actions: np.ndarray[Any, Any], next_obs: Observations, /) -> BoolArray: ...


class ActionPermissibility(gym.Wrapper[Any, Any, Any, Any]):
    """Puts the label of each executed action into ``info["permissible"]``, and subtracts a penalty for mistakes.

    The penalty is for algorithms other than those of this package, whose ``penalty=`` leaves logged returns alone. To
    have them logged without it, put the ``Monitor`` inside: ``ActionPermissibility(Monitor(env), f, penalty=1.0)``, and
    evaluate in an environment without this wrapper.

    :param env: the environment to wrap
    :param permissible: f(s, a | s') of one step: ``permissible(obs, action, next_obs) -> bool``; ``None``: the
        environment's own ``info["permissible"]``
    :param penalty: c, subtracted from the reward of a non-permissible action; ``"auto"``: the root mean square of the
        rewards so far, ``"auto_0.5"``: half of it
    """

    def __init__(
        self,
        env: gym.Env[Any, Any],
        permissible: Callable[[Any, Any, Any], bool] | None = None,
        penalty: float | str = 0.0,
    ):
        super().__init__(env)
        self.shaping, self.reward_scale = RewardShaping(penalty), RewardScale()
        if not (permissible is None or callable(permissible)):
            raise TypeError(
                "`permissible` must be a function (obs, action, next_obs) -> bool of one step, "
                f"but is {permissible!r}: pass the function itself."
            )
        self.permissible = permissible
        self._obs: Any = None

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        obs, info = self.env.reset(**kwargs)
        self._obs = copy_observation(obs)
        return obs, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        next_obs, reward, terminated, truncated, info = self.env.step(action)
        if self.permissible is not None:
            info = {**info, "permissible": self.permissible(self._obs, action, next_obs)}
        if self.shaping:
            reward = float(reward)
            self.reward_scale.update(reward)
            label = np.asarray(info.get("permissible"))
            parts = tuple(map(str, range(label.size))) if label.ndim == 1 else ()
            [added] = self.shaping.of_labels(labels_from_infos([info], parts), float(self.reward_scale))
            reward += float(added)
        self._obs = copy_observation(next_obs)
        return next_obs, reward, terminated, truncated, info


def does_not_lower(potential: Callable[[Observations], FloatArray]) -> APFunction:
    """The AP function of a potential Φ: an action is permissible if Φ(s') >= Φ(s).

    :param potential: (n,) values of n raw observations
    """

    def ap_function(obs: Observations, actions: np.ndarray[Any, Any], next_obs: Observations) -> BoolArray:
        later, now = (query_potential(potential, o, len(actions)) for o in (next_obs, obs))
        return np.asarray(later >= now)

    return ap_function


def query_labels(
    function: Callable[..., Any],
    argument: str,
    obs: Observations,
    actions: np.ndarray[Any, Any],
    *next_obs: Any,
    parts: tuple[str, ...] = (),
) -> BoolArray:
    """Calls a user's function with a batch of actions and checks the labels that it returns.

    :param argument: the name of the constructor argument that holds the function, for the error messages
    :param obs: s, raw, (n, *obs_shape)
    :param actions: a, in the environment's units, (n, *action_shape)
    :param next_obs: s', for functions that take it
    :param parts: names of the parts of the action that have labels of their own
    :return: (n,) bool, with parts (n, k)
    :raise RuntimeError: if the function raises an error
    :raise TypeError: if the labels are not bool
    :raise ValueError: if their shape is another
    """
    name = getattr(function, "__name__", repr(function))
    n = len(actions)
    try:
        # Copies, because a function that works in place would change what is stored and executed.
        labels = np.asarray(function(*map(copy_observation, (obs, actions, *next_obs))))
    except PotentialError:
        raise
    except Exception as error:
        batches = "(obs, actions, next_obs)" if next_obs else "(obs, actions)"
        raise RuntimeError(
            f"`{argument}` {name} raised {type(error).__name__}: {error}. It is called with batches "
            f"{batches} of n = {n} rows; here the actions have shape {actions.shape}."
        ) from error
    if labels.dtype != np.bool_:
        true = "True where it happened" if argument == "event" else "True where permissible"
        what = "NaN" if labels.dtype.kind == "f" and np.isnan(labels).any() else f"values of type {labels.dtype}"
        raise TypeError(f"`{argument}` {name} returned {what}, but must return bool: {true}.")
    shape = (n, len(parts)) if parts else (n,)
    if labels.shape != shape:
        each = f" and each of the `action_parts` {', '.join(parts)}" if parts else ""
        several = labels.ndim == 2 and argument.startswith("ap_function") and not parts
        hint = ". Labels of parts of the action need `action_parts`" if several else ""
        raise ValueError(
            f"`{argument}` {name} returned an array of shape {labels.shape} for {n} actions, but must return "
            f"shape {shape}: one label for each row of the batch{each}{hint}."
        )
    return labels


def labels_from_infos(infos: list[dict[str, Any]], parts: tuple[str, ...] = ()) -> BoolArray:
    """Collects the labels that environments or :class:`ActionPermissibility` put into ``info["permissible"]``.

    :param infos: one ``info`` of each environment
    :param parts: names of the parts of the action that have labels of their own
    :return: (n_envs,) bool, with parts (n_envs, k)
    """
    for info in infos:
        if "permissible" not in info:
            raise ValueError(
                'There is no AP function: the environment puts no "permissible" into `info`. Pass `ap_function=` '
                "to the algorithm, or wrap the environment in `ActionPermissibility(env, function)`."
            )
        found = np.asarray(info["permissible"])
        if found.dtype != np.bool_ or found.shape != ((len(parts),) if parts else ()):
            wanted = f"an array of {len(parts)} bool, one for each of {', '.join(parts)}," if parts else "a bool,"
            raise TypeError(f'`info["permissible"]` must be {wanted} but is {info["permissible"]!r}.')
    return np.array([info["permissible"] for info in infos], dtype=bool)
