"""The knowledge buffer K: replacement, balanced samples, the validation part, and pickling."""

import pickle
from collections import Counter

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from toy import Line

from sb3_sap import KnowledgeBuffer

BOX = spaces.Box(-np.inf, np.inf, (2,), np.float32)


def add(knowledge, numbers, labels):
    """Adds distinct tuples: number i has observation (i, -i) and action i / 1000."""
    numbers = np.asarray(numbers, dtype=np.float32)
    obs = np.stack([numbers, -numbers], axis=1)
    knowledge.add(obs, numbers[:, None] / 1000, np.asarray(labels, dtype=bool))


def stored(knowledge, part):
    """(number, class) of everything in a part, oldest first."""
    offset = knowledge._offset[part]
    found = []
    for label in (0, 1):
        for slot in offset + knowledge.parts[part].slots(label):
            number = knowledge.observations[""][slot, 0]
            assert knowledge.observations[""][slot, 1] == -number
            assert knowledge.actions[slot, 0] == pytest.approx(number / 1000)
            found.append((int(number), label))
    return sorted(found)


class Oracle:
    """Section 4.2 as a list: if full, a tuple replaces the oldest of its class, or of the other if its own is rare."""

    def __init__(self, capacity, least):
        self.capacity, self.least, self.rows = capacity, min(least, capacity // 2), []

    def add(self, number, label):
        if len(self.rows) == self.capacity:
            own = [row for row in self.rows if row[1] == label]
            other = [row for row in self.rows if row[1] != label]
            self.rows.remove(min(own if len(own) >= self.least else other))
        self.rows.append((number, label))


class ScriptedRng:
    """Sends tuples to the parts that the test chooses."""

    def __init__(self, knowledge, validation):
        self.draws = iter(0.0 if v else 0.99 for v in validation)
        knowledge.rng = self

    def random(self):
        return next(self.draws)


# Single labels, and long runs of one class, which fill a part before the other class occurs.
LABELS = st.one_of(
    st.lists(st.booleans(), max_size=90),
    st.lists(st.tuples(st.booleans(), st.integers(1, 30)), max_size=5).map(
        lambda r: [la for la, n in r for _ in range(n)]
    ),
)


@settings(max_examples=150, deadline=None)
@given(
    size=st.integers(5, 24),
    fraction=st.sampled_from([0.3, 0.4, 0.5]),
    least=st.integers(1, 5),
    labels=LABELS,
    random=st.randoms(),
)
def test_replacement_follows_section_4_2(size, fraction, least, labels, random):
    to_validation = [random.random() < fraction for _ in labels]
    knowledge = KnowledgeBuffer(BOX, 1, size, fraction, 0, least)
    n_validation = round(size * fraction)
    oracles = {"train": Oracle(size - n_validation, least), "validation": Oracle(n_validation, least)}
    ScriptedRng(knowledge, to_validation)
    for number, (label, validation) in enumerate(zip(labels, to_validation, strict=True)):
        add(knowledge, [number], [label])
        oracles["validation" if validation else "train"].add(number, int(label))
    for part, oracle in oracles.items():
        assert stored(knowledge, part) == sorted(oracle.rows)
        counts = Counter(label for _, label in oracle.rows)
        assert knowledge.counts(part) == (counts[0], counts[1])
    assert len(knowledge) == sum(len(oracle.rows) for oracle in oracles.values())
    assert knowledge.seen == [labels.count(False), labels.count(True)]


def test_full_part_keeps_its_balance():
    knowledge = KnowledgeBuffer(BOX, 1, 10, 0.5)
    ScriptedRng(knowledge, [False] * 100)
    add(knowledge, [0, 1], [False, False])
    add(knowledge, range(2, 100), [True] * 98)
    assert stored(knowledge, "train") == [(0, 0), (1, 0), (97, 1), (98, 1), (99, 1)]


def test_absent_class_replaces_the_oldest_tuple_of_the_other_class():
    knowledge = KnowledgeBuffer(BOX, 1, 10, 0.5)
    ScriptedRng(knowledge, [False] * 10)
    add(knowledge, range(8), [True] * 8)  # 3 to 7 remain
    add(knowledge, [8], [False])
    assert stored(knowledge, "train") == [(4, 1), (5, 1), (6, 1), (7, 1), (8, 0)]
    add(knowledge, [9], [True])
    assert stored(knowledge, "train") == [(5, 1), (6, 1), (7, 1), (8, 0), (9, 1)]


def test_class_that_was_absent_when_the_part_filled_grows_to_its_minimum():
    knowledge = KnowledgeBuffer(BOX, 1, 20, 0.5, min_per_class=3)
    ScriptedRng(knowledge, [False] * 20)
    add(knowledge, range(15), [True] * 15)
    add(knowledge, range(15, 20), [False] * 5)
    assert [number for number, label in stored(knowledge, "train") if label == 0] == [17, 18, 19]


def test_samples_of_skewed_knowledge_are_balanced():
    knowledge = KnowledgeBuffer(BOX, 1, 1000, 0.5, seed=0)
    ScriptedRng(knowledge, [False] * 200)
    add(knowledge, range(200), [i % 100 == 7 for i in range(200)])  # 7 and 107 are permissible
    knowledge.seed(0)
    sample = knowledge.sample(50)
    numbers = sample.observations[:, 0].astype(int)
    assert sample.labels.sum() == 25
    assert set(numbers[sample.labels == 1]) == {7, 107}
    assert len(set(numbers[sample.labels == 0])) > 15
    assert not {7, 107} & set(numbers[sample.labels == 0])
    np.testing.assert_allclose(sample.actions[:, 0], numbers / 1000, rtol=1e-6)
    # Mini-batches are cut from the sample in order, so each must hold both classes.
    assert 0 < sample.labels[:10].sum() < 10
    assert (sample.observations.dtype, sample.actions.dtype, sample.labels.dtype) == (np.float32,) * 3


def test_every_stored_tuple_is_equally_likely_to_be_sampled():
    knowledge = KnowledgeBuffer(BOX, 1, 20, 0.5)
    ScriptedRng(knowledge, [False] * 10)
    add(knowledge, range(10), [False] * 5 + [True] * 5)
    knowledge.seed(0)
    drawn = Counter(knowledge.sample(10_000).observations[:, 0].astype(int))
    assert sorted(drawn) == list(range(10))
    assert all(abs(times - 1000) < 150 for times in drawn.values())  # 5 standard deviations


def test_training_and_validation_samples_are_disjoint():
    knowledge = KnowledgeBuffer(BOX, 1, 400, 0.25, seed=3)
    add(knowledge, range(600), [i % 2 == 0 for i in range(600)])
    parts = [{number for number, _ in stored(knowledge, part)} for part in ("train", "validation")]
    assert not parts[0] & parts[1]
    assert set(knowledge.sample(2000, "train").observations[:, 0]) <= parts[0]
    assert set(knowledge.sample(2000, "validation").observations[:, 0]) <= parts[1]


def test_validation_part_has_a_tenth_of_the_size_and_of_the_tuples():
    knowledge = KnowledgeBuffer(BOX, 1, 10_000, seed=0)
    assert {part: slots.capacity for part, slots in knowledge.parts.items()} == {"train": 9000, "validation": 1000}
    add(knowledge, range(5000), [True] * 5000)
    assert sum(knowledge.counts("validation")) == pytest.approx(500, abs=100)
    assert len(knowledge) == 5000


def test_observations_are_stored_raw_and_normalised_when_sampled():
    env = VecNormalize(DummyVecEnv([Line]), clip_obs=1000)
    env.obs_rms.mean, env.obs_rms.var = np.array([10.0, 0.0]), np.array([4.0, 1.0])
    knowledge = KnowledgeBuffer(BOX, 1, 20, 0.5)
    ScriptedRng(knowledge, [False] * 2)
    add(knowledge, [14, 6], [True, False])
    knowledge.seed(0)
    sample = knowledge.sample(10, env=env)
    expected = np.where(sample.labels == 1, 2.0, -2.0)  # (14 - 10) / 2, (6 - 10) / 2
    np.testing.assert_allclose(sample.observations[:, 0], expected, rtol=1e-5)
    env.obs_rms.mean = np.array([14.0, 0.0])  # the present statistics count, not those at the time of storing
    assert set(knowledge.sample(10, env=env).observations[:, 0].round(3)) == {0.0, -4.0}
    assert set(knowledge.sample(10).observations[:, 0]) == {14.0, 6.0}


def test_dict_observations_are_sampled_by_key():
    number = spaces.Box(-np.inf, np.inf, (1,), np.float32)
    knowledge = KnowledgeBuffer(spaces.Dict({"a": number, "b": number}), 2, 20, 0.5, seed=0)
    ScriptedRng(knowledge, [False] * 2)
    obs = {"a": np.array([[1.0], [2.0]]), "b": np.array([[10.0], [20.0]])}
    knowledge.add(obs, np.array([[0.1, 0.2], [0.3, 0.4]]), np.array([True, False]))
    knowledge.seed(0)
    sample = knowledge.sample(4)
    np.testing.assert_array_equal(sample.observations["a"][:, 0], 2 - sample.labels)
    np.testing.assert_array_equal(sample.observations["b"], 10 * sample.observations["a"])
    np.testing.assert_allclose(sample.actions[sample.labels == 0], [[0.3, 0.4]] * 2, rtol=1e-6)


def test_images_are_stored_as_uint8():
    knowledge = KnowledgeBuffer(spaces.Box(0, 255, (3, 4, 4), np.uint8), 1, 20, 0.5)
    assert knowledge.observations[""].dtype == np.uint8
    assert knowledge.observations[""].shape == (20, 3, 4, 4)


def filled(seed):
    knowledge = KnowledgeBuffer(BOX, 1, 100, 0.3, seed)
    add(knowledge, range(90), [i % 3 == 0 for i in range(90)])
    return knowledge


def test_seed_determines_split_and_samples():
    one, same, other = filled(5), filled(5), filled(6)
    assert stored(one, "validation") == stored(same, "validation") != stored(other, "validation")
    for _ in range(2):
        np.testing.assert_array_equal(one.sample(20).observations, same.sample(20).observations)
    one.seed(9), same.seed(9)
    np.testing.assert_array_equal(one.sample(20).observations, same.sample(20).observations)


@pytest.mark.parametrize("fraction", [0.0, 1.0, -0.1, 1.5])
def test_validation_fraction_must_lie_between_0_and_1(fraction):
    with pytest.raises(ValueError, match=rf"`validation_fraction` must lie between 0 and 1, but is {fraction}"):
        KnowledgeBuffer(BOX, 1, 100, fraction)


@pytest.mark.parametrize(("size", "fraction"), [(0, 0.1), (-5, 0.1), (14, 0.1), (14, 0.9)])
def test_parts_without_room_for_both_classes_are_refused(size, fraction):
    with pytest.raises(ValueError, match=rf"`knowledge_buffer_size` = {size} with `validation_fraction` = {fraction}"):
        KnowledgeBuffer(BOX, 1, size, fraction)
    KnowledgeBuffer(BOX, 1, 16, fraction)  # round(1.6) = 2


def test_unbalanced_sample_has_the_proportions_of_the_labels():
    knowledge = KnowledgeBuffer(spaces.Box(-1, 1, (1,)), 1, 1000, seed=0)
    labels = np.arange(800) % 4 == 0  # a quarter is permissible
    knowledge.add(np.zeros((800, 1)), labels[:, None], labels)
    sample = knowledge.sample(2000, balanced=False)
    assert len(sample.labels) == 2000
    assert sample.labels.sum() == pytest.approx(500, abs=80)  # 4 standard deviations
    np.testing.assert_array_equal(sample.actions[:, 0], sample.labels)  # each action beside its own label
    assert knowledge.sample(2000).labels.sum() == 1000


def circle(n):
    angles = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return np.stack([np.cos(angles), np.sin(angles)], axis=1).astype(np.float32)


def test_typical_observation_is_one_of_those_stored():
    k = KnowledgeBuffer(spaces.Box(-1, 1, (2,)), 1, 3_000, seed=0)
    assert k.typical_observation() is None
    k.add(circle(100), np.zeros((100, 1)), np.arange(100) % 2 == 0)
    assert np.linalg.norm(k.typical_observation()) == pytest.approx(1)  # the median is (0, 0)
    skewed = np.array([[0.0, 0.1]] * 30 + [[1.0, 1.0]], np.float32)
    k = KnowledgeBuffer(spaces.Box(-1, 1, (2,)), 1, 3_000, seed=0)
    k.add(skewed, np.zeros((31, 1)), np.ones(31, bool))
    np.testing.assert_array_equal(k.typical_observation(), np.float32([0.0, 0.1]))


@pytest.mark.parametrize("n", [0, 3, 40, 200])
def test_pickle_holds_only_filled_slots_and_restores_the_buffer(n):
    images = spaces.Box(0, 255, (20, 20, 3), np.uint8)
    k = KnowledgeBuffer(spaces.Dict(image=images, v=spaces.Box(-1, 1, (1,))), 1, 100, seed=0)
    rng = np.random.default_rng(0)
    obs = {"image": rng.integers(0, 256, (n, 20, 20, 3), np.uint8), "v": rng.random((n, 1))}
    k.add(obs, rng.random((n, 1)), rng.random(n) < 0.5)
    written = pickle.dumps(k)
    assert len(written) < 6_000 + 1_300 * len(k)
    restored = pickle.loads(written)
    for key, store in k.observations.items():
        np.testing.assert_array_equal(restored.observations[key], store)
        assert restored.observations[key].dtype == store.dtype
    np.testing.assert_array_equal(restored.actions, k.actions)
    assert restored.counts("train") == k.counts("train")
    # Both continue in the same way.
    more = {"image": rng.integers(0, 256, (30, 20, 20, 3), np.uint8), "v": rng.random((30, 1))}
    actions, labels = rng.random((30, 1)), rng.random(30) < 0.5
    for one in (k, restored):
        one.add(more, actions, labels)
    np.testing.assert_array_equal(restored.observations["image"], k.observations["image"])
