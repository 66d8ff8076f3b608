"""The predictor's probabilities, as numbers and as pictures."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sb3_sap.common.arrays import FloatArray, Observations
from sb3_sap.predictor.pairs import query_candidates

#: Points along each axis of a picture.
RESOLUTION = 121
#: Magnitude beyond which a bound of the space does not describe the values that occur.
UNBOUNDED = 1e6


@th.no_grad()
def permissible_probability(
    model: Any, obs: Observations, actions: np.ndarray[Any, Any], part: str | None = None
) -> FloatArray:
    """E's probability that an action is permissible, for m actions in each of n states.

    :param model: a guided model
    :param obs: (n, *obs_shape) raw observations, or one such array per key
    :param actions: (n, m, *action_shape), or (m, *action_shape) for every state, in the environment's units
    :param part: of the action, one of ``action_parts``; ``None``: the action as a whole
    :return: (n, m)
    """
    tensors, _ = model.policy.obs_to_tensor(_normalised(model, obs))
    features = model.predictor.features(tensors)
    number = None if part is None else model.parts.names.index(part)
    shape = model.action_space.shape
    scaled = actions if isinstance(model.action_space, spaces.Discrete) else model.policy.scale_action(actions)
    if actions.ndim == len(shape) + 1:
        scaled = np.repeat(scaled[None], len(features), axis=0)
    logits = query_candidates(model.predictor, features, scaled.reshape(*scaled.shape[:2], -1), number)
    return np.asarray(1 / (1 + np.exp(-logits.astype(np.float64))))


def plot_permissibility(
    model: Any,
    variable: int | tuple[str, int] = 0,
    action: int = 0,
    obs: Any = None,
    limits: tuple[float, float] | None = None,
    variable_name: str | None = None,
    action_name: str | None = None,
    axis: Axes | None = None,
) -> Figure:
    """Draws the predicted permissible region over one state variable and one action, with the actor's choice on it.

    All values are in the environment's units. The other state variables keep the values of one observation, and the
    other actions are the actor's.

    :param model: a guided model whose predictor was fitted
    :param variable: index of the state variable in the flattened observation; of a ``Dict``: (key, index)
    :param action: index of the action in the flattened action; a ``Discrete`` space has one
    :param obs: the observation whose other variables are held; ``None``: a typical one of the training, or
        zeros where none is known, which the title then says
    :param limits: of the variable; ``None``: the 1st to the 99th percentile in K, or the bounds of the space
    :param variable_name: for the axis
    :param action_name: for the axis
    :param axis: where to draw; ``None``: a figure of its own
    :raise ValueError: for a model without a fitted predictor, or an index that does not exist
    """
    if not getattr(getattr(model, "predictor", None), "fitted", False):
        raise ValueError(
            f"`model` must be a guided model whose predictor was fitted, but this {type(model).__name__} has none: "
            "train it first, until K holds `min_per_class` examples of each class."
        )
    key, index = variable if isinstance(variable, tuple) else ("", variable)
    whole = model.observation_space
    space = dict(whole).get(key) if isinstance(whole, spaces.Dict) else None if key else whole
    n_actions = int(np.prod(model.action_space.shape or (1,)))
    if (
        not isinstance(space, spaces.Box)
        or index not in range(int(np.prod(space.shape)))
        or action not in range(n_actions)
    ):
        raise ValueError(
            f"`variable` = {variable!r}, `action` = {action!r}: there is no such variable of a Box in "
            f"{model.observation_space} or no such action in {model.action_space}."
        )
    seen = _training_observations(model)
    if limits is None:
        occurred = None if seen is None else seen[key].reshape(len(seen[key]), -1)[:, index]
        limits = _limits(space.low.flat[index], space.high.flat[index], occurred)
    values = np.linspace(*limits, RESOLUTION)
    held = _typical_observation(model) if obs is None else obs
    unknown = held is None
    if unknown:
        held = _zeros(model.observation_space)
    rows = held if isinstance(held, dict) else {"": held}
    rows = {k: np.repeat(np.asarray(v)[None], RESOLUTION, axis=0) for k, v in rows.items()}
    rows[key].reshape(RESOLUTION, -1)[:, index] = values
    if axis is None:
        axis = Figure(figsize=(6, 4.4), layout="constrained").subplots()
    image = draw_permissibility(axis, model, values, rows.get("", rows), action)
    axis.set(xlabel=variable_name or f"{key or 'observation'}[{index}]")
    axis.set(ylabel=action_name or ("action" if n_actions == 1 else f"action[{action}]"))
    if unknown:
        axis.set_title("the other variables are held at 0: such a state may not occur", fontsize="small")
    figure = axis.get_figure(root=True)
    assert figure is not None
    figure.colorbar(image, ax=axis, label="E: probability of permissible")
    return figure


def draw_permissibility(axis: Axes, model: Any, values: FloatArray, obs: Observations, action: int = 0) -> Any:
    """Draws E's probability over one action in each of n states, and the actor's choice, into a matplotlib axis.

    :param values: (n,) position of each state along the horizontal axis
    :param obs: (n, *obs_shape) raw
    :return: the image, for a colour bar
    """
    space = model.action_space
    chosen = model.predict(_normalised(model, obs), deterministic=True)[0]
    if isinstance(space, spaces.Discrete):
        heights: Any = np.arange(space.n)  # discrete actions count from 0 in SB3
        probability = permissible_probability(model, obs, heights)
        picked, style = chosen.reshape(-1), "k."
        axis.set_yticks(heights)
    else:
        heights = np.linspace(space.low.flat[action], space.high.flat[action], RESOLUTION)
        tried = np.repeat(chosen.reshape(len(values), 1, -1), RESOLUTION, axis=1)
        tried[:, :, action] = heights
        # With parts of the action the verdict is on the one that is drawn.
        named = zip(model.parts.names, model.parts.indices, strict=True)
        part = next((name for name, indices in named if action in indices), None)
        probability = permissible_probability(model, obs, tried.reshape(*tried.shape[:2], *space.shape), part)
        picked, style = chosen.reshape(len(values), -1)[:, action], "k-"
        axis.set_ylim(heights[0], heights[-1])
    image = axis.pcolormesh(values, heights, probability.T, cmap="RdYlGn", vmin=0, vmax=1, shading="nearest")
    axis.plot(values, picked, style, linewidth=2, label="the actor")
    axis.legend(loc="upper right")
    return image


def _normalised(model: Any, obs: Observations) -> Any:
    """Raw observations as the policy gets them."""
    env = model.get_vec_normalize_env()
    return obs if env is None else env.normalize_obs(obs)


def _training_observations(model: Any) -> dict[str, np.ndarray[Any, Any]] | None:
    """The raw training observations of K, per key; None where there are none, as after ``load``."""
    return model.knowledge.training_observations() if len(model.knowledge) else None


def _typical_observation(model: Any) -> Any:
    """A raw observation that occurred; None where none is known."""
    typical = model.knowledge.typical_observation()
    return model.typical_observation if typical is None else typical


def _zeros(space: Any) -> Any:
    keyed: Any = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    rows = {key: np.clip(np.zeros(s.shape, s.dtype), s.low, s.high) for key, s in keyed.items()}
    return rows if isinstance(space, spaces.Dict) else rows[""]


def _limits(low: float, high: float, seen: np.ndarray[Any, Any] | None) -> tuple[float, float]:
    if seen is not None:
        low, high = np.percentile(seen, [1, 99])
    return (float(low), float(high)) if -UNBOUNDED < low < high < UNBOUNDED else (-1.0, 1.0)
