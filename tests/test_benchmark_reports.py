"""Tables, figures and claims of synthetic runs, whose values can be computed in the head."""

import math
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest

from sb3_sap.benchmark.configurations import parse_configurations
from sb3_sap.benchmark.paper import TEST_TRACKS
from sb3_sap.benchmark.recorder import CURVE_COLUMNS, EPISODE_COLUMNS, TIME_COLUMNS
from sb3_sap.benchmark.reports.claims import CLAIMS, claims, judged
from sb3_sap.benchmark.reports.drawing import curve_figure, line_figure
from sb3_sap.benchmark.reports.figures import with_averages
from sb3_sap.benchmark.reports.measures import median_reached, per_run, seconds_to_competence, steps_to_competence
from sb3_sap.benchmark.reports.results import collect
from sb3_sap.benchmark.reports.summary import improvement
from sb3_sap.benchmark.reports.tables import curve_table
from sb3_sap.benchmark.reports.ways import ways
from sb3_sap.benchmark.runs import make_grid
from sb3_sap.benchmark.store import write_result
from sb3_sap.benchmark.training import LAP_COLUMNS
from sb3_sap.cli.main import main
from sb3_sap.evaluation.statistics import probability_of_improvement

MADE = {"versions": {"python": "3.11"}, "machine": "a machine", "date": "2020-01-02", "revision": "abc"}
#: S from 250 steps on, and from 500 on, by algorithm; what is below 0.5 is a lap that was not done.
SCORES = {"ddpg": (0.1, 0.2), "ddpg_ap": (0.91, 0.96), "ddpg_ap_ce2": (0.2, 0.93), "ddpg_ce1": (0.5, 0.5)}


