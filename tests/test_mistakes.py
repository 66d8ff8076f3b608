"""Mistakes that users make, one row each, with the sentence that each of them gets."""

import contextlib
import io
import re
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import stable_baselines3 as sb3
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer, RolloutBuffer
from stable_baselines3.common.callbacks import EveryNTimesteps
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack, VecNormalize
from toy import Line, build, nearby

from sb3_sap import (
    DDPGAP,
    DDPGCE1,
    DQNAP,
    TQCAP,
    ActionPermissibility,
    ActionPermissibilityMixin,
    GuidedPolicy,
    PermissibilityCallback,
    RescaleExtractor,
    check_permissibility,
    plots,
    preset,
)
from sb3_sap.cli.main import main
from sb3_sap.envs.tracks import get_track
from sb3_sap.evaluation.policies import load_policy

LANE, TORCS = "sap/LaneKeeping-v0", "sap/TorcsLaneKeeping-v0"
#: The maximum length of a sentence, and words that say what to do or what was expected.
LONGEST = 400
HELPFUL = re.compile(
    r"\b(add|are required|build|but|call|called with|choose|did you mean|expected|form|give|invalid|known are|leave|"
    r"load|maybe meant|must|name|needs?|no setting|not a|not match|not of|or no such|pass|room for|save|such as|takes?|"
    r"unexpected|unrecognized|use|was|wasn't|wrap|write|writes)\b"
)


class Row(NamedTuple):
    """One row."""

    about: str  # the argument, flag or file that the sentence names
    make: Callable[[], object]
    error: type[Exception] | int  # or the exit code of a command
    sentence: str  # a regular expression


def having(algorithm=DDPGAP, **settings):
    """Builds a model with these settings, without training it."""
    return lambda: build(algorithm, **settings)


def training(algorithm=DDPGAP, **settings):
    """Builds it and takes some steps."""
    return lambda: build(algorithm, **settings).learn(30)


def given(call, *arguments, **settings):
    return lambda: call(*arguments, **settings)


def command(line):
    return lambda: main(shlex.split(line))


def with_spaces(action=None, observation=None, **settings):
    env = Line(**settings)
    env.action_space = action or env.action_space
    env.observation_space = observation or env.observation_space
    return env


class Labels(Line):
    """Puts a value of any type into ``info["permissible"]``."""

    def __init__(self, value):
        super().__init__()
        self.value = value

    def step(self, action):
        return *super().step(action)[:4], {"permissible": self.value}


class OldStep(Line):
    """The interface of Gym, before Gymnasium."""

    def step(self, action):
        obs, reward, _, truncated, info = super().step(action)
        return obs, reward, truncated, info


def returns(value):
    return lambda *_: value


def fails(*_):
    raise KeyError("speed")


def drive(action):
    env = gym.make(LANE)
    env.reset()
    env.step(action)


def reset(**options):
    return lambda: gym.make(LANE).reset(options=options)


def before_reset():
    gym.make(LANE).unwrapped.step(np.zeros(1, np.float32))


@pytest.fixture(scope="module", autouse=True)
def files(tmp_path_factory):
    """Files that a command or function can be given by mistake, in the current folder."""
    folder = tmp_path_factory.mktemp("mistakes")
    with contextlib.chdir(folder):
        model = build(DDPGAP).learn(100)
        model.save("line.zip")
        model.save_replay_buffer("line.pkl")
        build(DDPGAP, DummyVecEnv([Line] * 2)).save_replay_buffer("two.pkl")
        build(DDPGAP, Line(dim=2)).save_replay_buffer("plane.pkl")
        plain = sb3.DDPG("MlpPolicy", Line(), buffer_size=10, device="cpu")
        plain.save("plain.zip")
        plain.save_replay_buffer("plain.pkl")
        normalised = build(DDPGAP, VecNormalize(DummyVecEnv([Line]))).learn(20)
        normalised.save("normalised.zip")
        VecNormalize(DummyVecEnv([lambda: Line("dict")])).save("keyed_statistics.pkl")
        VecNormalize(DummyVecEnv([Line])).save("statistics.pkl")
        for name, text in {
            "text.zip": "hello",
            "text.pkl": "hello",
            "broken.xml": "<params>",
            "other.xml": "<params name='a'/>",
            "broken.csv": "x,y\n1,2\n",
            "list.yml": "- a\n- b\n",
            "broken.yml": "a: [1\n",
            "key.yml": f"{LANE}:\n  n_timesteps: 100\n  policy: MlpPolicy\n  alhpa: 0.3\n",
            "value.yml": f"{LANE}:\n  n_timesteps: 100\n  policy: MlpPolicy\n  learning_rate: fast\n",
            "policy.yml": f"{LANE}:\n  n_timesteps: 100\n  policy: MlpPolicyy\n",
            "env.yml": "sap/LaneKeping-v0:\n  n_timesteps: 100\n  policy: MlpPolicy\n",
        }.items():
            Path(name).write_text(text, encoding="utf-8")
        Path("empty").mkdir()
        yield


