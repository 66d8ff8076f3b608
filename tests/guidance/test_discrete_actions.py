"""The guided algorithms for discrete actions, where they differ from those for continuous ones."""

import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from states import assert_same_state, reseed
from toy import DISCRETE, Line, build

from sb3_sap import DQNAP, QRDQNAP, GuidedPolicy

every_algorithm = pytest.mark.parametrize("algorithm", DISCRETE)
BASE = {DQNAP: stable_baselines3.DQN, QRDQNAP: sb3_contrib.QRDQN}


class Allows:
    """A predictor that permits the given actions in every state."""

    def __init__(self, *actions):
        self.actions, self.fitted = th.tensor(actions), True

    def features(self, obs):
        return obs

    def logits(self, features, actions):
        return th.isin(actions.flatten(), self.actions).float() - 0.5

    def fit(self, dataset):
        return 0.0

    def recall(self, dataset):
        return 1.0, 1.0


def guided(algorithm, greedy, predictor, n_envs=2000, **settings):
    env = Line(n_actions=4)
    model = build(algorithm, env, alpha=1.0, alpha_low=1.0, **settings)
    model.predictor = predictor
    model.predict = lambda obs, deterministic: (np.full(n_envs, greedy), None)
    model.set_logger(Logger(None, []))
    model._last_obs = np.zeros((n_envs, 2), np.float32)
    model._previous = [None] * n_envs
    model.num_timesteps = 10_000
    return model._sample_action(0, None, n_envs)


@every_algorithm
def test_rejected_action_is_replaced_by_a_random_permissible_one(algorithm):
    action, stored = guided(algorithm, 0, Allows(1, 3))
    np.testing.assert_array_equal(action, stored)
    assert np.issubdtype(action.dtype, np.integer)
    assert action.shape == (2000,)
    assert set(action) == {1, 3}
    assert np.sum(action == 1) == pytest.approx(1000, abs=90)  # 4 standard deviations


@every_algorithm
def test_action_is_executed_unchanged_if_it_is_permissible_or_if_none_is(algorithm):
    assert set(guided(algorithm, 1, Allows(1, 3))[0]) == {1}
    assert set(guided(algorithm, 0, Allows())[0]) == {0}


@every_algorithm
def test_action_forbidden_by_the_user_is_no_candidate(algorithm):
    action, _ = guided(algorithm, 0, Allows(1, 3), permissible_actions=lambda obs, actions: actions != 3)
    assert set(action) == {1}


@every_algorithm
def test_highest_q_selection_takes_the_best_permissible_action(algorithm):
    model = build(algorithm, Line(n_actions=4), candidate_selection="highest_q", alpha=1.0, alpha_low=1.0).learn(60)
    obs = np.random.default_rng(0).normal(size=(50, 2)).astype(np.float32)
    tensor = th.as_tensor(obs)
    with th.no_grad():
        q = model.q_net(tensor) if algorithm is DQNAP else model.quantile_net(tensor).mean(dim=1)
    greedy = q.argmax(dim=1).numpy()
    second = np.argsort(q.numpy(), axis=1)[:, -2]
    model.predictor = Allows(0, 1, 2, 3)
    model.predictor.logits = lambda features, actions: (
        (actions.flatten().long() != th.as_tensor(np.repeat(greedy, len(actions) // 50))).float() - 0.5
    )
    model.predict = lambda obs, deterministic: (greedy, None)
    model._last_obs, model._previous, model.num_timesteps = obs, [None] * 50, 10_000
    np.testing.assert_array_equal(model._sample_action(0, None, 50)[0], second)


@every_algorithm
def test_predictor_learns_and_guides_the_greedy_actions(algorithm):
    # 400 random steps; right of the centre only going left, or standing still, is permissible.
    model = build(algorithm, learning_starts=400, dataset_size=64, predictor_kwargs={"net_arch": [32]}).learn(400)
    assert model.predictor_accurate
    rows = np.array([[-0.8, 0.5], [-0.4, 0.5], [0.4, 0.5], [0.8, 0.5]], dtype=np.float32)
    actions = model.predict(rows, deterministic=True, guided=True)[0]
    assert (actions[:2] >= 1).all()
    assert (actions[2:] <= 1).all()
    single, _ = GuidedPolicy(model).predict(rows[3], deterministic=True)
    assert single == actions[3]


@every_algorithm
def test_replay_buffer_holds_the_executed_actions(algorithm):
    env = DummyVecEnv([lambda: Line(n_actions=3)] * 2)
    model = build(algorithm, env, alpha=1.0, alpha_low=1.0, t_k=10)
    model.predictor = Allows(2)
    model.learn(80)
    executed = np.stack([inner.executed for inner in env.envs], axis=1)
    np.testing.assert_array_equal(model.replay_buffer.actions[:40, :, 0], executed)
    assert (executed[5:] == 2).all()


@every_algorithm
def test_unguided_algorithm_with_a_fitted_predictor_equals_its_base_to_the_bit(algorithm):
    settings = {"learning_starts": 10, "buffer_size": 600, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}}
    base = BASE[algorithm]("MlpPolicy", Line(n_actions=3), seed=1, device="cpu", **settings).learn(150)
    model = build(algorithm, alpha=0.0, alpha_low=0.0).learn(150)
    assert model.predictor.fitted
    for name, value in base.policy.state_dict().items():
        assert th.equal(value, model.policy.state_dict()[name]), name


@every_algorithm
def test_loaded_model_continues_like_the_saved_one(algorithm, tmp_path):
    model = build(algorithm).learn(120)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = algorithm.load(tmp_path / "model", env=Line(n_actions=3))
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert_same_state(model, loaded)
    for one in (model, loaded):
        one._n_calls = 0  # SB3's counter of calls, on which updates of the target network depend, starts anew for both
        reseed(one)
        one.learn(60, reset_num_timesteps=False)
    assert_same_state(model, loaded)


@every_algorithm
def test_predictor_is_fitted_to_normalised_observations(algorithm):
    model = build(algorithm, VecNormalize(DummyVecEnv([lambda: Line(n_actions=3)] * 2))).learn(150)
    assert model.predictor.fitted


@pytest.mark.parametrize("space", [spaces.Box(-1, 1, (1,)), spaces.MultiDiscrete([2, 2])], ids=str)
@every_algorithm
def test_action_space_must_be_discrete(algorithm, space):
    env = Line()
    env.action_space = space
    with pytest.raises(ValueError, match=rf"^{algorithm.__name__} needs an `env` with a discrete \(Discrete\) action"):
        build(algorithm, env)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"actor_learning_rate": 1e-4}, "^`actor_learning_rate` = 0.0001, but DQNAP has no actor"),
        ({"constraint": "toy.nearby"}, "^`constraint` is an interval of continuous actions"),
    ],
)
def test_settings_of_continuous_actions_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        build(DQNAP, **settings)


def test_same_seed_gives_the_same_bits():
    runs = []
    for _ in range(2):
        set_random_seed(99)
        runs.append(build(DQNAP).learn(100))
    assert_same_state(*runs)
