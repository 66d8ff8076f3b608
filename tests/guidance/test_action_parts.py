"""Labels per part of the action: in K, in E, in Algorithm 1, in the loss, in the penalty and in files."""

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_sap import (
    DDPGAP,
    DQNAP,
    PPOAP,
    SACAP,
    ActionPermissibility,
    LearnedPermissibility,
    PermissibilityPredictor,
    check_permissibility,
)
from sb3_sap.cli.main import main
from sb3_sap.common.action_parts import ActionParts
from sb3_sap.evaluation.predictor_plots import permissible_probability, plot_permissibility
from sb3_sap.guidance.auxiliary_loss import rejection
from sb3_sap.predictor.parted import PartedKnowledge

PARTS = {"x": [0], "y": [1]}
SMALL = {"policy_kwargs": {"net_arch": [16]}, "predictor_kwargs": {"net_arch": [32], "learning_rate": 0.01}, "seed": 1}
OFF_POLICY = {**SMALL, "learning_starts": 20, "batch_size": 16, "buffer_size": 500}


class Plane(gym.Env):
    """A point that each action moves along its own axis; a part is permissible if its coordinate does not grow."""

    observation_space = spaces.Box(-2, 2, (2,), np.float32)
    action_space = spaces.Box(np.array([-1, -3], np.float32), np.array([1, 3], np.float32))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.at, self.t = self.np_random.uniform(-1, 1, 2), 0
        return self.at.astype(np.float32), {}

    def step(self, action):
        before = np.abs(self.at)
        self.at, self.t = np.clip(self.at + 0.2 * self._direction(action), -2, 2), self.t + 1
        info = {"permissible": np.abs(self.at) <= before}
        return self.at.astype(np.float32), -1.0, False, self.t >= 20, info

    def _direction(self, action):
        return np.asarray(action) / [1, 3]


class Grid(Plane):
    """The same with finite actions."""

    action_space = spaces.MultiDiscrete([3, 3])

    def _direction(self, action):
        return np.asarray(action) - 1


def does_not_grow(obs, actions, next_obs):
    return np.abs(next_obs) <= np.abs(obs)


def saved(model, folder):
    model.save(folder / "saved")
    return folder / "saved"


def of_the_info(**settings):
    return DDPGAP("MlpPolicy", Plane(), action_parts=PARTS, **OFF_POLICY, **settings)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({}, "must be like"),
        ([0, 1], "must be like"),
        ({"x": [0], "y": [0]}, "must be disjoint"),
        ({"x": [2]}, r"from 0 to 1, but is \[2\]"),
        ({"x": 0}, "must be a list of dimensions"),
        ({"x": []}, "must be a list of dimensions"),
    ],
)
def test_what_is_no_division_of_the_action_is_refused(parts, message):
    with pytest.raises(ValueError, match=message):
        ActionParts.of(parts, Plane.action_space)


def test_one_dimension_has_no_parts():
    with pytest.raises(ValueError, match="`action_parts` divide actions of several dimensions"):
        DQNAP("MlpPolicy", "CartPole-v1", action_parts={"push": [0]})


def test_each_part_is_balanced_by_itself():
    knowledge = PartedKnowledge(("x", "y"), Plane.observation_space, 2, 200, 0.1, 0, 1)
    rng = np.random.default_rng(0)
    labels = np.stack([rng.random(150) < 0.9, rng.random(150) < 0.3], axis=1)
    knowledge.add(rng.normal(size=(150, 2)), rng.normal(size=(150, 2)), labels)
    assert knowledge.seen == [int((~labels.all(axis=1)).sum()), int(labels.all(axis=1).sum())]
    drawn = knowledge.sample(40).labels
    assert drawn.shape == (80, 2)
    assert np.nanmean(drawn, axis=0).tolist() == [0.5, 0.5]
    assert (np.isnan(drawn).sum(axis=1) == 1).all()


def test_part_of_which_one_class_is_missing_is_left_out():
    knowledge = PartedKnowledge(("x", "y"), Plane.observation_space, 2, 200, 0.1, 0, 1)
    labels = np.stack([np.arange(50) % 2 == 0, np.ones(50, dtype=bool)], axis=1)
    knowledge.add(np.zeros((50, 2)), np.zeros((50, 2)), labels)
    drawn = knowledge.sample(20).labels
    assert len(drawn) == 20
    assert np.isnan(drawn[:, 1]).all()