def trained():
    return DDPGAP.load("line.zip")


def picture_of_a_discrete_observation():
    env = with_spaces(observation=spaces.Discrete(11))
    env._observe = lambda: env.steps
    plots.plot_permissibility(build(DDPGAP, env).learn(100), 0, 0)


CONSTRUCTORS = [
    Row("alpha", having(alpha=90), ValueError, "^`alpha` is a probability from 0 to 1, but is 90"),
    Row("alpha", having(alpha=None), ValueError, "^`alpha` is a probability from 0 to 1, but is None"),
    Row("alpha_low", having(DQNAP, alpha_low="0.5"), ValueError, "^`alpha_low` is a probability .* but is '0.5'"),
    Row("t_k", having(t_k=1.5), ValueError, "^`t_k` must be a whole number of at least 0, but is 1.5"),
    Row("guidance_end", having(guidance_end=-1), ValueError, "^`guidance_end` must be a whole number of at least 0"),
    Row(
        "candidate_selection",
        having(candidate_selection="best"),
        ValueError,
        "^`candidate_selection` must be one of 'random', 'nearest', 'highest_q', 'most_permissible', but is 'best'",
    ),
    Row(
        "actor_permissibility_coef",
        having(actor_permissibility_coef="1.0"),
        ValueError,
        "^`actor_permissibility_coef` must be a number, a schedule or \"lin_<number>\", but is '1.0'",
    ),
    Row(
        "actor_permissibility_coef",
        having(actor_permissibility_coef=-1.0),
        ValueError,
        "^`actor_permissibility_coef` must be at least 0, but is -1.0",
    ),
    Row("actor_learning_rate", having(actor_learning_rate="fast"), ValueError, "^`actor_learning_rate` must be a num"),
    Row("actor_learning_rate", having(DQNAP, actor_learning_rate=1e-3), ValueError, "DQNAP has no actor: set `learn"),
    Row("learning_rate", having(learning_rate="lin_x"), ValueError, "^`learning_rate` must be a number, a schedule"),
    Row(
        "refit_growth", having(refit_growth=5), ValueError, "^`refit_growth` is a fraction from 0 to below 1, but is 5"
    ),
    Row("teaching_growth", having(teaching_growth="a"), ValueError, "^`teaching_growth` is a fraction .* but is 'a'"),
    Row("dataset_size", having(dataset_size=None), ValueError, "^`dataset_size` must be a whole number of at least 2"),
    Row("validation_size", having(validation_size=0.5), ValueError, "^`validation_size` must be a whole number"),
    Row("validation_fraction", having(validation_fraction="0.1"), ValueError, "must lie between 0 and 1, but is '0.1'"),
    Row("validation_fraction", having(validation_fraction=None), ValueError, "must lie between 0 and 1, but is None"),
    Row(
        "min_per_class", having(min_per_class=10**6), ValueError, "can never be reached: .* has room for 4500 training"
    ),
    Row("n_candidates", having(n_candidates=12.0), ValueError, "^`n_candidates` must be a whole number of at least 1"),
    Row("predictor_kwargs", having(predictor_kwargs=[64, 64]), TypeError, r"dictionaries, but one is \[64, 64\]"),
    Row("policy_kwargs", having(policy_kwargs=64), TypeError, "must be dictionaries, but one is 64"),
    Row("predictor_kwargs", having(predictor_kwargs={"lr": 1}), TypeError, "^`predictor_kwargs` holds 'lr', but Perm"),
    Row(
        "optimizer_class",
        having(predictor_kwargs={"optimizer_class": "adamm"}),
        ValueError,
        "^`optimizer_class` = 'adamm' names no optimizer of torch.optim, such as 'Adam'",
    ),
    Row(
        "features_extractor_class",
        having(predictor_kwargs={"features_extractor_class": "NatureCNN"}),
        TypeError,
        "^`features_extractor_class` must be a function or its dotted name .* but is 'NatureCNN'",
    ),
    Row(
        "features_extractor_class",
        having(
            env=Line("dict"), policy="MultiInputPolicy", policy_kwargs={"features_extractor_class": RescaleExtractor}
        ),
        ValueError,
        "^RescaleExtractor is for arrays of numbers, .*: leave `features_extractor_class` out, or wrap",
    ),
    Row("alhpa", having(alhpa=0.5), TypeError, "unexpected keyword argument 'alhpa'.*"),
    Row(
        "replay_buffer_class", having(replay_buffer_class=RolloutBuffer), ValueError, "does not feed the knowledge buf"
    ),
    Row(
        "n_steps", having(n_steps=3, replay_buffer_class=ReplayBuffer), ValueError, "^`n_steps` = 3 cannot be combined"
    ),
    Row(
        "n_steps",
        having(env=Line("dict"), policy="MultiInputPolicy", n_steps=3),
        ValueError,
        "use `n_steps=1`, or array",
    ),
    Row("MultiInputPolicy", having(env=Line("dict")), ValueError, "^You must use `MultiInputPolicy`"),
    Row("action_noise", having(action_noise={"sigma": 0.1}), ValueError, "^`action_noise` has type None, but must be"),
    Row(
        "action_noise", having(action_noise={"type": "normal"}), ValueError, "^`action_noise` needs 'sigma', the scale"
    ),
    Row(
        "action_noise",
        training(action_noise=NormalActionNoise(np.zeros(2), np.ones(2)), t_k=1000),
        ValueError,
        r"^`action_noise` turned 1 actions of Box.* into an array of shape \(1, 2\): give a noise whose mean and sigma",
    ),
    Row(
        "constraint",
        having(DQNAP, constraint=nearby),
        ValueError,
        "^`constraint` is an interval .*permissible_actions`",
    ),
    Row(
        "Mine",
        given(type, "Mine", (ActionPermissibilityMixin, sb3.PPO), {}),
        TypeError,
        "^Mine puts ActionPermissibilityMixin before an on-policy algorithm, .* choose an off-policy one",
    ),
]

