"""The whole state of a model, to compare one that was loaded with the one that was saved."""

import numpy as np
import torch as th
from stable_baselines3.common.utils import set_random_seed
from toy import DISCRETE, GUIDED


def flat(value, name=""):
    """Every tensor, array and number of nested containers, by path."""
    if isinstance(value, dict):
        return {k: v for key, inner in value.items() for k, v in flat(inner, f"{name}/{key}").items()}
    if isinstance(value, (list, tuple)):
        return flat(dict(enumerate(value)), name)
    return {name: value.numpy() if isinstance(value, th.Tensor) else value}


def knowledge_state(model):
    knowledge = model.replay_buffer.knowledge
    parts = {
        name: [part.counts, part._oldest, *(part.slots(label) for label in (0, 1))]
        for name, part in knowledge.parts.items()
    }
    rng = knowledge.rng.bit_generator.state
    return [knowledge.observations, knowledge.actions, knowledge.seen, parts, rng]


def state(model):
    """All that the next step depends on, by path."""
    found = {"parameters": model.get_parameters(), "steps": model.num_timesteps, "updates": model._n_updates}
    names = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts", "pos", "full")
    found["R"] = [getattr(model.replay_buffer, name) for name in names]
    if hasattr(model, "exploration_rng"):
        found["rng"] = model.exploration_rng.bit_generator.state
    if type(model) in GUIDED + DISCRETE:
        found |= {"K": knowledge_state(model), "accuracy": model.validation_accuracy, "alpha": model.current_alpha}
        found |= {"fitted": model.predictor.fitted, "earlier": model._steps_of_earlier_learns}
    return flat(found)


def assert_same_state(one, other):
    a, b = state(one), state(other)
    assert a.keys() == b.keys()
    for name, value in a.items():
        np.testing.assert_array_equal(value, b[name], err_msg=name)


def reseed(model):
    """Resets what a file does not hold: the episode, and the generators of SB3 and of the environment."""
    model._last_obs = None
    set_random_seed(7)
    model.env.seed(7)
    model.action_space.seed(7)
