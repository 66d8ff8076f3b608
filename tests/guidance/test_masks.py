"""Known masks of finite actions: never violated, whatever the algorithm, the source and the vectorised environment."""

from __future__ import annotations

from contextlib import contextmanager
from unittest.mock import patch

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from masked_env import Masked, allowed
from sb3_contrib import QRDQN, MaskablePPO
from stable_baselines3 import DQN, PPO, HerReplayBuffer
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_sap import (
    A2CAP,
    DQNAP,
    PPOAP,
    QRDQNAP,
    TRPOAP,
    ActionMaskObservation,
    LearnedPermissibility,
    RecurrentPPOAP,
    WithoutMaskExtractor,
)
from sb3_sap.guidance import masked_values
from sb3_sap.guidance.masked_values import raw_next_observations

OFF_POLICY = (DQNAP, QRDQNAP)
ON_POLICY = (PPOAP, A2CAP, TRPOAP, RecurrentPPOAP)
MULTI_DISCRETE, MULTI_BINARY = spaces.MultiDiscrete([3, 2, 2]), spaces.MultiBinary(3)


def model_of(algorithm, env, policy="MlpPolicy", **overrides):
    if algorithm in OFF_POLICY:
        settings = {"learning_starts": 20, "train_freq": 1, "target_update_interval": 10, "exploration_fraction": 0.5}
        settings |= {"batch_size": 8, "buffer_size": 500}
    else:
        settings = {"n_steps": 8}
        if algorithm is not A2CAP:
            settings["batch_size"] = 8
        if algorithm in (PPOAP, RecurrentPPOAP):
            settings["n_epochs"] = 2
    if algorithm is RecurrentPPOAP:
        policy = policy.replace("Policy", "LstmPolicy")
        overrides["policy_kwargs"] = {**overrides.get("policy_kwargs", {}), "lstm_hidden_size": 4}
    policy_kwargs = {"net_arch": [8], **overrides.pop("policy_kwargs", {})}
    return algorithm(policy, env, seed=1, device="cpu", policy_kwargs=policy_kwargs, **{**settings, **overrides})


def vectorised(n_envs=2, wrap=lambda env: env, **kwargs):
    return DummyVecEnv([lambda: Monitor(wrap(Masked(**kwargs)))] * n_envs)


def illegal_steps(env):
    return sum(inner.unwrapped.illegal for inner in env.unwrapped.envs)


def assert_never_illegal(model, steps=120):
    model.learn(steps)
    assert illegal_steps(model.env) == 0
    for deterministic in (True, False):
        actions, _ = model.predict(model.env.reset(), deterministic=deterministic)
        model.env.step(actions)
    assert illegal_steps(model.env) == 0


@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("algorithm", [*OFF_POLICY, *ON_POLICY])
def test_masks_of_a_function_are_never_violated(algorithm, normalised):
    env = vectorised()
    if normalised:
        env = VecNormalize(env, clip_obs=0.5)  # clips, so that raw observations cannot be recovered
    model = model_of(algorithm, env, permissible_actions=allowed)
    model.learn(120)
    assert illegal_steps(env) == 0


@pytest.mark.parametrize("as_info", [False, True])
@pytest.mark.parametrize("algorithm", [*OFF_POLICY, *ON_POLICY])
def test_masks_in_the_observation_are_never_violated(algorithm, as_info):
    env = vectorised(wrap=ActionMaskObservation, as_info=as_info)
    assert_never_illegal(model_of(algorithm, env, "MultiInputPolicy", permissible_actions="action_mask"))


@pytest.mark.parametrize(
    ("algorithm", "space", "joint"),
    [
        *((PPOAP, space, joint) for space in (MULTI_DISCRETE, MULTI_BINARY) for joint in (False, True)),
        *((algorithm, MULTI_DISCRETE, True) for algorithm in ON_POLICY[1:]),
        (RecurrentPPOAP, MULTI_BINARY, False),
    ],
)
def test_masks_of_several_dimensions_are_never_violated(algorithm, space, joint):
    env = vectorised(wrap=lambda env: ActionMaskObservation(env, joint=joint), action_space=space, joint=joint)
    assert_never_illegal(model_of(algorithm, env, "MultiInputPolicy", permissible_actions="action_mask"))


