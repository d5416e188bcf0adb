"""The region's subspace: an orthonormal basis that holds the waves of near targets, and a projection that inverts."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.physics.array import PlanarArray
from august_jax.signal import roi
from august_jax.signal.roi import Coefficients, Subspace

BOXES = {"paper": ((10, 30), (10, 30), (10, 20)), "near": ((3, 7), (4, 8), (2, 5))}


@pytest.mark.parametrize("shape", [(16, 4), (16, 1), (4, 2), (16, 16), (1, 1)])
def test_basis_is_orthonormal(shape):
    basis = roi.legendre_basis(*shape)
    assert basis.shape == (shape[0] * shape[1], roi.default_count(*shape))
    np.testing.assert_allclose(basis.T @ basis, np.eye(basis.shape[1]), atol=1e-6)  # stored as float32


def test_basis_starts_with_constant_and_slopes():
    basis = roi.legendre_basis(16, 4, degrees=[(0, 0), (1, 0), (0, 1)]).reshape(16, 4, 3)
    assert np.ptp(basis[..., 0]) < 1e-6
    np.testing.assert_allclose(np.diff(basis[..., 1], axis=0), basis[1, 0, 1] - basis[0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(np.ptp(basis[..., 2], axis=0), 0.0, atol=1e-6)  # no change along x


@pytest.mark.parametrize(
    ("box", "shape", "lost"),
    [("paper", (16, 4), 1e-8), ("near", (16, 4), 1e-4), ("near", (16, 16), 1e-4), ("paper", (16, 1), 1e-8)],
)
def test_default_basis_keeps_the_waves_of_near_points(box, shape, lost):
    """Mean energy of g g^T outside the subspace, for points up to 0.5 m off along each axis."""
    array = PlanarArray(*shape, 3e9)
    basis = np.linalg.qr(roi.legendre_basis(*shape).astype(float))[0]
    rng = np.random.default_rng(0)

    def wave(point):
        return np.exp(1j * array.wavenumber * np.linalg.norm(point - array.positions, axis=-1))

    losses = []
    for _ in range(100):
        predicted = np.array([rng.uniform(*span) for span in BOXES[box]])
        inside = basis.T @ (wave(predicted + rng.uniform(-0.5, 0.5, 3)) * wave(predicted).conj())
        losses.append(1.0 - (np.sum(np.abs(inside) ** 2) / array.count) ** 2)
    assert np.mean(losses) < lost


def test_phases_take_out_the_wave_of_the_prediction():
    """At q itself the channel g g^T becomes a constant: one coefficient, of modulus N_b."""
    array = PlanarArray(16, 4, 3e9)
    point = np.array([12.0, 20.0, 11.0])
    wave = np.exp(1j * array.wavenumber * np.linalg.norm(point - array.positions, axis=-1))
    channel = jnp.asarray(np.outer(wave, wave), jnp.complex64)
    coefficients = roi.project(channel[None], jnp.asarray(point, jnp.float32), Subspace(array, (3e9,)))
    energy = np.abs(coefficients.values[0]) ** 2
    np.testing.assert_allclose(energy[0, 0], 64.0**2, rtol=1e-4)
    assert energy.sum() - energy[0, 0] < 1e-4 * energy[0, 0]  # (float32 phase error)^2 is far below


def test_lift_undoes_project_and_keeps_symmetry():
    subspace = Subspace(PlanarArray(8, 4, 3e9), (2.9e9, 3e9), 10)
    draw = jax.random.normal(jax.random.key(0), (2, 10, 10), jnp.complex64)
    coefficients = Coefficients(draw + jnp.swapaxes(draw, 1, 2), jnp.array([5.0, 6.0, 3.0]))
    channel = roi.lift(coefficients, subspace)
    np.testing.assert_allclose(channel, jnp.swapaxes(channel, 1, 2), atol=1e-5)
    again = roi.project(channel, coefficients.centre, subspace)
    np.testing.assert_allclose(again.values, coefficients.values, atol=1e-5)
    np.testing.assert_array_equal(again.centre, coefficients.centre)
    # An orthogonal projection keeps the energy.
    np.testing.assert_allclose(jnp.sum(jnp.abs(channel) ** 2), jnp.sum(jnp.abs(coefficients.values) ** 2), rtol=1e-5)


@pytest.mark.parametrize(("shape", "tones"), [((16, 4), (3e9,)), ((16, 4), (2.95e9, 3.05e9)), ((16, 1), (3e9,))])
def test_the_echo_s_bearing_is_found_from_its_phases(shape, tones):
    """A point up to 0.5 m off along each axis: its direction is found, its range left alone."""
    array = PlanarArray(*shape, 3e9)
    subspace, rng = Subspace(array, tones), np.random.default_rng(0)
    wavenumbers = 2 * np.pi * np.asarray(tones) / 299_792_458.0
    find = jax.jit(lambda channel, place: roi.towards(roi.project(channel, place, subspace), subspace))
    for _ in range(20):
        predicted = np.array([rng.uniform(*span) for span in BOXES["near"]])
        point = predicted + rng.uniform(-0.5, 0.5, 3)
        waves = [np.exp(1j * k * np.linalg.norm(point - array.positions, axis=-1)) for k in wavenumbers]
        channel = jnp.asarray([np.outer(wave, wave) for wave in waves], jnp.complex64)
        centre = np.asarray(find(channel, jnp.asarray(predicted, jnp.float32)), float)
        np.testing.assert_allclose(np.linalg.norm(centre), np.linalg.norm(predicted), rtol=1e-5)
        seen = slice(0, 3, 2) if shape[1] > 1 else slice(0, 1)  # a row of antennas has no elevation
        found, true = (each[seen] / np.linalg.norm(each) for each in (centre, point))
        # Curvature over the aperture is all that is left: milliradians where offsets reach a tenth.
        np.testing.assert_allclose(found, true, atol=2e-3)


def test_a_bearing_survives_noise_and_horizon():
    subspace = Subspace(PlanarArray(16, 4, 3e9), (3e9,))
    noise = 30 * jax.random.normal(jax.random.key(0), (50, 1, 15, 15), jnp.complex64)
    place = jnp.array([8.0, 0.5, 0.5])
    centre = jax.vmap(lambda values: roi.towards(Coefficients(values, place), subspace))(noise)
    assert np.isfinite(centre).all()
    np.testing.assert_allclose(np.linalg.norm(centre, axis=-1), np.sqrt(64.5), rtol=1e-4)


def test_recentred_coefficients_are_those_about_the_new_centre():
    array = PlanarArray(16, 4, 3e9)
    subspace, point = Subspace(array, (3e9,)), np.array([5.3, 5.8, 3.2])
    wave = np.exp(1j * array.wavenumber * np.linalg.norm(point - array.positions, axis=-1))
    channel = jnp.asarray(np.outer(wave, wave), jnp.complex64)[None]
    old, new = jnp.array([5.0, 6.0, 3.0]), jnp.array([5.25, 5.75, 3.1])
    moved = roi.recentre(roi.project(channel, old, subspace), new, subspace)
    direct = roi.project(channel, new, subspace)
    np.testing.assert_array_equal(moved.centre, new)
    assert jnp.linalg.norm(moved.values - direct.values) < 3e-3 * jnp.linalg.norm(direct.values)


def test_phases_keep_their_digits_far_away():
    """The plain difference of two float32 distances of 3 km is wrong by millimetres, a tenth of a radian."""
    array = PlanarArray(16, 4, 3e9)
    point = np.array([2000.0, 2000.0, 1000.0])
    exact = np.exp(-1j * array.wavenumber * (np.linalg.norm(point - array.positions, axis=-1) - np.linalg.norm(point)))
    got = roi.spherical_phases(array.positions, jnp.asarray(point, jnp.float32), array.wavenumber)
    np.testing.assert_allclose(got, exact, atol=1e-4)  # 1e-6 m times k


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: roi.legendre_basis(4, 2, 9), "9 functions for 8"),
        (lambda: roi.legendre_basis(4, 2, 0), "0 functions"),
        (lambda: roi.legendre_basis(4, 2, degrees=[(4, 0)]), r"\(4, 0\)"),
        (lambda: roi.legendre_basis(0, 2), "0 x 2"),
    ],
)
def test_bad_input_is_named(call, words):
    with pytest.raises(ValueError, match=words):
        call()
