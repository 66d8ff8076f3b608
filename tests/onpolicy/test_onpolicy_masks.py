"""Finite actions are masked exactly; of continuous ones the first permissible draw is executed."""

import math

import gymnasium as gym
import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
import torch as th
from gymnasium import spaces
from rollouts import (
    BASES,
    MULTI_BINARY,
    MULTI_DISCRETE,
    Recorder,
    build_on_policy,
    even,
    judged_by,
    settings,
    weights,
)
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv
from stubs import above, deny
from toy import Line

from sb3_sap import A2CAP, PPOAP, TRPOAP, RecurrentPPOAP


@pytest.mark.parametrize("algorithm", BASES)
@pytest.mark.parametrize("space", [spaces.Discrete(4), MULTI_DISCRETE, MULTI_BINARY], ids=str)
def test_rejected_action_is_never_executed(algorithm, space):
    env = Recorder(space)
    judged_by(even, algorithm, env).learn(48)
    assert len(env.executed) >= 48
    assert all((step + int(np.sum(action))) % 2 == 0 for step, action in env.executed)
    assert len({tuple(np.atleast_1d(action)) for _, action in env.executed}) > 2


def test_four_environments_are_judged_in_one_query():
    envs = [Recorder(spaces.Discrete(4)) for _ in range(4)]
    model = judged_by(even, PPOAP, DummyVecEnv([lambda env=env: env for env in envs]))
    model.learn(64)
    # 4 environments, 4 actions, and 10 steps until the states repeat, in the update, too.
    assert model.predictor.queries == [4 * 4] * 10
    assert all((step + int(action)) % 2 == 0 for env in envs for step, action in env.executed)


def test_dict_observations_are_judged_row_by_row():
    env = Line(kind="dict", n_actions=3)
    model = judged_by(  # the rightmost action is rejected in the second half of an episode
        lambda features, actions: 1.0 - 2.0 * ((features[:, 0] >= 0.45) & (actions[:, 0] == 2)),
        PPOAP,
        env,
        policy="MultiInputPolicy",
    )
    model.predictor.features = lambda obs: obs["time"]
    model.learn(32)
    late, early = (
        [int(a) for step, a in enumerate(env.executed) if (step % 10 >= 5) == half] for half in (True, False)
    )
    assert set(early) == {0, 1, 2}
    assert set(late) == {0, 1}
    assert model.predictor.queries == [3] * 32  # each state once, and none again in the update


def test_same_mask_gives_the_trajectory_of_maskable_ppo():
    env, other = Recorder(spaces.Discrete(4)), Recorder(spaces.Discrete(4))
    ours = judged_by(even, PPOAP, env, ent_coef=0.01).learn(64)
    theirs = sb3_contrib.MaskablePPO("MlpPolicy", other, ent_coef=0.01, **settings(stable_baselines3.PPO)).learn(64)
    assert [action for _, action in env.executed] == [action for _, action in other.executed]
    for name, value in weights(ours).items():
        assert th.equal(value, weights(theirs)[name]), name


def uniform(space, logits_of):
    """A model whose policy gives every joint action the same probability."""
    model = judged_by(logits_of, PPOAP, Recorder(space))
    th.nn.init.zeros_(model.policy.action_net.weight)
    th.nn.init.zeros_(model.policy.action_net.bias)
    return model


@pytest.mark.parametrize(
    ("space", "action", "permitted"),
    [(spaces.Discrete(4), 2, 2), (MULTI_DISCRETE, [1, 1], 3), (MULTI_BINARY, [0, 1, 1], 4)],
    ids=["Discrete", "MultiDiscrete", "MultiBinary"],
)
def test_log_probability_and_entropy_are_those_of_the_masked_distribution(space, action, permitted):
    model = uniform(space, even)
    with model._guided_by(model._guide()):
        obs, actions = th.zeros(1, 2), th.tensor([action])
        _, log_prob, entropy = model.policy.evaluate_actions(obs, actions)
        mode = model.policy.get_distribution(obs).mode()
    assert log_prob.item() == pytest.approx(-math.log(permitted), abs=1e-6)
    assert entropy.item() == pytest.approx(math.log(permitted), abs=1e-6)
    assert mode.flatten().tolist() == [0] * mode.numel()  # the first of equals is permitted