SPACES = [
    Row("env", having(env=Line(n_actions=3)), ValueError, r"^DDPGAP needs an `env` with a continuous .*choose DQNAP"),
    Row("env", having(DQNAP, env=Line()), ValueError, r"^DQNAP needs an `env` with a discrete .*such as SACAP"),
    Row("env", having(env=Line(high=np.inf)), ValueError, "are bounded, .*RescaleAction or set finite bounds"),
    Row("env", having(env=with_spaces(spaces.MultiBinary(2))), ValueError, "no off-policy algorithm of SB3 takes it"),
    Row("env", having(env=Line(low=-9, high=9, action_dtype=np.int64)), ValueError, "so make its dtype np.float32"),
    Row("env", having(env=Line(low=1, high=1)), ValueError, "leave out the dimensions that are fixed"),
    Row("env", having(DQNAP, env=with_spaces(spaces.Discrete(3, start=1))), ValueError, "TransformAction"),
    Row(
        "env",
        having(env=with_spaces(observation=spaces.Discrete(3, start=1))),
        ValueError,
        "subtract `start` in gymnasium",
    ),
    Row(
        "env", having(env=with_spaces(observation=spaces.Tuple([spaces.Discrete(2)]))), ValueError, "FlattenObservation"
    ),
    Row(
        "env",
        having(env=VecFrameStack(VecNormalize(DummyVecEnv([Line])), 2)),
        ValueError,
        r"VecFrameStack on top of VecNormalize, .*the other way round, VecNormalize\(VecFrameStack\(env, ...\), ...\)",
    ),
    Row(
        "env", having(env=VecNormalize(VecNormalize(DummyVecEnv([Line])))), ValueError, "twice, .*use one VecNormalize"
    ),
]

