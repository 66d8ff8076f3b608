"""Every algorithm with the features of SB3 that users combine it with."""

import copy
import inspect

import numpy as np
import pytest
import stable_baselines3
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from toy import ALGORITHMS, GUIDED, Line, build

from sb3_sap import DDPGAP, CrossQAP, PermissibilityCallback
from sb3_sap.common.settings import PAPER_STEPS

# CrossQ has only an MlpPolicy.
every_algorithm_but_crossq = pytest.mark.parametrize("algorithm", [cls for cls in ALGORITHMS if cls is not CrossQAP])
every_algorithm = pytest.mark.parametrize("algorithm", ALGORITHMS, ids=lambda cls: cls.__name__)


def trained(model):
    """Whether the actor, and the predictor if there is one, took gradient steps."""
    return model._n_updates > 0 and (type(model) not in GUIDED or model.predictor.fitted)


@every_algorithm
def test_algorithm_trains_in_several_environments(algorithm):
    env = DummyVecEnv([Line] * 3)
    model = build(algorithm, env, action_noise={"type": "normal", "sigma": 0.1}).learn(150)
    assert trained(model)
    assert model.num_timesteps == 150
    assert isinstance(model.action_noise, VectorizedActionNoise)
    assert [len(inner.executed) for inner in env.envs] == [50] * 3


@pytest.mark.slow
@every_algorithm
def test_algorithm_trains_in_subprocesses(algorithm):
    env = SubprocVecEnv([Line] * 2)
    try:
        assert trained(build(algorithm, env).learn(150))
    finally:
        env.close()


@every_algorithm
def test_algorithm_trains_under_vec_normalize_and_stores_raw_observations(algorithm):
    model = build(algorithm, VecNormalize(DummyVecEnv([Line] * 2))).learn(150)
    assert trained(model)
    buffer = model.replay_buffer
    np.testing.assert_allclose(np.unique(buffer.observations[:75, :, 1]), np.arange(10) / 10, atol=1e-6)


@pytest.mark.filterwarnings("ignore::tqdm.TqdmExperimentalWarning")
@every_algorithm
def test_progress_bar_reaches_the_last_step(algorithm, capsys):
    assert trained(build(algorithm).learn(150, progress_bar=True))
    assert "150/150" in capsys.readouterr().out


@every_algorithm
def test_tensorboard_log_has_the_metrics_of_the_algorithm(algorithm, tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    build(algorithm, tensorboard_log=str(tmp_path)).learn(150)
    (folder,) = tmp_path.iterdir()
    assert folder.name == f"{algorithm.__name__}_1"
    events = EventAccumulator(str(folder)).Reload()
    tags = set(events.Tags()["scalars"])
    assert {"rollout/ep_rew_mean", "train/actor_loss"} <= tags
    assert ("sap/validation_accuracy" in tags) == ("sap/alpha" in tags) == (algorithm in GUIDED)


@every_algorithm
def test_eval_and_checkpoint_callbacks_work(algorithm, tmp_path):
    callbacks = [
        EvalCallback(Monitor(Line()), eval_freq=50, n_eval_episodes=2, log_path=str(tmp_path), verbose=0),
        CheckpointCallback(100, str(tmp_path), save_replay_buffer=True),
    ]
    model = build(algorithm).learn(150, callback=callbacks)
    assert trained(model)
    evaluations = np.load(tmp_path / "evaluations.npz")
    assert evaluations["timesteps"].tolist() == [50, 100, 150]
    loaded = algorithm.load(tmp_path / "rl_model_100_steps", env=Line())
    loaded.load_replay_buffer(tmp_path / "rl_model_replay_buffer_100_steps")
    assert loaded.num_timesteps == 100
    assert loaded.replay_buffer.pos == 99  # stored after the callbacks of its step


@every_algorithm
def test_evaluate_policy_runs_whole_episodes(algorithm):
    model = build(algorithm).learn(30)
    env = Monitor(Line())
    env.reset(seed=3)
    rewards, lengths = evaluate_policy(model, env, n_eval_episodes=3, return_episode_rewards=True)
    assert lengths == [10, 10, 10]
    again, _ = evaluate_policy(model, env, n_eval_episodes=3, return_episode_rewards=True)
    assert all(-20 <= reward <= 0 for reward in [*rewards, *again])


@every_algorithm
def test_dictionaries_of_the_caller_are_used_and_not_modified(algorithm):
    given = {
        "policy_kwargs": {"net_arch": {"pi": [4], "qf": [6]}},
        "action_noise": {"type": "normal", "sigma": 0.1},
        "replay_buffer_kwargs": {"handle_timeout_termination": False},
        "n_steps": 3,
    }
    if algorithm in GUIDED:
        given["predictor_kwargs"] = {"net_arch": [5], "batch_size": 16}
    before = copy.deepcopy(given)
    model = build(algorithm, **given).learn(30)
    assert given == before
    for network, width in ((model.actor, 4), (model.critic, 6)):
        first_layer = next(layer for layer in network.modules() if isinstance(layer, th.nn.Linear))
        assert first_layer.out_features == width
    if issubclass(algorithm, stable_baselines3.DDPG):
        assert model.policy_kwargs["n_critics"] == 1
    if algorithm in GUIDED:
        assert model.predictor.head[0].out_features == 5


def rates(model):
    return [net.optimizer.param_groups[0]["lr"] for net in (model.actor, model.critic)]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"learning_rate": 0.02}, [0.02, 0.02]),
        ({"learning_rate": lambda remaining: 0.02 * remaining}, [0.01, 0.01]),
        ({"learning_rate": 0.02, "actor_learning_rate": 0.002}, [0.002, 0.02]),
        ({"learning_rate": 0.02, "actor_learning_rate": lambda remaining: 0.002 * remaining}, [0.001, 0.02]),
        ({"learning_rate": lambda r: 0.02 * r, "actor_learning_rate": 0.002}, [0.002, 0.01]),
        ({"learning_rate": "lin_0.02", "actor_learning_rate": "lin_2e-3"}, [0.001, 0.01]),
    ],
    ids=["number", "schedule", "two numbers", "actor schedule", "critic schedule", "as in YAML"],
)
@every_algorithm
def test_learning_rates_of_actor_and_critic_follow_numbers_and_schedules(algorithm, settings, expected, tmp_path):
    class HalfWay(BaseCallback):
        seen = None

        def _on_step(self):
            if self.num_timesteps == 21:  # the last update was made when half of 40 steps were left
                self.seen = rates(self.model)
            return True

    callback = HalfWay()
    model = build(algorithm, **settings)
    model.learn(40, callback=callback)
    assert callback.seen == pytest.approx(expected)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=Line())
    assert rates(loaded) == rates(model)
    loaded.learn(40, callback=callback)
    assert callback.seen == pytest.approx(expected)