@pytest.mark.parametrize("ap_function", [does_not_grow, None])
def test_both_parts_are_learned(ap_function):
    model = SACAP("MlpPolicy", Plane(), ap_function=ap_function, action_parts=PARTS, **OFF_POLICY).learn(120)
    assert (model.predictor.accuracies > 0.7).all()
    obs = th.tensor([[0.5, -0.5]])
    wrong = th.tensor([[0.9, 0.9]])  # away from the line in x, towards it in y
    assert (model.predictor.part_logits(model.predictor.features(obs), wrong) > 0).tolist() == [[False, True]]
    assert (model.predictor(obs, wrong) > 0).tolist() == [False]
    model.predictor.accuracies[0] = 0.6  # what is not trusted does not count
    assert (model.predictor(obs, wrong) > 0).tolist() == [True]


def verdicts(monkeypatch, model, of_parts):
    """E judges scaled actions by a function that gives (n, k) logits."""
    monkeypatch.setattr(model.predictor, "part_logits", lambda features, actions: of_parts(actions))


def test_rejected_part_alone_is_replaced(monkeypatch):
    model = of_the_info(alpha=1.0).learn(40)
    model.predictor.accuracies[:] = 1.0
    verdicts(monkeypatch, model, lambda a: th.stack([0.2 - a[:, 0], th.ones(len(a))], dim=1))
    guided = model.guide(np.array([[0.9, 0.4]], dtype=np.float32))
    assert guided[0, 0] < 0.2
    assert guided[0, 1] == np.float32(0.4)
    assert model.guide(np.array([[0.1, 0.4]], dtype=np.float32)) is None
    repaired = model.predict(np.zeros((1, 2), np.float32), guided=True)[0]
    plain = model.predict(np.zeros((1, 2), np.float32))[0]
    assert repaired[0, 1] == plain[0, 1]
    assert repaired[0, 0] < 0.2


def test_part_that_was_never_fitted_is_not_asked(monkeypatch):
    model = of_the_info(alpha=1.0, alpha_low=1.0).learn(40)
    model.predictor.accuracies[:] = th.tensor([0.5, th.nan])
    verdicts(monkeypatch, model, lambda a: th.stack([th.ones(len(a)), 0.2 - a[:, 1]], dim=1))
    rejected = np.array([[0.9, 0.4]], dtype=np.float32)
    assert model.guide(rejected) is None
    obs = np.zeros((1, 2), np.float32)
    np.testing.assert_array_equal(model.predict(obs, guided=True)[0], model.predict(obs)[0])


def test_known_actions_hold_beside_parts(monkeypatch):
    model = of_the_info(permissible_actions=lambda obs, actions: actions.sum(axis=1) < -1).learn(40)
    model.predictor.n_updates += 1  # as if it were fitted
    model.predictor.accuracies[:] = th.nan
    assert model.predict(np.zeros((5, 2), np.float32), guided=True)[0].sum(axis=1).max() < -1
    model.predictor.accuracies[:] = 1.0
    verdicts(monkeypatch, model, lambda a: th.stack([a[:, 0], th.ones(len(a))], dim=1))
    [guided] = model.predict(np.zeros((1, 2), np.float32), guided=True)[0]
    assert guided[0] > 0
    assert guided.sum() < -1


def test_second_part_is_judged_beside_the_repaired_first(monkeypatch):
    model = of_the_info(alpha=1.0).learn(40)
    model.predictor.accuracies[:] = 1.0
    # y may only be positive where x is negative, which it is not at first.
    verdicts(monkeypatch, model, lambda a: th.stack([-a[:, 0], -a[:, 0] * a[:, 1]], dim=1))
    guided = model.guide(np.array([[0.9, 0.4]], dtype=np.float32))
    assert guided[0, 0] < 0
    assert guided[0, 1] == np.float32(0.4)


def test_each_part_has_its_own_alpha():
    model = of_the_info(alpha=0.9, alpha_low=0.2)
    model.predictor.accuracies[:] = th.tensor([0.8, 0.6])
    assert [model._alpha_of(part) for part in (0, 1)] == [0.9, 0.2]
    assert model.predictor_accurate
    model.predictor.accuracies[0] = 0.69
    assert not model.predictor_accurate