def synthetic(run, accuracy=0.8):
    """The result of a run: S by algorithm and checkpoint, plus 0.002 for each seed; ten steps an episode."""
    early, late = SCORES.get(run.algo, (0.9, 0.9))
    laps, times = [], []
    for point in run.checkpoints:
        score = (0 if 0 < point < 250 else early if point < 500 else late) + run.seed / 500
        laps += [[point, track, score > 0.4, min(score * 2, 1), 1000 * score, score, 10] for track in run.tracks]
        times.append([point, 4 + point / 50, point / 50, point / 100])  # on a machine that is busy with something else
    guided = "_ap" in run.algo
    steps = range(25, run.steps + 1, 25)
    low = 300 if guided else run.steps  # the step until which the moving average is low
    e = (accuracy, accuracy - 0.05) if guided else (None, None)
    curve = [[step, 10.0 if step <= low else 45.0, *e, step // 2 if guided else None] for step in steps]
    lost = 10 if guided else 130
    episodes = [[10 * (i + 1), 10, -200.0, "off track"] for i in range(lost)]
    episodes.append([run.steps, run.steps - 10 * lost, 40.0 * (run.steps - 10 * lost), "unfinished"])
    if run.algo == "linear":
        times, curve, episodes = [], [], []
    tables = {"laps": (LAP_COLUMNS, laps), "times": (TIME_COLUMNS, times), "curve": (CURVE_COLUMNS, curve)}
    tables["episodes"] = (EPISODE_COLUMNS, episodes)
    tables = {name: {"columns": columns, "data": data} for name, (columns, data) in tables.items()}
    return {"run": run.description(), "made": MADE, **tables}


def make(folder, configurations=("paper",), steps=3_000, seeds=2, simulator="highway", **changes):
    grid = make_grid(parse_configurations(list(configurations)), simulator, steps, range(seeds))
    folder = folder / f"{simulator}-{steps}"
    for runs in grid.values():
        for run in runs:
            write_result(run, folder, synthetic(run, **changes))
    return collect(grid, folder, simulator, steps)


def test_competence_is_the_first_checkpoint_with_every_lap_above_the_threshold(tmp_path):
    results = make(tmp_path)
    at_90, at_95 = (steps_to_competence(results.laps, threshold) for threshold in (0.9, 0.95))
    assert at_90["ddpg_ap:paper"].tolist() == [250, 250]
    assert at_95["ddpg_ap:paper"].tolist() == [500, 500]
    assert at_90["ddpg_ap_ce2:paper"].tolist() == [500, 500]
    assert at_95["ddpg_ap_ce2:paper"].tolist() == [math.inf, math.inf]
    assert seconds_to_competence(results, 0.95)["ddpg_ap:paper"].tolist() == [5, 5]
    assert seconds_to_competence(results, 0.95)["ddpg:paper"].tolist() == [math.inf, math.inf]


def test_a_lap_that_is_not_done_is_not_competent(tmp_path):
    laps = make(tmp_path, ["ddpg_ap:paper"], seeds=1).laps
    laps.loc[(laps["checkpoint"] == 250) & (laps["track"] == "spring"), "lap_done"] = False
    assert steps_to_competence(laps, 0.9).tolist() == [350]


def test_the_median_counts_a_run_that_never_gets_there_as_infinite():
    assert median_reached(pd.Series([250, 500, math.inf])) == (500, 2)
    assert median_reached(pd.Series([250, math.inf, math.inf])) == (math.inf, 1)


def test_measures_of_a_run(tmp_path):
    runs = per_run(make(tmp_path))
    ap, ddpg = runs.loc[("ddpg_ap:paper", 1)], runs.loc[("ddpg:paper", 1)]
    assert (ap["laps_done"], ap["laps"], ddpg["laps_done"]) == (4, 4, 0)
    assert ap["score"] == pytest.approx(0.962)
    assert (ap["off_track"], ap["last_off_track"]) == (10, 100)
    assert ap["ms_per_step"] == pytest.approx(10)
    assert (ap["accuracy"], ap["lowest_accuracy"]) == pytest.approx((0.8, 0.75))
    assert np.isnan(ddpg["accuracy"])


def test_episodes_are_numbered_and_averaged(tmp_path):
    episodes = with_averages(make(tmp_path, ["ddpg_ap:paper"], seeds=1).episodes)
    assert episodes["episode"].tolist() == list(range(1, 12))
    assert episodes["average_reward"].tolist() == [-20.0] * 10 + [40.0]
    assert episodes["lost"].tolist() == [True] * 10 + [False]


def test_probability_of_improvement():
    ours, theirs = np.array([[1.0], [3.0]]), np.array([[2.0], [2.0]])
    assert probability_of_improvement(ours, theirs)[0] == 0.5
    assert probability_of_improvement(ours, ours + 10) == (0, 0, 0)
    assert probability_of_improvement(ours, ours)[0] == 0.5  # ties count half
    p, low, high = probability_of_improvement(np.array([[1.0, 1], [3, 3]]), np.array([[2.0, 0], [2, 0]]))
    assert p == 0.75
    assert 0.5 <= low < p < high <= 1


def test_a_guided_configuration_is_compared_with_its_base_and_the_best_baseline(tmp_path):
    results = make(tmp_path, ["paper", "ddpg", "sac:tuned"])
    table = improvement(results)
    found = {(row.guided, row.against): row.probability for row in table.itertuples()}
    assert found == {
        ("ddpg_ap:paper", "ddpg:paper"): 1,
        ("ddpg_ap:paper", "sac:tuned (best baseline)"): 1,
        ("ddpg_ap_ce2:paper", "ddpg:paper"): 1,
        ("ddpg_ap_ce2:paper", "sac:tuned (best baseline)"): 1,
    }


def test_a_robustness_test_compares_within_its_condition(tmp_path):
    fast = ["ddpg_ap:fast[env.speed=80]", "ddpg:tuned[env.speed=80]"]
    make(tmp_path, [*fast, "ddpg:tuned", "sac:tuned[env.random_start=true]"])
    assert report(tmp_path, "--configurations", *fast, "ddpg:tuned", name="robustness") == 0
    table = pd.read_csv(tmp_path / "highway-3000" / "robustness_improvement.csv")
    assert table[["guided", "against"]].to_numpy().tolist() == [[fast[0], f"{fast[1]} (best baseline)"]]


def test_a_changed_guided_configuration_is_compared_with_itself_unchanged(tmp_path):
    changed = "td3_ap:fast[teaching_growth=0]"
    table = improvement(make(tmp_path, [changed, "td3_ap:fast", "ddpg_ap:fast", "td3:tuned"]))
    found = table[["guided", "against"]].to_numpy().tolist()
    assert found[:2] == [[changed, "td3_ap:fast"], [changed, "td3:tuned (best baseline)"]]
    assert [row for row in found if row[1] == "td3_ap:fast"] == found[:1]


def test_the_headline_is_a_table_of_s_and_laps(tmp_path):
    make(tmp_path, ["ddpg_ap:paper", "ddpg:paper", "linear"])
    assert report(tmp_path, "--configurations", "ddpg_ap:paper", "ddpg:paper", "linear", name="headline") == 0
    header, _, ap, ddpg, linear = (tmp_path / "highway-3000" / "headline.md").read_text().splitlines()
    assert header.startswith("| configuration | S after 250 steps (laps) | S after 500 steps (laps) |")
    assert ap.split(" | ")[:3] == ["| ddpg_ap:paper", "0.911 [0.910, 0.912] (8 of 8)", "0.961 [0.960, 0.962] (8 of 8)"]
    assert "(0 of 8)" in ddpg
    assert linear.count("0.900 (4 of 4)") == 4


def report(out, *arguments, name="report"):
    return main(["benchmark", name, "--simulator", "highway", "--seeds", "2", "--out", str(out), *arguments])


def files(folder):
    return {path.name for path in folder.iterdir() if path.is_file()}


@pytest.mark.slow
def test_all_reports_of_the_runs_that_there_are(tmp_path, capsys):
    make(tmp_path, ["paper", "linear"])
    assert report(tmp_path) == 0
    folder = tmp_path / "highway-3000"
    figures = ("figure4a", "figure4b", "figure5", "curve")
    curves = {f"{name}.{kind}" for name in figures for kind in ("svg", "csv")}
    pages = {f"{name}.md" for name in ("table2", "figure4", "figure5", "curve", "summary")}
    tables = {"headline.md", "table2.csv", "summary.csv", "summary_improvement.csv"}
    readings = {f"readings{end}" for end in (".md", ".csv", "_improvement.csv")}  # two of which are the paper's own
    assert files(folder) == curves | pages | tables | readings
    assert "ablations is left out" in capsys.readouterr().out
    for name in figures:
        drawing = ElementTree.parse(folder / f"{name}.svg")
        assert len(drawing.findall(".//{http://www.w3.org/2000/svg}path")) > 10

    assert "| not run |" in (tmp_path / "highway-claims.md").read_text()
    table = (folder / "table2.md").read_text()
    assert "| E-road | ddpg_ap:paper | 2 of 2 | 100.0% | 961 | 0.961 [0.960, 0.962] | yes | 49,174 | 0.838 |" in table
    assert "| E-road | ddpg:paper | 0 of 2 | 40.2% | 201 | 0.201 [0.200, 0.202] | no (17.6%) | 4,461 | 0.076 |" in table
    assert "Made by `sb3-sap benchmark table2 --simulator highway --steps 3000 --seeds 2`, from 10 runs" in table
    assert "of 2020-01-02, revision abc, on a machine, one thread each. python 3.11." in table
    rows = pd.read_csv(folder / "table2.csv")
    assert len(rows) == 5 * 2 * 4
    assert set(rows["checkpoint"]) == {3000}

    summary = (folder / "summary.md").read_text()
    expected = "| ddpg_ap:paper | 2 | 8 of 8 | 0.961 [0.960, 0.962] | 0.960 | 250 (2 of 2) | 500 (2 of 2) | 5 (2 of 2) "
    assert expected + "| 10 | 100 | 10.0 | 0.800 (0.750) |" in summary
    assert "| linear | 1 | 4 of 4 | 0.900 | 0.900 | 0 (1 of 1) | – (0 of 1) | – (0 of 1) |  |  |  |  |" in summary
    assert "Runs that were not made: 2 of ddpg_ap:default" in summary


@pytest.mark.slow
def test_the_same_runs_give_the_same_bytes(tmp_path):
    make(tmp_path, steps=500)
    found = []
    for _ in range(2):
        assert report(tmp_path, "--steps", "500") == 0
        found.append({path.name: path.read_bytes() for path in (tmp_path / "highway-500").iterdir() if path.is_file()})
    assert found[0] == found[1]


def test_the_curve_has_a_panel_for_each_family_of_configurations(tmp_path):
    results = make(tmp_path, ["ddpg:paper", "ddpg_ap:paper", "ddpg_ap:fast", "td3:tuned", "ddpg:default", "linear"])
    axes = curve_figure(curve_table(results), results.configurations).axes
    panels = [[text.get_text() for text in left.get_legend().get_texts()] for left in axes[::2]]
    assert panels == [
        ["ddpg:paper", "ddpg_ap:paper", "linear"],
        ["ddpg_ap:fast", "ddpg:default", "linear"],
        ["td3:tuned", "linear"],
    ]


def test_a_controller_has_no_curve(tmp_path, capsys):
    make(tmp_path, ["linear"])
    assert report(tmp_path) == 0
    assert "curve is left out: none of these configurations learns" in capsys.readouterr().out
    assert (tmp_path / "highway-3000" / "headline.md").is_file()


def test_without_results_the_report_fails(tmp_path, capsys):
    assert report(tmp_path) == 1
    assert "table2 is left out: there are no results of these configurations" in capsys.readouterr().out


def test_results_of_other_settings_are_not_taken(tmp_path):
    make(tmp_path, ["ddpg_ap:paper[alpha=0.5]"])
    grid = make_grid(parse_configurations(["ddpg_ap:paper"]), "highway", 3_000, range(2))
    with pytest.raises(ValueError, match="no results of these configurations"):
        collect(grid, tmp_path / "highway-3000", "highway", 3_000)


def verdicts(folder, **changes):
    table = judged({steps: make(folder, steps=steps, **changes) for steps in (3_000, 15_000)})
    return {row["the paper says"]: (row["ours"], row["verdict"]) for _, row in table.iterrows()}


def test_claims_are_judged_by_their_criteria(tmp_path):
    found = verdicts(tmp_path)
    good, bad = "**reproduced**", "not reproduced"
    stable = "Fig. 4a: it gets stable more quickly, around 2,500 steps."
    # DDPG-AP and DDPG-(AP+CE2) are stable from step 300 on, both, so that neither comes before all others.
    assert found[stable][1] == bad
    assert "ddpg_ap 300" in found[stable][0]
    assert "ddpg never" in found[stable][0]
    expected = {
        "Fig. 4b: DDPG took more than 120 episodes to drive a considerable distance.": ("ddpg 131", good),
        "Fig. 4b: DDPG-AP never goes off the track after 25 episodes.": ("median 10, 2 of 2 seeds within 25", good),
        "Fig. 5: the accuracy is always above 70 %.": ("lowest 75.0%; 100% of the points at or above 70 %", good),
        "Fig. 5: it is 80 % on average.": ("80.0%", good),
        "Table 2, 3k: DDPG completes no lap.": ("0 of 8", good),
        "Table 2, 3k: DDPG-CE1 completes the laps with very low reward.": (
            "8 of 8 laps, 52% of DDPG-AP's reward",
            good,
        ),
        "Table 2, 3k: DDPG-CE2 completes all but Spring.": ("Spring 2 of 2, others 6 of 6", bad),
        "Table 2, 15k: DDPG-AP has the highest total reward on all test tracks.": (
            ", ".join(f"{track}: ddpg_ap" for track in TEST_TRACKS),
            good,
        ),
    }
    assert {sentence: found[sentence] for sentence in expected} == expected
    assert len(found) == len(CLAIMS)


def test_claims_of_a_worse_predictor(tmp_path):
    found = verdicts(tmp_path, accuracy=0.72)
    assert found["Fig. 5: the accuracy is always above 70 %."] == (
        "lowest 67.0%; 100% of the points at or above 70 %",
        "not reproduced",
    )
    assert found["Fig. 5: it is 80 % on average."] == ("72.0%", "not reproduced")


def test_the_page_of_claims_says_what_was_not_run(tmp_path):
    claims({3_000: make(tmp_path, seeds=1)}, tmp_path / "claims.md", "sb3-sap benchmark claims")
    page = (tmp_path / "claims.md").read_text()
    assert page.count("| not run |") == sum(claim.steps == 15_000 for claim in CLAIMS)
    assert "Made by `sb3-sap benchmark claims`, from 5 runs" in page


def test_claims_of_another_reading_are_judged_by_its_runs(tmp_path):
    results = {steps: make(tmp_path, ["paper_adam"], steps=steps) for steps in (3_000, 15_000)}
    claims(results, tmp_path / "adam.md", "sb3-sap benchmark claims --reading paper_adam", "paper_adam")
    claims({steps: make(tmp_path, steps=steps) for steps in results}, tmp_path / "literal.md", "command")
    adam, literal = ((tmp_path / f"{name}.md").read_text() for name in ("adam", "literal"))
    assert "not run" not in adam
    assert [line for line in adam.splitlines() if line[0:1] == "|"] == [
        line for line in literal.splitlines() if line[0:1] == "|"
    ]  # the scores here are by algorithm
    assert "fitted by Adam" in adam
    assert "fitted by Adam" not in literal


@pytest.mark.slow
def test_pages_of_another_reading_have_names_of_their_own(tmp_path):
    make(tmp_path, ["paper_adam"])
    for name in ("table2_adam", "figure4_adam", "figure5_adam"):
        assert report(tmp_path, "--configurations", "ddpg_ap:paper_adam", "ddpg:paper", name=name) == 0
    assert report(tmp_path, name="report") == 0  # which leaves them as they are
    found = files(tmp_path / "highway-3000")
    assert {"table2_adam.md", "figure4a_adam.svg", "figure4b_adam.csv", "figure5_adam.svg"} <= found
    page = (tmp_path / "highway-3000" / "figure4_adam.md").read_text()
    assert "(figure4a_adam.svg)" in page
    assert "(figure4b_adam.svg)" in page


def test_equal_settings_of_several_algorithms_have_the_same_colour():
    names = ["a:base", "a:loss[x=1]", "a:loss[x=2]", "b:loss[x=1,y=0]", "b:loss[x=2,y=0]"]  # all of b have y = 0
    names += [f"c:{number}" for number in range(4)]
    table = pd.DataFrame([[name, seed, x, 1.0] for name in names for seed in (0, 1) for x in (0, 1)])
    figure = line_figure(table.set_axis(["configuration", "seed", "x", "y"], axis=1), names, "x", "y", "x", "y")
    colours = {line.get_label(): line.get_color() for axes in figure.axes for line in axes.get_lines()}
    assert len(figure.axes) == 3
    assert colours["a:loss[x=1]"] == colours["b:loss[x=1]"] != colours["a:loss[x=2]"] == colours["b:loss[x=2]"]


def test_legend_has_what_differs_without_modules(tmp_path):
    names = [
        "a:base[f=some.module.f,c=0.5]",
        "a:base[f=some.module.f,p=some.other.Potential]",
        "a:base[f=some.module.f]",
    ]
    table = pd.DataFrame([[name, seed, x, 1.0] for name in names for seed in (0, 1) for x in (0, 1)])
    figure = line_figure(table.set_axis(["configuration", "seed", "x", "y"], axis=1), names, "x", "y", "x", "y")
    labels = [line.get_label() for line in figure.axes[0].get_lines()]
    assert labels == ["a:base[c=0.5]", "a:base[p=Potential]", "a:base"]


def test_ways_of_using_the_label(tmp_path):
    names = ["ddpg_ap:base+penalty[penalty=0]", "ddpg_ap:base+penalty", "ddpg_ap:base+loss", "td3_ap:base+loss"]
    ways(make(tmp_path, names, steps=1_000), tmp_path, "command")
    page = (tmp_path / "ways.md").read_text(encoding="utf-8")
    assert "| ddpg_ap:base+loss | ddpg_ap:base+penalty | " in page
    assert "| td3_ap:base+loss | " not in page.partition("## Probability")[2]  # whose penalty there is not
    assert "50.0%" in page  # of the steps were mistakes
    found = {path.name for path in tmp_path.glob("ways*")}
    assert found == {"ways.md", "ways.svg", "ways.csv", "ways_improvement.csv"}
