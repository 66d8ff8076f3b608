"""Tasks beyond lane keeping in the benchmark."""

import gymnasium as gym
import numpy as np
import pytest
import yaml

from sb3_sap.benchmark import dispatch
from sb3_sap.benchmark.configurations import parse_configuration, parse_configurations
from sb3_sap.benchmark.episodes import RETURN_COLUMNS, evaluation, of_whole_action
from sb3_sap.benchmark.recorder import CURVE_COLUMNS, EPISODE_COLUMNS, TIME_COLUMNS
from sb3_sap.benchmark.reports.results import collect
from sb3_sap.benchmark.reports.returns import mean_returns, steps_to_return
from sb3_sap.benchmark.runs import make_grid, make_run
from sb3_sap.benchmark.store import write_result
from sb3_sap.benchmark.task_reports import parts_of, races_of, task_configurations
from sb3_sap.benchmark.task_settings import EPISODES, evaluations
from sb3_sap.benchmark.training import train_and_evaluate
from sb3_sap.cli.main import main
from sb3_sap.presets import load_config

CAR = "MountainCarContinuous-v0"
MADE = {"versions": {"python": "3.11"}, "machine": "a machine", "date": "2020-01-02", "revision": "abc"}


def run(text, env_id=CAR, steps=100, seed=0, episodes=EPISODES):
    return make_run(parse_configuration(text), env_id, steps, seed, episodes)


class Policy:
    """Acts by a function of the batch of observations."""

    def __init__(self, act):
        self.act = act

    def predict(self, obs, deterministic):
        assert deterministic
        return self.act(obs), None


def rows_of(act, env_id=CAR, algo="ddpg_ap", episodes=("10000", "10001")):
    rows = evaluation(env_id, algo, {}, list(episodes))(Policy(act))
    return [dict(zip(RETURN_COLUMNS[1:], row, strict=True)) for row in rows]


# ------------------------------------------------------------------ configurations and runs


def test_a_task_compares_a_guided_algorithm_with_its_base_tuned_settings_and_the_oracle():
    assert task_configurations(CAR) == ["ddpg_ap:task", "ddpg:task", "ddpg:tuned[steps=200000,seeds=3]", "oracle"]
    assert "oracle" not in task_configurations("sap/TorcsDriving-v0")  # the environment itself labels
    racing = ["sac_ap:task", "sac:task", "tqc_ap:task", "tqc:task"]
    assert task_configurations("sap/TorcsRacing-v0") == racing  # it cannot be copied
    guided, base, tuned, default = (
        run(text) for text in ("ddpg_ap:task", "ddpg:task", "ddpg:tuned[steps=300]", "ddpg")
    )
    assert guided.settings["ap_function"] == "sb3_sap.tasks.mountain_car_continuous"
    shared = ("policy_kwargs", "learning_rate")
    assert base.settings == {name: guided.settings[name] for name in shared}
    assert tuned.settings["policy_kwargs"] == {"net_arch": [400, 300]}
    assert (tuned.steps, base.steps) == (300, 100)
    assert default.settings == {}
    assert guided.tracks == [str(seed) for seed in range(10_000, 10_010)]


def test_every_configuration_of_a_task_trains_in_the_same_environment():
    options = {str(run(text, "highway-fast-v0").training) for text in ("sac_ap:task", "sac:task", "sac")}
    assert len(options) == 1
    assert "Kinematics" in options.pop()


def test_labels_of_parts_are_one_label_in_an_evaluation():
    gap = {"desired_goal": np.zeros((2, 3)), "achieved_goal": np.array([[0.2, 0.2, 0.0], [0.2, 0.0, 0.0]])}
    nearer = {**gap, "achieved_goal": np.array([[0.1, 0.1, 0.0], [0.1, 0.1, 0.0]])}
    label = of_whole_action("sb3_sap.tasks.fetch_reach_axes")
    assert label(gap, np.zeros((2, 4)), nearer).tolist() == [True, False]
    assert label.__name__ == "fetch_reach_axes"
    assert of_whole_action("sb3_sap.tasks.fetch_reach")(gap, np.zeros((2, 4)), nearer).tolist() == [True, True]


