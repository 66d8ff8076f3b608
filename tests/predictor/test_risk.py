"""Risks learned by bootstrapping: their values on a chain, what K holds for them, and what does not go together."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from scripted import BOX, FIRST, SECOND, THIRD, envs, expected, labels_of
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from states import assert_same_state
from toy import Line, build, towards_centre

from sb3_sap import DDPGAP, DQNAP, PPOAP, SACAP, CrossQAP, PermissibilityPredictor
from sb3_sap.predictor.pairs import ManyActions
from sb3_sap.predictor.risk import RiskTarget, Steps, steps_at_risk

LENGTH = 6


class Chain(gym.Env):
    """Six steps to a fall, whatever the action; or, on every second episode, to a safe end. One-hot places."""

    def __init__(self, action_space=BOX, safe=False):
        self.observation_space = spaces.Box(0, 1, (2 * LENGTH + 1,), np.float32)
        self.action_space, self.safe, self.episode = action_space, safe, 0

    def _observe(self):
        return np.eye(2 * LENGTH + 1, dtype=np.float32)[self.place + LENGTH * self.ends_well]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.place = self.episode + 1, 0
        self.ends_well = self.safe and self.episode % 2 == 0
        return self._observe(), {}

    def step(self, action):
        self.place += 1
        ends = self.place == LENGTH
        return self._observe(), 0.0, ends, False, {"cost": float(ends and not self.ends_well)}


def untrained(algorithm, env, **settings):
    """A model that acts at random, and fits E at each step."""
    return build(algorithm, env, **({"learning_starts": 10_000, "event": "cost", "risk_discount": 0.5} | settings))


def risks(model, places, actions):
    """Q_risk of the model's E in n places of the chain."""
    obs = np.eye(2 * LENGTH + 1, dtype=np.float32)[places]
    return 1 - model.predictor.probabilities(obs, np.asarray(actions))


# ---------------------------------------------------------------- values


@pytest.mark.parametrize(
    ("discount", "threshold", "steps"),
    [(0.0, 0.5, 1), (0.5, 0.5, 2), (0.5, 0.3, 2), (0.5, 0.25, 3), (0.9, 0.9, 2), (0.9, 0.95, 1), (0.9, 0.3, 12)],
)
def test_events_so_many_steps_away_reach_the_threshold(discount, threshold, steps):
    assert steps_at_risk(discount, threshold) == steps
    assert discount ** (steps - 1) >= threshold - 1e-9 > discount**steps - 2e-9


@pytest.mark.parametrize(("algorithm", "space"), [(DDPGAP, BOX), (DQNAP, spaces.Discrete(2))])
def test_risk_k_steps_before_the_event_is_the_discount_to_the_k(algorithm, space):
    kwargs = {"net_arch": [32], "batch_size": 64, "learning_rate": 0.01}
    model = untrained(
        algorithm,
        Chain(space, safe=True),
        policy_kwargs={"net_arch": [8]},
        dataset_size=128,
        predictor_kwargs=kwargs,
        predictor_gradient_steps=2,
    ).learn(400)
    rng, either = np.random.default_rng(0), np.arange(LENGTH).repeat(4)
    actions = rng.integers(0, 2, len(either)) if space is not BOX else rng.uniform(-1, 1, (len(either), 1))
    found = risks(model, either, actions).reshape(LENGTH, 4)
    np.testing.assert_allclose(found, 0.5 ** np.arange(LENGTH)[::-1, None].repeat(4, axis=1), atol=0.1)
    assert risks(model, LENGTH + either, actions).max() < 0.1  # which ends without an event


def test_targets_are_those_of_the_definition():
    box = spaces.Box(-1, 1, (1,), np.float32)
    network = PermissibilityPredictor(box, box, net_arch=[4])
    target = RiskTarget(network, 0.5)
    rows = np.zeros((3, 1), np.float32)
    after, proposed = np.float32([[0.1], [0.2], [0.3]]), np.float32([[0.4], [0.5], [0.6]])
    steps = Steps(rows, rows, after, np.array([True, False, False]), np.array([True, True, False]), np.ones(3))
    found = target.examples(steps, lambda obs: th.as_tensor(obs + 0.3), th.device("cpu"))
    later = 1 - network.probabilities(after, proposed)[2]
    np.testing.assert_allclose(found.labels, [0, 1, 1 - 0.5 * later], rtol=1e-6)


def test_target_follows_the_predictor_slowly():
    box = spaces.Box(-1, 1, (1,), np.float32)
    network = PermissibilityPredictor(box, box, net_arch=[4])
    target = RiskTarget(network, 0.5)
    weight, copied = network.head[0].weight, target.network.head[0].weight
    before = copied.clone()
    with th.no_grad():
        weight += 1.0
    target.follow(network)
    th.testing.assert_close(copied, before + 0.1)


