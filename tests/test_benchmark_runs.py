"""Configurations, and the runs that are made of them."""

import json
import os
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_sap.benchmark.configurations import Configuration, parse_configuration, parse_configurations
from sb3_sap.benchmark.groups import GROUPS
from sb3_sap.benchmark.learners import CLASSES, algorithm_class, is_on_policy, make_model, settings_of
from sb3_sap.benchmark.linear import LinearFeedback
from sb3_sap.benchmark.recorder import Recorder, how_ended
from sb3_sap.benchmark.runs import make_grid, make_run
from sb3_sap.benchmark.training import train_and_evaluate
from sb3_sap.envs.car import STEERING_LOCK
from sb3_sap.envs.torcs.installation import TorcsNotFoundError, find_installation


def run(text, steps=100, seed=0, tracks=("g-track-3",), simulator="highway"):
    return make_run(parse_configuration(text), simulator, steps, seed, tracks)


@pytest.mark.parametrize(
    ("text", "name", "changes"),
    [
        ("ddpg", "ddpg:default", {}),
        ("ddpg_ap:paper", "ddpg_ap:paper", {}),
        ("ddpg_ap:paper[alpha=0.50]", "ddpg_ap:paper[alpha=0.5]", {"alpha": 0.5}),
        ("sac:tuned[learning_rate=1e-3]", "sac:tuned[learning_rate=0.001]", {"learning_rate": 0.001}),
        (
            "ddpg_ap:paper[ t_k = 20 , policy_kwargs.net_arch=[64, 64], env.random_start=true]",
            "ddpg_ap:paper[t_k=20,policy_kwargs.net_arch=[64,64],env.random_start=true]",
            {"t_k": 20, "policy_kwargs.net_arch": [64, 64], "env.random_start": True},
        ),
        (
            "ddpg_ap:paper[predictor_kwargs.optimizer_class=SGD,ap_function=null]",
            "ddpg_ap:paper[predictor_kwargs.optimizer_class=SGD,ap_function=null]",
            {"predictor_kwargs.optimizer_class": "SGD", "ap_function": None},
        ),
        ("linear", "linear", {}),
    ],
)
def test_a_configuration_has_one_spelling(text, name, changes):
    configuration = parse_configuration(text)
    assert configuration.name == name
    assert configuration.changes == changes
    assert parse_configuration(name) == configuration


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ddpg ap", "A configuration is written algo:preset"),
        ("ddpg:paper[alpha]", "'alpha' is not of the form key=value"),
        ("ddpg:paper[alpha=]", "is not of the form key=value"),
        ("ddpg:paper[a=[1]", "is not a value"),
        ("dpg:paper", "There is no algorithm or group 'dpg': did you mean 'ddpg'?"),
        ("ddpg:papper", "did you mean 'paper'"),
        ("ddpg:paper[alhpa=1]", "ddpg:paper[alhpa=1]: ddpg has no setting 'alhpa'."),
        ("ddpg:paper[gamma.x=1]", "'gamma' is not a mapping"),
        ("linear[angel=1]", "linear has no setting 'angel'"),
    ],
)
def test_a_wrong_configuration_is_reported_in_one_sentence(text, message):
    with pytest.raises(ValueError, match=r".") as error:
        run(text)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_groups_expand_and_repeat_no_configuration():
    configurations = parse_configurations(["paper", "ddpg:paper", "linear"])
    assert [configuration.name for configuration in configurations] == [*GROUPS["paper"], "linear"]


@pytest.mark.parametrize("name", [name for group in GROUPS if group not in ("sbx", "all") for name in GROUPS[group]])
def test_every_configuration_of_a_group_has_settings(name):
    run(name)


def test_default_means_the_library_s_own_settings():
    for algo in ("ddpg", "td3", "sac", "tqc", "crossq"):
        assert settings_of(Configuration(algo), "torcs", 3_000) == {}


def test_overrides_change_their_settings_and_no_others():
    paper = run("ddpg_ap:paper", steps=3_000)
    changed = run("ddpg_ap:paper[predictor_kwargs.weight_decay=0,t_k=7,env.speed=80,env.random_start=true]", 3_000)
    assert paper.settings["predictor_kwargs"]["weight_decay"] == 0.01
    assert changed.settings == paper.settings | {
        "predictor_kwargs": paper.settings["predictor_kwargs"] | {"weight_decay": 0},
        "t_k": 7,
    }
    assert changed.training == {"track": "wheel-2", "laps": None, "speed": 80, "random_start": True}
    assert changed.task == {"speed": 80}  # test laps are driven at that speed too, but not from random starts


