"""Knowledge before the first step: what goes into K and R, how E is fitted to it, and what happens if it is wrong."""

import copy
import pickle
from functools import cache

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.save_util import save_to_pkl
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from toy import DISCRETE, GUIDED, SMALL_FITS, Line, build, line_log, towards_centre

from sb3_sap import A2CAP, DDPGAP, DQNAP, PPOAP, SACAP, LearnedPermissibility, PermissibilityPredictor
from sb3_sap.guidance.teaching import SPREAD
from sb3_sap.transitions.sources import batches_of, joined


def known(algorithm=DDPGAP, env=None, log=None, **settings):
    model = build(algorithm, env, ap_function=towards_centre, **(SMALL_FITS | settings))
    report = model.add_knowledge(line_log() if log is None else log, into="knowledge")
    return model, report


# ------------------------------------------------------------------ into K


def test_log_is_labelled_and_kept_apart_from_the_models_own_knowledge():
    model, report = known(knowledge_buffer_size=200)
    log = line_log()
    labels = towards_centre(log["obs"], log["actions"], log["next_obs"])
    assert (report.permissible, report.non_permissible) == (labels.sum(), (~labels).sum())
    assert (report.rows, report.kept_examples) == (2_000, 200)
    prior = model.knowledge.prior
    assert prior.counts("train") == (90, 90)
    assert prior.counts("validation") == (10, 10)
    assert len(model.knowledge) == 0
    sample = prior.sample_own(400)
    next_x = sample.observations[:, :1] + 0.1 * sample.actions
    np.testing.assert_array_equal((np.abs(next_x) <= np.abs(sample.observations[:, :1]))[:, 0], sample.labels > 0.5)


def test_what_is_kept_is_a_random_sample_of_all():
    log = line_log(4_000)
    log["obs"][:, 1] = np.arange(4_000) / 4_000  # when it was logged
    model, _ = known(knowledge_buffer_size=400, log=log)
    when = model.knowledge.prior.sample_own(4_000).observations[:, 1]
    assert np.mean(when) == pytest.approx(0.5, abs=0.06)
    assert np.quantile(when, 0.1) < 0.2


@pytest.mark.parametrize("algorithm", [*GUIDED, PPOAP, A2CAP])
def test_every_algorithm_takes_a_log(algorithm):
    settings = {"n_steps": 16, "batch_size": 16} if algorithm is PPOAP else {}
    if algorithm in (PPOAP, A2CAP):
        model = algorithm("MlpPolicy", Line(), ap_function=towards_centre, seed=0, **settings, **SMALL_FITS)
    else:
        model = build(algorithm, ap_function=towards_centre, **SMALL_FITS)
    report = model.add_knowledge(line_log())
    assert report.kept_examples == 2_000
    assert report.into_replay == (0 if algorithm in (PPOAP, A2CAP) else 2_000)
    assert model.fit_predictor(epochs=6).accuracy > 0.85
    model.learn(60)


@pytest.mark.parametrize("algorithm", DISCRETE)
def test_discrete_actions(algorithm):
    log = line_log()
    log["actions"] = np.rint(log["actions"][:, 0] + 1).astype(int)
    log["next_obs"][:, 0] = log["obs"][:, 0] + 0.1 * (log["actions"] - 1)
    model, report = known(algorithm, log=log)
    assert report.non_permissible > 500
    assert model.fit_predictor(epochs=6).accuracy > 0.85


def test_dict_observations():
    model, _ = known(env=Line("dict"), log=line_log(kind="dict"), policy="MultiInputPolicy")
    assert model.fit_predictor(epochs=6).accuracy > 0.85


def test_labels_of_the_log_hold_where_there_are_some():
    _, report = known(log=line_log(wrong=True))
    _, own = known()
    assert report.permissible == own.non_permissible


def test_refused_rows_are_told_and_left_out():
    log = line_log(100)
    log["actions"][:10] = 7.0
    log["obs"][50, 0] = np.nan
    model, report = known(log=log)
    assert dict(report.refused) == {"not finite": 1, "action out of bounds": 10}
    assert report.permissible + report.non_permissible == 89 == len(model.knowledge.prior)
    assert "10 refused: action out of bounds" in str(report)