@pytest.mark.parametrize(
    ("algorithm", "space"),
    [*((algorithm, spaces.MultiDiscrete([17] * 3)) for algorithm in ON_POLICY), (PPOAP, spaces.MultiBinary(13))],
)
def test_masks_of_dimensions_hold_for_any_number_of_combinations(algorithm, space):
    env = vectorised(wrap=ActionMaskObservation, action_space=space)
    settings = {"permissible_actions": "action_mask", "alpha": 0}
    assert_never_illegal(model_of(algorithm, env, "MultiInputPolicy", **settings), steps=32)


@pytest.mark.parametrize("space", [MULTI_DISCRETE, spaces.MultiDiscrete([17] * 3)], ids=str)
def test_masks_of_dimensions_give_the_trajectory_of_maskable_ppo(space):
    settings = {
        "n_steps": 16,
        "batch_size": 16,
        "n_epochs": 3,
        "ent_coef": 0.01,
        "seed": 1,
        "policy_kwargs": {"net_arch": [8]},
    }
    envs = [vectorised(wrap=ActionMaskObservation, action_space=space) for _ in range(2)]
    ours = PPOAP("MultiInputPolicy", envs[0], permissible_actions="action_mask", **settings).learn(64)
    theirs = MaskablePPO("MultiInputPolicy", envs[1], **settings).learn(64)
    for name, value in ours.policy.state_dict().items():
        assert th.equal(value, theirs.policy.state_dict()[name]), name


def test_predictor_of_combinations_keeps_within_the_masks_of_dimensions():
    """Where E permits nothing of what is allowed, all of that is allowed."""
    env = vectorised(wrap=ActionMaskObservation, action_space=spaces.MultiBinary(13))
    settings = {"min_per_class": 4, "dataset_size": 8, "validation_size": 4, "predictor_kwargs": {"net_arch": [8]}}
    model = model_of(
        PPOAP,
        env,
        "MultiInputPolicy",
        permissible_actions="action_mask",
        ap_function=lambda obs, actions, next_obs: actions[:, 0] == actions[:, 1],
        **settings,
    )
    model.validation_accuracy = 1.0
    model.predictor.n_updates += 1
    assert_never_illegal(model, steps=32)


@pytest.mark.parametrize("algorithm", [DQNAP, PPOAP])
def test_normalised_observations_beside_a_mask(algorithm):
    env = VecNormalize(vectorised(wrap=ActionMaskObservation), norm_obs_keys=["observation"])
    assert_never_illegal(model_of(algorithm, env, "MultiInputPolicy", permissible_actions="action_mask"))


@pytest.mark.slow
@pytest.mark.parametrize("algorithm", [*OFF_POLICY, *ON_POLICY])
def test_no_illegal_step_in_a_hundred_thousand_of_eight_processes(algorithm):
    env = SubprocVecEnv([lambda: ActionMaskObservation(Masked())] * 8)
    settings = {"train_freq": 16, "learning_starts": 1_000} if algorithm in OFF_POLICY else {"n_steps": 128}
    if algorithm in (PPOAP, RecurrentPPOAP):
        settings |= {"batch_size": 256, "n_epochs": 2}
    model = model_of(algorithm, env, "MultiInputPolicy", permissible_actions="action_mask", **settings)
    model.learn(100_000)
    assert sum(env.get_attr("steps")) >= 100_000
    assert sum(env.get_attr("illegal")) == 0
    env.close()