def test_labels_of_parts_are_compared_with_one_label():
    whole = "ap_function=sb3_sap.tasks.fetch_reach,action_parts=null"
    assert parts_of("FetchReach-v4") == [
        "sac_ap:base+penalty[penalty=0]",
        *("sac_ap:base+penalty", "sac_ap:base+loss", "sac_ap:task"),
        *(f"sac_ap:{way}[{whole}]" for way in ("base+penalty", "base+loss", "task")),
    ]
    with pytest.raises(ValueError, match=r"one for the whole, which Pendulum-v1 does not have: choose from FetchReach"):
        parts_of("Pendulum-v1")


def test_racing_is_compared_with_one_label():
    one_label = "sac_ap:task[ap_function=sb3_sap.tasks.racing_whole,action_parts=null]"
    assert races_of("sap/TorcsRacing-v0")[-3:] == ["sac_ap:task", one_label, "scripted"]
    settings = run(one_label, "sap/TorcsRacing-v0").settings
    assert (settings["ap_function"], settings["action_parts"]) == ("sb3_sap.tasks.racing_whole", None)


def test_a_configuration_may_have_fewer_seeds():
    grid = make_grid(
        parse_configurations(["ddpg_ap:task", "ddpg:tuned[steps=40,seeds=2]"]), CAR, 20, range(5), EPISODES
    )
    assert [len(runs) for runs in grid.values()] == [5, 2]


@pytest.mark.parametrize(
    ("text", "env_id", "message"),
    [
        ("ddpg_ap:task", "MountainCarContinous-v0", "did you mean 'MountainCarContinuous-v0'"),
        ("ddpg_ap:tuned", CAR, "ddpg_ap has no preset 'tuned' for MountainCarContinuous-v0"),
        ("ddpg:paper", CAR, "ddpg has no preset 'paper'"),
        ("ddpg:task[steps=0]", CAR, "steps must be 1 or more, but is 0"),
        ("ddpg:task[alpha=1]", CAR, "ddpg has no setting 'alpha'"),
        ("linear", CAR, f"The configuration linear is for lane keeping, but {CAR} is not"),
        ("oracle", "sap/TorcsDriving-v0", "that can be copied, but sap/TorcsDriving-v0 is not"),
        ("oracle", "sap/TorcsRacing-v0", "that can be copied, but sap/TorcsRacing-v0 is not"),
        ("oracle", "highway", "that can be copied, but highway is not"),
        ("oracle[alpha=1]", CAR, "oracle has no setting 'alpha'"),
    ],
)
def test_a_wrong_configuration_is_reported_in_one_sentence(text, env_id, message):
    with pytest.raises(ValueError, match=r".") as error:
        make_grid([parse_configuration(text)], env_id, 20, [0], EPISODES)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_evaluations_end_with_the_training():
    assert evaluations(20_000) == list(range(1_000, 20_001, 1_000))
    assert evaluations(7) == [1, 2, 3, 4, 5, 6, 7]
    assert evaluations(50)[-2:] == [48, 50]


@pytest.mark.parametrize("algo", ["ddpg", "sac", "tqc", "dqn", "qrdqn"])
def test_tuned_settings_are_rl_zoo_s(algo):
    rl_zoo3 = pytest.importorskip("rl_zoo3")
    with open(f"{rl_zoo3.__path__[0]}/hyperparams/{algo}.yml", encoding="utf-8") as file:
        theirs = yaml.safe_load(file)
    own = {env_id: entry for env_id, entry in load_config(algo).items() if env_id in theirs and "-v" in env_id}
    assert own
    for env_id, entry in own.items():
        expected = {key: _as_yaml(value) for key, value in theirs[env_id].items()}
        if "noise_type" in expected:
            noise = {"type": expected.pop("noise_type"), "sigma": expected.pop("noise_std")}
            assert entry["action_noise"] == noise
        if "replay_buffer_class" in expected:
            expected["replay_buffer_class"] = f"stable_baselines3.{expected['replay_buffer_class']}"
        assert {key: value for key, value in entry.items() if key != "action_noise"} == expected


