"""Laps that are driven with a policy alone, and the files that are read and written for them."""

import json

import gymnasium as gym
import numpy as np
import pytest

from sb3_sap import DDPGAP
from sb3_sap.benchmark.paper import TABLE_2, TEST_TRACKS, paper_score
from sb3_sap.envs import get_track
from sb3_sap.envs.car import STEERING_LOCK
from sb3_sap.evaluation.laps import LapResult, drive_lap, lap, lap_env, write_results
from sb3_sap.evaluation.policies import load_policy


class Feedback:
    """Linear feedback that keeps the lane; full steering instead if ``lost``."""

    def __init__(self, lost=False):
        self.lost = lost

    def predict(self, obs, deterministic):
        assert deterministic
        steering = 1.0 if self.lost else 2.5 * obs[0] / STEERING_LOCK - 5.0 * obs[1]
        return np.clip(np.array([steering], dtype=np.float32), -1, 1), None


def test_lap_of_linear_feedback_is_done_with_a_high_score():
    result = drive_lap(Feedback(), "g-track-3")
    length = get_track("g-track-3").length
    assert result.lap_done
    assert result.covered == 1
    assert 0.9 < result.score < 1
    assert result.score == pytest.approx(result.total_reward / (3.6 * length / 0.2))
    # 50 km/h for 0.2 s are 2.78 m a step along the centre line, a little less or more on the inside or outside
    assert result.steps == pytest.approx(length / (50 / 3.6 * 0.2), rel=0.02)


def test_lap_with_full_steering_is_not_done():
    result = drive_lap(Feedback(lost=True), "g-track-3")
    assert not result.lap_done
    assert result.covered < 0.05


def test_results_are_written_as_a_list_of_rows(tmp_path):
    results = [LapResult("eroad", True, 1.0, 50_000.0, 0.85, 1174)]
    write_results(tmp_path / "deep" / "evaluation.json", results)
    [row] = json.loads((tmp_path / "deep" / "evaluation.json").read_text())
    assert row == {
        "track": "eroad",
        "lap_done": True,
        "covered": 1.0,
        "total_reward": 50_000.0,
        "score": 0.85,
        "steps": 1174,
    }
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["evaluation.json"]


def test_loaded_policy_predicts_like_the_model(tmp_path):
    model = DDPGAP("MlpPolicy", gym.make("sap/LaneKeeping-v0"), seed=0)
    model.save(tmp_path / "model")
    obs = np.random.default_rng(0).normal(size=(5, 5)).astype(np.float32)
    policy = load_policy(tmp_path / "model.zip")
    assert np.array_equal(policy.predict(obs, deterministic=True)[0], model.predict(obs, deterministic=True)[0])


def test_truncated_and_missing_model_files_are_refused(tmp_path):
    model = DDPGAP("MlpPolicy", gym.make("sap/LaneKeeping-v0"))
    model.save(tmp_path / "model.zip")
    whole = (tmp_path / "model.zip").read_bytes()
    for share in (0.0, 0.3, 0.9):
        (tmp_path / "cut.zip").write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(ValueError, match=r"cut.zip is not a whole model file .* save the model again"):
            load_policy(tmp_path / "cut.zip")
    with pytest.raises(FileNotFoundError, match=r"There is no model file .*none.zip"):
        load_policy(tmp_path / "none.zip")


def test_total_rewards_of_the_paper_give_the_quoted_scores():
    cells = TABLE_2[15_000]["ddpg_ap"]
    scores = [round(paper_score(track, cells[track].total_reward), 3) for track in TEST_TRACKS]
    assert scores == [0.940, 0.950, 0.950, 0.967]


def test_lap_environment_can_be_driven_several_times():
    env = lap_env("g-track-3")
    first = [lap(Feedback(lost), env, "g-track-3") for lost in (False, True, False)]
    assert first[0] == first[2] == drive_lap(Feedback(), "g-track-3")
    assert first[1] == drive_lap(Feedback(lost=True), "g-track-3")
