"""What the runs of `sb3-sap benchmark starts` begin with."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_sap.benchmark import logs, started
from sb3_sap.benchmark.logs import guide, log
from sb3_sap.benchmark.started import DDPGAPStarted
from sb3_sap.benchmark.task_settings import entry
from sb3_sap.common.functions import resolve
from sb3_sap.evaluation.environments import make_env
from sb3_sap.evaluation.laps import ENVIRONMENTS
from sb3_sap.guidance import taught_policy
from sb3_sap.tasks import mountain_car_continuous


@pytest.fixture(autouse=True)
def short(monkeypatch):
    monkeypatch.setattr(started, "AGENT_STEPS", 300)
    monkeypatch.setattr(logs, "LOG_STEPS", 400)
    for module in (started, taught_policy):
        monkeypatch.setattr(module, "CRITIC_STEPS", 20)


def model(start, source="embedded"):
    env = make_env(ENVIRONMENTS["highway"], track="wheel-2", laps=None)
    return DDPGAPStarted(
        "MlpPolicy", env, start=start, source=source, source_simulator="highway", seed=100, min_per_class=5, penalty=1.0
    )


def same(one, other):
    return all(th.equal(a, b) for a, b in zip(one.parameters(), other.parameters(), strict=True))


@pytest.mark.slow
def test_starts_from_an_agent():
    donor = started.agent(started.DDPGAP, 100)
    donor.fit_predictor()
    prepared = {start: model(start) for start in ("predictor", "policy", "policy_predictor", "replay")}
    for one in prepared.values():
        one._prepare()
    assert same(prepared["policy"].policy, donor.policy)
    assert not prepared["policy"].predictor.fitted
    for start in ("predictor", "policy_predictor"):
        assert same(prepared[start].predictor, donor.predictor)
        assert prepared[start].knowledge.prior is None
        assert prepared[start].replay_buffer.prior == ()
    assert not same(prepared["predictor"].policy, donor.policy)
    (prior,) = prepared["replay"].replay_buffer.prior
    np.testing.assert_allclose(  # the donor has no penalty
        prior.rewards[:300, 0],
        donor.replay_buffer.rewards[:300, 0] - 1.0 * ~started_labels(donor.replay_buffer),
        rtol=1e-4,
    )


def started_labels(buffer):
    from sb3_sap.envs import ap_function

    return ap_function(buffer.observations[:300, 0], None, buffer.next_observations[:300, 0])


@pytest.mark.slow
@pytest.mark.parametrize("source", ["log", "random"])
def test_starts_from_a_log(source):
    cloned, imitated, taught = (model(start, source) for start in ("cloned", "imitated", "taught"))
    for one in (cloned, imitated, taught):
        one._prepare()
        assert one.held_until == (started.HOLD_TAUGHT if one is taught else started.HOLD)
        assert len(one.replay_buffer.prior) == 1
    assert not cloned.predictor.fitted
    assert cloned.knowledge.prior is None
    assert imitated.predictor.fitted
    assert taught.predictor.fitted
    assert not same(imitated.actor, taught.actor)
    taught.learn(20)
    assert taught.num_timesteps == 20


def test_logs_are_labelled_and_reproducible():
    one, other = log("log", "highway", 100), log("log", "highway", 100)
    np.testing.assert_array_equal(one.obs, other.obs)
    np.testing.assert_array_equal(one.next_obs[:-1][~one.dones[:-1]], one.obs[1:][~one.dones[:-1]])
    wrong = log("wrong", "highway", 100)
    assert (wrong.labels != one.labels).mean() == pytest.approx(0.1, abs=0.05)
    assert (log("region", "highway", 100).obs[:, 1] <= 0).all()


@pytest.mark.parametrize("env_id", ["MountainCarContinuous-v0", "FetchReach-v4"])
def test_controllers_of_tasks_do_what_is_permissible(env_id):
    if env_id.startswith("Fetch"):
        pytest.importorskip("gymnasium_robotics")
    function = resolve(entry("", env_id)["ap_function"], "ap_function")
    good, random = log("log", env_id, 100), log("random", env_id, 100)
    assert good.labels is None
    assert good.rewards.sum() > random.rewards.sum()
    shares = [function(one.obs, one.actions, one.next_obs).mean() for one in (good, random)]
    assert shares[0] > 0.8 > shares[1]


def test_a_task_logs_in_itself():
    one = DDPGAPStarted(
        "MlpPolicy",
        gym.make("MountainCarContinuous-v0"),
        start="cloned",
        source="log",
        seed=100,
        ap_function=mountain_car_continuous,
    )
    one._prepare()
    assert one.replay_buffer.prior[0].observations.shape[-1] == 2


@pytest.mark.parametrize("env_id", ["MountainCarContinuous-v0", "lane keeping"])
def test_a_guide_acts_first(env_id):
    if env_id == "lane keeping":
        one = model("guided", "log")
    else:
        env = gym.make(env_id)
        one = DDPGAPStarted("MlpPolicy", env, start="guided", source="log", ap_function=mountain_car_continuous, seed=1)
    one.learn(20)
    assert one.replay_buffer.prior == ()
    obs, actions = (getattr(one.replay_buffer, name)[:20, 0] for name in ("observations", "actions"))
    np.testing.assert_allclose(actions, guide(env_id if env_id.startswith("M") else "highway")(obs), atol=1e-6)


def test_unknown_start_is_refused():
    with pytest.raises(ValueError, match="There is no start 'policy' from the source 'log'"):
        model("policy", "log")
