"""From runs to a decision, and to code that trains with it."""

import pandas as pd
import pytest
from torch import nn
from toy import Line, towards_centre

from sb3_sap import RescaleExtractor, compare
from sb3_sap.comparison.code import lines
from sb3_sap.comparison.decision import Comparison
from sb3_sap.comparison.pilot import _measure, steps_within
from sb3_sap.comparison.ways import ways
from sb3_sap.comparison.worker import Job, policy_for, train
from sb3_sap.onpolicy.algorithms import ON_POLICY_ALGORITHMS


def compared(returns, algo="sac_ap"):
    """A comparison whose runs have the given returns: by way, a list of (first, last) for each seed."""
    rows = [
        {"way": way, "seed": seed, "step": step, "return": value, "mistakes": 0.25}
        for way, runs in returns.items()
        for seed, run in enumerate(runs)
        for step, value in zip((50, 100), run, strict=True)
    ]
    kept = [way for way in ways(algo, potential=False) if way.name in returns]
    return Comparison(kept, pd.DataFrame(rows), {way.name: f"# {way.name}" for way in kept})


def runs(first, last, noise=0.0):
    return [(first + noise * i, last + noise * i) for i in range(5)]


def test_way_that_is_clearly_better_is_chosen():
    result = compared({"base": runs(0, 1), "penalty": runs(5, 6), "guidance": runs(2, 3)})
    assert result.choice.name == "penalty"
    assert result.decision == (
        "Use penalty: the label as a reward penalty. A run of it beats one of base with probability 1.00 (95 % "
        "interval 1.00 to 1.00). This holds for 100 steps."
    )
    assert result.code == "# penalty"


@pytest.mark.parametrize(("number", "warned"), [(2, True), (3, True), (4, False)])
def test_decision_of_few_runs_says_that_it_may_be_chance(number, warned):
    decision = compared({"base": runs(0, 1)[:number], "penalty": runs(5, 6)[:number]}).decision
    assert (f"With {number} runs of each way it may be chance" in decision) == warned


def test_simplest_way_is_chosen_where_no_other_is_shown_to_be_better():
    result = compared({"base": runs(0, 1, noise=1.0), "penalty": runs(0.5, 1.5, noise=1.0)})
    assert result.best.name == "penalty"
    assert result.choice.name == "base"
    assert "Penalty did best, but is not shown to be better than base, which is simpler" in result.decision


def test_learning_sooner_counts_as_well_as_ending_better():
    result = compared({"base": runs(0, 6), "penalty": runs(6, 6)})
    assert result.choice.name == "penalty"
    assert result.scores("base").tolist() == [[3.0]] * 5
    assert result.final("base").tolist() == [[6.0]] * 5


def test_table_has_a_row_for_each_way_and_files_are_written(tmp_path):
    result = compared({"base": runs(0, 1), "penalty": runs(5, 6)})
    assert result.table["way"].tolist() == ["base", "penalty"]
    assert result.table["worst run"].tolist() == ["1", "6"]
    assert result.table["mistakes"].tolist() == ["25.0%", "25.0%"]
    result.save(tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"evaluations.csv", "table.csv", "curves.png", "decision.txt", "train.py"}


def test_ways_of_finite_actions_hold_no_loss_and_shaping_needs_a_potential():
    assert [way.name for way in ways("dqn_ap", potential=True)] == ["base", "penalty", "shaping", "guidance"]
    assert [way.name for way in ways("td3_ap", potential=False)] == ["base", "penalty", "loss", "guidance"]


@pytest.mark.parametrize("algo", ["ddpg_ap", "dqn_ap"])
def test_code_of_every_way_can_be_run(algo, monkeypatch, tmp_path):
    discrete = algo == "dqn_ap"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gymnasium.make", lambda name: Line(n_actions=3 if discrete else None))
    job = Job("Line-v0", {}, algo, {"learning_starts": 5, "batch_size": 4}, 0, 12, 10, 1)
    for way in ways(algo, potential=True):
        code = lines(way, job, "MlpPolicy", "toy.towards_centre", "toy.centred").replace(", progress_bar=True", "")
        assert code.count("\n") < 20
        scope = {}
        exec(code, scope)
        assert scope["model"].num_timesteps >= 12


