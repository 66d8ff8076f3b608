"""DDPG-AP in one file of plain PyTorch, as the paper writes it: the page to read first.

Mazumder et al., "Action Permissibility in Deep Reinforcement Learning and Application to Autonomous Driving", KDD'18
Deep Learning Day. The package does the same on Stable-Baselines3; `tests/test_minimal.py` compares the decisions.

    python examples/ddpg_ap_minimal.py    # learns to keep a car in its lane, then drives a track that it has never seen
"""

from collections import deque
from copy import deepcopy
from dataclasses import dataclass

import gymnasium as gym
import numpy as np
import torch as th
from torch import nn
from torch.nn import functional as F

NON_PERMISSIBLE, PERMISSIBLE = 0, 1


@dataclass
class Args:
    """The settings of section 5.1, for a short run."""

    steps: int = 3_000
    seed: int = 1
    gamma: float = 0.9
    tau: float = 0.001
    actor_learning_rate: float = 1e-4
    critic_learning_rate: float = 1e-3
    batch_size: int = 128
    t_k: int = 150  # steps that explore by noise
    alpha: float = 0.9  # probability of querying E, once it is accurate enough
    alpha_low: float = 0.5  # the same before that; the paper gives no value
    n_candidates: int = 128  # N
    knowledge_size: int = 10_000  # |K|
    dataset_size: int = 2_000  # N_E
    predictor_learning_rate: float = 0.01
    weight_decay: float = 0.01  # λ
    min_per_class: int = 20  # examples of each class before E is fitted


def network(n_inputs: int, *last: nn.Module) -> nn.Sequential:
    return nn.Sequential(nn.Linear(n_inputs, 128), nn.ReLU(), nn.Linear(128, 256), nn.ReLU(), nn.Linear(256, 1), *last)