@pytest.mark.parametrize("space", [MULTI_DISCRETE, MULTI_BINARY], ids=str)
def test_joint_probabilities_are_the_products_of_the_policys(space):
    model = judged_by(lambda obs, actions: 1.0 - 2.0 * (actions.sum(dim=1) == 0), PPOAP, Recorder(space))
    th.nn.init.normal_(model.policy.action_net.weight)
    obs, actions = th.rand(5, 2), th.ones(5, space.shape[0])
    zero = th.zeros_like(actions)
    with th.no_grad():
        plain = model.policy.get_distribution(obs)
        expected = plain.log_prob(actions) - th.log(1 - plain.log_prob(zero).exp())  # all but the action 0
        with model._guided_by(model._guide()):
            found = model.policy.get_distribution(obs).log_prob(actions)
    th.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)


def test_masked_gradient_of_a_bandit_equals_the_analytic_one():
    model = judged_by(lambda obs, actions: 1.0 - 2.0 * (actions[:, 0] == 1), PPOAP, Recorder(spaces.Discrete(3)))
    net = model.policy.action_net
    th.nn.init.zeros_(net.weight)
    net.bias.data = th.tensor([1.0, 2.0, 1.0]).log()  # 1/4, 1/2, 1/4; without action 1: 1/2, 0, 1/2
    with model._guided_by(model._guide()):
        _, log_prob, _ = model.policy.evaluate_actions(th.zeros(2, 2), th.tensor([0, 2]))
    # Rewards 1 and 3, each with probability 1/2: the gradient of their mean is π(a) (r(a) − 2).
    (log_prob * th.tensor([1.0, 3.0]) * 0.5).sum().backward()
    th.testing.assert_close(net.bias.grad, th.tensor([-0.5, 0.0, 0.5]))


@pytest.mark.parametrize("algorithm", [PPOAP, A2CAP, TRPOAP])
@pytest.mark.parametrize("space", [spaces.Discrete(4), MULTI_DISCRETE], ids=str)
def test_update_evaluates_the_rollout_with_its_own_masks(algorithm, space):
    model = judged_by(even, algorithm, Recorder(space), learning_rate=0.0)
    model.learn(16)
    data = next(model.rollout_buffer.get(16))
    with model._guided_by(model._guide()):
        actions = data.actions.long().flatten() if space == spaces.Discrete(4) else data.actions
        _, log_prob, _ = model.policy.evaluate_actions(data.observations, actions)
    if algorithm is not TRPOAP:  # whose actor has moved
        th.testing.assert_close(log_prob, data.old_log_prob)
    assert log_prob.min() > -10


def test_executed_action_counts_as_permitted_in_the_update():
    model = judged_by(even, PPOAP, Recorder(spaces.Discrete(4)))
    with model._guided_by(model._guide()):
        _, log_prob, _ = model.policy.evaluate_actions(th.zeros(1, 2), th.tensor([1]))  # rejected now
    assert log_prob.item() > -10


@pytest.mark.parametrize("algorithm", BASES)
def test_continuous_action_is_the_first_permissible_draw_with_its_own_log_probability(algorithm):
    env = Line()
    model = judged_by(above(0.0), algorithm, env)
    model.learn(16)
    assert len(env.executed) == 16
    assert min(action[0] for action in env.executed) > 0  # all of 32 draws from N(0, 1) are negative once in 4e9
    buffer = model.rollout_buffer
    # The policy's standard deviation was 1 and its mean nearly 0, so that about half of 31 draws are permitted.
    normal = -0.5 * math.log(2 * math.pi) - 0.5 * buffer.actions.reshape(-1) ** 2
    share = np.exp(normal - buffer.log_probs.reshape(-1))
    assert share.mean() == pytest.approx(0.5, abs=0.1)
    assert share.std() < 0.2


