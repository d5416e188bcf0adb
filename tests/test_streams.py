"""Streams: apart from each other for any seed, and the same under any setting of JAX."""

import itertools

import jax
import numpy as np
import pytest

from august_jax import streams

SEEDS = (0, 1, 2, 7, 12, 1 << 20, (1 << 24) + 3, 2**30, 2**31, 2**32 - 1)


def bits(key):
    return tuple(np.asarray(jax.random.key_data(key)).tolist())


def test_no_two_streams_of_a_run_agree_for_any_seed():
    """Each stream's own key, its first members, and the children of a split of either, over seeds side by side."""
    seen: dict[tuple, str] = {}
    for seed, name in itertools.product(SEEDS, streams.NAMES):
        own = streams.key(seed, name)
        family = [own, *streams.members(own, np.arange(40)), *jax.random.split(streams.key(seed, name, 3), 6)]
        for place, key in enumerate(family):
            label = f"seed {seed}, {name}, {place}"
            assert bits(key) not in seen, f"{label} is {seen.get(bits(key))}"
            seen[bits(key)] = label


def test_the_root_s_own_children_are_no_streams():
    """``split(key, n)`` and ``fold_in(key, i)`` share keys: a stream must not be among the first of either."""
    for seed in SEEDS:
        root = jax.random.key(seed)
        children = {bits(key) for count in (2, 3, 5, 64) for key in jax.random.split(root, count)}
        children |= {bits(key) for key in streams.members(root, np.arange(1000))}
        assert not children & {bits(streams.key(seed, name)) for name in streams.NAMES}


def test_members_are_the_numbered_keys():
    parent = streams.key(5, "data.flight")
    np.testing.assert_array_equal(
        jax.random.key_data(streams.members(parent, np.array([4, 9]))),
        [bits(streams.key(5, "data.flight", number)) for number in (4, 9)],
    )


@pytest.mark.parametrize(
    "setting",
    [lambda: jax.enable_x64(True), lambda: jax.threefry_partitionable(False), lambda: jax.default_prng_impl("rbg")],
    ids=["x64", "counting", "generator"],
)
def test_pinned_numbers_do_not_depend_on_settings(setting):
    @streams.pin
    def draw():
        return np.asarray(jax.random.uniform(streams.key(3, "data.points"), (4, 5)))

    plain = draw()
    with setting():
        other = draw()
    assert other.dtype == np.float32
    np.testing.assert_array_equal(plain, other)


@pytest.mark.parametrize(
    "arguments, words",
    [((0, "data.nothing"), "no stream"), ((-1, "data.flight"), "seed"), ((2**32, "data.flight"), "seed")],
)
def test_bad_streams_are_named(unchecked, arguments, words):
    with pytest.raises(ValueError, match=words):
        streams.key(*arguments)