def _as_yaml(value):
    return eval(value) if isinstance(value, str) and value.startswith("dict(") else value


# ------------------------------------------------------------------ evaluation


def test_returns_of_policies_that_can_be_computed_in_the_head():
    for row in rows_of(lambda obs: np.ones((len(obs), 1))):  # it never gets there: 999 steps of 0.1
        assert row["total_reward"] == row["score"] == pytest.approx(-99.9)
        assert row["steps"] == 999
        assert row["success"] is None
        assert 0.3 < row["permissible"] < 0.7  # half of the time the car moves left
    for row in rows_of(lambda obs: np.where(obs[:, 1:] >= 0, 1.0, -1.0)):
        assert row["total_reward"] == pytest.approx(100 - 0.1 * row["steps"])
        assert row["steps"] < 150
        assert row["permissible"] == 1.0
    idle = rows_of(lambda obs: np.zeros((len(obs), 1)))
    assert [row["permissible"] for row in idle] == [0.0, 0.0]


def test_episodes_run_side_by_side_as_they_would_alone():
    def act(obs):
        return np.where(obs[:, 1:] >= 0, 0.8, -0.8)

    episodes = ("10000", "10001", "10002")
    together = rows_of(act, episodes=episodes)
    assert len({row["steps"] for row in together}) > 1
    assert together == [row for seed in episodes for row in rows_of(act, episodes=(seed,))]


def test_evaluation_of_discrete_actions_and_goals():
    [row] = rows_of(lambda obs: np.where(obs[:, 1] >= 0, 2, 0), "MountainCar-v0", "dqn", ("10000",))
    assert row["total_reward"] == -row["steps"] > -200
    [row] = rows_of(lambda obs: np.zeros((len(obs["observation"]), 2)), "parking-v0", "tqc", ("10000",))
    assert row["success"] is False
    assert row["permissible"] == 1.0  # it stands still


@pytest.mark.slow
def test_one_run_yields_everything():
    result = train_and_evaluate(
        run("ddpg_ap:task[learning_starts=20,min_per_class=2]", steps=40, episodes=["10000"]), 0.0
    )
    assert result["laps"]["columns"] == RETURN_COLUMNS
    assert [row[:2] for row in result["laps"]["data"]] == [[point, "10000"] for point in range(2, 41, 2)]
    assert result["curve"]["data"][0][:2] == [25, pytest.approx(result["curve"]["data"][0][1])]
    assert result["episodes"]["data"] == [[40, 40, result["episodes"]["data"][0][2], "unfinished"]]


# ------------------------------------------------------------------ the look-ahead oracle


def rows_of_the_oracle(text, env_id, episodes=("10000", "10001"), seed=0):
    of = run(text, env_id, seed=seed, episodes=episodes)
    assert (of.steps, of.checkpoints) == (0, [0])
    result = train_and_evaluate(of, 0.0)
    assert result["curve"]["data"] == result["times"]["data"] == []
    return [dict(zip(RETURN_COLUMNS, row, strict=True)) for row in result["laps"]["data"]]


def test_the_oracle_executes_only_permissible_actions():
    rows = rows_of_the_oracle("oracle", CAR)
    assert [row["permissible"] for row in rows] == [1.0, 1.0]
    assert all(row["total_reward"] > 90 for row in rows)  # to pump energy is to solve it
    assert rows == rows_of_the_oracle("oracle", CAR) != rows_of_the_oracle("oracle", CAR, seed=1)


def idle(obs, actions, next_obs):
    """Nothing but no torque is permissible."""
    return actions.reshape(-1) == 1


def never(obs, actions, next_obs):
    return np.zeros(len(actions), dtype=bool)


