"""Penalty and potential-based shaping: what the replay buffer holds, and what everything else still sees."""

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from toy import DISCRETE, GUIDED, Line, build, towards_centre

from sb3_sap import DDPGAP, PPOAP, SACAP, TQCAP, ActionPermissibility, CrossQAP, check_permissibility, does_not_lower
from sb3_sap.common.entropy import entropy_weight
from sb3_sap.common.reward_shaping import RewardScale, RewardShaping

GAMMA = 0.9


def height(obs):
    """A potential of :class:`Line`: highest in the middle, and not 0 anywhere."""
    x = obs["x"] if isinstance(obs, dict) else obs[:, :1]
    return 5.0 - np.abs(x[:, 0])


def anything(obs, actions):
    return np.ones(len(actions), dtype=bool)


class Ending(Line):
    """A line whose episodes terminate beyond ±0.5 and are truncated after the horizon."""

    def step(self, action):
        obs, reward, _, truncated, info = super().step(action)
        return obs, reward, abs(self.x) > 0.5, truncated, info


class Scaled(Line):
    """A line whose rewards are small."""

    def __init__(self, size):
        super().__init__()
        self.size = size

    def step(self, action):
        obs, reward, *rest = super().step(action)
        return obs, self.size * reward, *rest


def positions(buffer, n):
    """x before and after each of the first n transitions, (n * n_envs,) in the order of time."""
    return buffer.observations[:n, :, 0].ravel(), buffer.next_observations[:n, :, 0].ravel()


@pytest.mark.parametrize("algorithm", [*GUIDED, *DISCRETE])
def test_replay_buffer_holds_the_reward_less_the_penalty_of_mistakes(algorithm):
    model = build(algorithm, penalty=2.0)
    model.learn(40)
    before, after = positions(model.replay_buffer, 40)
    mistakes = np.abs(after) > np.abs(before)
    assert 0 < mistakes.sum() < 40
    assert np.allclose(model.replay_buffer.rewards[:40, 0], -np.abs(after) - 2.0 * mistakes, atol=1e-6)


@pytest.mark.parametrize(("penalty", "factor"), [("auto", 1.0), ("auto_0.5", 0.5)])
def test_automatic_penalty_is_the_root_mean_square_of_the_rewards_so_far(penalty, factor):
    model = build(DDPGAP, penalty=penalty)
    model.learn(40)
    before, after = positions(model.replay_buffer, 40)
    scale = np.sqrt(np.cumsum(after**2.0) / np.arange(1, 41))
    expected = -np.abs(after) - factor * scale * (np.abs(after) > np.abs(before))
    assert np.allclose(model.replay_buffer.rewards[:40, 0], expected, atol=1e-5)


@pytest.mark.parametrize(("coefficient", "least"), [("auto", 1.0), ("auto_0.1", 0.1), (0.3, 0.3)])
@pytest.mark.parametrize("algorithm", [SACAP, TQCAP, CrossQAP])
def test_automatic_penalty_is_not_small_beside_the_entropy(algorithm, coefficient, least):
    model = build(algorithm, Scaled(1e-3), penalty="auto_2.0", ent_coef=coefficient)
    model.learn(40)
    before, after = positions(model.replay_buffer, 40)
    expected = -1e-3 * np.abs(after) - 2.0 * least * (np.abs(after) > np.abs(before))
    assert np.allclose(model.replay_buffer.rewards[:40, 0], expected, atol=1e-6)


def test_automatic_penalty_where_the_entropy_has_other_units():
    model = build(SACAP, VecNormalize(DummyVecEnv([lambda: Scaled(1e-3)])), penalty="auto")
    model.learn(40)
    assert -2e-3 < model.replay_buffer.rewards[:40].min() < 0
    assert entropy_weight(PPOAP("MlpPolicy", Line(), ap_function=towards_centre, ent_coef=0.01)) == 0


def test_automatic_penalty_is_one_while_all_rewards_are_zero():
    scale = RewardScale()
    scale.update([0.0, 0.0])
    assert RewardShaping("auto").penalty_at(float(scale)) == 1.0
    scale.update([0.2, 0.0])
    assert RewardShaping("auto_2.0").penalty_at(float(scale)) == pytest.approx(0.2)