def test_gradient_of_a_part_is_in_its_own_dimensions(monkeypatch):
    model = of_the_info().learn(40)
    model.predictor.accuracies[:] = th.tensor([1.0, 0.5])
    verdicts(monkeypatch, model, lambda a: th.stack([-a.sum(dim=1), -a.sum(dim=1)], dim=1))
    actions = th.zeros((3, 2), requires_grad=True)
    rejection(model.predictor, th.zeros((3, 2)), actions).backward()
    assert (actions.grad[:, 0] > 0).all()
    assert (actions.grad[:, 1] == 0).all()


def test_penalty_is_for_each_part():
    model = of_the_info(penalty=5.0, alpha=0.0).learn(60)
    buffer = model.replay_buffer
    actions = model.policy.unscale_action(buffer.actions[:60, 0])
    grew = ~does_not_grow(buffer.observations[:60, 0], actions, buffer.next_observations[:60, 0])
    # float32 observations may round a difference of the exact coordinates away; here none is that small.
    np.testing.assert_allclose(buffer.rewards[:60, 0], -1 - 5 * grew.sum(axis=1))
    wrapped = ActionPermissibility(Plane(), penalty=5.0)
    wrapped.reset(seed=0)
    assert wrapped.step(10 * wrapped.unwrapped.at)[1] == -11.0


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (lambda obs, actions, next_obs: np.ones(len(obs), bool), r"\(1, 2\): one label for each row .* x, y"),
        (lambda obs, actions, next_obs: np.ones((len(obs), 3), bool), r"shape \(1, 3\) for 1 actions"),
    ],
)
def test_labels_of_another_shape_are_refused(labels, message):
    with pytest.raises(ValueError, match=message):
        DDPGAP("MlpPolicy", Plane(), ap_function=labels, action_parts=PARTS, **OFF_POLICY).learn(5)


def test_labels_of_parts_need_the_parts():
    with pytest.raises(ValueError, match="Labels of parts of the action need `action_parts`"):
        DDPGAP("MlpPolicy", Plane(), ap_function=does_not_grow, **OFF_POLICY).learn(5)
    with pytest.raises(TypeError, match="must be a bool, but is array"):
        DDPGAP("MlpPolicy", Plane(), **OFF_POLICY).learn(5)
    with pytest.raises(TypeError, match="an array of 1 bool, one for each of both"):
        DDPGAP("MlpPolicy", Plane(), action_parts={"both": [0, 1]}, **OFF_POLICY).learn(5)
    with pytest.raises(ValueError, match="`potential` labels the action as a whole"):
        DDPGAP("MlpPolicy", Plane(), potential=lambda obs: -np.abs(obs).sum(axis=1), action_parts=PARTS)


def stays_near(obs, actions, next_obs):
    return (np.abs(next_obs) <= np.abs(obs)[:, None] + 0.3).all(axis=1)  # (n, 3, 2) -> (n, 2)


@pytest.mark.parametrize("algorithm", [DDPGAP, PPOAP])
def test_labels_of_parts_may_come_late(algorithm):
    more = {"n_steps": 30, **SMALL} if algorithm is PPOAP else OFF_POLICY
    model = algorithm("MlpPolicy", Plane(), ap_function=stays_near, action_parts=PARTS, horizon=3, penalty=1.0, **more)
    model.learn(60)
    assert sum(model.knowledge.seen) == 60
    assert all(sum(store.seen) == 60 for store in model.knowledge.each)
    assert [store.seen for store in model.knowledge.each] != [model.knowledge.seen] * 2
    with pytest.raises(ValueError, match="`event` labels the action as a whole"):
        algorithm("MlpPolicy", Plane(), event="terminated", action_parts=PARTS, horizon=3)


def test_saved_model_goes_on_alike(tmp_path):
    model = of_the_info(actor_permissibility_coef=1.0).learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = DDPGAP.load(tmp_path / "model", env=Plane())
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.parts == model.parts
    np.testing.assert_array_equal(loaded.predictor.accuracies, model.predictor.accuracies)
    for one in (model, loaded):
        one.set_random_seed(3)
        one.env.seed(3)
        one.env.reset()
        one.learn(30)
    for name, value in model.policy.state_dict().items():
        assert th.equal(value, loaded.policy.state_dict()[name])
    with pytest.raises(ValueError, match="holds labels of the parts"):
        DDPGAP("MlpPolicy", Plane(), action_parts={"z": [0], "y": [1]}, **OFF_POLICY).load_replay_buffer(
            tmp_path / "buffer"
        )