class Knowledge:
    """One part of K: labelled (s, a), the oldest of a class making room for a new one of the same (section 4.2)."""

    def __init__(self, capacity: int, min_per_class: int):
        self.capacity, self.min_per_class = capacity, min_per_class
        self.classes: tuple[deque, deque] = (deque(), deque())

    def add(self, obs, action, label: int) -> None:
        own, other = self.classes[label], self.classes[1 - label]
        if len(own) + len(other) == self.capacity:
            (other if len(own) < self.min_per_class else own).popleft()  # a class that is too small grows
        own.append((obs, action))

    def sample(self, rng: np.random.Generator, n: int):
        """D_E: n // 2 examples of each class, in random order."""
        rows = [(*self.classes[c][i], c) for c in (0, 1) for i in rng.integers(len(self.classes[c]), size=n // 2)]
        rng.shuffle(rows)
        return tuple(th.as_tensor(np.array(column, dtype=np.float32)) for column in zip(*rows, strict=True))


def fit(predictor: nn.Module, optimizer, dataset, batch_size: int) -> None:
    """One pass over D_E. The optimizer's weight decay is the gradient of λ/2 ‖θ_E‖².  Eq. (7)"""
    for obs, actions, labels in zip(*(column.split(batch_size) for column in dataset), strict=True):
        logits = predictor(th.cat([obs, actions], dim=1)).squeeze(1)
        loss = F.binary_cross_entropy_with_logits(logits, labels)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


@th.no_grad()
def permits(predictor: nn.Module, obs, actions) -> np.ndarray:
    """E's verdict on n actions in one state: (obs_dim,), (n, action_dim) -> (n,) bool."""
    obs, actions = th.as_tensor(obs), th.as_tensor(actions)
    return (predictor(th.cat([obs.expand(len(actions), -1), actions], dim=1)).squeeze(1) > 0).numpy()


@th.no_grad()
def balanced_accuracy(predictor: nn.Module, dataset) -> float:
    obs, actions, labels = dataset
    correct = (predictor(th.cat([obs, actions], dim=1)).squeeze(1) > 0) == (labels > 0.5)
    return float((correct[labels == 0].float().mean() + correct[labels == 1].float().mean()) / 2)


def sample_candidates(rng: np.random.Generator, n: int) -> np.ndarray:
    """A_st by low-variance uniform sampling: one draw from each of n equal intervals of [-1, 1], (n, 1)."""
    return (-1 + 2 * (np.arange(n) + rng.random(n)) / n).astype(np.float32)[:, None]


def select_action(rng, predictor, obs, action, alpha: float, candidates) -> np.ndarray:
    """Lines 5 to 15 of Algorithm 1, for a step after t_k.

    :param action: (1,) of the actor, line 1
    :param candidates: a function that samples A_st, (n, 1)
    """
    if rng.random() < alpha and not permits(predictor, obs, action[None])[0]:  # lines 5-7
        actions = candidates()  # line 8
        permissible = actions[permits(predictor, obs, actions)]  # line 9
        if len(permissible):  # line 10
            action = rng.choice(permissible)  # line 11
    return action  # line 15


def soft_update(target: nn.Module, source: nn.Module, tau: float) -> None:
    for old, new in zip(target.parameters(), source.parameters(), strict=True):
        old.data.lerp_(new.data, tau)


def train(args: Args, env: gym.Env) -> nn.Module:
    """Algorithm 1 around DDPG; the environment says in ``info["permissible"]`` what f(s, a | s') is."""
    th.manual_seed(args.seed)
    rng = np.random.default_rng(args.seed)
    obs_dim = env.observation_space.shape[0]
    actor, critic, predictor = network(obs_dim, nn.Tanh()), network(obs_dim + 1), network(obs_dim + 1)
    target_actor, target_critic = deepcopy(actor), deepcopy(critic)
    actor_optimizer = th.optim.Adam(actor.parameters(), args.actor_learning_rate)
    critic_optimizer = th.optim.Adam(critic.parameters(), args.critic_learning_rate)
    e_optimizer = th.optim.SGD(predictor.parameters(), args.predictor_learning_rate, weight_decay=args.weight_decay)
    replay: list = []
    room = args.knowledge_size // 10  # nine tenths train E, one tenth validates it
    training = Knowledge(args.knowledge_size - room, args.min_per_class)
    validation = Knowledge(room, args.min_per_class)
    accuracy, fitted, noise = 0.0, False, np.zeros(1)
    obs, _ = env.reset(seed=args.seed)
    for t in range(args.steps):
        with th.no_grad():
            action = actor(th.as_tensor(obs)).numpy()  # line 1
        if t < args.t_k:
            noise += -0.6 * noise + 0.3 * rng.normal(size=1)  # Ornstein-Uhlenbeck
            action = np.clip(action + noise, -1, 1).astype(np.float32)  # lines 2-4
        elif fitted:
            alpha = args.alpha if accuracy >= 0.7 else args.alpha_low  # section 4.3
            action = select_action(
                rng, predictor, obs, action, alpha, lambda: sample_candidates(rng, args.n_candidates)
            )
        next_obs, reward, terminated, truncated, info = env.step(action)
        replay.append((obs, action, np.float32(reward), next_obs, np.float32(terminated)))
        (validation if rng.random() < 0.1 else training).add(obs, action, int(info["permissible"]))
        obs = next_obs
        if terminated or truncated:
            obs, _ = env.reset()
            noise[:] = 0

        if min(map(len, training.classes)) >= args.min_per_class:  # section 4.2
            fit(predictor, e_optimizer, training.sample(rng, args.dataset_size), args.batch_size)
            fitted = True
        if fitted and min(map(len, validation.classes)) > 0:
            accuracy = balanced_accuracy(predictor, validation.sample(rng, 200))

        rows = [replay[i] for i in rng.integers(len(replay), size=args.batch_size)]
        s, a, r, s2, done = (th.as_tensor(np.array(column)) for column in zip(*rows, strict=True))
        with th.no_grad():
            q = target_critic(th.cat([s2, target_actor(s2)], dim=1)).squeeze(1)
        critic_loss = F.mse_loss(critic(th.cat([s, a], dim=1)).squeeze(1), r + args.gamma * (1 - done) * q)
        critic_optimizer.zero_grad()
        critic_loss.backward()
        critic_optimizer.step()
        actor_loss = -critic(th.cat([s, actor(s)], dim=1)).mean()
        actor_optimizer.zero_grad()
        actor_loss.backward()
        actor_optimizer.step()
        soft_update(target_actor, actor, args.tau)
        soft_update(target_critic, critic, args.tau)
        if (t + 1) % 500 == 0:
            mean_reward = np.mean([row[2] for row in replay[-500:]])
            print(f"step {t + 1:,}: accuracy of E {accuracy:.2f}, mean reward {mean_reward:.1f}")
    return actor


@th.no_grad()
def drive(actor: nn.Module, env: gym.Env) -> tuple[float, bool]:
    """One episode with the actor alone: the total reward, and whether the lap was finished."""
    obs, _ = env.reset(seed=0)
    total, done = 0.0, False
    while not done:
        obs, reward, terminated, truncated, info = env.step(actor(th.as_tensor(obs)).numpy())
        total, done = total + float(reward), terminated or truncated
    return total, bool(info["lap_done"])


if __name__ == "__main__":
    th.set_num_threads(1)
    driver = train(Args(), gym.make("sb3_sap:sap/LaneKeeping-v0", track="wheel-2", laps=None))
    for track in ("eroad", "spring", "g-track-3", "ole-road-1"):
        total_reward, lap_done = drive(driver, gym.make("sb3_sap:sap/LaneKeeping-v0", track=track))
        print(f"{track}: total reward {total_reward:,.0f}, {'the whole lap' if lap_done else 'left the road'}")
