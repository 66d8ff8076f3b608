"""Labels of a rollout, what they add to its rewards, and when E is fitted to them."""

import math

import numpy as np
import pytest
import torch as th
from rollouts import MULTI_DISCRETE, Recorder, build_on_policy, even, judged_by, never_labels
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stubs import above
from toy import Line, centred, towards_centre

from sb3_sap import A2CAP, PPOAP, PermissibilityCallback, RecurrentPPOAP
from sb3_sap.onpolicy.loss import PermissibilityLoss
from sb3_sap.onpolicy.trust import Agreement
from sb3_sap.predictor.schedule import weighted_labels


class Spy:
    """An AP function that keeps what it was called with."""

    def __init__(self):
        self.calls = []

    def __call__(self, obs, actions, next_obs):
        self.calls.append((obs, actions, next_obs))
        return np.ones(len(actions), dtype=bool)


@pytest.mark.filterwarnings("ignore:.*cannot be pickled")
@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("algorithm", [PPOAP, RecurrentPPOAP])
def test_labels_are_of_raw_transitions_also_at_the_end_of_an_episode(algorithm, normalised):
    spy, env = Spy(), DummyVecEnv([Line] * 4)
    model = build_on_policy(algorithm, VecNormalize(env) if normalised else env, ap_function=spy)
    model.learn(128)
    assert len(spy.calls) == 32
    obs, actions, next_obs = (np.concatenate([call[i] for call in spy.calls]) for i in range(3))
    # x' = x + 0.1 a, and the second entry counts tenths of the episode, up to 1.
    np.testing.assert_allclose(next_obs[:, 0] - obs[:, 0], 0.1 * actions[:, 0], atol=1e-6)
    np.testing.assert_allclose(next_obs[:, 1] - obs[:, 1], 0.1, atol=1e-6)
    assert (next_obs[:, 1] == 1).sum() == 3 * 4
    assert np.abs(actions).max() <= 1
    observed, kept = model.knowledge.observations[""], model.knowledge.actions
    assert len(model.knowledge) == 128
    filled = model.knowledge._filled()
    order = np.lexsort(np.column_stack([observed[filled], kept[filled]]).T)
    expected = np.column_stack([obs, actions])
    np.testing.assert_array_equal(
        np.column_stack([observed[filled], kept[filled]])[order], expected[np.lexsort(expected.T)]
    )


def test_actions_are_kept_scaled_and_labelled_in_the_environments_units():
    spy = Spy()
    model = build_on_policy(PPOAP, Line(low=0.0, high=10.0), ap_function=spy).learn(16)
    actions = np.concatenate([call[1] for call in spy.calls])
    assert 0 <= actions.min() < actions.max() <= 10
    kept = model.knowledge.actions[model.knowledge._filled()]
    np.testing.assert_allclose(np.sort(5 * kept + 5, axis=0), np.sort(actions, axis=0), atol=1e-5)


def test_joint_actions_are_kept_as_they_are():
    model = build_on_policy(PPOAP, Recorder(MULTI_DISCRETE), ap_function=never_labels).learn(16)
    kept = model.knowledge.actions[model.knowledge._filled()]
    assert sorted(map(tuple, kept)) == sorted(tuple(map(float, a)) for _, a in model.env.envs[0].unwrapped.executed)


def test_penalty_is_in_the_rollout_and_not_in_logged_returns():
    plain, penalised = (
        build_on_policy(PPO).learn(16),
        build_on_policy(PPOAP, penalty=100.0, ap_function=never_labels).learn(16),
    )
    np.testing.assert_array_equal(plain.rollout_buffer.actions, penalised.rollout_buffer.actions)
    np.testing.assert_allclose(plain.rollout_buffer.rewards - 100, penalised.rollout_buffer.rewards, atol=1e-4)
    returns = [[episode["r"] for episode in model.ep_info_buffer] for model in (plain, penalised)]
    assert returns[0] == returns[1] != []
    assert "add" not in vars(penalised.rollout_buffer)


def test_automatic_penalty_is_the_root_mean_square_of_the_rewards():
    plain, penalised = (
        build_on_policy(PPO).learn(16),
        build_on_policy(PPOAP, penalty="auto", ap_function=never_labels).learn(16),
    )
    own = plain.rollout_buffer.rewards - penalised.rollout_buffer.rewards
    first = plain.rollout_buffer.rewards[0, 0]
    assert own[0, 0] == pytest.approx(abs(first))