@pytest.mark.parametrize("labels", [{}, {"ap_function": towards_centre}])
def test_penalty_of_several_environments_under_normalisation(labels):
    env = VecNormalize(DummyVecEnv([lambda: Line(labels=not labels)] * 2))
    model = build(SACAP, env, penalty=2.0, **labels)
    model.learn(60)
    before, after = positions(model.replay_buffer, 30)
    expected = -np.abs(after) - 2.0 * (np.abs(after) > np.abs(before))
    assert np.allclose(model.replay_buffer.rewards[:30].ravel(), expected, atol=1e-5)
    normalised = model.replay_buffer.sample(8, env=env).rewards
    assert float(normalised.abs().max()) <= env.clip_reward


def test_logged_returns_have_the_reward_of_the_environment():
    plain, penalised = build(SACAP, learning_starts=100), build(SACAP, learning_starts=100, penalty=5.0)
    for model in (plain, penalised):
        model.learn(100)
    assert [e["r"] for e in plain.ep_info_buffer] == [e["r"] for e in penalised.ep_info_buffer]


def test_potential_of_a_terminal_state_is_zero_and_a_truncated_episode_bootstraps():
    env = Ending(labels=False)
    model = build(SACAP, env, potential=height, gamma=GAMMA)
    model.learn(200)
    buffer = model.replay_buffer
    before, after = positions(buffer, 200)
    terminal = np.abs(after) > 0.5
    assert terminal.any()
    assert buffer.timeouts[:200].any()
    expected = -np.abs(after) + GAMMA * np.where(terminal, 0.0, 5.0 - np.abs(after)) - (5.0 - np.abs(before))
    assert np.allclose(buffer.rewards[:200, 0], expected, atol=1e-5)


def test_actions_that_do_not_lower_the_potential_are_permissible():
    model = build(DDPGAP, Line(labels=False), potential=height)
    model.learn(60)
    before, after = positions(model.replay_buffer, 60)
    mistakes = int((np.abs(after) > np.abs(before)).sum())
    assert model.knowledge.seen == [mistakes, 60 - mistakes]
    report = check_permissibility(Line(labels=False), does_not_lower(height), verbose=False, n_steps=200)
    assert report.own_row


def test_shaping_of_n_step_returns_telescopes():
    model = build(SACAP, Line(labels=False, horizon=50), potential=height, n_steps=3, gamma=GAMMA)
    model.learn(40)
    buffer = model.replay_buffer
    x = np.append(buffer.observations[:40, 0, 0], buffer.next_observations[39, 0, 0])
    samples = buffer._get_samples(np.arange(30))
    rewards = -np.abs(x[1:])
    for t in range(30):
        plain = sum(GAMMA**k * rewards[t + k] for k in range(3))
        shaped = plain + GAMMA**3 * (5.0 - abs(x[t + 3])) - (5.0 - abs(x[t]))
        assert float(samples.rewards[t]) == pytest.approx(shaped, abs=1e-4)


def near(obs, actions, next_obs):
    """Permissible: the position is no further from the goal that is pursued."""
    distance = [np.abs(o["achieved_goal"] - o["desired_goal"])[:, 0] for o in (obs, next_obs)]
    return distance[1] <= distance[0]


def test_hindsight_goals_are_penalised_as_if_they_had_been_pursued():
    settings = {"policy": "MultiInputPolicy", "replay_buffer_class": HerReplayBuffer, "learning_starts": 100}
    model = build(SACAP, Line("goal", labels=False), ap_function=near, penalty=3.0, **settings)
    model.learn(100)
    batch, envs = np.arange(40), np.zeros(40, dtype=int)
    samples = model.replay_buffer._get_virtual_samples(batch, envs)
    obs, after = (
        {key: value.numpy() for key, value in side.items()}
        for side in (samples.observations, samples.next_observations)
    )
    assert (obs["desired_goal"] != 0).any()
    mistakes = ~near(obs, None, after)
    assert mistakes.any()
    expected = -np.abs(after["achieved_goal"] - obs["desired_goal"])[:, 0] - 3.0 * mistakes
    assert np.allclose(samples.rewards.numpy()[:, 0], expected, atol=1e-5)
    with pytest.raises(ValueError, match=r"^`penalty` = 3.0 needs an `ap_function` beside PermissibilityHerReplay"):
        build(SACAP, Line("goal"), penalty=3.0, **settings)


