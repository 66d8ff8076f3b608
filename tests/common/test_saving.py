"""A loaded model continues like the saved one, and a file that cannot be loaded is refused in one sentence."""

import json
import threading
import zipfile

import numpy as np
import pytest
import stable_baselines3
import torch as th
from stable_baselines3.common.callbacks import CheckpointCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import FlattenExtractor
from states import assert_same_state, flat, reseed
from toy import ALGORITHMS, CONSTRAINED, GUIDED, Line, build, nearby, towards_centre

from sb3_sap import DDPG, DDPGAP, DDPGAPCE2, SACAP, TQCAP, PermissibilityNStepReplayBuffer


# SB3 warns when it loads an n-step model, although it restores n_steps.
@pytest.mark.filterwarnings("ignore:`n_steps=3` is ignored")
@pytest.mark.parametrize("n_steps", [1, 3])
@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_loaded_model_continues_like_the_saved_one(algorithm, n_steps, tmp_path):
    settings = {"alpha_low": 0.3, "knowledge_buffer_size": 60} if algorithm in GUIDED else {}
    model = build(algorithm, action_noise=NormalActionNoise(np.zeros(1), 0.2 * np.ones(1)), n_steps=n_steps, **settings)
    model.learn(120)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer")
    loaded = algorithm.load(tmp_path / "model", env=Line())
    loaded.load_replay_buffer(tmp_path / "buffer")
    assert_same_state(model, loaded)
    for one in (model, loaded):
        reseed(one)
        one.learn(60, reset_num_timesteps=False)
    assert model.num_timesteps == 180
    assert_same_state(model, loaded)
    if algorithm in GUIDED:
        assert model.predictor.fitted


@pytest.mark.parametrize("algorithm", GUIDED)
def test_second_learn_after_loading_has_no_second_warm_up(algorithm, tmp_path):
    model = build(algorithm).learn(60)
    assert model.predictor.fitted
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", env=Line(horizon=100))
    loaded.alpha = loaded.alpha_low = 0.0
    predicted = []
    predict = loaded.predict
    loaded.predict = lambda *args, **kwargs: predicted.append(1) or predict(*args, **kwargs)
    loaded.learn(5)  # counts from 0 again, below learning_starts
    assert len(predicted) == 5


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_loaded_model_predicts_the_same_without_an_environment(algorithm, tmp_path):
    model = build(algorithm).learn(30)
    model.save(tmp_path / "model")
    obs = np.random.default_rng(0).normal(size=(20, 2)).astype(np.float32)
    loaded, own = (m.predict(obs, deterministic=True)[0] for m in (algorithm.load(tmp_path / "model"), model))
    np.testing.assert_array_equal(loaded, own)


def test_load_changes_settings_and_checks_them(tmp_path):
    build(DDPGAP).learn(20).save(tmp_path / "model")
    model = DDPGAP.load(tmp_path / "model", alpha=0.25, t_k=3, n_candidates=7)
    assert (model.alpha, model.noise_steps, model.n_candidates) == (0.25, 3, 7)
    with pytest.raises(ValueError, match="`alpha` is a probability"):
        DDPGAP.load(tmp_path / "model", alpha=2)


def test_load_accepts_another_number_of_environments(tmp_path):
    build(DDPGAPCE2).learn(30).save(tmp_path / "model")
    env = stable_baselines3.common.vec_env.DummyVecEnv([Line] * 3)
    model = DDPGAPCE2.load(tmp_path / "model", env=env).learn(60)
    assert model.replay_buffer.actions.shape[1] == 3


@pytest.mark.parametrize("value", ["lin_0.001", 0.001])
@pytest.mark.parametrize("name", ["learning_rate", "actor_learning_rate", "actor_permissibility_coef"])
def test_load_accepts_schedules(name, value, tmp_path):
    build(DDPGAP).learn(20).save(tmp_path / "model")
    model = DDPGAP.load(tmp_path / "model", env=Line(), **{name: value})
    schedule = getattr(model, name)
    assert schedule == 0.001 if value == 0.001 else schedule(0.5) == pytest.approx(0.0005)
    model.learn(20)
    with pytest.raises(ValueError, match=f"`{name}` must be a number, a schedule or"):
        DDPGAP.load(tmp_path / "model", **{name: "falling"})


def test_load_changes_n_steps_and_gamma_of_the_replay_buffer(tmp_path):
    build(DDPGAP, n_steps=4, gamma=0.8).learn(20).save(tmp_path / "model")
    for n_steps in (1, 2):
        buffer = DDPGAP.load(tmp_path / "model", n_steps=n_steps, gamma=0.5).replay_buffer
        assert (buffer.n_steps, buffer.gamma) == (n_steps, 0.5)