@pytest.mark.parametrize(
    ("source", "settings", "sentence"),
    [
        ({"actions": np.full((5, 1), 9.0)}, {}, "All 5 transitions were refused: action out of bounds"),
        ({}, {"ap_function": None}, "no labels"),
        ({"into": "everything"}, {}, "`into` must be"),
        ({"into": "replay", "rewards": None}, {}, "needs rewards"),
    ],
)
def test_what_is_wrong_is_said_and_the_model_is_as_it_was(source, settings, sentence):
    model = build(DDPGAP, **({"ap_function": towards_centre} | settings))
    into = source.pop("into", "knowledge")
    with pytest.raises(ValueError, match=sentence):
        model.add_knowledge(line_log(5) | source, into=into)
    assert model.knowledge.prior is None
    assert model.replay_buffer.prior == ()


def test_interrupted_import_leaves_the_model_as_it_was(monkeypatch):
    monkeypatch.setattr("sb3_sap.transitions.sources.ROWS", 10)
    model, _ = known()
    before = pickle.dumps(model.replay_buffer)
    calls = []

    def interrupted(obs, actions, next_obs):
        calls.append(len(actions))
        if len(calls) == 3:
            raise KeyboardInterrupt
        return towards_centre(obs, actions, next_obs)

    model.ap_function = interrupted
    with pytest.raises(KeyboardInterrupt):
        model.add_knowledge(line_log(50))
    assert calls == [10, 10, 10]
    assert pickle.dumps(model.replay_buffer) == before


# ------------------------------------------------------------------ into R


def test_rewards_get_the_penalty_once():
    model = build(SACAP, ap_function=towards_centre, penalty=2.0)
    log = line_log(300)
    report = model.add_knowledge(log, into="replay")
    (prior,) = model.replay_buffer.prior
    labels = towards_centre(log["obs"], log["actions"], log["next_obs"])
    np.testing.assert_allclose(prior.rewards[:300, 0], log["rewards"] - 2.0 * ~labels, rtol=1e-5)
    assert report.into_replay == prior.size() == 300
    assert model.knowledge.prior is None


def test_actions_are_stored_scaled():
    env = Line(low=-2, high=4)
    model = build(SACAP, env, ap_function=towards_centre)
    log = line_log(50)
    log["actions"] = log["actions"] * 3 + 1
    model.add_knowledge(log)
    np.testing.assert_allclose(model.replay_buffer.prior[0].actions[:50, 0], (log["actions"] - 1) / 3, atol=1e-6)


@pytest.mark.parametrize(
    ("share", "own", "expected"), [(0.5, 60, 0.5), (0.25, 60, 0.25), (0.5, 0, 1.0), (0.0, 60, 0.0)]
)
def test_batches_are_shared_between_old_and_new(share, own, expected):
    model = build(SACAP, ap_function=towards_centre, prior_share=share)
    log = line_log(200)
    log["rewards"] = np.full(200, 77.0)
    model.add_knowledge(log, into="replay")
    if own:
        model.learn(own)
    rewards = model.replay_buffer.sample(40).rewards.numpy()
    assert (rewards == 77).mean() == expected


def test_two_sources_are_drawn_from_in_proportion():
    model = build(SACAP, ap_function=towards_centre)
    for value, n in ((7.0, 300), (9.0, 100)):
        model.add_knowledge(line_log(n) | {"rewards": np.full(n, value)}, into="replay")
    rewards = model.replay_buffer.sample(4_000).rewards.numpy()
    assert (rewards == 9).mean() == pytest.approx(0.25, abs=0.03)


def test_n_step_returns_stop_where_the_log_is_broken():
    model = build(SACAP, ap_function=towards_centre, n_steps=3, gamma=0.5)
    x = np.arange(6, dtype=np.float32)
    obs = np.stack([x, x], axis=1)
    log = {"obs": obs, "actions": np.zeros((6, 1)), "next_obs": obs + 1, "rewards": np.ones(6)}
    log["obs"][3:] += 10  # the fourth step does not follow the third
    log["next_obs"][3:] += 10
    model.add_knowledge(log, into="replay")
    prior = model.replay_buffer.prior[0]
    data = prior._get_samples(np.arange(6))
    np.testing.assert_allclose(data.rewards[:, 0], [1.75, 1.5, 1.0, 1.75, 1.5, 1.0])
    assert not data.dones.any()  # cut off, and not terminal
    np.testing.assert_allclose(data.next_observations[:, 0], [3, 3, 3, 16, 16, 16])


