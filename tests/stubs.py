"""Models with a stub actor and a stub predictor, whose decisions can be computed in the head."""

import numpy as np
import torch as th
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.noise import ActionNoise
from toy import build

from sb3_sap import DDPGAP


class StubPredictor:
    """A predictor with the given logits, a function of (obs, actions), which records its queries."""

    def __init__(self, logits_of, fitted=True):
        self.logits_of, self.fitted = logits_of, fitted
        self.queries = []  # number of rows of each

    def features(self, obs):
        return obs

    def logits(self, features, actions):
        self.queries.append(len(actions))
        return self.logits_of(features, actions)

    def fit(self, dataset):
        return 0.0

    def recall(self, dataset):
        return 1.0, 1.0


class Constant(ActionNoise):
    """Noise of one value, which counts its calls."""

    def __init__(self, value):
        self.value, self.calls = value, 0

    def __call__(self):
        self.calls += 1
        return np.array([self.value], dtype=np.float32)


def above(border):
    """Logits that permit the actions above a border."""
    return lambda obs, actions: actions[:, 0] - border


def never(obs, actions):
    raise AssertionError("the predictor must not be queried here")


def deny(obs, actions):
    return -th.ones(len(actions))


def guided(
    actor, logits_of, *, alpha=1.0, obs=None, n_candidates=4, fitted=True, algorithm=DDPGAP, env=None, **settings
):
    """A model past t_k whose actor always returns ``actor`` (env units) and whose predictor has the given logits."""
    model = build(algorithm, env, alpha=alpha, alpha_low=alpha, n_candidates=n_candidates, **settings)
    model.predictor = StubPredictor(logits_of, fitted)
    model.predict = lambda obs, deterministic: (np.array(actor, dtype=model.action_space.dtype), None)
    model.set_logger(Logger(None, []))
    model._last_obs = np.zeros((len(actor), 2), np.float32) if obs is None else np.array(obs, np.float32)
    model._last_original_obs = model._last_obs
    model._previous = [None] * len(actor)
    model.num_timesteps = 10_000
    return model


def sample(model, noise=None):
    """The actions that the model chooses for its last observations: in env units, and scaled."""
    return model._sample_action(model.learning_starts, noise, len(model._last_obs))
