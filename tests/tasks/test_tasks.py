"""The AP functions of other tasks, on transitions computed by hand and in the environments themselves."""

import os

import gymnasium as gym
import highway_env  # noqa: F401  registers its environments
import numpy as np
import pytest

from sb3_sap import check_permissibility, tasks
from sb3_sap.common.functions import resolve
from sb3_sap.envs.torcs.installation import TorcsNotFoundError
from sb3_sap.evaluation import make_env
from sb3_sap.presets import algorithms, load_config
from sb3_sap.tasks.driving import SCALES, approach_speed, passing_distance
from sb3_sap.tasks.energy import acrobot_energy, flag_within_reach
from sb3_sap.tasks.pendulum import energy as pendulum_energy_of


def rows(*values):
    return np.array(values, dtype=np.float32)


# ------------------------------------------------------------------ mountain cars


def test_mountain_car_must_not_push_against_the_motion():
    obs = rows([-0.5, 0.02], [-0.5, 0.02], [-0.5, -0.02], [-0.5, -0.02], [-0.5, 0.02])
    expected = [True, False, False, True, False]
    assert tasks.mountain_car_continuous(obs, rows([1.0], [-1.0], [1.0], [-0.2], [0.05]), obs).tolist() == expected
    actions = np.array([2, 0, 2, 0, 1])
    assert tasks.mountain_car(obs, actions, obs).tolist() == expected
    assert tasks.mountain_car(obs, actions[:, None], obs).tolist() == expected


def test_mountain_car_may_push_either_way_where_it_turns():
    before, after = rows([-0.9, -0.001]), rows([-0.9, 0.001])
    for push in (-1.0, 1.0):
        assert tasks.mountain_car_continuous(before, rows([push]), after).tolist() == [True]
    assert tasks.mountain_car(np.repeat(before, 2, 0), np.array([0, 2]), np.repeat(after, 2, 0)).tolist() == [True] * 2
    start = rows([-0.5, 0.0])
    assert tasks.mountain_car_continuous(start, rows([1.0]), rows([-0.499, 0.001])).tolist() == [True]


def test_mountain_car_must_not_idle():
    obs = rows([-0.5, 0.02], [-0.5, 0.02], [-0.5, -0.02], [-0.5, 0.0])
    push = rows([0.0], [0.05], [-0.05], [0.0])
    assert tasks.mountain_car_continuous(obs, push, obs).tolist() == [False] * 4
    assert tasks.mountain_car(obs, np.array([1, 1, 1, 1]), obs).tolist() == [False] * 4


def test_mountain_car_with_enough_energy_may_turn_at_once():
    # Moving left up the left hill, pushing right.
    slow, fast = rows([-0.6, -0.01]), rows([-0.9, -0.04])
    assert flag_within_reach(np.concatenate([slow, fast])).tolist() == [False, True]
    assert tasks.mountain_car(slow, np.array([2]), slow).tolist() == [False]
    assert tasks.mountain_car(fast, np.array([2]), fast).tolist() == [True]


def test_flag_is_within_reach_where_pushing_right_arrives():
    env = gym.make("MountainCar-v0").unwrapped
    rng = np.random.default_rng(0)
    states = np.column_stack([rng.uniform(-1.2, 0.4, 300), rng.uniform(-0.07, 0.07, 300)])
    arrives = []
    for state in states:
        env.reset(seed=0)
        env.state = tuple(state)
        # A car that turns back to the left does not arrive.
        obs, _, done, _, _ = env.step(2)
        turned = obs[1] > 0
        while not done and not (turned and obs[1] < 0):
            obs, _, done, _, _ = env.step(2)
            turned |= obs[1] > 0
        arrives.append(done)
    assert 50 < sum(arrives) < 250
    # Gymnasium takes finite steps, so that the energy may err at the very edge.
    assert np.mean(flag_within_reach(states) == arrives) > 0.97


# ------------------------------------------------------------------ acrobot


def test_acrobot_energy_of_known_states():
    hanging, upright = [1, 0, 1, 0, 0, 0], [-1, 0, 1, 0, 0, 0]
    folded = [1, 0, -1, 0, 0, 0]  # the second link points up again
    assert acrobot_energy(rows(hanging, upright, folded)) == pytest.approx(9.8 * np.array([-2, 2, -1]))
    # The second link alone turns at 2 rad/s: at its centre 1 m/s, 1 kg and 1 kg·m².
    assert acrobot_energy(rows([1, 0, 1, 0, 0, 2])) == pytest.approx([-19.6 + 0.5 + 2.0])


def test_acrobot_energy_is_conserved_by_the_environment_without_torque():
    env = gym.make("Acrobot-v1").unwrapped
    env.reset(seed=0)
    env.state = np.array([1.0, -0.5, 0.8, -1.2])
    energies = []
    for _ in range(20):
        energies.append(acrobot_energy(env._get_ob()[None])[0])
        env.step(1)
    assert np.ptp(energies) < 0.05  # without torque it is conserved


