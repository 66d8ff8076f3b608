"""Each ablated variant differs from DDPG-AP in one thing."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stubs import StubPredictor, above
from toy import GUIDED, Line, build

from sb3_sap.benchmark.ablated import DDPGAPProposed, DDPGAPUnbalanced, KilometresPerHour, TorcsKeras, UnbalancedFit

assert GUIDED  # build() gives small settings to those that it knows; here they are given by hand
SMALL = {"dataset_size": 16, "validation_size": 8, "min_per_class": 2, "alpha": 1.0, "alpha_low": 1.0}


def test_proposed_actions_in_r_and_executed_ones_in_k():
    env = Line()
    model = build(DDPGAPProposed, env, **SMALL)
    model.predictor = StubPredictor(above(0.5))
    proposed = []
    predict = model.predict
    model.predict = lambda *args, **kwargs: (proposed.append(predict(*args, **kwargs)), proposed[-1])[1]
    model.learn(60)
    executed = np.array(env.executed)
    assert (executed[10:] > 0.5).mean() > 0.8
    knowledge = model.replay_buffer.knowledge
    in_k = np.concatenate([knowledge.actions[knowledge._offset[p] :][: len(s)] for p, s in knowledge.parts.items()])
    np.testing.assert_allclose(np.sort(in_k, axis=0), np.sort(executed, axis=0), atol=1e-6)
    stored = model.replay_buffer.actions[:60, 0]
    np.testing.assert_array_equal(stored[:10], executed[:10])  # the warm-up proposes what it executes
    np.testing.assert_allclose(stored[10:], [action for action, _ in proposed for action in action], atol=1e-6)


def test_unbalanced_fits(monkeypatch):
    fits = []
    monkeypatch.setattr(UnbalancedFit, "fit", lambda self: fits.append(self.num_timesteps))
    build(DDPGAPUnbalanced, **SMALL).learn(60, callback=lambda *_: True)
    assert fits[-1] == 60


@pytest.mark.parametrize(
    ("units", "expected"),
    [(KilometresPerHour, [0.1, -0.5, 50.0, 1.0, 0.0]), (TorcsKeras, [0.1 / np.pi, -0.5, 50 / 300, 1 / 300, 0.0])],
)
def test_other_units_of_a_car_at_50_km_h(units, expected):
    extractor = units(gym.make("sap/LaneKeeping-v0").observation_space)
    np.testing.assert_allclose(extractor(th.tensor([[0.1, -0.5, 1.0, 0.02, 0.0]])), [expected], rtol=1e-6)