def test_sbx_has_the_settings_of_its_namesake():
    pytest.importorskip("sbx")
    assert settings_of(Configuration("sbx_sac", "default"), "torcs", 3_000) == {}
    tuned = settings_of(Configuration("sac", "tuned"), "torcs", 3_000)
    assert settings_of(Configuration("sbx_sac", "tuned"), "torcs", 3_000) == tuned | {
        "qf_learning_rate": tuned["learning_rate"]
    }
    paper = settings_of(Configuration("sbx_ddpg", "paper"), "torcs", 3_000)
    assert paper["learning_rate"] == 0.0001
    assert paper["qf_learning_rate"] == 0.001


def test_checkpoints_end_with_the_training():
    assert run("ddpg", steps=300).checkpoints == [100, 150, 200, 250, 300]
    assert run("ddpg", steps=100).checkpoints == [100]
    assert run("linear", steps=600).checkpoints == [0]


def test_a_grid_has_every_seed_and_one_run_of_the_linear_controller():
    grid = make_grid(parse_configurations(["ddpg", "linear"]), "highway", 100, range(100, 103))
    assert {configuration.name: [run.seed for run in runs] for configuration, runs in grid.items()} == {
        "ddpg:default": [100, 101, 102],
        "linear": [0],
    }


def test_names_of_runs_of_different_seeds_differ_in_the_seed_alone():
    first, second = (run("ddpg", seed=seed).name for seed in (0, 1))
    assert first.removesuffix("-seed0") == second.removesuffix("-seed1")


def test_linear_feedback():
    policy = LinearFeedback(angle=2.5, track_pos=-1.6, speed_y=1.0)
    obs = np.array([[STEERING_LOCK / 10, 0, 0, 0, 0], [0, 0.5, 1, 0, 0], [0, -1, 1, 1, 0]], dtype=np.float32)
    assert policy.predict(obs)[0] == pytest.approx(np.array([[0.25], [-0.8], [1.0]]))
    assert policy.predict(obs[1])[0].shape == (1,)
    laps = train_and_evaluate(run("linear", tracks=["wheel-2"]), 0.0)["laps"]["data"]
    assert [row[:3] for row in laps] == [[0, "wheel-2", True]]
    assert laps[0][5] > 0.98


@pytest.fixture(scope="module")
def result():
    return train_and_evaluate(run("ddpg_ap[min_per_class=2,dataset_size=32]", steps=300), 0.0)


def test_one_run_yields_everything(result):
    laps, times, curve, episodes = (
        [dict(zip(result[name]["columns"], row, strict=True)) for row in result[name]["data"]]
        for name in ("laps", "times", "curve", "episodes")
    )
    assert [(row["checkpoint"], row["track"]) for row in laps] == [(n, "g-track-3") for n in (100, 150, 200, 250, 300)]
    assert all(row["lap_done"] == (row["covered"] == 1) for row in laps)
    assert [row["checkpoint"] for row in times] == [100, 150, 200, 250, 300]
    assert 0 < times[0]["training_seconds"] < times[-1]["training_seconds"] < times[-1]["wall_seconds"]
    assert [row["step"] for row in curve] == list(range(25, 301, 25))
    accuracies = [(row["lowest_accuracy"], row["accuracy"]) for row in curve if row["accuracy"] is not None]
    assert accuracies
    assert all(0 <= lowest <= mean <= 1 for lowest, mean in accuracies)
    # Episodes follow one another without a gap, and their rewards are those of the curve.
    assert sum(row["length"] for row in episodes) == 300
    assert np.cumsum([row["length"] for row in episodes]).tolist() == [row["end"] for row in episodes]
    assert {row["ended"] for row in episodes[:-1]} <= {"off track", "backwards"}
    hundred = [row for row in episodes if row["end"] <= 100]
    if hundred and hundred[-1]["end"] == 100:
        assert curve[3]["reward"] == pytest.approx(sum(row["total_reward"] for row in hundred) / 100, abs=0.01)
    json.dumps(result)


@pytest.mark.parametrize("algo", ["ddpg_ap", "sac", "crossq"])
def test_evaluation_does_not_change_training(algo):
    def train(callback):
        env = gym.make("sap/LaneKeeping-v0", laps=None)
        model = make_model(algo, env, {"learning_starts": 30, "policy_kwargs": {"net_arch": [16]}}, seed=3)
        model.learn(80, callback=callback)
        return model

    def evaluate(policy, checkpoint):
        from sb3_sap.evaluation.laps import drive_lap

        assert checkpoint == policy.num_timesteps
        evaluated.append(checkpoint)
        drive_lap(policy, "g-track-3")
        return []

    class Clock:
        wall = process = staticmethod(lambda: 0.0)
        stopped = th.no_grad

    evaluated = []
    alone = train(None).policy.state_dict()
    watched = train(Recorder([40, 60, 80], evaluate, Clock())).policy.state_dict()
    assert evaluated == [40, 60, 80]
    assert all(th.equal(alone[name], watched[name]) for name in alone)