FUNCTIONS = [
    Row("ap_function", having(ap_function=3), TypeError, "must be a function or its dotted name .*, but is 3"),
    Row("ap_function", having(ap_function="toy.missing"), ValueError, "cannot be imported .*: give 'package.module.f"),
    Row("ap_function", having(ap_function="toy.NOT_A_FUNCTION"), TypeError, "names a int, but must name a function"),
    Row(
        "ap_function", training(ap_function=fails), RuntimeError, r"fails raised KeyError: 'speed'. .*here the actions"
    ),
    Row("ap_function", training(ap_function=returns(True)), ValueError, r"shape \(\) for 1 actions, .*shape \(1,\)"),
    Row("ap_function", training(ap_function=returns(np.array([np.nan]))), TypeError, "NaN, but must return bool"),
    Row("ap_function", training(ap_function=returns([0.3])), TypeError, "values of type float64, but must return bool"),
    Row(
        "ap_function", training(ap_function=lambda obs, action: True), RuntimeError, r"with batches \(obs, actions, nex"
    ),
    Row("ap_function", training(env=Line(labels=False)), ValueError, "^There is no AP function: .*Pass `ap_function="),
    Row('info["permissible"]', training(env=Labels(None)), TypeError, r"must be a bool, but is None\.$"),
    Row('info["permissible"]', training(env=Labels(1)), TypeError, r"must be a bool, but is 1\.$"),
    Row('info["permissible"]', training(env=Labels(np.array([True]))), TypeError, r"but is array\(\[ True\]\)\.$"),
    Row("permissible", given(ActionPermissibility, Line(), True), TypeError, "but is True: pass the function itself"),
    Row("permissible_actions", having(permissible_actions=3), TypeError, "must be a function or its dotted name"),
    Row("permissible_actions", training(permissible_actions=fails), RuntimeError, r"batches \(obs, actions\) of n = 1"),
    Row("permissible_actions", training(permissible_actions=returns(None)), TypeError, "but must return bool"),
    Row(
        "permissible_actions",
        training(DQNAP, permissible_actions=lambda obs, actions: np.ones((len(actions), 1), bool)),
        ValueError,
        r"shape \(1, 1\) for 1 actions, but must return shape \(1,\)",
    ),
    Row("constraint", having(DDPGCE1, constraint=3), TypeError, "must be a function or its dotted name"),
    Row(
        "constraint", training(DDPGCE1, constraint=fails), RuntimeError, r"raised KeyError: 'speed'\. It is called wit"
    ),
    Row(
        "constraint", training(DDPGCE1, constraint=returns(None)), ValueError, r"must return \(low, high\), each of th"
    ),
    Row(
        "constraint", training(DDPGCE1, constraint=returns((1, 2, 3))), ValueError, r"shape \(1,\), but gave \(1, 2, 3"
    ),
    Row(
        "constraint", training(DDPGCE1, constraint=returns(([0, 0], [1, 1]))), ValueError, r"must return \(low, high\)"
    ),
    Row("constraint", training(DDPGCE1, constraint=returns(("a", "b"))), ValueError, r"must return \(low, high\)"),
    Row("constraint", training(DDPGCE1, constraint=returns((1.0, -1.0))), ValueError, "with low <= high, but gave"),
    Row(
        "constraint", training(DDPGCE1, constraint=returns((np.nan, np.nan))), ValueError, "with low <= high, but gave"
    ),
    Row(
        "PermissibilityCallback",
        lambda: build(DDPGAP).learn(20, callback=EveryNTimesteps(5, PermissibilityCallback())),
        ValueError,
        r"would never train the AP predictor, .*: pass it to `learn\(callback=\[...\]\)` itself",
    ),
]