@pytest.mark.parametrize("n_actions", [None, 3])
@pytest.mark.parametrize("algo", ON_POLICY_ALGORITHMS)
def test_code_of_every_way_of_an_on_policy_algorithm_can_be_run(algo, n_actions, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gymnasium.make", lambda name: Line(n_actions=n_actions))
    settings = {"n_steps": 8, "policy_kwargs": {"net_arch": [8]}} | ({} if algo == "a2c_ap" else {"batch_size": 4})
    if algo == "ppo_lstm_ap":
        settings["policy_kwargs"]["lstm_hidden_size"] = 8
    job = Job("Line-v0", {}, algo, settings, 0, 12, 10, 1).in_rollouts()
    for way in ways(algo, potential=True, finite=n_actions is not None):
        policy = policy_for(Line(), algo)
        code = lines(way, job, policy, "toy.towards_centre", "toy.centred").replace(", progress_bar=True", "")
        assert code.count("\n") < 20
        scope = {}
        exec(code, scope)
        assert scope["model"].num_timesteps == 16
        assert type(scope["model"]).__name__.endswith("AP") == (way.name != "base")


@pytest.mark.parametrize(
    ("algo", "finite", "last"),
    [
        ("ppo_ap", True, ["loss", "mask"]),
        ("ppo_ap", False, ["loss"]),
        ("trpo_ap", True, ["mask"]),
        ("trpo_ap", False, ["guidance"]),
    ],
)
def test_ways_of_on_policy_algorithms(algo, finite, last):
    found = ways(algo, potential=True, finite=finite)
    assert [way.name for way in found] == ["base", "penalty", "shaping", *last]
    assert found[0].meaning == f"{algo.removesuffix('_ap').upper()} alone, without the label"


def test_on_policy_runs_have_whole_rollouts_and_are_evaluated_at_their_ends():
    def sized(steps, **settings):
        return Job("x", {}, "ppo_ap", settings, 0, steps, 10, 1).in_rollouts()

    few, many = sized(3_000, n_steps=512), sized(13 * 2_048)
    assert (few.steps, few.evaluated_at) == (3_072, [512, 1_024, 1_536, 2_048, 2_560, 3_072])
    assert [step // 2_048 for step in many.evaluated_at] == [2, 3, 4, 6, 7, 8, 10, 11, 12, 13]
    off_policy = Job("x", {}, "sac_ap", {}, 0, 1_005, 10, 1).in_rollouts()
    assert (off_policy.steps, off_policy.evaluated_at[:2]) == (1_005, [100, 201])


def test_on_policy_run_reports_after_its_updates():
    reports, settings = [], {"n_steps": 8, "batch_size": 4, "ap_function": towards_centre}
    job = Job(Line, {"n_actions": 3}, "ppo_ap", settings, 0, 24, 10, 1).in_rollouts()
    train(job, reports.append)
    assert [row["step"] for row in reports] == [8, 16, 24]
    assert all(0 <= row["mistakes"] <= 1 for row in reports)


def test_setting_of_the_user_goes_before_that_of_a_way(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gymnasium.make", lambda name: Line())
    job = Job("Line-v0", {}, "ddpg_ap", {"learning_starts": 5, "batch_size": 4, "refit_growth": 0.125}, 0, 12, 10, 1)
    for way in ways("ddpg_ap", potential=True)[1:]:
        scope = {}
        code = lines(way, job, "MlpPolicy", "toy.towards_centre", "toy.centred")
        exec(code.replace(", progress_bar=True", ""), scope)
        assert scope["model"].refit_growth == 0.125


def test_code_of_the_base_has_no_settings_of_guidance(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gymnasium.make", lambda name: Line())
    job = Job("Line-v0", {}, "ddpg_ap", {"learning_starts": 5, "batch_size": 4, "refit_growth": 0.125}, 0, 12, 10, 1)
    code = lines(ways("ddpg_ap", potential=False)[0], job, "MlpPolicy", "toy.towards_centre", None)
    assert "refit_growth" not in code
    exec(code.replace(", progress_bar=True", ""), {})


def test_classes_in_settings_are_imported(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("gymnasium.make", lambda name: Line())
    settings = {
        "learning_starts": 5,
        "batch_size": 4,
        "policy_kwargs": {"features_extractor_class": RescaleExtractor, "net_arch": [8], "activation_fn": nn.Tanh},
    }
    for way in ways("sac_ap", potential=False)[:2]:
        job = Job("Line-v0", {}, "sac_ap", settings, 0, 12, 10, 1)
        scope = {}
        code = lines(way, job, "MlpPolicy", "toy.towards_centre", None)
        exec(code.replace(", progress_bar=True", ""), scope)
        assert isinstance(scope["model"].actor.features_extractor, RescaleExtractor)


def test_code_names_functions_of_a_notebook_without_importing_them():
    def mine(obs, actions, next_obs):
        return towards_centre(obs, actions, next_obs)

    mine.__module__, mine.__qualname__ = "__main__", "mine"
    job = Job("Line-v0", {"dim": 1}, "sac_ap", {}, 0, 12, 10, 1)
    code = lines(ways("sac_ap", False)[1], job, "MlpPolicy", mine, None)
    assert "ap_function=mine" in code
    assert "import mine" not in code
    assert "gym.make('Line-v0', dim=1)" in code


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"seeds": 1}, "^`seeds` must be a whole number of at least 2, but is 1"),
        ({"minutes": 0}, "^`minutes` must be a number above 0, but is 0"),
        ({"steps": 0}, "^`steps` must be a whole number of at least 1, but is 0"),
        ({"algo": "sacc"}, "^`algo` = 'sacc' has no guided algorithm: did you mean 'sac_ap'"),
        ({"ap_function": "toy.missing"}, "^`ap_function`: 'toy.missing' cannot be imported"),
    ],
)
def test_bad_arguments_get_a_sentence(settings, sentence):
    with pytest.raises(ValueError, match=sentence):
        compare(Line, **settings)


def test_steps_follow_from_the_time(monkeypatch):
    monkeypatch.setattr("sb3_sap.comparison.pilot._measure", lambda job, warm_up: (0.01, 0.1, 4.0))
    now = iter([0.0, 0.0, 0.0, 0.0, 0.0, 60.0])
    monkeypatch.setattr("sb3_sap.comparison.pilot.time.monotonic", lambda: next(now))
    jobs = [Job("x", {}, "sac_ap", {}, 0, 0, 10, 5)] * 3
    # 600 s of two processors for 3 ways of 4 seeds: 300 s, less 3 · (4 + 5) s, at 3 · 0.01 s a step.
    assert steps_within(10, jobs, seeds=4, jobs=2) == int((300 - 27) / 0.03)
    with pytest.raises(ValueError, match=r"^1 minutes suffice for 100 steps of each run, .* give at least 2 minutes"):
        steps_within(1, jobs, seeds=4, jobs=2)
    # The trials themselves take a minute of ten.
    assert steps_within(10, jobs, seeds=4, jobs=2) == int((270 - 27) / 0.03)


def test_on_policy_steps_that_fit_are_whole_rollouts_and_at_least_four(monkeypatch):
    monkeypatch.setattr("sb3_sap.comparison.pilot._measure", lambda job, warm_up: (0.01, 0.1, 4.0))
    monkeypatch.setattr("sb3_sap.comparison.pilot.time.monotonic", lambda: 0.0)
    jobs = [Job("x", {}, "ppo_ap", {}, 0, 0, 10, 5)] * 3
    assert steps_within(10, jobs, seeds=4, jobs=2) == 4 * 2_048  # of 9,100
    with pytest.raises(ValueError, match=r"^8 minutes suffice for 7100 steps of each run, .* give at least 10 minutes"):
        steps_within(8, jobs, seeds=4, jobs=2)


def test_steps_before_learning_do_not_count_as_trained(monkeypatch):
    """Steps are free until 1,000, and then take 0.01 s each; an episode takes 0.5 s."""
    now = 0.0

    def run(job):
        nonlocal now
        for step in (job.steps // 2, job.steps):
            now = 5.0 + 0.01 * max(0, step - 1_000) + 0.5 * (1 + (step == job.steps))
            yield {"step": step, "took": 0.5}

    monkeypatch.setattr("sb3_sap.comparison.pilot.run_in_process", run)
    monkeypatch.setattr("sb3_sap.comparison.pilot.time.monotonic", lambda: now)
    per_step, episode, start = _measure(Job("x", {}, "sac_ap", {}, 0, 0, 10, 5), 1_000)
    assert per_step == pytest.approx(0.01)
    assert (episode, start) == (0.5, 5.0)