@pytest.mark.slow
@pytest.mark.parametrize(("algo", "simulator"), [("ddpg_ap", "torcs"), ("sbx_sac", "highway"), ("tqc", "highway")])
def test_a_run_is_the_same_however_often_it_is_evaluated(algo, simulator):
    if simulator == "torcs" and not os.environ.get("SB3_SAP_REQUIRE_TORCS"):
        try:
            find_installation()
        except TorcsNotFoundError as error:
            pytest.skip(str(error))
    if algo.startswith("sbx"):
        pytest.importorskip("sbx")
    often = run(f"{algo}[learning_starts=30]", steps=150, simulator=simulator)
    often = replace(often, checkpoints=[30, 60, 90, 150])
    seldom = replace(often, checkpoints=[150])
    first, second = train_and_evaluate(often, 0.0), train_and_evaluate(seldom, 0.0)
    assert first["curve"] == second["curve"]
    assert first["episodes"] == second["episodes"]
    assert first["laps"]["data"][-len(second["laps"]["data"]) :] == second["laps"]["data"]


def test_every_class_exists():
    for algo in CLASSES:
        if not algo.startswith("sbx_"):
            env = "CartPole-v1" if "dqn" in algo else "sap/LaneKeeping-v0"
            settings = {"n_steps": 64} if is_on_policy(algorithm_class(algo)) else {"buffer_size": 100}
            assert make_model(algo, gym.make(env), settings, 0).seed == 0


def test_an_on_policy_run_is_evaluated_after_its_updates():
    of = run("ppo_ap:base+loss[n_steps=64]", steps=320)
    assert of.settings["learning_rate"] == 0.001  # the base's own settings
    assert of.settings["permissibility_coef"] == "lin_3.0"
    assert of.checkpoints == [128, 192, 256, 320]  # of 100, 150, 200, 250
    assert run("ppo:tuned", steps=600).checkpoints == [256, 512, 600]
    result = train_and_evaluate(of, 0.0)
    assert [row[0] for row in result["laps"]["data"]] == of.checkpoints
    labelled = result["curve"]["data"][-1][-1]
    assert 0 < labelled < 320


def test_a_label_without_use_leaves_an_on_policy_run_as_its_base():
    ours, base = (
        train_and_evaluate(run(text, steps=256), 0.0) for text in ("ppo_ap:base+penalty[penalty=0]", "ppo:tuned")
    )
    assert ours["laps"] == base["laps"]
    assert ours["episodes"] == base["episodes"]


@pytest.mark.parametrize("algo", ["td3", "td3_ap"])
def test_a_learning_rate_that_falls_is_written_alike_for_the_base(algo):
    env = gym.make("sap/LaneKeeping-v0", laps=None)
    model = make_model(algo, env, {"learning_rate": "lin_0.002", "buffer_size": 100}, 0)
    assert [model.lr_schedule(left) for left in (1.0, 0.5, 0.0)] == [0.002, 0.001, 0.0]


@pytest.mark.parametrize(
    ("info", "how"),
    [
        ({"off_track": True, "angle": 3.0}, "off track"),
        ({"off_track": False, "angle": 3.0}, "backwards"),
        ({"off_track": False, "angle": 0.3}, "still"),
        ({"off_track": False, "angle": 0.3, "TimeLimit.truncated": True}, "truncated"),
        ({}, "terminated"),
    ],
)
def test_how_an_episode_ended(info, how):
    assert how_ended(info) == how


def test_long_laps_are_driven_at_the_end_only():
    names = ("ole-road-1", "g-track-3")
    plain = make_run(parse_configuration("ddpg"), "highway", 150, 0, names)
    later = make_run(parse_configuration("ddpg"), "highway", 150, 0, names, at_the_end=["ole-road-1", "spring"])
    assert later.at_the_end == ["ole-road-1"]  # of the tracks that are driven at all
    assert "at_the_end" not in plain.description()  # so that older results keep their names
    assert plain.name != later.name
    laps = train_and_evaluate(later, 0.0)["laps"]["data"]
    assert [row[:2] for row in laps] == [[100, "g-track-3"], [150, "ole-road-1"], [150, "g-track-3"]]
