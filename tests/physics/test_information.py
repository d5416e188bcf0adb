"""Fisher information against differences of the exact channel, and what it must say about single tones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import cross

from august_jax.physics import (
    AntennaArray,
    PlanarArray,
    body_channel,
    contrast,
    factor_body,
    fisher_information,
    mean_position_error,
    position_bound,
    sensing_channel,
    tilt_bound,
    unknown_gain_position_bound,
    without_gain,
)
from august_jax.physics.information import KNOWN_GAIN, Spread, error_covariance

ARRAY = PlanarArray(8, 4, 3e9)
CELLS = cross(arm=9)
PLACE = np.array([2.0, 3.0, 1.5])


@pytest.fixture(scope="module")
def information():
    body = factor_body(CELLS, 3e9)
    return fisher_information(body, ARRAY, np.eye(3), PLACE, 3.0, 5e-3, 100.0)


def test_information_is_that_of_differences_of_the_channel(information):
    from scipy.spatial.transform import Rotation

    def channel(theta):
        with jax.enable_x64(True):
            turn = Rotation.from_rotvec(theta[3:6]).as_matrix()
            moved = CELLS.moved(jnp.asarray(turn), jnp.asarray(PLACE + theta[:3]))
            chi = complex(contrast(3.0 + theta[6], 5e-3 + theta[7], 3e9))
            return np.asarray(sensing_channel(ARRAY, moved, chi)) * np.exp(theta[8] + 1j * theta[9])

    steps = np.array([1e-5] * 3 + [1e-4] * 3 + [1e-3, 1e-4, 1e-4, 1e-4])
    slopes = [(channel(step * axis) - channel(-step * axis)) / (2 * step) for step, axis in zip(steps, np.eye(10))]
    gram = np.real(np.einsum("amn,bmn->ab", slopes, np.conj(slopes)))
    expected = 2 * 100.0 * ARRAY.count**2 * gram / np.linalg.norm(channel(np.zeros(10))) ** 2
    scale = np.sqrt(np.diag(expected))
    # Derivatives in float32 through a response good to 3e-5.
    np.testing.assert_allclose(information / scale / scale[:, None], expected / scale / scale[:, None], atol=2e-3)


def test_an_unknown_gain_takes_the_range_away(information):
    known, unknown = position_bound(information, KNOWN_GAIN), position_bound(information)
    assert known < 0.01 < unknown
    assert 0.7 * unknown < mean_position_error(information) < unknown
    assert position_bound(information / 100.0) > unknown
    assert position_bound(np.zeros((10, 10))) == pytest.approx(0.5)  # the prior alone, 0.5/sqrt(3) along three axes
    normal = np.array([0.0, 0.0, 1.0])
    assert 0.0 < tilt_bound(information, normal) < tilt_bound(information / 100.0, normal) < np.deg2rad(30)


def test_the_bound_to_descend_is_the_bound(information):
    place = jnp.asarray(PLACE, jnp.float32)
    bound = unknown_gain_position_bound(factor_body(CELLS, 3e9), ARRAY, jnp.eye(3), place, 3.0, 5e-3, 100.0)
    assert bound == pytest.approx(float(position_bound(information)), rel=1e-2)


def test_what_is_left_without_the_gain_is_what_a_wide_prior_leaves(information):
    left = without_gain(information)
    narrow = Spread().deviations()[:8]
    expected = np.linalg.inv(left + np.diag(narrow**-2.0))
    np.testing.assert_allclose(
        error_covariance(information)[:8, :8], expected, rtol=2e-2, atol=2e-3 * np.outer(narrow, narrow).min()
    )


def test_two_receivers_know_more_than_one():
    body = factor_body(CELLS, 3e9)
    aside = AntennaArray(ARRAY.positions + [2.5, 0.0, 0.0], ARRAY.moments, 3e9)
    alone = without_gain(fisher_information(body, ARRAY, np.eye(3), PLACE, 3.0, 5e-3, 10.0))
    both = alone + without_gain(fisher_information(body, ARRAY, np.eye(3), PLACE, 3.0, 5e-3, 10.0, receiver=aside))
    prior = np.diag(Spread().deviations()[:8] ** -2.0)
    errors = [np.sqrt(np.trace(np.linalg.inv(known + prior)[:3, :3])) for known in (alone, both)]
    assert errors[1] < 0.5 * errors[0]  # two bearings make a range


def test_the_posterior_by_dense_sampling_is_as_wide_as_the_bound():
    """Only the place and a complex gain unknown: noisy echoes, the likelihood on a grid, its mean squared width.

    The gain is marginalised in closed form: log p = s^2-weighted |<H(q), Y>|^2/|H(q)|^2.
    """
    body = factor_body(CELLS, 3e9)
    noise_count, snr, prior_m = ARRAY.count**2, 1000.0, 0.02
    known = Spread(position_m=prior_m, turn_rad=1e-6, permittivity=1e-6, conductivity=1e-9)
    information_ = fisher_information(body, ARRAY, np.eye(3), PLACE, 3.0, 5e-3, snr)
    covariance = error_covariance(information_, known)[:3, :3]
    # A grid along the bound's own axes, six standard deviations to both sides.
    values, axes = np.linalg.eigh(covariance)
    steps = np.linspace(-6.0, 6.0, 25)
    offsets = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3) * np.sqrt(values) @ axes.T
    chi = contrast(3.0, 5e-3, 3e9).astype(jnp.complex64)
    channel = jax.jit(
        lambda places: jax.lax.map(
            lambda place: body_channel(body, ARRAY, jnp.eye(3), place, chi).reshape(-1), places, batch_size=256
        )
    )
    candidates = np.asarray(channel(jnp.asarray(PLACE + offsets, jnp.float32)))
    candidates = candidates / np.linalg.norm(candidates, axis=1, keepdims=True)
    truth = candidates[len(candidates) // 2]
    random = np.random.default_rng(0)
    sigma = np.sqrt(1.0 / (snr * noise_count))  # |truth| = 1
    spreads = []
    for _ in range(40):
        noise = sigma * np.sqrt(0.5) * (random.normal(size=(2, noise_count)).T @ [1.0, 1j])
        score = np.abs(candidates.conj() @ (truth + noise)) ** 2 / sigma**2
        score -= 0.5 * np.sum(offsets**2, axis=1) / prior_m**2
        weight = np.exp(score - score.max())
        weight /= weight.sum()
        mean = weight @ offsets
        spreads.append(weight @ np.sum((offsets - mean) ** 2, axis=1))
    assert np.sqrt(np.mean(spreads)) == pytest.approx(np.sqrt(np.trace(covariance)), rel=0.15)
    assert np.sqrt(np.trace(covariance)) < 0.8 * np.sqrt(3.0) * prior_m  # the echo says something