def test_penalty_is_normalised_as_the_rewards_are():
    def env():
        normalize = VecNormalize(DummyVecEnv([Line]), clip_reward=1e6, norm_obs=False, training=False)
        normalize.ret_rms.var = np.array(4.0)  # rewards are divided by 2
        return normalize

    plain, penalised = (
        build_on_policy(PPO, env()).learn(16),
        build_on_policy(PPOAP, env(), penalty=100.0, ap_function=never_labels).learn(16),
    )
    np.testing.assert_allclose(plain.rollout_buffer.rewards - 50, penalised.rollout_buffer.rewards, atol=1e-4)


def test_potential_is_added_to_the_rewards():
    # Φ = −|x|, and the reward is −|x'|, so that γ Φ(s') − Φ(s) is γ r + |x|.
    plain, shaped = (
        build_on_policy(PPO).learn(16),
        build_on_policy(PPOAP, potential=centred, ap_function=None).learn(16),
    )
    x = abs(plain.rollout_buffer.observations.reshape(-1, 2)[0, 0])
    reward = plain.rollout_buffer.rewards[0, 0]
    assert shaped.rollout_buffer.rewards[0, 0] == pytest.approx(reward + 0.99 * reward + x, abs=1e-5)


def away_from_centre(obs, actions, next_obs):
    return ~towards_centre(obs, actions, next_obs)


class Fits(PermissibilityCallback):
    """Counts fits at each number of updates, while no guide is set."""

    def __init__(self):
        super().__init__()
        self.found = []

    def fit(self):
        assert self.model.policy.guide is None
        self.found.append((self.num_timesteps, self.model._n_updates))
        super().fit()


def test_fits_precede_each_update_in_proportion_to_the_new_labels():
    callback = Fits()
    model = build_on_policy(PPOAP, Line(n_actions=3), predictor_epochs=0.25)
    model.learn(64, callback)
    # 16 new labels, which count eight times, are at a quarter of an epoch two samples of 16; an update has two epochs.
    assert [steps for steps, _ in callback.found] == [16, 16, 32, 32, 48, 48, 64, 64]
    assert [updates for _, updates in callback.found] == [0, 0, 2, 2, 4, 4, 6, 6]


def test_fits_of_short_rollouts_accumulate():
    callback = Fits()
    build_on_policy(A2CAP, Line(n_actions=3), n_steps=4, predictor_epochs=0.125).learn(64, callback)
    assert [steps for steps, _ in callback.found] == [16, 32, 48, 64]


def test_fits_wait_for_both_classes_and_then_are_bounded_by_what_k_holds():
    callback = Fits()
    model = build_on_policy(PPOAP, predictor_epochs=0.125, ap_function=never_labels, knowledge_buffer_size=40)
    model.learn(160, callback)
    assert callback.found == []
    assert model._examples_due == len(model.knowledge) <= 40


def test_first_labels_count_eight_times():
    assert [weighted_labels(n) for n in (0, 1, 2000, 2001, 10_000)] == [0, 8, 16_000, 16_001, 24_000]


def test_gradient_of_the_loss_joins_that_of_the_base():
    model = judged_by(above(0.0), PPOAP, alpha=0)
    obs, actions = th.ones(3, 2), th.zeros(3, 1)
    log_std, action_net = model.policy.log_std, model.policy.action_net.weight

    def gradients(of):
        model.policy.zero_grad()
        of().backward()
        return log_std.grad.clone(), action_net.grad.clone()

    def loss_alone():
        return 0.7 * model._guide().losses(obs, model.policy.get_distribution(obs)).mean()

    base = gradients(lambda: model.policy.evaluate_actions(obs, actions)[1].sum())
    extra = gradients(lambda: loss_alone() + 0 * log_std.sum())
    model.policy.permissibility_loss = PermissibilityLoss(model._guide(), 0.7, lambda loss: None)
    both = gradients(lambda: model.policy.evaluate_actions(obs, actions)[1].sum())
    for ours, one, other in zip(both, base, extra, strict=True):
        assert th.allclose(ours, one + other, atol=1e-6)
    assert not th.allclose(both[1], base[1])


@pytest.mark.parametrize(
    ("labels", "advantages", "expected"),
    [
        ([True, False] * 500, [1.0, -1.0] * 500, 1 - 2 / math.sqrt(1000)),
        ([True, False] * 500, [-1.0, 1.0] * 500, 0.0),  # the label contradicts the advantages
        ([True, True, False, False] * 250, [1.0, -1.0, 1.0, -1.0] * 250, 0.0),  # independent
        ([True, True, False, False] * 50, [3.0, 1.0, 1.0, -1.0] * 50, 1 / math.sqrt(2) - 2 / math.sqrt(200)),
        ([True] * 1000, [1.0, -1.0] * 500, 0.0),
        ([True, False] * 500, [0.5] * 1000, 0.0),
        ([True, False], [1.0, -1.0], 0.0),  # two steps prove nothing
        ([], [], 0.0),
    ],
)
def test_agreement_is_the_correlation_less_twice_its_standard_error(labels, advantages, expected):
    agreement = Agreement()
    agreement.update(np.array(labels, dtype=bool).reshape(-1, 2), np.array(advantages).reshape(-1, 2))
    assert float(agreement) == pytest.approx(expected, abs=1e-6)