CHECKS = [
    Row("env", given(check_permissibility, "Pendulum-v1"), TypeError, "single Gymnasium environment, but is 'Pend"),
    Row("env", given(check_permissibility, DummyVecEnv([Line])), TypeError, "must be a single Gymnasium environment"),
    Row("n_steps", given(check_permissibility, Line(), n_steps=10), ValueError, "number of at least 100, but is 10"),
    Row("n_steps", given(check_permissibility, Line(), n_steps=150.5), ValueError, "must be a whole number"),
    Row(
        "seed",
        given(check_permissibility, Line(), seed="a"),
        ValueError,
        "^`seed` must be a whole number of at least 0",
    ),
    Row(
        "policy", given(check_permissibility, Line(), policy=3), TypeError, "must have SB3's `predict` or be a function"
    ),
    Row(
        "ap_function", given(check_permissibility, Line(labels=False), n_steps=100), ValueError, "^There is no AP func"
    ),
    Row("ap_function", given(check_permissibility, Line(), returns(1), n_steps=100), TypeError, "but must return bool"),
    Row(
        "env",
        given(check_permissibility, with_spaces(spaces.MultiBinary(2))),
        ValueError,
        "a bounded Box or a Discrete",
    ),
    Row(
        "env.step", given(check_permissibility, OldStep(), n_steps=100), ValueError, "must return a tuple .* as Gymnas"
    ),
    Row("name", given(preset, "fst", TQCAP), ValueError, "^`name` = 'fst' is unknown: did you mean 'fast'"),
    Row("preset", given(preset, "fast"), ValueError, r"^The preset 'fast' differs .*, as in preset\('fast', TQCAP\)"),
    Row(
        "algo", given(preset, "fast", sb3.SAC), ValueError, "^`algo` = SAC is neither an algorithm of sb3_sap nor deri"
    ),
    Row("algo", given(preset, "fast", "tqcap"), ValueError, "^`algo` = 'tqcap' is unknown: did you mean 'tqc_ap'"),
    Row("steps", given(preset, "paper", steps="many"), TypeError, "^`steps` must be a number of training steps"),
    Row("model", lambda: plots.plot_permissibility(build(DDPGAP), 0, 0), ValueError, "train it first, until K holds"),
    Row("variable", lambda: plots.plot_permissibility(trained(), 7, 0), ValueError, "no such variable of a Box in Box"),
    Row(
        "variable", lambda: plots.plot_permissibility(trained(), "x", 0), ValueError, "no such variable of a Box in Box"
    ),
    Row("variable", lambda: plots.plot_permissibility(trained(), ("x", 0), 0), ValueError, "there is no such variable"),
    Row("variable", picture_of_a_discrete_observation, ValueError, r"no such variable of a Box in Discrete\(11\)"),
    Row("action", lambda: plots.plot_permissibility(trained(), 0, 3), ValueError, "or no such action in Box"),
    Row("runs", given(plots.return_curves, {}), ValueError, "^`runs` is empty: give a name and what `Monitor` wrote"),
    Row("nowhere", given(plots.return_curves, {"a": "nowhere"}), FileNotFoundError, "as SB3's Monitor writes them"),
    Row("model", lambda: GuidedPolicy(sb3.SAC("MlpPolicy", Line())), TypeError, "^`model` must be a guided model"),
]

FILES = [
    Row(
        "AP predictor", lambda: DDPGAP.load("plain.zip", env=Line()), TypeError, "so a plain algorithm saved them: buil"
    ),
    Row("text.zip", lambda: DDPGAP.load("text.zip"), ValueError, "the file text.zip wasn't a zip-file"),
    Row("knowledge", lambda: sb3.DDPG.load("line.zip"), TypeError, "load it with the class that saved it, such as `DD"),
    Row("alpha", lambda: DDPGAP.load("line.zip", alpha=3), ValueError, "^`alpha` is a probability from 0 to 1"),
    Row("ap_function", lambda: DDPGAP.load("line.zip", ap_function="a.b"), ValueError, "'a.b' cannot be imported"),
    Row(
        "predictor_kwargs",
        lambda: DDPGAP.load("line.zip", predictor_kwargs={"net_arch": [4]}),
        ValueError,
        "^`predictor_kwargs` change net_arch of a saved predictor, .*: build a new DDPGAP with them",
    ),
    Row("spaces", lambda: DDPGAP.load("line.zip", env=Line(dim=2)), ValueError, "^Action spaces do not match: Box"),
    Row("set_parameters", lambda: build(DDPGAP).set_parameters("plain.zip"), TypeError, "exact_match=False"),
    Row(
        "predictor_kwargs",
        lambda: build(DDPGAP, predictor_kwargs={"optimizer_class": "SGD"}).set_parameters("line.zip"),
        TypeError,
        "state of another optimizer than the predictor's SGD: build the model with the `predictor_kwargs`",
    ),
    Row("buffer", lambda: build(DDPGAP).load_replay_buffer("plain.pkl"), TypeError, "load one saved by DDPGAP"),
    Row("environments", lambda: build(DDPGAP).load_replay_buffer("two.pkl"), ValueError, "of 2 environments, but thi"),
    Row(
        "action_space", lambda: build(DDPGAP).load_replay_buffer("plane.pkl"), ValueError, "load one that was saved in"
    ),
    Row(
        "nowhere.zip", lambda: load_policy("nowhere.zip"), FileNotFoundError, "no model file nowhere.zip: give the .zip"
    ),
    Row(
        "text.zip", lambda: load_policy(Path("text.zip")), ValueError, "not a whole model file .*: save the model agai"
    ),
    Row("no.pkl", lambda: load_policy("line.zip", "no.pkl"), FileNotFoundError, "no.pkl: give the one that `VecN"),
    Row(
        "VecNormalize", lambda: load_policy("line.zip", "text.pkl"), ValueError, "text.pkl cannot be read .*: give what"
    ),
    Row("statistics", lambda: load_policy("line.zip", "keyed_statistics.pkl"), ValueError, "but the model takes"),
    Row(
        "--vecnormalize", lambda: load_policy("line.zip", "statistics.pkl"), ValueError, "learned on raw observations: "
    ),
    Row("--vecnormalize", lambda: load_policy("normalised.zip"), ValueError, "statistics the file does not hold: give"),
]