def test_the_oracle_tries_actions_in_a_copy():
    [row] = rows_of_the_oracle(f"oracle[ap_function={__name__}.idle]", "Acrobot-v1", ("10000",))
    assert (row["permissible"], row["total_reward"]) == (1.0, -500.0)  # hanging as it was
    [row] = rows_of_the_oracle(f"oracle[ap_function={__name__}.never]", "Acrobot-v1", ("10000",))
    assert row["permissible"] == 0.0
    assert row["steps"] > 100  # nothing is permissible: it acts at random
    rows = rows_of_the_oracle("oracle", "parking-v0", ("10000",))  # a goal, two actions
    assert [row["success"] for row in rows] == [False]


# ------------------------------------------------------------------ report

#: Mean return at half of the training and at its end, by configuration.
RETURNS = {"ddpg_ap:task": (91, 95), "ddpg:task": (0, 0), "ddpg:tuned": (-20, 93), "oracle": (0, 50)}


def synthetic(of, name):
    half, end = RETURNS[name.partition("[")[0]]
    data = []
    for point in of.checkpoints:
        value = (half if point < of.steps else end) + of.seed
        data += [[point, track, None, 0.9, value, value, 10] for track in of.tracks]
    tables = {
        "laps": (RETURN_COLUMNS, data),
        "times": (TIME_COLUMNS, [[at, 9.0 + at, at, 1 + at / 20] for at in of.checkpoints] if of.steps else []),
        "curve": (CURVE_COLUMNS, [[25, 1.0, 0.8, 0.7, 10]] if of.steps else []),
        "episodes": (EPISODE_COLUMNS, [[of.steps, of.steps, 1.0, "unfinished"]] if of.steps else []),
    }
    return {"run": of.description(), "made": MADE} | {
        table: {"columns": columns, "data": rows} for table, (columns, rows) in tables.items()
    }


def test_the_command_writes_a_page(tmp_path, monkeypatch, capsys):
    configurations = ["ddpg_ap:task", "ddpg:task", "ddpg:tuned[steps=100,seeds=1]", "oracle"]
    grid = make_grid(parse_configurations(configurations), CAR, 40, range(2), EPISODES)
    folder = tmp_path / CAR
    for configuration, runs in grid.items():
        for of in runs:
            write_result(of, folder, synthetic(of, configuration.name))
    monkeypatch.setattr(dispatch, "run_in_own_process", lambda run, snapshot: {"error": "nothing is missing"})
    command = ["benchmark", "task", CAR, "--steps", "40", "--seeds", "2", "--out", str(tmp_path)]
    assert main([*command, "--configurations", *configurations]) == 0
    page = (folder / "returns.md").read_text(encoding="utf-8")
    assert "| ddpg_ap:task | 40 | 2 | 95.5 [95, 96] | 95 | 2 (2 of 2) | 90.0% | 0.800 | 50.0 |" in page
    assert "| ddpg:task | 40 | 2 | 0.5 [0, 1] | 0 | – (0 of 2) |" in page
    assert "| ddpg:tuned[steps=100,seeds=1] | 100 | 1 | 93 [93, 93] | 93 | 100 (1 of 1) |" in page
    assert "| oracle | 0 | 2 | 50.5 [50, 51] | 50 | – (0 of 2) | 90.0% |  |  |" in page
    assert "| ddpg_ap:task | ddpg:task | 1.00 [1.00, 1.00] |" in page
    assert "| ddpg_ap:task | oracle | 1.00 [1.00, 1.00] |" in page
    assert f"Made by `sb3-sap benchmark task {CAR} --steps 40 --seeds 2 --configurations" in page
    assert {path.name for path in folder.glob("returns*")} == {
        "returns.md",
        "returns.csv",
        "returns_improvement.csv",
        "returns.svg",
    }
    results = collect(grid, folder, CAR, 40)
    runs = mean_returns(results.laps)
    assert steps_to_return(runs[runs["configuration"] == "ddpg:tuned[steps=100,seeds=1]"], 90).tolist() == [100]
    assert gym.spec(CAR).reward_threshold == 90
    assert main(["benchmark", "task", "Mountain-v0", "--out", str(tmp_path)]) == 1
    assert "No guided algorithm has settings for 'Mountain-v0'" in capsys.readouterr().err
