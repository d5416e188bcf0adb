"""Schemes: what every member of the registry keeps, and the baselines' own closed forms."""

import jax
import numpy as np
import pytest

from august_jax.config import preset
from august_jax.models import Networks, create
from august_jax.scene import procedural_airframe
from august_jax.schemes import SCHEMES, Setting, Slots, Truth, mean_shape
from august_jax.signal import Coefficients

CONFIG = preset("smoke")
COUNT, POINTS = 4, 60
QUICK = [name for name, scheme in SCHEMES.items() if not scheme.slow]
"""The one that searches has a test file of its own."""


@pytest.fixture(scope="module")
def setting():
    airframes = [procedural_airframe(name) for name in CONFIG.target.airframes]
    return Setting(CONFIG, Networks("untrained", CONFIG, *create(CONFIG, 0)), airframes, jax.random.key(0))


@pytest.fixture(scope="module")
def slots():
    rng = np.random.default_rng(0)
    body = np.asarray(procedural_airframe("quad_x").sample_surface(jax.random.key(0), 2 * POINTS))
    position = np.array([5.0, 6.0, 3.0]) + rng.uniform(-1.0, 1.0, (COUNT, 3))
    cloud, resampled = (position[:, None] + half for half in (body[:POINTS], body[POINTS:]))
    predicted = (position + rng.uniform(-0.5, 0.5, (COUNT, 3))).astype(np.float32)
    values = rng.normal(size=(COUNT, 1, 7, 7)) + 1j * rng.normal(size=(COUNT, 1, 7, 7))
    values = (values + values.swapaxes(-1, -2)).astype(np.complex64)
    up = np.tile([0.0, 0.0, 1.0], (COUNT, 1))
    truth = Truth(*(each.astype(np.float32) for each in (position, up, cloud, resampled)))
    return Slots(predicted, np.full(COUNT, 20.0, np.float32), Coefficients(values, predicted), truth)


@pytest.mark.parametrize("name", QUICK)
def test_every_scheme_answers_every_slot_under_its_own_name(name, setting, slots):
    scheme = SCHEMES[name]
    assert scheme.name == name and scheme.label
    answer = scheme.prepare(setting)(jax.random.key(1), slots)
    given = {field: value for field, value in answer._asdict().items() if value is not None}
    assert given
    for field, value in given.items():
        for leaf in jax.tree.leaves(value):
            assert leaf.shape[0] == COUNT and (field == "cloud" or leaf.shape == (COUNT, 3))
    for field in {"normal", "triple_normal"} & set(given):
        np.testing.assert_allclose(np.linalg.norm(given[field], axis=-1), 1.0, atol=1e-5)
        assert np.all(given[field][:, 2] >= 0.0)
    if "cloud" in given:  # a cloud lies somewhere
        assert answer.position is not None or answer.centre is not None
        assert np.isfinite(answer.cloud.points).all()


@pytest.mark.parametrize("name", QUICK)
def test_every_scheme_repeats_itself_for_the_same_key(name, setting, slots):
    ask = SCHEMES[name].prepare(setting)
    first, second = (ask(jax.random.key(2), slots) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, second)


@pytest.mark.parametrize("name", [name for name, scheme in SCHEMES.items() if not scheme.hears])
def test_a_scheme_without_ears_answers_in_silence(name, setting, slots):
    """It needs neither echo nor networks, so that one answer serves all SNRs."""
    alone = SCHEMES[name].prepare(setting._replace(networks=None))
    silent = alone(jax.random.key(2), slots._replace(heard=None, snr_db=None))
    jax.tree.map(np.testing.assert_array_equal, silent, SCHEMES[name].prepare(setting)(jax.random.key(2), slots))


@pytest.mark.parametrize("name", [name for name in QUICK if SCHEMES[name].hears])
def test_a_scheme_with_ears_hears(name, setting, slots):
    ask = SCHEMES[name].prepare(setting)
    other = slots._replace(heard=slots.heard._replace(values=slots.heard.values[::-1]))
    first, second = (jax.tree.leaves(ask(jax.random.key(2), each)) for each in (slots, other))
    assert any(not np.allclose(one, two) for one, two in zip(first, second, strict=True))
    assert SCHEMES[name].prepare(setting._replace(networks=None)) is None or name != "august"


def test_mean_shape_is_level_and_has_no_heading():
    airframes = [procedural_airframe(name) for name in ("quad_x", "octo")]
    points = np.asarray(mean_shape(jax.random.key(0), airframes, 5001))
    assert points.shape == (5001, 3)
    # four standard errors: 0.2 m / sqrt(5001)
    np.testing.assert_allclose(points.mean(axis=0), 0.0, atol=0.012)
    spread = points.T @ points / len(points)
    assert spread[0, 0] == pytest.approx(spread[1, 1], rel=0.1)
    assert abs(spread[0, 1]) < 0.05 * spread[0, 0]
    # shares alike, and heights are those of the craft, whom a heading does not move
    heights = np.concatenate([np.asarray(each.sample_surface(jax.random.key(1), 2500))[:, 2] for each in airframes])
    assert np.std(points[:, 2]) == pytest.approx(np.std(heights), rel=0.1)
