"""A taught policy: the critics learn about it first, and it is released gradually."""

import copy

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer
from toy import GUIDED, SMALL_FITS, Line, build, line_log, towards_centre

from sb3_sap import DDPGAP, DQNAP, SACAP, CrossQAP
from sb3_sap.guidance import taught_policy
from sb3_sap.guidance.values import q_values
from sb3_sap.predictor.states import some_states


def known(algorithm=DDPGAP, into="both", **settings):
    model = build(algorithm, ap_function=towards_centre, **(SMALL_FITS | {"t_k": 0, "learning_starts": 0} | settings))
    model.add_knowledge(line_log(), into=into)
    return model


def states(*modules):
    return [copy.deepcopy(module.state_dict()) for module in modules]


def equal(one, other):
    return all(th.equal(value, other[name]) for name, value in one.items())


@pytest.mark.parametrize("algorithm", [DDPGAP, SACAP])
def test_critics_learn_from_the_log_what_a_held_policy_is_worth(algorithm):
    model = known(algorithm)
    model.teach_policy(20, hold=30, critic_steps=0)
    actor, critic = states(model.actor, model.critic)
    entropy = model.log_ent_coef.item() if algorithm is SACAP else None
    model.teach_policy(1, hold=30, critic_steps=50)
    assert model._n_updates == 0  # the auxiliary loss counts updates of the actor by it
    assert not equal(critic, model.critic.state_dict())
    if algorithm is SACAP:
        assert model.log_ent_coef.item() == entropy
    assert not hasattr(model, "_logger")  # so that `learn` opens the user's
    moved = max(
        (a - b).abs().max().item() for a, b in zip(actor.values(), model.actor.state_dict().values(), strict=True)
    )
    assert moved < 0.01  # by the one step of imitation alone


def test_critics_of_a_held_policy_learn_its_values():
    """The reward is minus the distance from the centre, and nothing later counts, so that the values are known."""
    model = known(gamma=0.0, learning_rate=0.003, policy_kwargs={"net_arch": [64, 64]})
    model.teach_policy(100, hold=10, critic_steps=600)
    obs = np.array([[0.8, 0.5], [0.4, 0.5], [0.1, 0.5]], dtype=np.float32)
    actions = np.zeros((3, 1), dtype=np.float32)
    with th.no_grad():
        values = model.critic(th.as_tensor(obs), th.as_tensor(actions))[0][:, 0].numpy()
    np.testing.assert_allclose(values, -obs[:, 0], atol=0.06)


@pytest.mark.parametrize("kind", [*GUIDED, "n_steps", "normalised", "hindsight"])
def test_whatever_the_algorithm_and_buffer_critics_learn_and_the_actor_stays(kind):
    settings = {"t_k": 0, "learning_starts": 0, "ap_function": towards_centre} | SMALL_FITS
    log, algorithm = line_log(300), kind if isinstance(kind, type) else SACAP
    if kind == "n_steps":
        settings["n_steps"] = 3
    elif kind == "normalised":
        settings["env"] = VecNormalize(make_vec_env(Line), norm_reward=False)
    elif kind == "hindsight":
        hindsight = {"replay_buffer_class": HerReplayBuffer, "policy": "MultiInputPolicy", "env": Line("goal")}
        settings |= hindsight | {"ap_function": lambda o, a, n: np.ones(len(a), dtype=bool)}
        goals = {"achieved_goal": log["obs"][:, :1], "desired_goal": np.zeros((300, 1), np.float32)}
        space = settings["env"].observation_space
        log["obs"] = {key: goals.get(key, log["obs"]).reshape(300, *space[key].shape) for key in space}
        log["next_obs"] = log["obs"]
        log["dones"] = np.arange(300) % 10 == 9
    model = build(algorithm, **settings)
    model.add_knowledge(log)
    model.teach_policy(1, hold=5, critic_steps=0)
    actor, critic = states(model.actor, model.critic)
    model._teach_critics(3)
    assert equal(actor, model.actor.state_dict())
    assert not equal(critic, model.critic.state_dict())


def transferred(algorithm=DDPGAP, **settings):
    """A model whose E came from elsewhere, with the states that it has learned in."""
    donor = known(DDPGAP, into="knowledge")
    donor.fit_predictor()
    donor.predictor.about["states"] = some_states(donor.knowledge.prior)
    settings = SMALL_FITS | {"predictor_kwargs": {}, "t_k": 0, "learning_starts": 0} | settings
    model = build(algorithm, ap_function=towards_centre, **settings)
    model.set_predictor(donor.predictor)
    return model