def test_acrobot_must_not_brake_its_joint():
    obs = rows([1, 0, 1, 0, 0, 1.0])
    assert [bool(tasks.acrobot(obs, np.array([a]), obs)[0]) for a in (0, 1, 2)] == [False, False, True]
    turning = rows([1, 0, 1, 0, 0, -1.0])
    assert bool(tasks.acrobot(obs, np.array([0]), turning)[0])
    swinging = rows([1, 0, 1, 0, 5.0, 1.0])  # 12.5·(0.25 + 1 + 1) + … > 4.9 + 19.6 J above hanging
    assert bool(tasks.acrobot(swinging, np.array([0]), swinging)[0])


# ------------------------------------------------------------------ pendulum


def test_pendulum_functions_judge_height_torque_and_energy():
    level, higher = rows([0.0, 1.0, -1.0]), rows([0.1, 0.99, -1.0])
    assert tasks.pendulum_height(level, rows([0.0]), higher).tolist() == [True]
    assert tasks.pendulum_height(higher, rows([0.0]), level).tolist() == [False]
    # θ > 0: torque towards the top is negative.
    assert tasks.pendulum_torque(level, rows([-1.0]), level).tolist() == [True]
    assert tasks.pendulum_torque(level, rows([1.0]), level).tolist() == [False]
    # Falling at 1 rad/s from level, energy is missing: drive on, do not brake.
    falling = rows([0.0, 1.0, 1.0])
    assert tasks.pendulum_energy(falling, rows([1.0]), falling).tolist() == [True]
    assert tasks.pendulum_energy(falling, rows([-1.0]), falling).tolist() == [False]
    # At 6 rad/s there is too much energy.
    racing = rows([0.0, 1.0, 6.0])
    assert tasks.pendulum_energy(racing, rows([1.0]), racing).tolist() == [False]
    assert tasks.pendulum_energy(racing, rows([-1.0]), racing).tolist() == [True]
    assert pendulum_energy_of(rows([1, 0, 0], [-1, 0, 0], [0, 1, 2])) == pytest.approx([0, -30, -13])


# ------------------------------------------------------------------ driving


def parked(x, y, vx, vy, goal=(0.3, 0.0)):
    return {"achieved_goal": rows([x, y, vx, vy, 1, 0]), "desired_goal": rows([*goal, 0, 0, 0, 1])}


def test_parking_judges_the_approach_speed():
    assert approach_speed(parked(0, 0, 1, 1)) == pytest.approx([1.0])
    away, still, towards, aside = (parked(0, 0, *v) for v in ((-0.5, 0), (0, 0), (0.5, 0), (0, 0.5)))
    assert tasks.parking(still, None, away).tolist() == [False]
    assert tasks.parking(towards, None, aside).tolist() == [False]
    assert tasks.parking(away, None, still).tolist() == [True]
    assert tasks.parking(towards, None, towards).tolist() == [True]
    assert tasks.parking(parked(0, 0, -2, 0), None, parked(0, 0, -2.5, 0)).tolist() == [False]
    assert tasks.parking(parked(0, 0, -4, 0), None, parked(0, 0, -5, 0)).tolist() == [True]  # too fast to stop
    # From 15 m/s no car stops within 20 m, from 10 m/s it does; within 10 m everything is permissible.
    assert tasks.parking(parked(0.1, 0, 3.2, 0), None, parked(0.1, 0, 3, 0)).tolist() == [True]
    assert tasks.parking(parked(0.1, 0, 3.2, 0), None, parked(0.1, 0, 2, 0)).tolist() == [False]
    assert tasks.parking(parked(0.25, 0, 0.5, 0), None, parked(0.25, 0, 0, 0)).tolist() == [True]


def on_the_road(y, vy, *others):
    """An observation of a car at y m, at vy m/s, and up to two others, (x, y, vx, vy) relative to it."""
    obs = np.zeros((1, 3, 5), dtype=np.float32)
    obs[0, 0] = 1, 1, y / 12, 1, vy / 20
    for row, other in enumerate(others, 1):
        obs[0, row] = 1, *(np.array(other) / SCALES)
    return obs


@pytest.mark.parametrize(
    ("others", "miss"),
    [
        ([], np.inf),
        ([(20, 1, -10, 0)], 1.0),  # beside it in 2 s
        ([(20, 1, -10, 2)], 4.0),  # 1.5 to 2.5 s away, 4 m aside at the first of them
        ([(50, 0, -10, 0)], np.inf),  # 4 s away
        ([(20, 0, 10, 0)], np.inf),  # it drives away
        ([(-4, 4, 0, -1)], 1.0),  # alongside, and nearer in 3 s
        ([(20, 4, -10, 0), (22, -3, -10, 0)], 3.0),
    ],
)
def test_passing_distance_is_the_nearest_one_within_the_look_ahead(others, miss):
    assert passing_distance(on_the_road(4, 0, *others)) == pytest.approx([miss], rel=1e-5)