def test_hindsight_goals_come_from_the_episodes_of_the_log():
    env = Line("goal")
    model = build(
        SACAP, env, ap_function=_goal_label, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer, penalty=0.5
    )
    donor = build(
        SACAP, Line("goal"), ap_function=_goal_label, policy="MultiInputPolicy", replay_buffer_class=HerReplayBuffer
    )
    donor.learn(45)
    report = model.add_knowledge(donor.replay_buffer)
    assert (report.into_replay, report.episodes) == (45, 5)
    batch = model.replay_buffer.sample(64)
    assert batch.rewards.shape == (64, 1)
    assert len(np.unique(batch.observations["desired_goal"].numpy())) > 5
    model.learn(30)


def _goal_label(obs, actions, next_obs):
    return (np.abs(next_obs["achieved_goal"]) <= np.abs(obs["achieved_goal"]))[:, 0]


@pytest.mark.parametrize("n_envs", [1, 3])
def test_several_environments_learn_from_one_log(n_envs):
    env = DummyVecEnv([Line] * n_envs)
    model = build(SACAP, env, ap_function=towards_centre)
    model.add_knowledge(line_log(100))
    model.learn(60)
    assert model.replay_buffer.prior[0].n_envs == 1


def test_on_policy_algorithm_has_no_replay_buffer():
    model = PPOAP("MlpPolicy", Line(), ap_function=towards_centre, n_steps=16, batch_size=16)
    with pytest.raises(ValueError, match="needs a replay buffer, which PPOAP has not"):
        model.add_knowledge(line_log(), into="both")


def test_what_was_added_is_saved_with_the_replay_buffer(tmp_path):
    model, _ = known()
    model.add_knowledge(line_log(100), into="replay")
    model.learn(30)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = DDPGAP.load(tmp_path / "model", Line(), ap_function=towards_centre)
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.knowledge.prior.counts("train") == model.knowledge.prior.counts("train")
    np.testing.assert_array_equal(
        loaded.knowledge.prior.sample_own(50).observations, model.knowledge.prior.sample_own(50).observations
    )
    assert loaded.replay_buffer.prior[0].size() == 100
    loaded.learn(30, reset_num_timesteps=False)


def test_model_without_prior_draws_the_same_batches_as_before():
    one, other = build(SACAP).learn(60), build(SACAP, prior_share=0.1).learn(60)
    assert all(th.equal(a, b) for a, b in zip(one.policy.parameters(), other.policy.parameters(), strict=True))


# ------------------------------------------------------------------ E before the first step


def test_predictor_is_fitted_before_the_first_step_and_trusted():
    model, _ = known(t_k=0, learning_starts=0)
    report = model.fit_predictor(epochs=6)
    assert report.accuracy == model.validation_accuracy > 0.9
    assert 0 < report.calibration_error < 0.2
    assert report.epochs >= 1
    assert str(report).startswith("Balanced accuracy 0.9")
    assert model.current_alpha == model.alpha
    model.env.seed(0)
    model.learn(20)
    env = model.env.envs[0].unwrapped
    assert len(env.executed) == 20


@pytest.mark.slow
@pytest.mark.parametrize("batch_size", [16, 64])
def test_few_examples_are_fitted_beyond_the_plateau_at_the_start(batch_size):
    log = line_log(150)
    for name in ("obs", "next_obs"):
        log[name] = np.float32(0.05) * log[name]  # so near the middle, towards or away depends on small differences
    log["labels"] = (log["actions"] * log["obs"][:, :1] < 0)[:, 0]
    model, _ = known(log=log, predictor_kwargs={"net_arch": [64, 64], "batch_size": batch_size}, dataset_size=256)
    assert model.fit_predictor(epochs=20).accuracy > 0.8