def test_loaded_n_step_model_keeps_its_n_step_buffer(tmp_path):
    build(DDPGAP, n_steps=4, gamma=0.8).save(tmp_path / "model")
    buffer = DDPGAP.load(tmp_path / "model").replay_buffer
    assert type(buffer) is PermissibilityNStepReplayBuffer
    assert (buffer.n_steps, buffer.gamma) == (4, 0.8)


@pytest.mark.parametrize("algorithm", GUIDED)
def test_set_parameters_restores_the_predictor(algorithm):
    trained, fresh = build(algorithm).learn(80), build(algorithm, seed=2)
    parameters = trained.get_parameters()
    assert set(parameters) >= {"policy", "actor.optimizer", "critic.optimizer", "predictor", "predictor.optimizer"}
    assert not fresh.predictor.fitted
    fresh.set_parameters(parameters)
    for name, value in flat(fresh.get_parameters()).items():
        np.testing.assert_array_equal(value, flat(parameters)[name], err_msg=name)
    assert fresh.predictor.fitted


def test_loaded_optimizer_holds_the_parameters_of_the_loaded_predictor(tmp_path):
    build(DDPGAP).learn(40).save(tmp_path / "model")
    predictor = DDPGAP.load(tmp_path / "model").predictor
    in_optimizer = {id(p) for group in predictor.optimizer.param_groups for p in group["params"]}
    assert in_optimizer == {id(p) for p in predictor.parameters()}


@pytest.mark.parametrize("plain", [DDPG, stable_baselines3.DDPG])
def test_plain_and_guided_classes_refuse_the_files_of_each_other(plain, tmp_path):
    build(plain).learn(20).save(tmp_path / "plain")
    build(DDPGAP).learn(20).save(tmp_path / "guided")
    with pytest.raises(TypeError, match=r"no AP predictor.*a plain algorithm saved them.*exact_match=False"):
        DDPGAP.load(tmp_path / "plain")
    with pytest.raises(TypeError, match=r"load it with the class that saved it, such as `DDPGAP.load`"):
        plain.load(tmp_path / "guided")
    with pytest.raises(TypeError, match=r"no AP predictor.*a plain algorithm saved them.*exact_match=False"):
        build(DDPGAP).set_parameters(tmp_path / "plain")


def test_guided_model_takes_over_the_parameters_of_a_plain_one(tmp_path):
    plain = build(DDPG).learn(40)
    plain.save(tmp_path / "plain")
    model = build(DDPGAP, seed=2)
    predictor = flat(model.predictor.state_dict())
    model.set_parameters(tmp_path / "plain", exact_match=False)
    for name, value in flat(plain.get_parameters()).items():
        np.testing.assert_array_equal(value, flat(model.get_parameters())[name], err_msg=name)
    for name, value in flat(model.predictor.state_dict()).items():
        np.testing.assert_array_equal(value, predictor[name], err_msg=name)
    model.learn(40)


def test_incomplete_parameters_are_refused():
    model = build(DDPGAP)
    parameters = model.get_parameters()
    del parameters["policy"]
    with pytest.raises(ValueError, match="Names of parameters do not match"):
        model.set_parameters(parameters)


def data_of(path):
    with zipfile.ZipFile(path) as file:
        return json.loads(file.read("data")), file.namelist()


def test_function_given_by_dotted_name_is_saved_as_that_name(tmp_path):
    model = build(DDPGAPCE2, Line(labels=False), ap_function="toy.towards_centre", constraint="toy.nearby").learn(20)
    assert model.replay_buffer.ap_function is towards_centre
    model.save(tmp_path / "model")
    data, _ = data_of(tmp_path / "model.zip")
    assert data["ap_function"] == "toy.towards_centre"
    assert data["constraint"] == "toy.nearby"
    text = json.dumps({name: value for name, value in data.items() if name not in ("ap_function", "constraint")})
    assert "towards_centre" not in text
    assert "nearby" not in text
    loaded = DDPGAPCE2.load(tmp_path / "model", env=Line(labels=False)).learn(20)
    assert loaded.replay_buffer.ap_function is towards_centre
    assert loaded._constraint is nearby


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_model_file_holds_no_buffer_and_no_network_twice(algorithm, tmp_path):
    model = build(algorithm, buffer_size=20_000).learn(20)
    model.save(tmp_path / "model")
    data, names = data_of(tmp_path / "model.zip")
    assert not {"replay_buffer", "predictor", "policy", "env", "_constraint", "_previous"} & set(data)
    assert ("predictor.pth" in names) == ("predictor.optimizer.pth" in names) == (algorithm in GUIDED)
    assert (tmp_path / "model.zip").stat().st_size < 100_000
    if algorithm in CONSTRAINED:
        assert "constraint" in data


