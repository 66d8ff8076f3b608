"""A scripted environment of episodes with costs, and the labels that the definition of an event gives it."""

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.vec_env import DummyVecEnv

BOX = spaces.Box(-1, 1, (1,), np.float32)
#: Episodes as (number of steps, whether the last one terminates, steps with a cost), over and over.
FIRST = [(3, True, ()), (4, False, (1,))]
SECOND = [(1, True, ()), (5, False, ()), (2, False, (0,))]
THIRD = [(7, True, (2, 3)), (1, False, ())]


class Scripted(gym.Env):
    """Observes (environment, episode, step); the reward is 10."""

    def __init__(self, episodes=FIRST, number=0, keyed=False, action_space=BOX):
        self.episodes, self.number, self.keyed, self.action_space = episodes, number, keyed, action_space
        box = spaces.Box(0, 1000, (3,), np.float32)
        self.observation_space = spaces.Dict({"place": box, "again": box}) if keyed else box
        self.episode, self.time = -1, 0

    def _observe(self):
        values = np.array([self.number, self.episode, self.time], np.float32)
        return {"place": values, "again": 2 * values} if self.keyed else values

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.episode, self.time = self.episode + 1, 0
        return self._observe(), {}

    def step(self, action):
        length, terminates, costs = self.episodes[self.episode % len(self.episodes)]
        cost = float(self.time in costs)
        self.time += 1
        ends = self.time == length
        return self._observe(), 10.0, ends and terminates, ends and not terminates, {"cost": cost}


def envs(*scripts, **settings):
    scripts = scripts or (FIRST,)
    return DummyVecEnv([lambda s=s, i=i: Scripted(s, i, **settings) for i, s in enumerate(scripts)])


def steps_of(obs):
    """The places where each row of R was observed, as `labels_of` writes them."""
    return [[tuple(int(x) for x in place) for place in row] for row in obs]


def labels_of(model):
    """The labels in K by (environment, episode, step)."""
    knowledge, found = model.knowledge, {}
    observed = knowledge.observations.get("", knowledge.observations.get("place"))
    for part, slots in knowledge.parts.items():
        for label in (0, 1):
            for row in observed[knowledge._offset[part] + slots.slots(label)]:
                place = tuple(int(x) for x in row)
                assert place not in found
                found[place] = bool(label)
    return found


def expected(scripts, steps, horizon, event):
    """The labels after ``steps`` of each environment, from the definition, with what is known by then."""
    found = {}
    for number, script in enumerate(scripts):
        start, episode = 0, 0
        while start < steps:
            length, terminates, costs = script[episode % len(script)]
            seen = min(length, steps - start)
            events = {length - 1} if event == "terminated" and terminates else set()
            events = {t for t in (events if event == "terminated" else costs) if t < seen}
            for time in range(seen):
                if any(t in events for t in range(time, time + horizon)):
                    found[number, episode, time] = False
                elif time + horizon <= seen or (terminates and seen == length):
                    found[number, episode, time] = True
            start, episode = start + length, episode + 1
    return found