@pytest.mark.parametrize("policy", ["function", "key"])
def test_known_mask_gives_the_trajectory_of_maskable_ppo(policy):
    settings = {"n_steps": 32, "batch_size": 16, "ent_coef": 0.01, "seed": 1, "policy_kwargs": {"net_arch": [8]}}
    if policy == "function":
        wrap, name, source = (lambda env: env), "MlpPolicy", allowed
    else:
        wrap, name, source = ActionMaskObservation, "MultiInputPolicy", "action_mask"
    ours = PPOAP(name, vectorised(wrap=wrap), permissible_actions=source, **settings).learn(256)
    theirs = MaskablePPO(name, vectorised(wrap=wrap), **settings).learn(256)
    for name, value in ours.policy.state_dict().items():
        assert th.equal(value, theirs.policy.state_dict()[name]), name


@pytest.mark.parametrize(("algorithm", "base"), [(DQNAP, DQN), (QRDQNAP, QRDQN), (PPOAP, PPO)])
def test_mask_that_allows_everything_changes_no_bit(algorithm, base):
    everything = model_of(algorithm, vectorised(), permissible_actions=lambda obs, actions: np.ones(len(actions), bool))
    everything.learn(100)
    assert everything.knowledge.seen == [0, 0]  # a mask needs no labels
    settings = {"learning_starts": 20, "train_freq": 1, "target_update_interval": 10, "exploration_fraction": 0.5}
    settings |= {"batch_size": 8, "buffer_size": 500}
    if base is PPO:
        settings = {"n_steps": 8, "batch_size": 8, "n_epochs": 2}
    plain = base("MlpPolicy", vectorised(), seed=1, policy_kwargs={"net_arch": [8]}, **settings).learn(100)
    for name, value in plain.policy.state_dict().items():
        assert th.equal(value, everything.policy.state_dict()[name]), name


@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("algorithm", OFF_POLICY)
def test_update_takes_the_targets_maximum_over_the_allowed_actions(algorithm, normalised):
    env = vectorised(1)
    if normalised:
        env = VecNormalize(env, norm_reward=False)
    model = model_of(algorithm, env, permissible_actions=allowed, learning_starts=1000).learn(100)
    hide, seen = masked_values.masked_outputs, []

    @contextmanager
    def spied(network, mask):
        with hide(network, mask):
            handle = network.register_forward_hook(lambda module, args, values: seen.append((args[0], values)))
            yield
            handle.remove()

    set_random_seed(5)
    legal = model.replay_buffer.sample(8).next_observations[:, 1:] > 0.5
    set_random_seed(5)
    with patch.object(masked_values, "masked_outputs", spied):
        model.train(1, 8)
    obs, masked = seen[0]
    with th.no_grad():
        values = masked_values.values_network(model, target=True)(obs)
    if algorithm is QRDQNAP:
        masked, values = masked.mean(dim=1), values.mean(dim=1)
    expected = values.masked_fill(~legal, -th.inf).max(dim=1).values
    assert th.equal(masked.max(dim=1).values, expected)
    assert (values.max(dim=1).values > expected).any()  # without the mask it would be another


@pytest.mark.parametrize("normalised", [False, True])
@pytest.mark.parametrize("n_steps", [1, 3])
def test_batches_are_those_of_the_buffer_and_raw_ones_are_exact(normalised, n_steps):
    env = vectorised(1)
    if normalised:
        env = VecNormalize(env, clip_obs=0.5)
    model = model_of(DQNAP, env, permissible_actions=allowed, n_steps=n_steps).learn(100)
    buffer, normalize = model.replay_buffer, model.get_vec_normalize_env()
    set_random_seed(5)
    plain = buffer.sample(16, normalize)
    set_random_seed(5)
    raw = buffer.sample(16, None)
    set_random_seed(5)
    with raw_next_observations(buffer) as batch:
        watched = buffer.sample(16, normalize)
    for name, value in plain._asdict().items():
        if value is not None:
            assert th.equal(value, getattr(watched, name)), name
    assert th.equal(batch[0], raw.next_observations)


def test_greedy_choice_is_the_best_allowed_action():
    model = model_of(DQNAP, vectorised(1), permissible_actions=allowed).learn(60)
    rng = np.random.default_rng(0)
    obs = np.float32(np.column_stack([rng.random(50), rng.random((50, 5)) < 0.5]))
    obs[:, 3] = 1
    actions, _ = model.predict(obs, deterministic=True)
    with th.no_grad():
        values = model.q_net(th.as_tensor(obs)).numpy()
    np.testing.assert_array_equal(actions, np.where(obs[:, 1:] > 0.5, values, -np.inf).argmax(axis=1))