def test_checkpoint_can_be_loaded_with_its_replay_buffer(tmp_path):
    callback = CheckpointCallback(20, str(tmp_path), "run", save_replay_buffer=True)
    model = build(DDPGAP).learn(40, callback=callback)
    loaded = DDPGAP.load(tmp_path / "run_40_steps", env=Line())
    loaded.load_replay_buffer(tmp_path / "run_replay_buffer_40_steps")
    # SB3 calls `on_step` before the step is stored, so a checkpoint lacks the latest transition.
    assert loaded.num_timesteps == model.num_timesteps == 40
    assert len(loaded.replay_buffer.knowledge) == 39
    loaded.learn(10, reset_num_timesteps=False)
    assert len(loaded.replay_buffer.knowledge) == 49


@pytest.mark.parametrize("algorithm", [DDPG, DDPGAP])
def test_truncated_file_is_refused(algorithm, tmp_path):
    path = tmp_path / "model.zip"
    build(algorithm).save(path)
    whole = path.read_bytes()
    for length in [*range(0, len(whole), 1009), len(whole) - 1]:
        path.write_bytes(whole[:length])
        # Truncated after an embedded torch archive, the file still looks like a valid zip.
        with pytest.raises(ValueError, match=r"model\.zip.* (wasn't a zip-file|holds no whole model)"):
            algorithm.load(path)
    path.write_bytes(whole)
    algorithm.load(path)


def test_load_applies_new_settings_of_the_predictors_optimizer(tmp_path):
    model = build(DDPGAP).learn(60)
    model.save(tmp_path / "model")
    settings = {"net_arch": [8], "batch_size": 4, "learning_rate": 1e-5, "weight_decay": 0.0}
    extra = {"optimizer_kwargs": {"betas": (0.5, 0.9)}}
    loaded = DDPGAP.load(tmp_path / "model", env=Line(), predictor_kwargs={**settings, **extra})
    [group] = loaded.predictor.optimizer.param_groups
    assert (group["lr"], group["weight_decay"], group["betas"]) == (1e-5, 0.0, (0.5, 0.9))
    assert loaded.predictor.batch_size == 4
    # The weights and running averages are those of the file.
    saved, own = (flat(m.predictor.optimizer.state_dict()["state"]) for m in (model, loaded))
    assert saved.keys() == own.keys() != set()
    for name, value in saved.items():
        np.testing.assert_array_equal(value, own[name])
    loaded.learn(30)


@pytest.mark.parametrize(
    ("changed", "names"),
    [
        ({"optimizer_class": "SGD"}, "optimizer_class"),
        ({"optimizer_class": th.optim.AdamW}, "optimizer_class"),
        ({"activation_fn": th.nn.Tanh}, "activation_fn"),
        ({"net_arch": [9], "activation_fn": th.nn.Tanh}, "net_arch, activation_fn"),
        ({"features_extractor_class": "sb3_sap.RescaleExtractor"}, "features_extractor_class"),
    ],
    ids=str,
)
def test_load_refuses_settings_of_another_predictor(tmp_path, changed, names):
    build(DDPGAP).learn(30).save(tmp_path / "model")
    with pytest.raises(ValueError, match=f"^`predictor_kwargs` change {names} of a saved.*build a new DDPGAP"):
        DDPGAP.load(tmp_path / "model", predictor_kwargs={"net_arch": [8], "batch_size": 16, **changed})


def test_set_parameters_keeps_the_models_own_settings_and_refuses_another_optimizer(tmp_path):
    build(DDPGAP).learn(60).save(tmp_path / "model")
    other = build(DDPGAP, predictor_kwargs={"net_arch": [8], "learning_rate": 1e-5})
    other.set_parameters(tmp_path / "model")
    assert other.predictor.optimizer.param_groups[0]["lr"] == 1e-5
    with pytest.raises(TypeError, match="another optimizer than the predictor's SGD"):
        build(DDPGAP, predictor_kwargs={"net_arch": [8], "optimizer_class": "SGD"}).set_parameters(tmp_path / "model")