def test_without_penalty_and_potential_nothing_is_added():
    assert not RewardShaping()
    assert RewardShaping(penalty=1.0)
    model = build(DDPGAP)
    model.learn(30)
    _, after = positions(model.replay_buffer, 30)
    assert np.array_equal(model.replay_buffer.rewards[:30, 0], np.float32([-abs(float(x)) for x in after]))


def test_penalty_without_labels_is_refused_even_if_actions_are_ruled_out_beforehand():
    model = build(SACAP, Line(labels=False), permissible_actions=anything, penalty=1.0)
    with pytest.raises(ValueError, match=r"^There is no AP function"):
        model.learn(5)


def test_saved_model_keeps_penalty_and_potential(tmp_path):
    model = build(SACAP, penalty=2.0, potential=height, ap_function=towards_centre)
    model.save(tmp_path / "model")
    loaded = SACAP.load(tmp_path / "model", env=Line())
    assert loaded.replay_buffer.shaping.penalty == 2.0
    assert loaded.replay_buffer.shaping.potential(np.array([[1.0, 0.0]])) == 4.0
    assert SACAP.load(tmp_path / "model", env=Line(), penalty=1.0).replay_buffer.shaping.penalty == 1.0
    model.learn(20)
    model.save_replay_buffer(tmp_path / "buffer")
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.replay_buffer.shaping == model.replay_buffer.shaping


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        *(
            ({"penalty": c}, f'^`penalty` must be a number of at least 0, "auto" or "auto_<number>", but is {c!r}')
            for c in (-1.0, "big", np.inf, "auto_", "auto_-1")
        ),
        ({"potential": lambda obs: obs}, r"^`potential` .* must return \d+ finite numbers, .* shape \(\d+, 2\)"),
        ({"potential": lambda obs: np.full(len(obs), np.nan)}, "^`potential` .* values that are not finite"),
        ({"potential": lambda obs: obs["x"]}, "^`potential` .* raised IndexError"),
        ({"potential": "toy.missing"}, "^`potential`: 'toy.missing' cannot be imported"),
    ],
)
@pytest.mark.filterwarnings("ignore:`.*cannot be pickled")
def test_bad_settings_get_a_sentence(settings, sentence):
    with pytest.raises((ValueError, TypeError, RuntimeError), match=sentence):
        build(SACAP, **settings).learn(20)


def test_wrapper_subtracts_the_penalty_for_other_algorithms_and_an_inner_monitor_does_not_see_it():
    class Still(gym.Env):
        observation_space, action_space = Line().observation_space, Line().action_space

        def reset(self, *, seed=None, options=None):
            self.steps = 0
            return np.zeros(2, np.float32), {}

        def step(self, action):
            self.steps += 1
            return np.zeros(2, np.float32), 1.0, False, self.steps == 4, {}

    env = ActionPermissibility(Monitor(Still()), lambda obs, action, next_obs: action[0] > 0, penalty=0.25)
    env.reset()
    rewards = [env.step(np.float32([action]))[1] for action in (1, -1, -1)]
    assert rewards == [1.0, 0.75, 0.75]
    *_, info = env.step(np.float32([-1]))
    assert info["episode"]["r"] == 4.0
    assert not info["permissible"]
    own = ActionPermissibility(Line(), penalty=1.0)  # the label of the environment itself
    own.reset(options={"x": 0.5})
    assert own.step(np.float32([1]))[1] == pytest.approx(-1.6)
    bare = ActionPermissibility(Line(labels=False), penalty=1.0)
    bare.reset()
    with pytest.raises(ValueError, match="no AP function"):
        bare.step(np.float32([1]))
    SAC("MlpPolicy", env, learning_starts=5).learn(10)