def test_agreement_is_measured_over_the_last_rollouts():
    agreement, signs = Agreement(), np.array([[True], [False]] * 50)
    for _ in range(6):  # 600 steps, of which the last 512 are kept
        agreement.update(signs, np.where(signs, 1.0, -1.0))
    assert float(agreement) == pytest.approx(1 - 2 / math.sqrt(512))
    many = np.array([[True], [False]] * 1000)
    agreement.update(many, np.where(many, -1.0, 1.0))  # a rollout that is longer replaces them all
    assert float(agreement) == 0.0


class Nearer(Line):
    """A :class:`Line` that rewards coming nearer to the centre."""

    def step(self, action):
        before = abs(self.x)
        obs, _, *rest = super().step(action)
        return obs, 10 * (before - abs(self.x)), *rest


@pytest.mark.slow
def test_loss_follows_the_agreement():
    """Labels that the advantages contradict are predicted well, and yet the model equals its base to the bit."""
    settings = {"n_steps": 64, "gamma": 0.0, "learning_rate": 0.0}
    own = {"alpha": 0, "permissibility_coef": 5.0, "predictor_epochs": 20}
    right, wrong = (
        build_on_policy(PPOAP, Nearer(), ap_function=f, **own, **settings).learn(320)
        for f in (towards_centre, away_from_centre)
    )
    assert min(right.validation_accuracy, wrong.validation_accuracy) > 0.75
    assert float(right.agreement) > 0.3
    assert float(wrong.agreement) == 0
    assert "sap/permissibility_loss" not in wrong.logger.name_to_value
    assert right.logger.name_to_value["sap/permissibility_loss"] > 0


class LabelsAtTimes(Line):
    """A :class:`Line` that labels only every other step."""

    def step(self, action):
        *rest, info = super().step(action)
        return *rest, (info if self.steps % 2 else {})


def test_rollout_that_is_labelled_in_part_says_nothing_about_agreement():
    settings = {"ap_function": None, "permissible_actions": lambda obs, actions: np.ones(len(actions), dtype=bool)}
    model = build_on_policy(PPOAP, LabelsAtTimes(n_actions=3), permissibility_coef=1.0, **settings).learn(64)
    assert sum(model.knowledge.seen) == 32
    assert float(model.agreement) == 0


def test_loss_of_finite_actions_is_that_of_the_permitted_probability():
    model = judged_by(
        lambda obs, actions: 0.5 - actions[:, 0],
        PPOAP,
        Recorder(MULTI_DISCRETE),
        alpha=0,
        permissibility_coef=1.0,
        learning_rate=0.0,
    )
    for parameter in model.policy.action_net.parameters():
        th.nn.init.zeros_(parameter)
    model.learn(16)
    # Of three choices in the first dimension, one is permitted.
    assert model.logger.name_to_value["sap/permissibility_loss"] == pytest.approx(math.log(3), abs=1e-5)


@pytest.mark.parametrize("algorithm", [PPOAP, A2CAP, RecurrentPPOAP])
def test_loss_of_continuous_actions_moves_the_mode_to_what_is_permitted(algorithm):
    model = judged_by(above(0.0), algorithm, alpha=0, permissibility_coef=1.0, learning_rate=0.0)
    for parameter in model.policy.action_net.parameters():
        th.nn.init.zeros_(parameter)
    model.learn(16)
    # E is the action, and the mode 0: softplus(−0) = ln 2.
    assert model.logger.name_to_value["sap/permissibility_loss"] == pytest.approx(math.log(2), abs=1e-5)
    trained, untrained = (
        judged_by(above(0.0), algorithm, alpha=0, permissibility_coef=coef, learning_rate=0.003).learn(16)
        for coef in (1.0, 0.0)
    )
    obs = np.zeros(2, np.float32)
    assert trained.predict(obs, deterministic=True)[0] > untrained.predict(obs, deterministic=True)[0]


@pytest.mark.parametrize("accuracy", [0.69, float("nan")])
def test_nothing_follows_an_inaccurate_classifier(accuracy):
    model = judged_by(even, PPOAP, Recorder(MULTI_DISCRETE), permissibility_coef=1.0)
    model.validation_accuracy = accuracy
    model.learn(16)
    assert model.predictor.queries == []


def test_warning_of_constant_labels():
    with pytest.warns(UserWarning, match="labelled all of the first 1008 actions non-permissible"):
        build_on_policy(PPOAP, ap_function=never_labels, n_epochs=1).learn(1008)