def test_load_applies_a_new_seed(tmp_path):
    build(DDPGAP).learn(60).save(tmp_path / "model")

    def draws(**settings):
        model = DDPGAP.load(tmp_path / "model", **settings)
        return model.exploration_rng.random(), model.replay_buffer.knowledge.rng.random()

    assert draws(seed=5) == draws(seed=5) != draws(seed=6)
    assert draws()[0] == draws()[0]  # continues where the saved generator was


@pytest.mark.parametrize("name", ["ap_function", "permissible_actions", "constraint"])
def test_function_that_cannot_be_pickled_warns_at_construction_and_is_left_out_of_the_file(tmp_path, name):
    lock = threading.Lock()
    functions = {
        "ap_function": lambda obs, actions, next_obs: lock and towards_centre(obs, actions, next_obs),
        "permissible_actions": lambda obs, actions: np.ones(len(actions), bool) if lock else None,
        "constraint": lambda obs, previous, action: nearby(obs, previous, action) if lock else None,
    }
    with pytest.warns(UserWarning, match=rf"^`{name}` .* cannot be pickled.*`load\(path, {name}=...\)`"):
        model = build(DDPGAP, **{name: functions[name]}).learn(20)
    model.save(tmp_path / "model")
    assert getattr(DDPGAP.load(tmp_path / "model"), name) is None
    with pytest.warns(UserWarning, match="cannot be pickled"):
        loaded = DDPGAP.load(tmp_path / "model", env=Line(), **{name: functions[name]})
    assert getattr(loaded.learn(20), name) is functions[name]


@pytest.mark.parametrize(
    ("algorithm", "changed"),
    [(SACAP, {"ent_coef": 0.2}), (SACAP, {"ent_coef": "auto_0.5"}), (TQCAP, {"use_sde": True})],
)
def test_load_refuses_settings_whose_effect_is_in_the_saved_state(tmp_path, algorithm, changed):
    model = build(algorithm).learn(20)
    model.save(tmp_path / "model")
    [name] = changed
    with pytest.raises(
        ValueError, match=f"^`{name}` = .* cannot be changed by `load`.*build a new {algorithm.__name__}"
    ):
        algorithm.load(tmp_path / "model", env=Line(), **changed)
    algorithm.load(tmp_path / "model", env=Line(), **{name: getattr(model, name)})


@pytest.mark.parametrize("n_steps", [(1, 3), (3, 1)])
def test_model_loaded_with_other_n_steps_learns_with_them(tmp_path, n_steps):
    build(DDPGAP, n_steps=n_steps[0]).learn(20).save(tmp_path / "model")
    loaded = DDPGAP.load(tmp_path / "model", env=Line(), n_steps=n_steps[1]).learn(20)
    assert getattr(loaded.replay_buffer, "n_steps", 1) == n_steps[1]


class Activated(FlattenExtractor):
    def __init__(self, space, activation):
        super().__init__(space)
        self.activation = activation

    def forward(self, observations):
        return self.activation(super().forward(observations))


def test_network_with_functions_as_arguments_can_be_loaded(tmp_path):
    arguments = {"features_extractor_class": Activated, "features_extractor_kwargs": {"activation": lambda x: x.tanh()}}
    model = build(DDPGAP, policy_kwargs={"net_arch": [8], **arguments}).learn(30)
    model.save(tmp_path / "model")
    DDPGAP.load(tmp_path / "model", env=Line()).learn(20)
    DDPGAP.load(tmp_path / "model", predictor_kwargs={"net_arch": (8,), "optimizer_class": th.optim.Adam})


def test_optimizer_state_of_another_torch_version_can_be_loaded():
    model = build(DDPGAP).learn(60)
    for key in ("decoupled_weight_decay", "a setting of tomorrow"):
        parameters = model.get_parameters()
        [group] = parameters["predictor.optimizer"]["param_groups"]
        if group.pop(key, None) is None:
            group[key] = None
        model.set_parameters(parameters)
        model.learn(10)


@pytest.mark.parametrize(
    ("act", "error", "sentence"),
    [
        (
            lambda path: SACAP.load(path),
            ValueError,
            "no model that SACAP can take over .* the class that saved it",
        ),
        (lambda path: DDPGAP.load(path, alhpa=0.1), TypeError, "unknown setting `alhpa`: did you mean `alpha`"),
        (lambda path: DDPGAP.load(path).learn(10), ValueError, "This model has no environment to learn in"),
    ],
)
def test_mistakes_with_saved_models_get_one_sentence(tmp_path, act, error, sentence):
    build(DDPGAP).learn(20).save(tmp_path / "model")
    with pytest.raises(error, match=sentence):
        act(tmp_path / "model")