def test_fit_keeps_the_best_weights(monkeypatch):
    model, _ = known()
    first = model.fit_predictor(epochs=5)
    weights = copy.deepcopy(model.predictor.state_dict())
    monkeypatch.setattr(type(model.predictor), "fit", _spoil)
    again = model.fit_predictor(epochs=3)
    assert again.loss == pytest.approx(first.loss, abs=0.05)  # on other held-out examples
    assert all(th.equal(value, weights[name]) for name, value in model.predictor.state_dict().items())


def _spoil(predictor, dataset):
    with th.no_grad():
        for parameter in predictor.parameters():
            parameter.normal_()
    return 0.0


def test_too_few_labels_of_one_class_are_told():
    log = line_log()
    log["labels"] = np.ones(2_000, bool)
    model, _ = known(log=log)
    with pytest.raises(ValueError, match=r"cannot be fitted to 0 and 1\d* non-permissible and permissible"):
        model.fit_predictor(epochs=6)


def test_policy_is_taught_before_the_first_step():
    model, _ = known(policy_kwargs={"net_arch": [32]}, learning_rate=0.01)
    model.fit_predictor(epochs=6)
    model.teach_policy(300)
    rows = np.array([[-0.8, 0.5], [-0.4, 0.5], [0.4, 0.5], [0.8, 0.5]], dtype=np.float32)
    assert np.sign(model.predict(rows, deterministic=True)[0][:, 0]).tolist() == [1, 1, -1, -1]
    assert all(th.equal(a, b) for a, b in zip(model.actor.parameters(), model.actor_target.parameters(), strict=True))


@pytest.mark.parametrize("algorithm", [DDPGAP, SACAP])
def test_taught_policy_is_held_while_the_critics_learn(algorithm):
    model, _ = known(algorithm, t_k=0, learning_starts=0)
    model.fit_predictor(epochs=6)
    model.teach_policy(20, hold=30)
    before = copy.deepcopy(model.actor.state_dict())
    critic = copy.deepcopy(model.critic.state_dict())
    model.learn(30)
    assert all(th.equal(value, before[name]) for name, value in model.actor.state_dict().items())
    assert not all(th.equal(value, critic[name]) for name, value in model.critic.state_dict().items())
    model.learn(10, reset_num_timesteps=False)
    assert not all(th.equal(value, before[name]) for name, value in model.actor.state_dict().items())


def test_taught_stochastic_policy_explores_around_what_is_permitted():
    model, _ = known(SACAP, policy_kwargs={"net_arch": [32]}, learning_rate=0.01)
    model.fit_predictor(epochs=6)
    model.teach_policy(300, imitate=False)
    drawn = model.predict(np.tile(np.array([[0.5, 0.5]], np.float32), (500, 1)))[0]
    assert drawn.mean() < -0.05
    assert drawn.std() == pytest.approx(SPREAD, rel=0.3)


@pytest.mark.slow
def test_taught_policy_moves_no_further_than_e_demands():
    model, _ = known(policy_kwargs={"net_arch": [32]}, learning_rate=0.01)
    model.fit_predictor()
    model.teach_policy(1_000, imitate=False)
    obs = np.array([[-0.8, 0.5], [0.8, 0.5]], np.float32)
    assert (np.abs(model.predict(obs)[0]) < 0.6).all()  # any push in the right direction is permissible