class Asks(BaseCallback):
    """Somebody else asks the policy amid a rollout."""

    def _on_step(self):
        self.model.policy(self.locals["obs_tensor"])
        return True


@pytest.mark.parametrize("algorithm", [PPOAP, A2CAP])
@pytest.mark.parametrize("kind", ["array", "dict"])
@pytest.mark.parametrize("callback", [None, Asks], ids=["alone", "asked"])
def test_update_evaluates_the_rollout_with_its_own_shares(algorithm, kind, callback):
    env = DummyVecEnv([lambda: Line(kind=kind)] * 3)
    policy = "MlpPolicy" if kind == "array" else "MultiInputPolicy"
    model = judged_by(above(0.0), algorithm, env, policy=policy, learning_rate=0.0, n_steps=8)
    if kind == "dict":
        model.predictor.features = lambda obs: obs["time"]
    model.learn(24, callback=callback and callback())
    data = next(model.rollout_buffer.get(24))
    with model._guided_by(model._rollout_guide):
        _, log_prob, _ = model.policy.evaluate_actions(data.observations, data.actions)
    with th.no_grad():
        alone = model.policy.get_distribution(data.observations).log_prob(data.actions)
    th.testing.assert_close(log_prob, data.old_log_prob, atol=1e-5, rtol=0)
    assert (log_prob - alone).mean().item() == pytest.approx(math.log(2), abs=0.2)


class Blind(gym.ObservationWrapper):
    """All observations are alike, so that only the memory tells states apart."""

    def observation(self, observation):
        return 0 * observation


def test_states_that_look_alike_have_the_share_of_their_own_memory():
    model = judged_by(above(0.0), RecurrentPPOAP, Blind(Line()), learning_rate=0.0, n_steps=16, n_candidates=4_000)
    model.policy.action_net.weight.data.mul_(300)  # the mean moves with the memory
    model.learn(16)
    buffer = model.rollout_buffer
    data = next(buffer.get(16))
    with model._guided_by(model._rollout_guide), th.no_grad():
        mean = model.policy.get_distribution(data.observations, data.lstm_states.pi, data.episode_starts)[0]
        _, log_prob, _ = model.policy.evaluate_actions(
            data.observations, data.actions, data.lstm_states, data.episode_starts
        )
    mean = mean.distribution.mean[:, 0]
    assert mean.std() > 0.1
    rows = data.mask > 0.5
    alone = -0.5 * math.log(2 * math.pi) - 0.5 * (data.actions[:, 0] - mean) ** 2
    expected = alone - th.special.ndtr(mean).log()
    th.testing.assert_close(data.old_log_prob[rows], expected[rows], atol=0.1, rtol=0)
    th.testing.assert_close(log_prob[rows], data.old_log_prob[rows], atol=1e-4, rtol=0)


@pytest.mark.parametrize("sde", [False, True])
def test_update_begins_with_a_ratio_of_one_and_the_gradient_of_the_conditioned_density(sde):
    """The gradient of log Z with respect to the mean, where actions above 0 are permitted, is φ(μ) / Φ(μ)."""
    settings = {"use_sde": True, "policy_kwargs": {"net_arch": [8], "log_std_init": 0.0}} if sde else {}
    model = judged_by(above(0.0), PPOAP, Line(), n_candidates=4_000, **settings)
    policy, obs = model.policy, th.rand(6, 2)
    with model._guided_by(model._guide()):
        actions, _, before = policy.forward(obs)
        assert (actions > 0).all()
        _, after, _ = policy.evaluate_actions(obs, actions)
        th.testing.assert_close(after, before, atol=1e-5, rtol=0)
        policy.optimizer.zero_grad()
        after.sum().backward()
    with th.no_grad():
        unguided = policy.get_distribution(obs).distribution
    mean, std = unguided.mean[:, 0], unguided.stddev[:, 0]
    score = (actions[:, 0] - mean) / std**2
    density = th.exp(-0.5 * (mean / std) ** 2) / math.sqrt(2 * math.pi) / std
    expected = score - density / th.special.ndtr(mean / std)
    assert policy.action_net.bias.grad.item() == pytest.approx(expected.sum().item(), rel=0.1, abs=0.3)


