"""When the predictor is fitted and validated, how that controls alpha, and which metrics are logged."""

import warnings
from itertools import pairwise
from unittest.mock import Mock

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, EvalCallback, EveryNTimesteps
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import DummyVecEnv
from toy import GUIDED, Line, build

from sb3_sap import DDPGAP, PermissibilityCallback
from sb3_sap.predictor.knowledge import LabelledActions


class Recorder(PermissibilityCallback):
    """Records when it would have fitted and validated."""

    def __init__(self):
        super().__init__()
        self.fits, self.validations = [], []

    def fit(self):
        self.fits.append(self.model.num_timesteps)
        self.model.predictor.n_updates += 1

    def validate(self):
        self.validations.append(self.model.num_timesteps)


class NoCallback(BaseCallback):
    def _on_step(self):
        return True


@pytest.mark.parametrize(
    ("settings", "n_envs", "expected"),
    [
        ({"train_freq": 1}, 1, [8, 9, 10, 11, 12]),
        # As often as the base algorithm trains,
        ({"train_freq": 4}, 1, [8, 12]),
        ({"train_freq": 4, "gradient_steps": 2}, 1, [8, 8, 12, 12]),
        ({"train_freq": 4, "gradient_steps": 9}, 1, [8] * 4 + [12] * 4),
        ({"train_freq": 4, "gradient_steps": -1}, 1, [8] * 4 + [12] * 4),
        ({"train_freq": (1, "episode")}, 1, [5, 10, 15]),
        ({"train_freq": 2}, 2, [8, 12]),
        # or at every step,
        ({"train_freq": 4, "predictor_gradient_steps": -1}, 1, [8] * 4 + [12] * 4),
        ({"train_freq": (1, "episode"), "predictor_gradient_steps": -1}, 1, [5] * 5 + [10] * 5 + [15] * 5),
        ({"train_freq": 4, "refit_growth": 0.01}, 1, [8] * 4 + [12] * 4),
        ({"train_freq": 4, "refit_growth": 0.01, "predictor_gradient_steps": 3}, 1, [8] * 3 + [12] * 3),
        # which is a vectorised step, after which two transitions are new.
        ({"train_freq": 2, "predictor_gradient_steps": -1}, 2, [8] * 2 + [12] * 2),
        ({"train_freq": 1}, 2, [8, 10, 12]),
        # If the base algorithm never trains, the predictor is still fitted.
        ({"train_freq": 1, "gradient_steps": 0}, 1, [8, 9, 10, 11, 12]),
    ],
)
def test_fits_after_each_rollout_are_as_many_as_the_settings_say(settings, n_envs, expected):
    callback = Recorder()
    env = DummyVecEnv([lambda: Line(horizon=5)] * n_envs)
    model = build(DDPGAP, env, seed=1, min_per_class=1, **{"gradient_steps": 1} | settings)
    # The first labels of a class may come late: K gets some of each before the run.
    knowledge = model.replay_buffer.knowledge
    while min(knowledge.counts("train") + knowledge.counts("validation")) == 0:
        knowledge.add(np.zeros((2, 2)), np.zeros((2, 1)), np.array([True, False]))
    first = expected[0]
    model.learn(12, callback=callback)
    # Fits begin with the first rollout; `expected` begins where the cases differ most.
    assert [step for step in callback.fits if step >= first] == expected
    assert callback.validations == sorted(set(callback.fits))


@pytest.mark.parametrize(
    ("growth", "steps"),
    [
        (0.0, list(range(1, 13))),
        (
            0.25,
            [1, 2, 3, 4, 6, 7, 9, 11],
        ),  # 4 up to step 4, then 4·(1 + ln(t/4)): 5 at 5.1, 6 at 6.6, 7 at 8.5, 8 at 10.9
    ],
)
def test_refit_growth_gives_a_geometric_schedule(growth, steps):
    model = build(DDPGAP, refit_growth=growth)
    assert [now for now in range(1, 13) if model.refits_due(now - 1, now)] == steps
    assert model.refits_due(0, 12) == len(steps)


def test_geometric_schedule_has_a_maximum_gap_if_the_auxiliary_loss_has_its_own_schedule():
    model = build(DDPGAP, refit_growth=0.1, teaching_growth=0.0)
    fits = [now for now in range(1, 1001) if model.refits_due(now - 1, now)]
    assert fits[:11] == [*range(1, 11), 12]
    # A tenth of 150 steps is the maximum gap of 15; without it the last gap would be 100.
    assert {later - fit for fit, later in pairwise(fits) if fit > 150} == {15}


def test_callback_fits_as_often_as_refits_are_due():
    callback = Recorder()
    env = DummyVecEnv([lambda: Line(horizon=5)] * 2)
    model = build(DDPGAP, env, refit_growth=0.1, min_per_class=1).learn(200, callback=callback)
    late = [step for step in callback.fits if step > 100]
    assert len(late) == model.refits_due(50, 100) == 7  # 10·ln 2
    assert set(callback.validations) <= set(callback.fits)