ENVIRONMENTS = [
    Row("track", given(gym.make, LANE, track="wheel2"), ValueError, "got 'wheel2': did you mean 'wheel-2'"),
    Row("track", given(gym.make, LANE, track="random:x"), ValueError, "did you mean 'random' or 'random:SEED'"),
    Row("broken.xml", given(get_track, "broken.xml"), ValueError, "is not a readable TORCS track file"),
    Row("Main Track", given(get_track, "other.xml"), ValueError, "has no section 'Main Track'.*not a TORCS track"),
    Row("broken", given(get_track, "broken.csv"), ValueError, "^Track table 'broken' must begin with '# width_m"),
    Row(
        "laps", given(gym.make, LANE, laps=0), ValueError, "must be a positive whole number, or None to drive on, got 0"
    ),
    Row("laps", given(gym.make, LANE, laps=1.5), ValueError, "must be a positive whole number, or None"),
    Row("speed", given(gym.make, LANE, speed=500), ValueError, r"^speed must lie in \[5, 144\] km/h, got 500"),
    Row("speed", given(gym.make, LANE, speed="fast"), ValueError, r"^speed must lie in \[5, 144\] km/h, got 'fast'"),
    Row(
        "speed", given(gym.make, TORCS, speed="fast"), ValueError, "^speed must lie above 0 and not above 300 km/h, got"
    ),
    Row(
        "start", given(gym.make, TORCS, start="pits"), ValueError, "^start must be one of 'training', 'race', got 'pits"
    ),
    Row("control_step", given(gym.make, LANE, control_step="a"), ValueError, "must be a positive number of seconds"),
    Row(
        "control_step", given(gym.make, TORCS, control_step=0.0015), ValueError, "must be a positive multiple of 0.002"
    ),
    Row("control_step", given(gym.make, TORCS, control_step="a"), ValueError, "must be a positive multiple of 0.002 s"),
    Row("off_track_reward", given(gym.make, LANE, off_track_reward="a"), ValueError, "must be a number, got 'a'"),
    Row("options", reset(dist=3), ValueError, "may hold distance, track_pos and angle, got 'dist': did you mean 'dist"),
    Row("track_pos", reset(track_pos=30), ValueError, r"must lie in \[-1, 1\], got 30"),
    Row("action", given(drive, np.array([np.nan])), ValueError, r"^action must be numbers in \[-1, 1\], got \[nan\]"),
    Row(
        "action", given(drive, np.zeros(3)), ValueError, r"^action must be of Box\(-1.0, 1.0, \(1,\), float32\), got ar"
    ),
    Row("action", given(drive, "left"), ValueError, "^action must be of Box.*, got 'left'"),
    Row("reset", before_reset, RuntimeError, r"^step\(\) was called before reset\(\)"),
]