def test_ratio_follows_the_change_of_the_permitted_share():
    model = judged_by(above(0.0), PPOAP, Line(), n_candidates=20_000)
    policy, obs = model.policy, th.zeros(1, 2)
    with model._guided_by(model._guide()):
        actions, _, before = policy.forward(obs)
        with th.no_grad():
            mean = policy.get_distribution(obs).distribution.mean.item()
            policy.action_net.bias += 0.3
        _, after, _ = policy.evaluate_actions(obs, actions)

    def log_density(mean):
        share = 0.5 * math.erfc(-mean / math.sqrt(2))
        return -0.5 * (actions.item() - mean) ** 2 - math.log(share)

    assert (after - before).item() == pytest.approx(log_density(mean + 0.3) - log_density(mean), abs=0.03)


def test_where_no_draw_is_permissible_the_first_is_executed():
    env, other = Line(), Line()
    judged_by(deny, PPOAP, env).learn(16)
    build_on_policy(stable_baselines3.PPO, other).learn(16)
    np.testing.assert_array_equal(env.executed[0], other.executed[0])


def test_draws_of_state_dependent_exploration_differ():
    env = Line()
    judged_by(above(0.0), PPOAP, env, use_sde=True, policy_kwargs={"net_arch": [8], "log_std_init": 0.0}).learn(16)
    assert min(action[0] for action in env.executed) > 0


@pytest.mark.parametrize("algorithm", BASES)
def test_prediction_has_the_masks_of_the_rollouts(algorithm):
    model = judged_by(lambda obs, actions: actions[:, 0] - 0.5, algorithm, Line(n_actions=2))
    model.policy.action_net.bias.data = th.tensor([5.0, 0.0])
    obs = np.zeros((3, 2), np.float32)

    def predicted(**options):
        return model.predict(obs, deterministic=True, **options)[0].tolist()

    alone, masked = [0, 0, 0], [1, 1, 1]
    assert (predicted(), predicted(guided=True), predicted(guided=False)) == (masked, masked, alone)
    model.validation_accuracy = 0.6  # rollouts are not masked
    assert (predicted(), predicted(guided=True)) == (alone, masked)
    model.validation_accuracy, model.alpha = 1.0, 0
    assert (predicted(), predicted(guided=True)) == (alone, masked)


def test_continuous_prediction_is_the_policy_alone_unless_guided():
    model = judged_by(above(0.5), PPOAP)
    model.policy.action_net.bias.data.zero_()
    assert abs(model.predict(np.zeros(2, np.float32), deterministic=True)[0][0]) < 0.1


def test_guided_continuous_prediction_is_the_permissible_action_nearest_to_the_mode():
    model = judged_by(above(0.5), PPOAP, n_candidates=100)
    model.policy.action_net.bias.data.zero_()
    alone, guided = (model.predict(np.zeros(2, np.float32), deterministic=True, guided=g)[0] for g in (False, True))
    assert abs(alone[0]) < 0.1
    assert 0.5 < guided[0] < 0.53  # candidates are at most 0.04 apart
    assert model.predict(np.zeros(2, np.float32), guided=True)[0][0] > 0.5


class Predicts(BaseCallback):
    def __init__(self, guided):
        super().__init__()
        self.guided, self.found = guided, []

    def _on_step(self):
        action, _ = self.model.predict(np.zeros(2, np.float32), deterministic=True, guided=self.guided)
        self.found.append(int(action))
        return True


@pytest.mark.parametrize("guided", [None, False])
def test_evaluation_amid_a_rollout(guided):
    env, callback = Recorder(spaces.Discrete(2)), Predicts(guided)
    model = judged_by(lambda obs, actions: actions[:, 0] - 0.5, PPOAP, env, learning_rate=0.0)
    model.policy.action_net.bias.data = th.tensor([5.0, 0.0])
    model.learn(16, callback)
    assert callback.found == [0 if guided is False else 1] * 16
    assert [int(action) for _, action in env.executed] == [1] * 16
    assert model.policy.guide is None