@pytest.mark.parametrize("kind", ["array", "dict", "normalized"])
@pytest.mark.parametrize("algorithm", [DDPGAP, SACAP, DQNAP])
def test_predictor_alone_teaches_a_policy(algorithm, kind, tmp_path):
    log = line_log(kind=kind if kind == "dict" else "array")
    if algorithm is DQNAP:
        log["actions"] = np.rint(log["actions"][:, 0] + 1).astype(int)
        log["labels"] = (log["actions"] - 1) * (log["obs"]["x"] if kind == "dict" else log["obs"])[:, 0] < 0
    n_actions = 3 if algorithm is DQNAP else None
    env, new = (Line("dict" if kind == "dict" else "array", n_actions=n_actions) for _ in range(2))
    if kind == "normalized":
        env, new = (VecNormalize(DummyVecEnv([lambda one=one: one])) for one in (env, new))
    policy = "MultiInputPolicy" if kind == "dict" else "MlpPolicy"
    donor, _ = known(algorithm, env=env, log=log, policy=policy)
    donor.fit_predictor(epochs=6)
    donor.save_predictor(tmp_path / "e.pt")
    if kind == "normalized":
        new.obs_rms = copy.deepcopy(env.obs_rms)
    model = build(algorithm, new, predictor=tmp_path / "e.pt", predictor_kwargs={}, policy=policy, learning_rate=0.01)
    model.teach_policy(300)
    obs = np.array([[-0.8, 0.5], [0.8, 0.5]], np.float32)
    shown = {"x": obs[:, :1], "time": obs[:, 1:]} if kind == "dict" else obs
    if kind == "normalized":
        shown = new.normalize_obs(obs)
    actions = model.predict(shown, deterministic=True)[0].reshape(2)
    towards = actions - 1 if algorithm is DQNAP else actions
    assert towards[0] > 0 > towards[1]


@pytest.mark.parametrize("algorithm", [DDPGAP, SACAP])
def test_policy_imitates_the_permissible_actions_of_a_log(algorithm):
    rng, log = np.random.default_rng(0), line_log()
    log["labels"] = rng.random(2_000) < 0.5
    log["actions"] = np.where(log["labels"][:, None], rng.normal(-0.6, 0.05, (2_000, 1)), 0.6).astype(np.float32)
    model, _ = known(algorithm, log=log, policy_kwargs={"net_arch": [32]}, learning_rate=0.01)
    model.teach_policy(600)
    drawn = model.predict(np.tile(np.array([[0.5, 0.5]], np.float32), (500, 1)))[0]
    assert drawn.mean() == pytest.approx(-0.6, abs=0.1)
    assert drawn.std() == pytest.approx(0.05 if algorithm is SACAP else 0, abs=0.06)


def test_actor_that_was_not_taught_or_is_not_held_learns_before_the_first_step():
    model, _ = known()
    model.add_knowledge(line_log(100), into="replay")
    model._setup_learn(1)
    for taught in (False, True):
        if taught:
            model.fit_predictor(epochs=1)
            model.teach_policy(1)
        before = copy.deepcopy(model.actor.state_dict())
        model.train(gradient_steps=1, batch_size=8)
        assert not all(th.equal(value, before[name]) for name, value in model.actor.state_dict().items())


def test_share_of_old_transitions_may_be_changed_by_load(tmp_path):
    model, _ = known()
    model.add_knowledge(line_log(200) | {"rewards": np.full(200, 77.0)}, into="replay")
    model.learn(60)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = DDPGAP.load(tmp_path / "model", Line(), prior_share=0.25)
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert loaded.knowledge.prior_share == 0.25
    assert (loaded.replay_buffer.sample(40).rewards == 77).float().mean() == 0.25


def test_policy_cannot_be_taught_by_nothing():
    with pytest.raises(ValueError, match="nothing is known"):
        build(DDPGAP).teach_policy()
    with pytest.raises(ValueError, match="call `fit_predictor` first"):
        known()[0].teach_policy(imitate=False)
    with pytest.raises(ValueError, match="no permissible action is known"):
        build(DDPGAP).teach_policy(imitate=True)
    with pytest.raises(ValueError, match="needs continuous actions"):
        build(DQNAP).teach_policy(imitate=True)


@pytest.mark.slow
def test_predictor_that_is_right_too_seldom_teaches_with_a_warning(recwarn):
    model, _ = known()
    model.fit_predictor()
    model.teach_policy(1, imitate=False)
    assert not [w for w in recwarn if "balanced accuracy" in str(w.message)]
    model.validation_accuracy = 0.55
    model.teach_policy(1)  # which imitates
    with pytest.warns(UserWarning, match="its balanced accuracy is 55%, below the 70% from which"):
        model.teach_policy(1, imitate=False)