def test_mistakes_weigh_what_their_share_is():
    model = untrained(SACAP, Chain(), risk_threshold=0.4).learn(60)  # two steps of six
    steps = model.knowledge.sample_steps(40)
    places = steps.observations.argmax(axis=1)
    assert (places >= 4).sum() == 20
    np.testing.assert_allclose(steps.weights, np.where(places >= 4, 2 / 3, 4 / 3), rtol=0.05)
    np.testing.assert_array_equal(steps.next_observations.argmax(axis=1), places + 1)
    np.testing.assert_array_equal(steps.events, places == 5)
    np.testing.assert_array_equal(steps.ended, places == 5)


def test_permissible_is_what_is_below_the_threshold():
    box = spaces.Box(-1, 1, (1,), np.float32)
    with th.random.fork_rng():
        th.manual_seed(3)
        strict = PermissibilityPredictor(box, box, net_arch=[4], threshold=0.7)
    obs, actions = np.linspace(-1, 1, 50, dtype=np.float32).reshape(2, 25, 1)
    probabilities = strict.probabilities(obs, actions)
    tensors = th.as_tensor(obs), th.as_tensor(actions)
    with th.no_grad():
        verdicts = strict(*tensors).numpy() > 0
        [each] = ManyActions(strict, tensors[1]).logits([strict.features(tensors[0])])
    np.testing.assert_array_equal(verdicts, probabilities > 0.7)
    np.testing.assert_allclose(each.diagonal(), strict(*tensors).detach(), atol=1e-5)


# ---------------------------------------------------------------- what K holds


@pytest.mark.parametrize("event", ["terminated", "cost"])
def test_labels_are_those_of_the_horizon_that_the_threshold_stands_for(event):
    scripts = (FIRST, SECOND, THIRD)
    settings = {"event": event, "risk_discount": 0.5, "risk_threshold": 0.25}
    model = untrained(SACAP, envs(*scripts), **settings).learn(3 * 40)
    assert model.label_horizon == 3
    assert labels_of(model) == expected(scripts, 40, 3, event)


@pytest.mark.parametrize("keyed", [False, True])
def test_k_holds_what_followed_each_action(keyed):
    scripts = (FIRST, THIRD)
    policy = "MultiInputPolicy" if keyed else "MlpPolicy"
    env = VecNormalize(envs(*scripts, keyed=keyed))
    model = untrained(SACAP, env, policy=policy, knowledge_buffer_size=40, risk_threshold=0.2).learn(2 * 60)
    knowledge = model.knowledge
    assert len(knowledge) == 40  # rows were overwritten
    key = "place" if keyed else ""
    for slot in knowledge._filled():
        number, episode, time = knowledge.observations[key][slot].astype(int)
        np.testing.assert_array_equal(knowledge.next_observations[key][slot], [number, episode, time + 1])
        length, terminates, costs = scripts[number][episode % len(scripts[number])]
        assert knowledge.events[slot] == (time in costs)
        assert knowledge.ended[slot] == (terminates and time + 1 == length)
    assert knowledge.events.any()
    assert knowledge.ended.any()


def test_episodes_may_be_those_of_hindsight():
    her = {"policy": "MultiInputPolicy", "replay_buffer_class": HerReplayBuffer, "learning_starts": 30}

    def leaves(obs, actions, next_obs):
        return np.abs(next_obs["achieved_goal"][:, 0]) > 0.5

    model = build(SACAP, Line(kind="goal"), **her, event=leaves, risk_discount=0.6).learn(80)
    assert model.predictor.fitted


# ---------------------------------------------------------------- the base algorithm, files


@pytest.mark.parametrize(("guided", "base", "env"), [(SACAP, SAC, BOX), (DQNAP, DQN, spaces.Discrete(3))])
def test_without_guidance_it_equals_its_base_to_the_bit(guided, base, env):
    own = {"dataset_size", "validation_size", "min_per_class", "predictor_kwargs"}
    settings = {"learning_starts": 10, "risk_threshold": 0.2}
    model = untrained(guided, envs(SECOND, THIRD, action_space=env), alpha=0.0, **settings).learn(80)
    assert model.predictor.fitted
    given = {"learning_starts": 10, "buffer_size": 600, "batch_size": 8, "policy_kwargs": {"net_arch": [8]}, "seed": 1}
    assert not own & set(given)
    plain = base("MlpPolicy", envs(SECOND, THIRD, action_space=env), **given, device="cpu").learn(80)
    for name, value in plain.policy.state_dict().items():
        th.testing.assert_close(value, model.policy.state_dict()[name], rtol=0, atol=0)