def test_random_choice_is_uniform_over_the_allowed_actions():
    model = model_of(DQNAP, vectorised(1), permissible_actions=allowed)
    model.exploration_rate = 1.0
    obs = np.float32([[0.5, 1, 0, 1, 0, 1]]).repeat(3_000, axis=0)
    actions, _ = model.predict(obs)
    # SB3 draws from all five; what is forbidden is drawn anew from the three.
    assert np.bincount(actions, minlength=5) == pytest.approx(
        [1000, 0, 1000, 0, 1000], abs=104
    )  # 4 standard deviations


@pytest.mark.parametrize("algorithm", [DQNAP, PPOAP])
def test_evaluation_tools_respect_masks_in_the_observation(algorithm, tmp_path):
    test = vectorised(1, wrap=ActionMaskObservation)
    model = model_of(
        algorithm, vectorised(1, wrap=ActionMaskObservation), "MultiInputPolicy", permissible_actions="action_mask"
    )
    model.learn(64, callback=EvalCallback(test, eval_freq=16, n_eval_episodes=3, verbose=0))
    evaluate_policy(model, test, n_eval_episodes=10)
    assert test.envs[0].unwrapped.steps > 20
    assert illegal_steps(test) == 0
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model")
    evaluate_policy(loaded, test, n_eval_episodes=10)
    assert illegal_steps(test) == 0


@pytest.mark.parametrize("algorithm", [DQNAP, PPOAP])
def test_single_observation_is_masked_as_in_a_batch(algorithm):
    model = model_of(algorithm, vectorised(1), permissible_actions=allowed)
    obs = np.float32([0.5, 0, 0, 0, 1, 0])
    assert model.predict(obs)[0] == 3
    assert model.predict(obs[None])[0].tolist() == [3]


def test_mask_of_an_episodes_last_state_is_its_own():
    """The automatic reset of a vectorised environment has already begun the next episode."""
    env = vectorised(1, wrap=ActionMaskObservation)
    env.seed(3)
    env.reset()
    ends = 0
    while ends < 5:
        obs, _, dones, infos = env.step(np.array([env.envs[0].unwrapped.mask.argmax()]))
        if dones[0]:
            ends += 1
            last = infos[0]["terminal_observation"]
            np.testing.assert_array_equal(last["observation"][1:], last["action_mask"])
        np.testing.assert_array_equal(obs["observation"][0, 1:], obs["action_mask"][0])


def test_extractor_leaves_the_mask_out():
    env = vectorised(1, wrap=ActionMaskObservation)
    kwargs = {"features_extractor_class": WithoutMaskExtractor}
    model = model_of(DQNAP, env, "MultiInputPolicy", permissible_actions="action_mask", policy_kwargs=kwargs)
    assert model.q_net.features_extractor.features_dim == 6
    assert_never_illegal(model)
    with pytest.raises(ValueError, match="leaves out 'other', but the observation space is"):
        WithoutMaskExtractor(env.observation_space, key="other")


@pytest.mark.parametrize("algorithm", [DQNAP, PPOAP])
def test_mask_and_predictor_hold_together(algorithm):
    def labels(obs, actions, next_obs):
        return np.asarray(actions) % 2 == 0

    env = vectorised(2)
    settings = {"dataset_size": 32, "validation_size": 16, "min_per_class": 2, "predictor_kwargs": {"batch_size": 16}}
    model = model_of(algorithm, env, permissible_actions=allowed, ap_function=labels, **settings).learn(400)
    assert illegal_steps(env) == 0
    assert model.predictor.fitted
    obs = np.float32([[0.5, 1, 1, 0, 1, 0]]).repeat(40, axis=0)  # 0, 1 and 3, of which E permits 0
    assert model.validation_accuracy > 0.9
    assert set(model.predict(obs, guided=True)[0].tolist()) == {0}
    obs = np.float32([[0.5, 0, 1, 0, 1, 0]]).repeat(40, axis=0)  # E permits neither
    assert set(model.predict(obs, guided=True)[0].tolist()) <= {1, 3}