@pytest.mark.parametrize(
    ("description", "kind"),
    [
        ({"type": "normal", "sigma": 0.2}, NormalActionNoise),
        ({"type": "ornstein-uhlenbeck", "sigma": 0.3, "theta": 0.6, "dt": 1}, OrnsteinUhlenbeckActionNoise),
    ],
)
@every_algorithm
def test_action_noise_can_be_given_as_in_yaml(algorithm, description, kind):
    model = build(algorithm, Line(dim=2), action_noise=description).learn(40)
    assert type(model.action_noise) is kind
    assert model.action_noise._sigma.tolist() == [description["sigma"]] * 2


@every_algorithm
def test_training_after_each_episode_takes_the_given_gradient_steps(algorithm):
    model = build(algorithm, train_freq=(1, "episode"), gradient_steps=2).learn(150)
    assert trained(model)
    assert model._n_updates == 2 * 14  # 15 episodes, of which the first is the warm-up


@every_algorithm
def test_algorithm_trains_with_n_step_returns(algorithm):
    model = build(algorithm, n_steps=3, gamma=0.5).learn(150)
    assert trained(model)
    assert (model.replay_buffer.n_steps, model.replay_buffer.gamma) == (3, 0.5)


@every_algorithm_but_crossq
def test_algorithm_trains_on_dict_observations(algorithm):
    model = build(algorithm, Line("dict"), policy="MultiInputPolicy").learn(150)
    assert trained(model)
    assert isinstance(model.replay_buffer, DictReplayBuffer)


@every_algorithm_but_crossq
def test_algorithm_trains_with_hindsight_and_continues_after_loading(algorithm, tmp_path):
    settings = {"policy": "MultiInputPolicy", "replay_buffer_class": HerReplayBuffer, "learning_starts": 20}
    model = build(algorithm, Line("goal"), replay_buffer_kwargs={"n_sampled_goal": 2}, **settings).learn(150)
    assert trained(model)
    assert isinstance(model.replay_buffer, HerReplayBuffer)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = algorithm.load(tmp_path / "model", env=Line("goal"))
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert trained(loaded.learn(30, reset_num_timesteps=False))


@pytest.mark.parametrize("algorithm", [algorithm for algorithm in GUIDED if algorithm is not CrossQAP])
def test_algorithm_trains_on_images_and_stores_them_as_uint8(algorithm):
    class Picture(Line):
        def __init__(self):
            super().__init__()
            self.observation_space = spaces.Box(0, 255, (36, 36, 1), np.uint8)

        def _observe(self):
            return np.full((36, 36, 1), np.clip(128 + 60 * self.x, 0, 255), dtype=np.uint8)

    model = build(algorithm, Picture(), policy="CnnPolicy", batch_size=2, buffer_size=60, knowledge_buffer_size=60)
    assert trained(model.learn(40))
    assert model.replay_buffer.knowledge.observations[""].dtype == np.uint8


@every_algorithm
def test_signature_lists_the_parameters(algorithm):
    parameters = inspect.signature(algorithm).parameters
    expected = {"policy", "env", "learning_rate", "buffer_size", "seed", "device", "actor_learning_rate"}
    expected |= {"alpha", "t_k", "ap_function", "predictor_kwargs"} if algorithm in GUIDED else set()
    assert expected <= parameters.keys()
    assert not {"args", "kwargs"} & parameters.keys()
    assert ("alpha" in parameters) == (algorithm in GUIDED)
    assert parameters["gamma"].default == 0.99


@every_algorithm
def test_learn_defaults_to_the_steps_of_the_paper(algorithm):
    assert PAPER_STEPS == 15_000
    assert inspect.signature(algorithm.learn).parameters["total_timesteps"].default == PAPER_STEPS


def test_learn_without_arguments_schedules_the_steps_of_the_paper(monkeypatch):
    # All 15,000 steps take minutes: the callback that the model installs ends the run after 200.
    monkeypatch.setattr(PermissibilityCallback, "_on_step", lambda self: self.num_timesteps < 200)
    env = Line()
    model = DDPGAP("MlpPolicy", env).learn()
    assert model.num_timesteps == 200
    assert model._total_timesteps == 15_000
    assert trained(model)