def test_after_guidance_the_predictor_is_fitted_every_fifth_time_without_effect_on_the_actor(monkeypatch):
    callback = Recorder()
    build(DDPGAP, guidance_end=30, min_per_class=1).learn(60, callback=callback)
    assert [step for step in callback.fits if step >= 30] == [30, 35, 40, 45, 50, 55, 60]

    rarely = build(DDPGAP, guidance_end=30, min_per_class=1).learn(60)
    monkeypatch.setattr("sb3_sap.guidance.auxiliary_update.FITS_AFTER_GUIDANCE", 1)
    often = build(DDPGAP, guidance_end=30, min_per_class=1).learn(60)
    assert rarely.predictor.n_updates < often.predictor.n_updates
    assert all(map(th.equal, rarely.actor.parameters(), often.actor.parameters()))


def test_after_guidance_fits_continue_if_the_auxiliary_loss_has_its_own_schedule():
    callback = Recorder()
    settings = {"actor_permissibility_coef": 1.0, "teaching_growth": 0.0}
    build(DDPGAP, guidance_end=30, min_per_class=1, **settings).learn(60, callback=callback)
    assert [step for step in callback.fits if step >= 30] == list(range(30, 61))


def test_geometric_schedule_counts_the_steps_of_all_learns():
    model, callback = build(DDPGAP, refit_growth=0.1, min_per_class=1), Recorder()
    model.learn(100).learn(100, callback=callback)
    assert len(callback.fits) == model.refits_due(100, 200) == 6  # 10·ln 2 is 6.9


def test_predictor_is_not_fitted_before_each_class_has_its_minimum():
    callback = Recorder()
    labels = iter([True] * 10 + [False] * 30)

    def scripted(obs, actions, next_obs):
        return np.array([next(labels)])

    model = build(DDPGAP, ap_function=scripted, min_per_class=5)
    model.replay_buffer.knowledge.rng = Mock(random=lambda: 0.5)  # everything goes into the training part
    model.learn(40, callback=callback)
    assert callback.fits == list(range(15, 41))


def test_fit_and_validation_use_balanced_samples_of_disjoint_parts(monkeypatch):
    drawn = []
    model = build(DDPGAP, dataset_size=30, validation_size=14)
    monkeypatch.setattr(model.predictor, "fit", lambda data: drawn.append(data) or 0.5)
    monkeypatch.setattr(model.predictor, "recall", lambda data: drawn.append(data) or (0.5, 0.9))
    model.predictor.n_updates += 1
    model.learn(40)
    assert {len(data.labels) for data in drawn} == {30, 14}
    assert {data.labels.mean() for data in drawn} == {0.5}
    parts = [{tuple(o) for d in drawn if len(d.labels) == n for o in d.observations.tolist()} for n in (30, 14)]
    assert not parts[0] & parts[1]
    assert model.validation_accuracy == pytest.approx(0.7)


@pytest.mark.parametrize(
    ("accuracies", "alpha", "alpha_low", "expected"),
    [
        ((0.2, 0.8), 0.9, 0.5, 0.5),
        ((0.699, 0.699), 0.9, 0.5, 0.5),
        ((0.7, 0.7), 0.9, 0.5, 0.9),
        ((0.5, 1.0), 0.9, 0.5, 0.9),
        ((0.0, 1.0), 0.3, 0.5, 0.3),  # an α below alpha_low is never raised
        ((1.0, 1.0), 0.3, 0.5, 0.3),
        ((1.0, 1.0), 0.0, 0.5, 0.0),
        (None, 0.9, 0.5, 0.5),  # before the first validation
    ],
)
def test_alpha_is_lowered_while_the_validation_accuracy_is_below_the_threshold(accuracies, alpha, alpha_low, expected):
    model = build(DDPGAP, alpha=alpha, alpha_low=alpha_low)
    if accuracies is not None:
        model.predictor.recall = lambda data: accuracies
        model.set_logger(Logger(None, []))
        callback = PermissibilityCallback()
        callback.init_callback(model)
        model.replay_buffer.knowledge.sample = lambda *args: LabelledActions(None, None, None)
        callback.validate()
        assert callback.logger.name_to_value["sap/validation_accuracy"] == pytest.approx(sum(accuracies) / 2)
        assert callback.logger.name_to_value["sap/validation_accuracy_non_permissible"] == accuracies[0]
        assert callback.logger.name_to_value["sap/validation_accuracy_permissible"] == accuracies[1]
    assert model.current_alpha == expected


def default_fits(monkeypatch):
    """Counts the fits of default callbacks; Recorder overrides what is patched."""
    fits = []
    monkeypatch.setattr(PermissibilityCallback, "fit", lambda self: fits.append(self.model.num_timesteps))
    return fits