def test_frozen_predictor_stays_as_it_is():
    model, _ = known(freeze_predictor=True)
    model.fit_predictor(epochs=6)
    before = copy.deepcopy(model.predictor.state_dict())
    model.learn(100)
    assert all(th.equal(value, before[name]) for name, value in model.predictor.state_dict().items())


@pytest.mark.slow
def test_wrong_knowledge_is_noticed_and_unlearned():
    model, _ = known(log=line_log(wrong=True), t_k=0, learning_starts=0)
    model.fit_predictor(epochs=6)
    with pytest.warns(UserWarning, match="does not fit what is observed"):
        model.learn(150)
    assert model.knowledge.prior is None
    assert model.familiarity is None
    model.learn(400, reset_num_timesteps=False)
    obs = np.array([[0.5, 0.5], [0.5, 0.5]], np.float32)
    left, right = model.predictor.probabilities(obs, np.array([[-0.9], [0.9]]))
    assert left > 0.5 > right


@pytest.mark.slow
def test_right_knowledge_is_kept():
    model, _ = known(t_k=0, learning_starts=0)
    model.fit_predictor(epochs=6)
    model.learn(300)
    assert model.knowledge.prior is not None
    assert model.familiarity.score > 0.7


# ------------------------------------------------------------------ E as a file


@cache
def fitted():
    model, _ = known()
    model.fit_predictor(epochs=6)
    return model


def test_predictor_is_saved_and_taken_by_another_algorithm(tmp_path):
    donor = fitted()
    donor.save_predictor(tmp_path / "e.pt")
    for given in (tmp_path / "e.pt", str(tmp_path / "e.pt"), donor.predictor):
        model = build(SACAP, predictor=given, predictor_kwargs={})
        assert model.validation_accuracy == donor.validation_accuracy
        assert model.predictor is not donor.predictor
        for name, value in donor.predictor.state_dict().items():
            assert th.equal(value, model.predictor.state_dict()[name])
    assert model.predictor.head[0].out_features == 32
    model.learn(60)
    on_policy = PPOAP("MlpPolicy", Line(), n_steps=16, batch_size=16, predictor=tmp_path / "e.pt")
    on_policy.learn(32)


def test_wrapper_for_other_libraries_begins_with_a_predictor(tmp_path):
    donor = fitted()
    donor.save_predictor(tmp_path / "e.pt")
    for given in (tmp_path / "e.pt", donor.predictor):
        env = LearnedPermissibility(Line(), predictor=given, alpha=1.0, seed=0)
        env.reset(seed=0, options={"x": 0.5})
        *_, info = env.step(np.array([0.9], np.float32))
        assert info["replaced"]
    with pytest.raises(ValueError, match="only be used with the same spaces"):
        LearnedPermissibility(Line(dim=2), predictor=donor.predictor)


def test_loaded_predictor_judges_alone(tmp_path):
    donor = fitted()
    donor.predictor.save(tmp_path / "e.pt")
    predictor = PermissibilityPredictor.load(tmp_path / "e.pt")
    assert predictor.fitted
    obs = np.array([[0.5, 0.5], [0.5, 0.5]], np.float32)
    left, right = predictor.probabilities(obs, np.array([[-0.9], [0.9]]))
    assert left > 0.9 > 0.1 > right


def test_file_of_a_predictor_runs_no_code(tmp_path):
    class Evil:
        def __reduce__(self):
            return (open, (str(tmp_path / "written"), "w"))

    th.save({"format": 1, "weights": Evil()}, tmp_path / "evil.pt")
    save_to_pkl(tmp_path / "evil.pkl", Evil())
    for name in ("evil.pt", "evil.pkl"):
        with pytest.raises(ValueError, match="holds no AP predictor"):
            PermissibilityPredictor.load(tmp_path / name)
    assert not (tmp_path / "written").exists()
    with pytest.raises(FileNotFoundError, match="There is no file"):
        PermissibilityPredictor.load(tmp_path / "nothing.pt")


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(np.array([-1, 0], np.float32), np.array([1, np.inf], np.float32)),
        spaces.Discrete(4, start=2),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(3),
        spaces.Dict({"a": spaces.Box(0, 255, (2, 2), np.uint8), "b": spaces.Discrete(2)}),
    ],
)
def test_spaces_survive_a_file(tmp_path, space):
    action_space = space if not isinstance(space, spaces.Dict) else spaces.Discrete(2)
    observations = space if isinstance(space, spaces.Dict) else spaces.Box(-1, 1, (2,))
    from stable_baselines3.common.torch_layers import CombinedExtractor, FlattenExtractor

    extractor = CombinedExtractor if isinstance(space, spaces.Dict) else FlattenExtractor
    predictor = PermissibilityPredictor(observations, action_space, features_extractor_class=extractor)
    predictor.save(tmp_path / "e.pt")
    loaded = PermissibilityPredictor.load(tmp_path / "e.pt")
    assert (loaded.observation_space, loaded.action_space) == (observations, action_space)