@pytest.mark.parametrize("algorithm", GUIDED)
def test_critics_that_know_nothing_learn_what_e_says(algorithm, monkeypatch):
    """To them an action is worth three root mean squares of the rewards more where E permits it."""
    monkeypatch.setattr(taught_policy, "VALUE_STEPS", 500)
    model = transferred(algorithm, learning_rate=0.003, policy_kwargs={"net_arch": [64, 64]})
    model.teach_policy(50, hold=20)
    model.learn(1)
    model.replay_buffer.rewards[:] = -2.0
    model._teach_values()
    obs = th.tensor([[0.8, 0.5], [-0.8, 0.5]])
    outward, inward = th.tensor([[1.0], [-1.0]]), th.tensor([[-1.0], [1.0]])
    with th.no_grad():
        gain = q_values(model, obs, inward) - q_values(model, obs, outward)
    np.testing.assert_allclose(gain.numpy(), 6.0, atol=1.5)
    if algorithm is not CrossQAP:  # which has no target
        assert equal(states(model.critic)[0], model.critic_target.state_dict())


def test_they_do_so_once_after_the_first_rewards(monkeypatch, tmp_path):
    taught_at = []
    monkeypatch.setattr(DDPGAP, "_teach_values", lambda self: taught_at.append(self.lifetime_steps))
    model = transferred()
    model.teach_policy(5, hold=40)
    model.learn(2)
    model.save(tmp_path / "model")
    loaded = DDPGAP.load(tmp_path / "model", env=Line())
    assert (loaded.valued_at, taught_at) == (4, [])
    model.learn(8, reset_num_timesteps=False)
    assert taught_at == [4]


@pytest.mark.parametrize(("into", "imitate"), [("both", False), ("both", True), ("knowledge", True)])
def test_critics_that_can_learn_from_transitions_do_not(into, imitate):
    model = known(into=into)
    model.fit_predictor()
    model.teach_policy(1, hold=20, imitate=imitate, critic_steps=0)
    assert model.valued_at == -1


def test_an_e_that_knows_little_does_not_teach_the_critics(monkeypatch):
    monkeypatch.setattr(DDPGAP, "predictor_accurate", False)
    model = transferred()
    with pytest.warns(UserWarning, match="below the"):
        model.teach_policy(1, hold=20)
    (critic,) = states(model.critic)
    monkeypatch.setattr(DDPG, "train", lambda *args, **kwargs: None)
    model.learn(5)
    assert equal(critic, model.critic.state_dict())


def test_policy_is_released_gradually():
    """Right after the hold it moves less than a policy that was not held, in as many steps."""
    moved = []
    for hold in (20, 0):
        model = known()
        model.teach_policy(50, hold=hold, critic_steps=0)
        if hold:
            model.learn(hold)
        (before,) = states(model.actor)
        model.learn(4, reset_num_timesteps=False)
        after = model.actor.state_dict()
        moved.append(sum((after[name] - value).abs().sum().item() for name, value in before.items()))
    assert 0 < moved[0] < 0.35 * moved[1]
    model = known()
    model.teach_policy(50, hold=20, critic_steps=0)
    assert (model.held_until, model.released_at) == (20, 40)


def test_interrupted_training_leaves_a_held_policy_as_it_was(monkeypatch):
    model = known()
    model.teach_policy(5, hold=20, critic_steps=0)
    (actor,) = states(model.actor)

    def interrupted(self, gradient_steps, batch_size=64):
        next(self.actor.parameters()).data.add_(1.0)
        raise KeyboardInterrupt

    monkeypatch.setattr(DDPG, "train", interrupted)
    for train in (lambda: model._teach_critics(1), lambda: model.train(1)):
        with pytest.raises(KeyboardInterrupt):
            train()
        assert equal(actor, model.actor.state_dict())


def test_released_policy_continues_in_a_loaded_model(tmp_path):
    model = known()
    model.teach_policy(50, hold=20, critic_steps=0)
    model.learn(10)
    model.save(tmp_path / "model")
    loaded = DDPGAP.load(tmp_path / "model")
    assert (loaded.held_until, loaded.released_at) == (20, 40)


def test_critics_are_not_taught_where_nothing_is_known_to_them(monkeypatch):
    model = known(into="knowledge")
    (critic,) = states(model.critic)
    model.teach_policy(5, hold=10)
    assert equal(critic, model.critic.state_dict())
    monkeypatch.setattr(taught_policy, "CRITIC_STEPS", 3)
    both = known()
    (critic,) = states(both.critic)
    both.teach_policy(5, hold=10)
    assert not equal(critic, both.critic.state_dict())
    for bad in ({"hold": 10, "critic_steps": 5}, {"hold": 0, "critic_steps": 5}, {"hold": 10, "critic_steps": -1}):
        with pytest.raises(ValueError, match="needs continuous actions, a `hold` above 0 and transitions with rewards"):
            model.teach_policy(5, **bad)
    with pytest.raises(ValueError, match="needs continuous actions"):
        build(DQNAP).teach_policy(5, hold=10, critic_steps=5)