@pytest.mark.parametrize("algorithm", GUIDED)
@pytest.mark.parametrize(
    "given",
    [
        None,
        NoCallback(),
        [NoCallback()],
        lambda local, glob: True,
        CallbackList([NoCallback()]),
        EveryNTimesteps(5, NoCallback()),
    ],
    ids=["none", "callback", "list", "function", "CallbackList", "EventCallback"],
)
def test_model_installs_the_callback_in_every_learn(given, algorithm, monkeypatch):
    fits = default_fits(monkeypatch)
    build(algorithm).learn(100, callback=given)
    assert fits[-10:] == list(range(91, 101))


@pytest.mark.filterwarnings("ignore::tqdm.TqdmExperimentalWarning")
@pytest.mark.parametrize("progress_bar", [False, True])
@pytest.mark.parametrize(
    "wrap",
    [
        lambda c: c,
        lambda c: [NoCallback(), c],
        lambda c: CallbackList([c]),
        lambda c: [CallbackList([NoCallback(), c])],
    ],
    ids=["itself", "list", "CallbackList", "nested"],
)
def test_callback_of_the_user_replaces_the_default(wrap, progress_bar, monkeypatch):
    fits, callback = default_fits(monkeypatch), Recorder()
    build(DDPGAP).learn(30, callback=wrap(callback), progress_bar=progress_bar)
    assert fits == []
    assert callback.fits[-10:] == list(range(21, 31))


def test_subclass_of_the_callback_can_override_on_step():
    class Mine(Recorder):
        def _on_step(self):
            return self.num_timesteps < 30

    callback = Mine()
    assert build(DDPGAP).learn(100, callback=callback).num_timesteps == 30
    assert callback.fits[-9:] == list(range(21, 30))  # SB3 does not end a rollout that a callback stops


@pytest.mark.parametrize(
    "wrap",
    [
        lambda c: EveryNTimesteps(5, c),
        lambda c: [NoCallback(), EvalCallback(DummyVecEnv([Line]), callback_after_eval=c)],
        lambda c: EvalCallback(DummyVecEnv([Line]), callback_on_new_best=c),
        lambda c: EvalCallback(DummyVecEnv([Line]), callback_after_eval=CallbackList([c])),
    ],
    ids=["EveryNTimesteps", "after_eval", "on_new_best", "list in after_eval"],
)
def test_callback_inside_an_event_callback_is_refused(wrap):
    # SB3's event callbacks do not pass the end of a rollout on to their children.
    with pytest.raises(ValueError, match=r"inside (EveryNTimesteps|EvalCallback) would never train.*learn\(callback="):
        build(DDPGAP).learn(30, callback=wrap(Recorder()))


@pytest.mark.parametrize("label", [True, False])
@pytest.mark.parametrize("knowledge_buffer_size", [100, 10_000])
def test_constant_labels_warn_once(label, knowledge_buffer_size):
    model = build(
        DDPGAP,
        ap_function=lambda o, a, n: np.full(len(a), label),
        knowledge_buffer_size=knowledge_buffer_size,
        learning_starts=10_000,
    )
    word = "permissible" if label else "non-permissible"
    with pytest.warns(UserWarning, match=f"AP function labelled all of the first 1000 actions {word}") as caught:
        model.learn(1100)
    assert len(caught) == 1


def test_rare_labels_do_not_warn():
    labels = iter([False] + [True] * 1100)
    model = build(DDPGAP, ap_function=lambda o, a, n: np.array([next(labels)]), learning_starts=10_000)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.learn(1100)


def test_permissible_rate_counts_the_labels_of_the_rollout():
    rates = []

    class Rates(BaseCallback):
        def _on_step(self):
            return True

        def _on_rollout_end(self):
            rates.append(self.logger.name_to_value["sap/permissible_rate"])
            self.logger.name_to_value.clear()
            self.logger.name_to_count.clear()

    labels = iter([True, True, True, False, False, False, False, False, True, True, False, False])
    build(DDPGAP, ap_function=lambda o, a, n: np.array([next(labels)]), train_freq=4).learn(12, callback=[Rates()])
    assert rates == [0.75, 0.0, 0.5]


def test_every_metric_is_logged():
    class Everything(Logger):
        dumped = {}  # noqa: RUF012

        def dump(self, step=0):
            self.dumped.update(self.name_to_value)
            super().dump(step)

    model = build(DDPGAP, alpha=1.0, alpha_low=1.0)
    model.set_logger(Everything(None, []))
    model.learn(200)
    logged = {name.removeprefix("sap/"): v for name, v in model.logger.dumped.items() if name.startswith("sap/")}
    assert set(logged) == {
        "validation_accuracy",
        "validation_accuracy_permissible",
        "validation_accuracy_non_permissible",
        "predictor_loss",
        "consultation_rate",
        "rejection_rate",
        "fallback_rate",
        "permissible_rate",
        "alpha",
    }
    assert logged["alpha"] == logged["consultation_rate"] == 1.0
    assert all(0 <= value <= 1 for name, value in logged.items() if name != "predictor_loss")