COMMANDS = [
    Row("--algo", command("demo --algo ppo"), 2, "argument --algo: invalid choice: 'ppo' .choose from 'ddpg'"),
    Row("--steps", command("demo --steps 0"), 2, "argument --steps: must be 1 or more, but is 0"),
    Row("--seed", command("demo --seed -1"), 2, "argument --seed: must be 0 or more, but is -1"),
    Row("--setps", command("demo --setps 3"), 2, "unrecognized arguments: --setps 3"),
    Row("papper", command("demo --preset papper"), 1, "'papper' is unknown: did you mean 'paper'"),
    Row("track", command("demo --track wheel2"), 1, "got 'wheel2': did you mean 'wheel-2'"),
    Row("broken.xml", command("demo --track broken.xml"), 1, "is not a readable TORCS track file"),
    Row("COMMAND", command("nothing"), 2, "invalid choice: 'nothing' .choose from 'demo', 'compare', 'evaluate'"),
    Row("nothing.zip", command("evaluate nothing.zip"), 1, "There is no model file nothing.zip: give the .zip"),
    Row("text.zip", command("evaluate text.zip"), 1, "is not a whole model file"),
    Row("--tracks", command("evaluate line.zip --tracks"), 2, "argument --tracks: expected at least one argument"),
    Row("track", command("evaluate line.zip --tracks nowhere"), 1, "track must be a known name or the path"),
    Row("no.pkl", command("evaluate line.zip --vecnormalize no.pkl"), 1, "There is no file no.pkl: give the one"),
    Row("COMMAND", command("benchmark runn"), 2, "argument COMMAND: invalid choice: 'runn' .choose from 'run'"),
    Row("ddpgap", command("benchmark run --configurations ddpgap:default"), 1, "did you mean 'ddpg_ap'"),
    Row("papr", command("benchmark run --configurations ddpg_ap:papr"), 1, "'papr' is unknown: did you mean 'paper'"),
    Row(
        "alpha",
        command("benchmark run --configurations 'ddpg_ap:paper[alpha]'"),
        1,
        "'alpha' is not of the form key=value",
    ),
    Row(
        "alhpa",
        command("benchmark run --configurations 'ddpg_ap:paper[alhpa=1]' --out out"),
        1,
        "has no setting 'alhpa'",
    ),
    Row("--jobs", command("benchmark run --jobs 0"), 2, "argument --jobs: must be 1 or more, but is 0"),
    Row(
        "nowhere", command("push-to-hub nowhere --repo-id a/b --dry-run"), 1, "no model nowhere: give the output folder"
    ),
    Row(
        "--algo", command("push-to-hub line.zip --repo-id a/b"), 1, "does not say how it was made: add --algo and --env"
    ),
    Row("--repo-id", command("push-to-hub line.zip"), 2, "the following arguments are required: --repo-id"),
    Row(
        "--algo", command("push-to-hub line.zip --repo-id a/b --algo dpg --env a --command b"), 1, "is unknown: did you"
    ),
    Row("COMMAND", command("torcs instal"), 2, "argument COMMAND: invalid choice: 'instal' .choose from 'install'"),
    Row(
        "nothing.json", command("torcs replay a.csv.gz --start nothing.json"), 1, "There are no start conditions nothin"
    ),
]

