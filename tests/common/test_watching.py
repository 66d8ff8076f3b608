"""Warnings of a training environment that is also used elsewhere, or that does not normalise as before."""

import pytest
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback, EveryNTimesteps
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnvWrapper, VecNormalize, unwrap_vec_normalize
from toy import Line, build

from sb3_sap import DDPGAP


class Evaluates(BaseCallback):
    """Evaluates once in the training environment."""

    def _on_step(self):
        if self.n_calls == 20:
            evaluate_policy(self.model, self.training_env, 1, warn=False)
        return True


@pytest.mark.filterwarnings("ignore:Training and eval env")
@pytest.mark.parametrize(
    "make",
    [
        lambda env: EvalCallback(env, eval_freq=20, verbose=0, warn=False),
        lambda env: [EveryNTimesteps(20, EvalCallback(env, verbose=0, warn=False))],
        lambda env: EvalCallback(env.envs[0], eval_freq=20, verbose=0, warn=False),
        lambda env: Evaluates(),
    ],
    ids=["EvalCallback", "nested", "the environment inside", "own callback"],
)
def test_evaluating_in_the_training_environment_warns(make):
    env = DummyVecEnv([Line])
    with pytest.warns(UserWarning, match="^The training environment is also used by .*environment of its own"):
        build(DDPGAP, env).learn(40, callback=make(env))


@pytest.mark.filterwarnings("error:The training environment")
def test_evaluating_in_another_environment_does_not_warn():
    env = DummyVecEnv([Line] * 2)
    callback = EvalCallback(DummyVecEnv([Line]), eval_freq=10, verbose=0, warn=False)
    model = build(DDPGAP, env).learn(40, callback=callback)
    model.learn(7, callback=lambda *_: False)  # stopped within a rollout


class Skips(VecEnvWrapper):
    """Executes every action twice."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        actions = self.venv.actions
        self.venv.step_wait()
        self.venv.step_async(actions)
        return self.venv.step_wait()


@pytest.mark.filterwarnings("error:The training environment")
@pytest.mark.parametrize("wrap", [Skips, lambda env: VecNormalize(Skips(env))])
def test_wrapper_that_steps_twice_does_not_warn(wrap):
    build(DDPGAP, wrap(DummyVecEnv([Line]))).learn(40)


def test_loading_into_an_environment_that_does_not_normalise_warns(tmp_path):
    model = build(DDPGAP, VecNormalize(DummyVecEnv([Line]))).learn(30)
    model.save(tmp_path / "model")
    with pytest.warns(UserWarning, match=r"^This model learned from .* VecNormalize.load\(statistics, env\)"):
        DDPGAP.load(tmp_path / "model", env=Line())
    with pytest.warns(UserWarning, match="gives raw ones"):
        DDPGAP.load(tmp_path / "model").set_env(DummyVecEnv([Line]))
    with pytest.warns(UserWarning, match="statistics of this VecNormalize are those of no observation"):
        DDPGAP.load(tmp_path / "model", env=VecNormalize(DummyVecEnv([Line])))


@pytest.mark.filterwarnings("error:This model learned")
def test_loading_with_the_statistics_does_not_warn(tmp_path):
    model = build(DDPGAP, VecNormalize(DummyVecEnv([Line]))).learn(30)
    model.save(tmp_path / "model")
    unwrap_vec_normalize(model.env).save(tmp_path / "statistics.pkl")
    env = VecNormalize.load(tmp_path / "statistics.pkl", DummyVecEnv([Line]))
    DDPGAP.load(tmp_path / "model", env=env)
    rewards_alone = build(DDPGAP, VecNormalize(DummyVecEnv([Line]), norm_obs=False)).learn(30)
    rewards_alone.save(tmp_path / "model")
    DDPGAP.load(tmp_path / "model", env=Line())
