"""`check_permissibility`, on problems whose report can be computed in the head."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import Line, build, towards_centre

from sb3_sap import DDPGAP, DQNAP, SACAP, ActionPermissibility, check_permissibility
from sb3_sap.check import classifier
from sb3_sap.check.trials import N_ACTIONS


@pytest.fixture(autouse=True)
def fewer_fits(monkeypatch):
    """These problems need few."""
    monkeypatch.setattr(classifier, "FITS", 40)


class FixedLine(Line):
    """Every episode is one step from the same x."""

    def __init__(self, x, **kwargs):
        super().__init__(horizon=1, **kwargs)
        self.start = x

    def reset(self, *, seed=None, options=None):
        return super().reset(seed=seed, options={"x": self.start})


def check(env, *args, **kwargs):
    return check_permissibility(env, *args, **({"n_steps": 400, "verbose": False} | kwargs))


def steps_left(obs, actions, next_obs):
    return actions[:, 0] <= 0


@pytest.mark.parametrize(
    ("x", "changes"),
    [(0.5, 1), (0.03, 2)],  # permissible: a <= 0, and -0.6 <= a <= 0
)
def test_label_changes_are_counted_along_the_action(x, changes):
    report = check(FixedLine(x))
    assert report.action_matters == 1
    assert report.label_changes == changes


def test_labels_that_permit_half_of_the_actions_get_no_advice():
    report = check(FixedLine(0.5), n_steps=2_000)
    assert report.permissible_rate == pytest.approx(0.5, abs=0.04)
    assert report.accuracy > 0.95
    assert report.policy_forbidden is None
    assert report.own_row
    assert report.advice == ()


@pytest.mark.parametrize(("action", "forbidden"), [(-1, 0), (1, 1)])
def test_policy_forbidden_is_the_share_of_its_actions_that_are_not_permissible(action, forbidden):
    report = check(FixedLine(0.5), policy=lambda obs: np.full(1, action, dtype=np.float32))
    assert report.policy_forbidden == forbidden
    assert any("your policy's own actions" in sentence for sentence in report.advice) == bool(forbidden)


def test_model_of_sb3_is_checked_with_its_deterministic_actions():
    env = FixedLine(0.5, n_actions=2)
    model = build(DQNAP, env, policy_kwargs={"net_arch": []}, exploration_initial_eps=1.0, exploration_final_eps=1.0)
    with th.no_grad():
        model.q_net.q_net[0].weight.zero_()
        model.q_net.q_net[0].bias.copy_(th.tensor([1.0, 0.0]))  # always left
    assert check(env, policy=model).policy_forbidden == 0


def test_discrete_actions_have_no_label_changes():
    report = check(FixedLine(0.5, n_actions=3))  # left, none, right
    assert report.permissible_rate == pytest.approx(2 / 3, abs=0.08)
    assert report.action_matters == 1
    assert report.label_changes is None


@pytest.mark.parametrize("kind", ["array", "dict", "goal"])
def test_labels_from_info_and_from_a_function_give_the_same_report(kind):
    by_info = check(FixedLine(0.5, kind=kind))
    if kind != "goal":
        assert check(FixedLine(0.5, kind=kind, labels=False), towards_centre) == by_info
    assert check(FixedLine(0.5, kind=kind, labels=False, reuse=kind == "array"), "test_check.steps_left") == by_info


def test_three_dimensions_in_other_units_inform_equally():
    report = check(FixedLine(0.5, dim=3, low=-20.0, high=60.0), n_steps=2_000)
    # x' = x + 0.1 · mean: along one dimension there is a threshold, unless the other two decide; together they decide.
    assert report.label_changes == 1
    assert report.action_matters == 1
    assert report.accuracy > 0.9
    # Each has the same influence.
    assert report.action_informs == pytest.approx([report.action_informs[0]] * 3, abs=0.08)
    assert min(report.action_informs) > 0.05


def test_action_matters_if_six_dimensions_decide_together():
    """The label depends on a weighted sum, whose sign a single dimension can rarely change."""
    weights = np.ones(6)
    report = check(FixedLine(0.5, dim=6), lambda obs, actions, next_obs: actions @ weights > 0)
    assert report.action_matters == 1
    report = check(FixedLine(0.5, dim=6), lambda obs, actions, next_obs: (actions @ weights > 0) & (obs[:, 0] < 0))
    assert report.action_matters == 0


def test_uninformative_dimensions_are_named():
    report = check(FixedLine(0.5, dim=3), lambda obs, actions, next_obs: actions[:, 1] > 0, n_steps=1_000)
    first, second, third = report.action_informs
    assert second == pytest.approx(0.5, abs=0.08)  # if it is shuffled, the classifier is as good as a coin
    assert max(first, third) < 0.02
    assert "action[1] 4" in str(report) or "action[1] 5" in str(report)
    assert any("from action[0] and action[2]." in sentence for sentence in report.advice)


@pytest.mark.slow
def test_accuracy_without_the_action_shows_whether_the_state_decides():
    decided_by_action = check(FixedLine(0.5), steps_left, n_steps=1_000)
    assert decided_by_action.accuracy_without_action == pytest.approx(0.5, abs=0.08)
    decided_by_state = check(Line(dim=2), lambda obs, actions, next_obs: obs[:, 1] < 0.45)
    assert decided_by_state.accuracy_without_action == pytest.approx(decided_by_state.accuracy, abs=0.02)
    assert len(decided_by_state.advice) == 1


def test_steps_that_return_to_states_are_as_many_as_documented(monkeypatch):
    monkeypatch.setattr(classifier, "FITS", 1)

    def steps(kind, function, **kwargs):
        env = kind(**kwargs)
        check(env, function, n_steps=100)
        return len(env.executed) - 100

    line = {"horizon": 100}
    assert steps(Line, steps_left, **line) == pytest.approx(3_500, rel=0.25)
    assert steps(Line, lambda o, a, n: a == 0, n_actions=5, **line) == pytest.approx(5 * 170, rel=0.25)
    never = steps(Line, lambda o, a, n: o[:, 1] < 0.05, dim=2, **line)
    assert never == pytest.approx(21_000, rel=0.25)
    assert steps(Line, lambda o, a, n: a.sum(axis=1) > 0, dim=2, **line) == pytest.approx(5_000, rel=0.25)


def test_constant_labels_get_one_advice():
    report = check(FixedLine(0.5), lambda obs, actions, next_obs: np.ones(len(actions), dtype=bool))
    assert report.permissible_rate == 1
    assert report.action_matters == 0
    assert report.accuracy is None
    assert len(report.advice) == 1
    assert "constant labels" in report.advice[0]


def test_rare_labels_are_reported_with_the_steps_that_they_take():
    report = check(Line(horizon=100), lambda obs, actions, next_obs: next_obs[:, 1] < 0.995)  # every hundredth step
    assert report.permissible_rate == 0.99
    assert any("after about 2,000 steps" in sentence for sentence in report.advice)


def test_labels_that_do_not_depend_on_the_action_get_advice():
    report = check(Line(), lambda obs, actions, next_obs: obs[:, 1] < 0.45)
    assert report.action_matters == 0
    assert any("does the label depend on the action" in sentence for sentence in report.advice)


def test_unpredictable_labels_get_advice():
    def parity(obs, actions, next_obs):
        return np.floor(actions[:, 0] * 100).astype(int) % 7 < 4

    report = check(FixedLine(0.5), parity, n_steps=1_000)
    assert report.label_changes > 4
    assert report.accuracy < 0.7
    assert report.own_row
    assert len(report.advice) == 2


@pytest.mark.parametrize("trap", ["batch", "random"])
def test_labels_that_depend_on_more_than_their_row_get_advice(trap):
    rng = np.random.default_rng(0)

    def function(obs, actions, next_obs):
        return actions[:, 0] < (actions[0, 0] if trap == "batch" else rng.uniform(-1, 1, len(actions)))

    report = check(FixedLine(0.5), function)
    assert not report.own_row
    assert any("in another order" in sentence for sentence in report.advice)


def test_environment_that_ignores_its_seed_gets_no_trials_of_actions():
    class IgnoresItsSeed(Line):
        def reset(self, *, seed=None, options=None):
            return super().reset(options={"x": np.random.default_rng().uniform(0.5, 1)})

    report = check(IgnoresItsSeed())
    assert report.action_matters is None
    assert report.label_changes is None
    assert report.permissible_rate > 0


@pytest.mark.slow
def test_same_seed_gives_the_same_report_and_global_generators_are_unchanged():
    th.manual_seed(3)
    before = th.rand(1)
    th.manual_seed(3)
    one, other, another = (check(Line(), seed=seed) for seed in (1, 1, 2))
    assert th.rand(1) == before
    assert one == other
    assert one != another


def test_report_is_printed(capsys):
    report = check_permissibility(FixedLine(0.5), n_steps=400)
    assert str(report) in capsys.readouterr().out
    assert "No problems found" in str(report)


class RandomObservations(gym.Env):
    """Random observations of any space; a step to the left is permissible."""

    def __init__(self, observation_space):
        self.observation_space, self.action_space = observation_space, BOX

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.observation_space.seed(seed)
        return self.observation_space.sample(), {}

    def step(self, action):
        return self.observation_space.sample(), 0.0, False, False, {"permissible": bool(action[0] <= 0)}


BOX = spaces.Box(-1, 1, (1,))
PICTURES = [spaces.Box(0, 255, shape, np.uint8) for shape in ((36, 36, 3), (3, 20, 30), (5, 4, 1))]


@pytest.mark.parametrize(
    "space",
    [
        *(spaces.Dict(picture=picture, speed=BOX) for picture in PICTURES),
        spaces.Dict(gear=spaces.Discrete(3), doors=spaces.MultiBinary(4), knobs=spaces.MultiDiscrete([2, 3])),
        spaces.Discrete(3),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(4),
        spaces.MultiBinary([2, 3]),
        PICTURES[1],
    ],
    ids=str,
)
def test_observation_spaces_of_sb3_can_be_checked(space, monkeypatch):
    monkeypatch.setattr(classifier, "FITS", 3)
    shapes = []

    def steps_left(obs, actions, next_obs):
        shapes.append({key: rows.shape[1:] for key, rows in obs.items()} if isinstance(obs, dict) else obs.shape[1:])
        return actions[:, 0] <= 0

    report = check(RandomObservations(space), steps_left, n_steps=200)
    assert report.action_matters == 1
    assert report.accuracy is not None
    # The layout is that of the environment.
    assert shapes[0] == ({key: s.shape for key, s in space.spaces.items()} if space.shape is None else space.shape)


def with_spaces(**changes):
    env = Line()
    vars(env).update(changes)
    return env


class Answers(Line):
    """An environment whose methods return what is given."""

    def __init__(self, **answers):
        super().__init__()
        self.answers = answers

    def reset(self, **kwargs):
        return self.answers.get("reset") if "reset" in self.answers else super().reset(**kwargs)

    def step(self, action):
        return self.answers.get("step") or super().step(action)


@pytest.mark.parametrize(
    ("arguments", "error", "sentence"),
    [
        ({"env": 3}, TypeError, "single Gymnasium environment"),
        ({"n_steps": 10}, ValueError, "at least 100"),
        ({"env": Line(labels=False)}, ValueError, "There is no AP function"),
        ({"policy": 3}, TypeError, "SB3's `predict`"),
        *(
            ({"env": with_spaces(action_space=space)}, ValueError, "a bounded Box or a Discrete action space, but")
            for space in (spaces.MultiDiscrete([2, 2]), spaces.MultiBinary(2), spaces.Dict(a=BOX), spaces.Tuple([BOX]))
        ),
        ({"env": with_spaces(action_space=spaces.Box(-np.inf, np.inf, (1,)))}, ValueError, "actions are bounded"),
        ({"env": with_spaces(observation_space=spaces.Discrete(3, start=1))}, ValueError, "subtract `start`"),
        *(
            ({"env": with_spaces(observation_space=space)}, ValueError, "(?s)observations that SB3 takes.*Flatten")
            for space in (
                spaces.Tuple([BOX]),
                spaces.Dict(a=spaces.Dict(b=BOX)),
                spaces.Dict(a=spaces.Tuple([BOX])),
                spaces.Text(3),
                spaces.MultiDiscrete([[2, 3], [2, 3]]),
            )
        ),
        ({"env": DummyVecEnv([Line])}, TypeError, "single Gymnasium environment"),
        ({"env": "CartPole-v1"}, TypeError, "single Gymnasium environment"),
        ({"env": Answers(reset=0)}, ValueError, r"`env.reset` must return .* returned one int"),
        ({"env": Answers(reset=(0, 0, {}))}, ValueError, r"`env.reset` must .* a tuple of \(int, int, dict\)"),
        ({"env": Answers(step=(0, 0.0, True, {}))}, ValueError, r"`env.step` must .* \(int, float, bool, dict\)"),
        ({"ap_function": lambda obs, actions: actions > 0}, RuntimeError, r"with batches \(obs, actions, next_obs\)"),
        ({"ap_function": lambda a, b, c, d: b > 0}, RuntimeError, r"with batches \(obs, actions, next_obs\)"),
        ({"ap_function": "nowhere.nothing"}, ValueError, "cannot be imported"),
    ],
)
def test_what_cannot_be_checked_is_refused(arguments, error, sentence):
    with pytest.raises(error, match=sentence):
        check(**({"env": Line()} | arguments))


def energy_did_not_fall(obs, actions, next_obs):
    def energy(o):
        return 0.5 * o[:, 1] ** 2 + 0.0025 / 3 * np.sin(3 * o[:, 0])

    return energy(next_obs) >= energy(obs)


@pytest.mark.slow
def test_actions_against_the_motion_are_forbidden_in_mountain_car(monkeypatch):
    monkeypatch.setattr(classifier, "FITS", 120)
    env = gym.make("MountainCarContinuous-v0")
    with_velocity, against = (
        check(env, energy_did_not_fall, policy=lambda obs, sign=sign: sign * np.sign(obs[1:])) for sign in (1, -1)
    )
    # Pushing against the motion loses energy; pushing with it only at the wall, or where Euler's steps are coarse.
    assert with_velocity.policy_forbidden < 0.1 < 0.4 < against.policy_forbidden
    assert with_velocity.accuracy > 0.7


@pytest.mark.slow
def test_lane_keeping_forbids_good_actions_near_the_axis():
    """Equation (6) falls short of Definition 3: from the axis itself every motion leads away from it."""
    env = gym.make("sap/LaneKeeping-v0", laps=None)

    def linear(obs):
        return np.clip(2.5 * obs[:1] / 0.366519 - 1.6 * obs[1:2] + obs[3:4], -1, 1)

    strict = check(env, policy=linear)
    beside = ActionPermissibility(
        gym.make("sap/LaneKeeping-v0", laps=None), lambda s, a, s2: bool(abs(s2[1]) - abs(s[1]) <= 0.05)
    )
    assert strict.policy_forbidden > 0.1
    assert check(beside, policy=linear).policy_forbidden < strict.policy_forbidden / 2
    assert N_ACTIONS % 2 == 1  # the sweep contains steering straight ahead


@pytest.mark.parametrize("algorithm", [DDPGAP, SACAP])
def test_actions_without_a_dimension_work_in_the_check_and_in_training(algorithm):
    env = Line(labels=False)
    env.action_space = spaces.Box(-1, 1, (), np.float32)
    report = check_permissibility(env, towards_centre, n_steps=200, verbose=False)
    assert report.action_matters > 0.9
    assert len(report.action_informs) == 1
    model = build(algorithm, env, ap_function=towards_centre).learn(60)
    assert model.predictor.fitted
    action, _ = model.predict(np.float32([0.5, 0.1]), guided=True)
    assert action.shape == ()
