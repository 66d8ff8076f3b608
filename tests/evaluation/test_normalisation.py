"""A policy of normalised observations, with the statistics that its run saved."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from stable_baselines3 import DDPG
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import Line, build

from sb3_sap import DDPGAP
from sb3_sap.cli.main import main
from sb3_sap.evaluation.normalisation import NormalisedPolicy, find_statistics
from sb3_sap.evaluation.policies import load_policy

OBS = np.array([[0.3, 0.9], [-0.5, 0.1]], dtype=np.float32)


def normalised(kind="array", **kwargs):
    return VecNormalize(DummyVecEnv([lambda: Line(kind)]), **kwargs)


def actions(policy, obs=OBS):
    return policy.predict(obs, deterministic=True)[0]


@pytest.fixture
def model():
    return build(DDPGAP, normalised()).learn(30)


def test_statistics_beside_a_model_are_used_and_remain_unchanged(model, tmp_path):
    env = model.get_vec_normalize_env()
    model.save(tmp_path / "model.zip")
    env.save(tmp_path / "vecnormalize.pkl")
    policy = load_policy(tmp_path / "model.zip")
    before = policy.statistics.obs_rms.mean.copy()
    assert np.array_equal(actions(policy), actions(model, env.normalize_obs(OBS)))
    assert not np.array_equal(actions(policy), actions(policy.policy))
    assert np.array_equal(actions(policy, OBS[0]), actions(policy)[0])
    assert np.array_equal(policy.statistics.obs_rms.mean, before)


def test_model_of_normalised_observations_is_refused_without_statistics(model, tmp_path):
    model.save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"model.zip learned on normalised .* `--vecnormalize FILE`"):
        load_policy(tmp_path / "model.zip")
    model.get_vec_normalize_env().save(tmp_path / "elsewhere.pkl")
    assert load_policy(tmp_path / "model.zip", tmp_path / "elsewhere.pkl").path == tmp_path / "elsewhere.pkl"


def test_model_of_raw_observations_ignores_statistics_beside_it(tmp_path):
    build(DDPGAP).learn(12).save(tmp_path / "model.zip")
    statistics = normalised()
    statistics.save(tmp_path / "vecnormalize.pkl")
    assert not isinstance(load_policy(tmp_path / "model.zip"), NormalisedPolicy)
    with pytest.raises(ValueError, match="learned on raw observations: leave `--vecnormalize` out"):
        load_policy(tmp_path / "model.zip", tmp_path / "vecnormalize.pkl")
    statistics.norm_obs = False
    statistics.save(tmp_path / "vecnormalize.pkl")
    policy = load_policy(tmp_path / "model.zip", tmp_path / "vecnormalize.pkl")
    assert np.array_equal(actions(policy), actions(policy.policy))  # only rewards were normalised


@pytest.mark.parametrize(
    ("name", "statistics"),
    [
        ("model.zip", "vecnormalize.pkl"),
        ("rl_model_500_steps.zip", "rl_model_vecnormalize_500_steps.pkl"),
        ("Pendulum-v1.zip", "Pendulum-v1/vecnormalize.pkl"),
        ("best_model.zip", "Pendulum-v1/vecnormalize.pkl"),
        ("rl_model_500_steps.zip", "Pendulum-v1/vecnormalize.pkl"),
        ("best_model.zip", None),
    ],
)
def test_statistics_are_found_beside_the_model_or_in_the_folder_of_its_run(name, statistics, tmp_path):
    for other in ("rl_model_vecnormalize_1000_steps.pkl", "hub/vecnormalize.pkl", "Pendulum-v1/config.yml"):
        (tmp_path / other).parent.mkdir(exist_ok=True)
        (tmp_path / other).touch()
    if statistics:
        (tmp_path / statistics).touch()
    assert find_statistics(tmp_path / name) == (tmp_path / statistics if statistics else None)


def test_statistics_of_several_runs_must_be_named(tmp_path):
    for run in ("A-v0", "B-v0"):
        (tmp_path / run).mkdir()
        for name in ("config.yml", "vecnormalize.pkl"):
            (tmp_path / run / name).touch()
    with pytest.raises(ValueError, match=r"A-v0/vecnormalize.pkl or .*name one with `--vecnormalize`"):
        find_statistics(tmp_path / "best_model.zip")
    assert find_statistics(tmp_path / "A-v0.zip") == tmp_path / "A-v0" / "vecnormalize.pkl"


def test_checkpoint_of_a_plain_sb3_model_gets_its_statistics(tmp_path):
    env = normalised("dict")
    model = DDPG("MultiInputPolicy", env, buffer_size=100, policy_kwargs={"net_arch": [8]}, seed=1)
    model.learn(20, callback=CheckpointCallback(10, tmp_path, save_vecnormalize=True))
    policy = load_policy(tmp_path / "rl_model_20_steps.zip")
    assert policy.path == tmp_path / "rl_model_vecnormalize_20_steps.pkl"
    obs = {"x": OBS[:, :1], "time": OBS[:, 1:]}
    assert np.array_equal(actions(policy, obs), actions(model, policy.statistics.normalize_obs(obs)))


class Wide(Line):
    """Observes three numbers instead of two."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(-1, 1, (3,), np.float32)


def test_statistics_that_do_not_fit_are_refused(model, tmp_path):
    model.save(tmp_path / "model.zip")

    def refused(name, sentence, error=ValueError):
        with pytest.raises(error, match=sentence):
            load_policy(tmp_path / "model.zip", tmp_path / name)

    refused("nothing.pkl", "There is no file .*nothing.pkl", FileNotFoundError)
    (tmp_path / "text.pkl").write_text("no pickle")
    refused("text.pkl", "text.pkl cannot be read")
    model.get_vec_normalize_env().save(tmp_path / "whole.pkl")
    (tmp_path / "cut.pkl").write_bytes((tmp_path / "whole.pkl").read_bytes()[:-20])
    refused("cut.pkl", "cut.pkl cannot be read")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    refused("buffer.pkl", "holds no VecNormalize but a .*Buffer")
    VecNormalize(DummyVecEnv([Wide])).save(tmp_path / "wide.pkl")
    refused("wide.pkl", r"observations of shape \(3,\), but the model takes \(2,\)")
    normalised("dict").save(tmp_path / "dict.pkl")
    refused("dict.pkl", r"shape \{'time': \(1,\), 'x': \(1,\)\}, but the model takes \(2,\)")


def test_evaluate_prints_which_statistics_it_uses(tmp_path, capsys):
    def lane():
        return gym.make("sap/LaneKeeping-v0", laps=None)

    env = VecNormalize(DummyVecEnv([lane]))
    model = build(DDPGAP, env).learn(30)
    model.save(tmp_path / "model.zip")
    command = ["evaluate", str(tmp_path / "model.zip"), "--tracks", "random:3"]
    assert main(command) == 1
    error = capsys.readouterr().err
    assert "--vecnormalize" in error
    assert error.count("\n") == 1
    assert not (tmp_path / "evaluation.json").exists()
    env.save(tmp_path / "own.pkl")
    assert main([*command, "--vecnormalize", str(tmp_path / "own.pkl")]) == 0
    assert f"Observations are normalised with {tmp_path / 'own.pkl'}." in capsys.readouterr().out