def test_wrapper_form_gives_masks_to_maskable_ppo():
    def permissible(obs, action, next_obs):
        return bool(action % 2 == 0)

    inner = Masked()
    env = LearnedPermissibility(inner, permissible, alpha=0, refit_growth=0.05, seed=0)
    MaskablePPO("MlpPolicy", env, n_steps=64, batch_size=32, seed=0).learn(256)
    assert inner.illegal == 0
    assert env.validation_accuracy > 0.9
    inner.mask = np.array([True, True, False, True, False])
    np.testing.assert_array_equal(env.action_masks(), [True, False, False, False, False])
    inner.mask = np.array([False, True, False, True, False])
    np.testing.assert_array_equal(env.action_masks(), inner.mask)


def not_the_first(obs, actions):
    """Of SB3's BitFlippingEnv: the first bit must not be flipped while it is set."""
    return ~((np.asarray(actions) == 0) & (obs["observation"][:, 0] == 1))


def test_masks_and_hindsight_goals():
    env = BitFlippingEnv(n_bits=4, continuous=False)
    executed = []
    step = env.step
    env.step = lambda action: executed.append((env.state[0], action)) or step(action)
    settings = {"replay_buffer_class": HerReplayBuffer, "learning_starts": 20}
    model = model_of(DQNAP, env, "MultiInputPolicy", permissible_actions=not_the_first, **settings).learn(200)
    assert (1, 0) not in {(int(bit), int(action)) for bit, action in executed}
    assert model.replay_buffer.size() == 200


def test_masks_and_the_memory_saving_buffer():
    settings = {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
    env = vectorised(1)
    model_of(DQNAP, env, permissible_actions=allowed, **settings).learn(120)
    assert illegal_steps(env) == 0


class Unmasked(Masked):
    """Without any mask, or with one that is none."""

    def __init__(self, mask=None):
        super().__init__(as_info=True)
        self.given = mask

    def _info(self):
        return {} if self.given is None else {"action_mask": self.given}


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: ActionMaskObservation(Unmasked()).reset(),
            "has no method `action_masks\\(\\)` and puts no 'action_mask'",
        ),
        (lambda: ActionMaskObservation(Unmasked([1, 0])).reset(), "must have the shape \\(5,\\), but has \\(2,\\)"),
        (lambda: ActionMaskObservation(Unmasked([0.5] * 5)).reset(), "must hold True or False"),
        (lambda: ActionMaskObservation(Unmasked([2] * 5)).reset(), "must hold True or False"),
        (
            lambda: ActionMaskObservation(ActionMaskObservation(Masked())),
            "has an entry 'action_mask' already: give the model `permissible_actions='action_mask'`",
        ),
        (
            lambda: model_of(DQNAP, Masked(), permissible_actions="action_mask"),
            "is neither the dotted name of a function nor a key of the observation space",
        ),
        (
            lambda: model_of(
                DQNAP, ActionMaskObservation(Masked()), "MultiInputPolicy", permissible_actions="observation"
            ),
            "whose shape is \\(6,\\), but a mask of Discrete\\(5\\) has the shape \\(5,\\)",
        ),
        (
            lambda: PPOAP("MlpPolicy", "Pendulum-v1", permissible_actions=allowed),
            "masks finite actions, but the action space is Box",
        ),
    ],
)
def test_bad_masks_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_actions_whose_risk_is_learned_are_among_the_allowed_ones():
    model = model_of(DQNAP, vectorised(1), event="terminated", risk_discount=0.5, permissible_actions=allowed)
    obs = np.concatenate([Masked().reset(seed=seed)[0][None] for seed in range(50)])
    actions = model.proposed_actions(obs).numpy()[:, 0]
    assert allowed(obs, actions).all()
    assert len(set(actions.tolist())) > 1