def test_proposals_leave_batch_statistics_alone():
    model = untrained(CrossQAP, envs(SECOND, THIRD), learning_starts=10).learn(60)
    model.policy.set_training_mode(True)
    before = {name: value.clone() for name, value in model.policy.state_dict().items()}
    actions = model.proposed_actions(np.zeros((5, 3), np.float32))
    assert actions.shape == (5, 1)
    assert model.policy.training
    for name, value in model.policy.state_dict().items():
        th.testing.assert_close(value, before[name], rtol=0, atol=0)


def test_loaded_model_goes_on_as_if_it_had_not_been_saved(tmp_path):
    settings = {"risk_threshold": 0.2, "penalty": 2.0}
    whole, parted = (untrained(SACAP, envs(SECOND, THIRD), **settings).learn(60) for _ in range(2))
    assert whole.predictor.fitted
    parted.save(tmp_path / "model")
    parted.save_replay_buffer(tmp_path / "buffer")
    loaded = SACAP.load(tmp_path / "model", env=parted.env, force_reset=False)
    loaded.load_replay_buffer(tmp_path / "buffer")
    for model in (whole, loaded):
        model.action_space.seed(3)
        model.learn(20, reset_num_timesteps=False)
    assert_same_state(whole, loaded)
    for name, value in whole.risk_network.state_dict().items():
        th.testing.assert_close(value, loaded.risk_network.state_dict()[name], rtol=0, atol=0)


def test_file_without_a_risk_fits_no_model_with_one(tmp_path):
    untrained(SACAP, Chain(), risk_discount=None).save(tmp_path / "without")
    untrained(SACAP, Chain()).save(tmp_path / "with")
    with pytest.raises(TypeError, match=r"^These parameters were saved without `risk_discount`, .* has 0.5: leave"):
        SACAP.load(tmp_path / "without", risk_discount=0.5)
    with pytest.raises(TypeError, match=r"^These parameters were saved with `risk_discount`, .* has None: leave"):
        SACAP.load(tmp_path / "with", risk_discount=None)


def test_file_of_the_predictor_knows_its_threshold(tmp_path):
    model = untrained(SACAP, Chain(), risk_threshold=0.4).learn(60)
    model.save_predictor(tmp_path / "e")
    assert PermissibilityPredictor.load(tmp_path / "e").offset == model.predictor.offset == pytest.approx(np.log(1.5))


def test_memory_is_taken_with_the_option_alone():
    plain = untrained(SACAP, Chain(), risk_discount=None, horizon=3)
    assert plain.risk_target is None
    assert not hasattr(plain.knowledge, "next_observations")
    with pytest.raises(ValueError, match=r"^The file's knowledge buffer has not what followed each action"):
        _load_buffer(untrained(SACAP, Chain()), plain)


def _load_buffer(model, other):
    import io

    file = io.BytesIO()
    other.save_replay_buffer(file)
    file.seek(0)
    model.load_replay_buffer(file)


# ---------------------------------------------------------------- metric and errors


def test_metric_is_the_mean_risk_of_the_steps():
    found = []

    class Recorder(Logger):
        def record_mean(self, name, value, *args):
            if name == "sap/risk":
                found.append(value)

    model = untrained(DDPGAP, DummyVecEnv([Chain]), risk_discount=0.0)
    model.set_logger(Recorder(None, []))
    model.learn(200)
    assert np.mean(found[-20:]) == pytest.approx(1 / 6, abs=0.02)  # one of six steps falls


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"risk_discount": 1.0}, "^`risk_discount` must be a number from 0 to below 1, but is 1.0"),
        ({"risk_discount": "a"}, "^`risk_discount` must be a number from 0 to below 1, but is 'a'"),
        ({"risk_threshold": 1.0}, "^`risk_threshold` must lie between 0 and 1, but is 1.0"),
        ({"horizon": 3}, "^`horizon` = 3 and `risk_discount` = 0.5 were both given"),
        ({"event": None}, "^`risk_discount` = 0.5 needs an `event`"),
        ({"event": None, "ap_function": towards_centre}, "^`risk_discount` = 0.5 needs an `event`"),
    ],
)
def test_wrong_setting_gets_one_sentence(settings, message):
    with pytest.raises(ValueError, match=message):
        untrained(SACAP, envs(), **settings)


def test_what_does_not_go_together_gets_one_sentence():
    model = untrained(SACAP, envs())
    log = {"obs": np.zeros((9, 3), np.float32), "actions": np.zeros((9, 1), np.float32), "labels": np.ones(9, bool)}
    with pytest.raises(ValueError, match=r"^With `risk_discount` E learns from the model's own steps alone"):
        model.add_knowledge(log | {"next_obs": log["obs"]})
    with pytest.raises(ValueError, match=r"^`fit_predictor` fits E to labels"):
        model.fit_predictor()
    with pytest.raises(ValueError, match=r"^`risk_discount` is for off-policy algorithms, and PPOAP learns from"):
        PPOAP("MlpPolicy", Chain(), event="cost", risk_discount=0.5)