TRAIN = f"train --algo ddpg_ap --env {LANE} -n 20"
ZOO = [
    Row(
        "--algo", command(f"train --algo ddpgap --env {LANE}"), 1, "`--algo` 'ddpgap' is unknown: did you mean 'ddpg_ap"
    ),
    Row(
        "sap/LaneKeping-v0", command("train --algo ddpg_ap --env sap/LaneKeping-v0"), 1, "you maybe meant sap/LaneKeep"
    ),
    Row("env", command("train --algo ddpg_ap --env CartPole-v1 -n 20"), 1, "a continuous .* choose DQNAP or QRDQNAP"),
    Row("-n", command(f"{TRAIN} -n x"), 2, "argument -n/--n-timesteps: invalid int value: 'x'"),
    Row("--nonsense", command(f"{TRAIN} --nonsense"), 2, "unrecognized arguments: --nonsense"),
    Row("alhpa", command(f"{TRAIN} -params alhpa:3"), 1, "'alhpa' is unknown to ddpg_ap: did you mean 'alpha'"),
    Row("alpha", command(f"{TRAIN} -params alpha:3"), 1, "`alpha` is a probability from 0 to 1, but is 3"),
    Row("-params", command(f"{TRAIN} -params alpha:much"), 2, "'much' is no Python .*; write it like alpha:\"'much'\""),
    Row(
        "--env-kwargs", command(f"{TRAIN} --env-kwargs track:eroad"), 2, "'eroad' is no Python .*; write it like track"
    ),
    Row("nowhere.yml", command(f"{TRAIN} -conf nowhere.yml"), 1, "There is no configuration file nowhere.yml"),
    Row(
        "list.yml",
        command(f"{TRAIN} -conf list.yml"),
        1,
        "must hold environments with their settings, but holds a list",
    ),
    Row("broken.yml", command(f"{TRAIN} -conf broken.yml"), 1, "is not YAML in line 2: expected ',' or ']', but got"),
    Row("key.yml", command(f"{TRAIN} -conf key.yml"), 1, "the key 'alhpa' is unknown to ddpg_ap: did you mean 'alpha'"),
    Row("learning_rate", command(f"{TRAIN} -conf value.yml"), 1, "must be a number or \"lin_<number>\", but is 'fast'"),
    Row("policy", command(f"{TRAIN} -conf policy.yml"), 1, "'MlpPolicyy' is unknown: did you mean 'MlpPolicy'"),
    Row(
        "env.yml", command(f"{TRAIN} -conf env.yml"), 1, "the environment 'sap/LaneKeping-v0' is unknown: did you mean"
    ),
    Row(
        "--gym-packages", command(f"{TRAIN} --gym-packages nothing"), 1, "'nothing' cannot be imported .*: name a modul"
    ),
    Row(
        "--n-jobs", command(f"optimize --algo ddpg_ap --env {LANE} --n-jobs 0"), 1, "must be at least 1, or -1 for a w"
    ),
    Row(
        "--storage", command(f"retest --algo ddpg_ap --env {LANE}"), 1, "needs a study: give `--storage` and `--study-n"
    ),
    Row(
        "--trial-id", command(f"optimize --algo ddpg_ap --env {LANE} --trial-id 3"), 1, "needs the study that it belong"
    ),
    Row(
        "--guidance-only", command(f"optimize --algo ddpg --env {LANE} --guidance-only"), 1, "leave it out, or choose a"
    ),
    Row(
        "--validation-tracks",
        command("optimize --algo ddpg_ap --env Pendulum-v1 --validation-tracks eroad"),
        1,
        "needs one of sap/LaneKeeping-v0, sap/TorcsLaneKeeping-v0, not Pendulum-v1",
    ),
    Row("plot", command("plot nothing"), 1, "`plot` needs to know what: choose one of 'train', 'all', 'file', 'study'"),
]


def sentence_of(mistake):
    """The message of the exception, or what a command writes to the standard error."""
    if isinstance(mistake.error, type):
        with pytest.raises(mistake.error) as raised:
            mistake.make()
        assert raised.type is mistake.error, raised.value
        return str(raised.value)
    error = io.StringIO()
    with contextlib.redirect_stderr(error), contextlib.redirect_stdout(io.StringIO()):
        try:
            code = mistake.make()
        except SystemExit as end:  # by argparse, which prints the usage first
            code = end.code
    assert code == mistake.error
    text = error.getvalue().rstrip("\n")
    return text if code == 1 else text.splitlines()[-1]


def check(mistake):
    sentence = sentence_of(mistake)
    assert re.search(mistake.sentence, sentence), sentence
    assert len(sentence) <= LONGEST
    assert "\n" not in sentence
    assert mistake.about in sentence
    assert HELPFUL.search(sentence), sentence


def names(mistakes):
    return [f"{number}-{mistake.about}" for number, mistake in enumerate(mistakes)]


PYTHON = [*CONSTRUCTORS, *SPACES, *FUNCTIONS, *CHECKS, *FILES, *ENVIRONMENTS, *COMMANDS]


@pytest.mark.filterwarnings("ignore:`.*cannot be pickled", "ignore:`t_k`")
@pytest.mark.parametrize("mistake", PYTHON, ids=names(PYTHON))
def test_mistake_gets_one_sentence(mistake):
    check(mistake)


@pytest.mark.parametrize("mistake", ZOO, ids=names(ZOO))
def test_mistake_in_commands_of_rl_zoo_gets_one_sentence(mistake):
    pytest.importorskip("rl_zoo3", reason="RL Zoo is not installed: pip install sb3-sap[zoo]")
    check(mistake)