def test_predictor_alone_is_saved_with_its_parts(tmp_path):
    model = of_the_info().learn(60)
    model.save_predictor(tmp_path / "predictor.pt")
    loaded = PermissibilityPredictor.load(tmp_path / "predictor.pt")
    assert loaded.parts.as_dict() == PARTS
    other = of_the_info(predictor=tmp_path / "predictor.pt")
    np.testing.assert_array_equal(other.predictor.accuracies, model.predictor.accuracies)
    for parts in ({"z": [0, 1]}, None):
        with pytest.raises(ValueError, match="The AP predictor has the `action_parts`"):
            DDPGAP("MlpPolicy", Plane(), predictor=tmp_path / "predictor.pt", action_parts=parts)
    again = DDPGAP.load(saved(other, tmp_path), env=Plane())
    assert again.predictor.parts.as_dict() == PARTS


def test_commands_know_parts(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("sb3_sap.cli.predictor.make_env", lambda *_: Plane())
    rng = np.random.default_rng(0)
    obs, actions = rng.uniform(-1, 1, (400, 2)), rng.uniform(-1, 1, (400, 2)) * [1, 3]
    np.savez(tmp_path / "log.npz", obs=obs, actions=actions, next_obs=obs + 0.2 * actions / [1, 3])
    log, out = str(tmp_path / "log.npz"), str(tmp_path / "predictor.pt")
    named = ["--env", "Plane", "--ap-function", f"{__name__}.does_not_grow", "--action-parts", "{x: [0], y: [1]}"]
    assert main(["predictor", "fit", log, *named, "--out", out, "--net-arch", "32"]) == 0
    assert main(["predictor", "evaluate", out, log, *named]) == 0
    assert main(["predictor", "show", out]) == 0
    assert "of y" in capsys.readouterr().out


def test_transitions_of_elsewhere_have_labels_of_parts():
    rng = np.random.default_rng(0)
    obs, actions = rng.uniform(-1, 1, (200, 2)), rng.uniform(-1, 1, (200, 2)) * [1, 3]
    given = {"obs": obs, "actions": actions, "next_obs": obs + 0.2 * actions / [1, 3]}
    model = of_the_info()
    with pytest.raises(ValueError, match=r"have shape \(200,\), but must have \(200, 2\)"):
        model.add_knowledge({**given, "labels": np.ones(200, bool)})
    labels = does_not_grow(given["obs"], given["actions"], given["next_obs"])
    report = model.add_knowledge({**given, "labels": labels})
    assert report.permissible == labels.all(axis=1).sum()
    model.fit_predictor(epochs=20)
    assert (model.predictor.accuracies > 0.7).all()


@pytest.mark.parametrize("env", [Plane, Grid])
def test_on_policy(env):
    model = PPOAP("MlpPolicy", env(), action_parts=PARTS, n_steps=64, **SMALL).learn(256)
    assert (model.predictor.accuracies > 0.7).all()


@pytest.mark.slow
def test_check_is_of_each_part(capsys):
    reports = check_permissibility(Plane(), n_steps=200, action_parts=PARTS)
    assert list(reports) == ["x", "y"]
    printed = capsys.readouterr().out
    assert printed.startswith("x:")
    assert "y:" in printed
    assert reports["x"].action_informs[0] > reports["x"].action_informs[1]
    by_function = check_permissibility(Plane(), does_not_grow, n_steps=200, action_parts=PARTS, verbose=False)
    assert by_function["y"].permissible_rate == pytest.approx(reports["y"].permissible_rate, abs=0.02)


def test_picture_is_of_the_part_that_is_drawn(monkeypatch):
    model = of_the_info().learn(60)
    verdicts(monkeypatch, model, lambda a: th.stack([20 * a[:, 0], -20 * a[:, 1]], dim=1))
    obs, actions = np.zeros((1, 2), np.float32), np.array([[0.5, 1.5]], np.float32)
    assert permissible_probability(model, obs, actions, part="x")[0, 0] > 0.9
    assert permissible_probability(model, obs, actions, part="y")[0, 0] < 0.1
    [mesh] = plot_permissibility(model, action=1).axes[0].collections
    drawn = np.asarray(mesh.get_array()).reshape(121, 121)
    assert drawn[0].min() > 0.9  # lowest values of y
    assert drawn[-1].max() < 0.1


def test_wrapper_judges_the_whole_action():
    with pytest.raises(ValueError, match="LearnedPermissibility judges the action as a whole"):
        LearnedPermissibility(Plane(), predictor_kwargs={"action_parts": PARTS})