class OwnActivation(th.nn.ReLU):
    """An activation that no library has."""


def test_class_of_ones_own_must_be_passed(tmp_path):
    model = build(DDPGAP, predictor_kwargs={"net_arch": [8], "activation_fn": OwnActivation})
    model.predictor.save(tmp_path / "e.pt")
    with pytest.raises(ValueError, match=r"pass it, as in PermissibilityPredictor.load\(path, activation_fn="):
        PermissibilityPredictor.load(tmp_path / "e.pt")
    PermissibilityPredictor.load(tmp_path / "e.pt", activation_fn=OwnActivation)


def test_predictor_of_other_spaces_is_refused():
    with pytest.raises(ValueError, match="only be used with the same spaces"):
        build(DDPGAP, Line(dim=2), predictor=fitted().predictor)


def test_predictor_of_another_architecture_than_asked_for_is_refused():
    with pytest.raises(ValueError, match="`predictor_kwargs` change net_arch"):
        build(DDPGAP, predictor=fitted().predictor, predictor_kwargs={"net_arch": [7]})


def test_learning_rate_is_that_of_the_model():
    donor = fitted()
    model = build(DDPGAP, predictor=donor.predictor, predictor_kwargs={"learning_rate": 0.5})
    assert model.predictor.optimizer.param_groups[0]["lr"] == 0.5


def test_load_restores_the_predictor_of_the_file(tmp_path):
    model = build(DDPGAP)
    model.save(tmp_path / "model")
    with pytest.raises(TypeError, match=r"call `model\.set_predictor"):
        DDPGAP.load(tmp_path / "model", Line(), predictor=fitted().predictor)
    loaded = DDPGAP.load(tmp_path / "model", Line())
    with pytest.raises(ValueError, match="`predictor_kwargs` change net_arch"):
        loaded.set_predictor(fitted().predictor)
    loaded.predictor_kwargs = {}
    loaded.set_predictor(fitted().predictor)
    loaded.save(tmp_path / "again")
    again = DDPGAP.load(tmp_path / "again", Line(), ap_function=towards_centre)
    assert again.predictor.head[0].out_features == 32


def test_normalisation_must_be_the_same(tmp_path):
    def normalised(scale):
        env = VecNormalize(make_vec_env(Line), norm_reward=False)
        env.obs_rms.mean, env.obs_rms.var = np.zeros(2), np.full(2, scale)
        env.training = False
        return env

    model, _ = known(env=normalised(4.0))
    model.fit_predictor(epochs=6)
    model.save_predictor(tmp_path / "e.pt")
    build(DDPGAP, normalised(4.0), predictor=tmp_path / "e.pt", predictor_kwargs={})
    with pytest.raises(ValueError, match="normalised with other statistics"):
        build(DDPGAP, normalised(1.0), predictor=tmp_path / "e.pt", predictor_kwargs={})
    with pytest.raises(ValueError, match="has no VecNormalize"):
        build(DDPGAP, predictor=tmp_path / "e.pt", predictor_kwargs={})
    with pytest.raises(ValueError, match="fitted to raw observations"):
        build(DDPGAP, normalised(1.0), predictor=fitted().predictor, predictor_kwargs={})