def test_highway_judges_passing_distance_and_road_edges():
    hit, graze, clear = (on_the_road(4, 0, (20, side, -10, 0)) for side in (0, 2, 4))
    assert tasks.highway(graze, None, hit).tolist() == [False]
    assert tasks.highway(hit, None, graze).tolist() == [True]
    assert tasks.highway(clear, None, graze).tolist() == [False]
    assert tasks.highway(on_the_road(4, 0), None, hit).tolist() == [True]  # it was not in sight before
    # 10 m is the right edge, -2 m the left one; y grows to the right.
    right, left, middle = (lambda vy, y=y: on_the_road(y, vy) for y in (9, -1, 4))
    assert tasks.highway(right(1.0), None, right(1.5)).tolist() == [False]
    assert tasks.highway(right(2.0), None, right(1.5)).tolist() == [True]
    assert tasks.highway(left(-1.0), None, left(-1.5)).tolist() == [False]
    assert tasks.highway(left(-2.0), None, left(-1.5)).tolist() == [True]
    assert tasks.highway(left(1.0), None, left(1.5)).tolist() == [True]
    assert tasks.highway(middle(1.0), None, middle(1.5)).tolist() == [True]
    assert tasks.highway(right(-1.0), None, right(1.5)).tolist() == [False]


# ------------------------------------------------------------------ in their environments

ENTRIES = [
    (algo, env_id, entry)
    for algo in algorithms()
    for env_id, entry in load_config(algo).items()
    if str(entry.get("ap_function", "")).startswith("sb3_sap.tasks.")
]


@pytest.mark.parametrize(("algo", "env_id", "entry"), ENTRIES, ids=[f"{a}-{e}" for a, e, _ in ENTRIES])
def test_configured_ap_functions_give_both_labels_in_their_environments(algo, env_id, entry):
    try:
        env = make_env(env_id, **entry.get("env_kwargs", {}))
    except TorcsNotFoundError as error:
        if os.environ.get("SB3_SAP_REQUIRE_TORCS"):
            raise
        pytest.skip(str(error))
    transitions = []
    obs, _ = env.reset(seed=0)
    actions = env.action_space  # highway-env replaces it by an unseeded one at every reset
    actions.seed(0)
    for _ in range(60):
        action = actions.sample()
        next_obs, _, terminated, truncated, _ = env.step(action)
        transitions.append((obs, np.asarray(action), next_obs))
        obs = env.reset()[0] if terminated or truncated else next_obs

    def batch(values):
        return (
            {key: np.stack([v[key] for v in values]) for key in values[0]}
            if isinstance(values[0], dict)
            else (np.stack(values))
        )

    labels = resolve(entry["ap_function"], "ap_function")(*map(batch, zip(*transitions, strict=True)))
    parts = entry.get("action_parts", ())
    assert labels.shape == ((60, len(parts)) if parts else (60,))
    assert labels.dtype == bool
    assert 0 < labels.sum() < labels.size


def swings_up(obs):
    """Drives the energy to that of standing upright, and holds the pendulum there."""
    cos, sin, rate = obs
    if cos > 0.95:
        return np.float32([np.clip(-10 * sin - 2 * rate, -2, 2)])
    return np.float32([2 * np.sign(rate * -pendulum_energy_of(obs[None])[0]) or 2])


def test_check_gives_advice_about_the_height_of_the_pendulum():
    env = gym.make("Pendulum-v1")
    obs, _ = env.reset(seed=0)
    for _ in range(200):
        obs, *_ = env.step(swings_up(obs))
    assert obs[0] > 0.99  # it is a good policy
    report = check_permissibility(env, tasks.pendulum_height, policy=swings_up, verbose=False)
    assert any("does the label depend on the action" in sentence for sentence in report.advice)
    assert any("of your policy's own actions" in sentence for sentence in report.advice)


# ------------------------------------------------------------------ robotics


def test_hand_must_come_nearer_to_its_goal():
    goal = rows([0.0, 0.0, 0.0]).repeat(4, axis=0)
    before = {"desired_goal": goal, "achieved_goal": rows([0.2, 0, 0], [0.2, 0, 0], [0.2, 0, 0], [0, 0.01, 0])}
    after = {"desired_goal": goal, "achieved_goal": rows([0.1, 0, 0], [0.2, 0, 0], [0, 0.3, 0], [0, 0.04, 0])}
    assert tasks.fetch_reach(before, np.zeros((4, 4)), after).tolist() == [True, False, False, True]
    axes = tasks.fetch_reach_axes(before, np.zeros((4, 4)), after)
    assert axes.tolist() == [[True] * 3, [False, True, True], [True, False, True], [True, False, True]]
    assert tasks.nearness(before).tolist() == pytest.approx([-4, -4, -4, -0.2])