def test_donor_of_another_algorithm_and_its_own_buffer():
    donor = build(SACAP, ap_function=towards_centre).learn(80)
    model = build(DDPGAP, ap_function=towards_centre)
    report = model.add_knowledge(donor.replay_buffer)
    assert report.rows == 80 == report.into_replay
    batch = joined(list(batches_of(donor.replay_buffer)))
    assert report.permissible == towards_centre(batch.obs, batch.actions, batch.next_obs).sum()


# ------------------------------------------------------------------ where silence would be wrong


def test_copied_model_labels_and_penalises():
    model = copy.deepcopy(build(SACAP, ap_function=towards_centre, penalty=5.0))
    model.add_knowledge(line_log(100), into="replay")
    assert model.replay_buffer.prior[0].rewards.min() < -5


def test_single_row_is_taken():
    model = build(SACAP, ap_function=towards_centre)
    assert model.add_knowledge(line_log(1)).into_replay == 1
    assert model.replay_buffer.prior[0].dones[0, 0] == 1


def test_predictor_object_knows_its_accuracy_and_normalisation():
    env = VecNormalize(make_vec_env(Line), norm_reward=False)
    model, _ = known(env=env)
    model.fit_predictor(epochs=6)
    with pytest.raises(ValueError, match="has no VecNormalize"):
        build(SACAP, predictor=model.predictor, predictor_kwargs={})
    donor = fitted()
    assert build(SACAP, predictor=donor.predictor, predictor_kwargs={}).validation_accuracy == donor.validation_accuracy


def test_statistics_of_a_fresh_vecnormalize_are_those_of_the_log():
    env = VecNormalize(make_vec_env(Line), norm_reward=False)
    log = line_log()
    log["obs"][:, 1] += 500
    log["next_obs"][:, 1] += 500
    model, _ = known(env=env, log=log)
    assert model.fit_predictor(epochs=6).accuracy > 0.85
    assert env.obs_rms.mean[1] == pytest.approx(500.5, abs=1)


def test_model_without_environment_does_not_write_a_predictor(tmp_path):
    build(DDPGAP, VecNormalize(make_vec_env(Line))).save(tmp_path / "model")
    with pytest.raises(ValueError, match="has no environment"):
        DDPGAP.load(tmp_path / "model").save_predictor(tmp_path / "e.pt")


def test_policy_can_be_taught_again_while_it_is_held():
    model, _ = known(t_k=0, learning_starts=0)
    model.fit_predictor(epochs=6)
    model.teach_policy(10, hold=100)
    model.learn(20)
    before = copy.deepcopy(model.actor.state_dict())
    model.teach_policy(50)
    assert not all(th.equal(value, before[name]) for name, value in model.actor.state_dict().items())


@pytest.mark.parametrize("algorithm", GUIDED)
def test_held_policy_acts_the_same(algorithm):
    model, _ = known(algorithm, t_k=0, learning_starts=0)
    model.fit_predictor(epochs=6)
    model.teach_policy(10, hold=100)
    obs = np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32)
    before = model.predict(obs, deterministic=True)[0]
    model.learn(30)
    np.testing.assert_array_equal(model.predict(obs, deterministic=True)[0], before)


def test_loaded_model_goes_on_testing_its_predictor(tmp_path):
    model = build(DDPGAP, predictor=fitted().predictor, predictor_kwargs={}, t_k=0, learning_starts=0)
    model.save(tmp_path / "model")
    loaded = DDPGAP.load(tmp_path / "model", Line(), seed=1)
    loaded.learn(60)
    assert sum(map(len, loaded.familiarity._right.values())) > 5


def test_frozen_predictor_that_contradicts_is_told_and_stays():
    model, _ = known(log=line_log(wrong=True), t_k=0, learning_starts=0, freeze_predictor=True)
    model.fit_predictor(epochs=6)
    before = copy.deepcopy(model.predictor.state_dict())
    with pytest.warns(UserWarning, match="is frozen, but contradicts"):
        model.learn(150)
    assert all(th.equal(value, before[name]) for name, value in model.predictor.state_dict().items())


@pytest.mark.parametrize("call", [lambda m: m.fit_predictor(epochs=0), lambda m: m.teach_policy(steps=0)])
def test_numbers_of_at_least_one(call):
    model, _ = known()
    with pytest.raises(ValueError, match="must be at least 1"):
        call(model)
