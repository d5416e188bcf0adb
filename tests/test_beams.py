"""Beams point where they should, fill their sector, and the pilots keep to their power."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.physics.array import PlanarArray
from august_jax.signal import beams

NX, NZ = 16, 4
CENTRE = (1.1, 0.4)
WIDTHS = (np.pi / 6, np.pi / 6)


def test_angles_turn_back_into_the_point():
    point = np.array([3.0, 5.0, 2.0])
    azimuth, elevation = beams.direction_angles(jnp.asarray(point))
    unit = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    np.testing.assert_allclose(np.linalg.norm(point) * np.array(unit), point, rtol=1e-6)  # float32


def test_codebook_is_the_printed_formula_but_for_the_sign():
    """A slow loop over beams and elements, a and b counted from the centre of the array."""
    book = np.asarray(beams.roi_codebook(NX, NZ, CENTRE, WIDTHS))
    slow = np.empty((NX * NZ, NX * NZ), complex)
    for i in range(NX):
        for j in range(NZ):
            azimuth = CENTRE[0] - WIDTHS[0] / 2 + WIDTHS[0] * i / (NX - 1)
            elevation = CENTRE[1] - WIDTHS[1] / 2 + WIDTHS[1] * j / (NZ - 1)
            for a in range(NX):
                for b in range(NZ):
                    cycles = (a - (NX - 1) / 2) * np.cos(elevation) * np.cos(azimuth)
                    cycles += (b - (NZ - 1) / 2) * np.sin(elevation)
                    slow[b + a * NZ, j + i * NZ] = np.exp(1j * np.pi * cycles) / np.sqrt(NX * NZ)
    np.testing.assert_allclose(book, slow, atol=1e-6)  # float32 phases up to 26 rad
    np.testing.assert_allclose(beams.roi_codebook(NX, NZ, CENTRE, WIDTHS, mirror=True), slow.conj(), atol=1e-6)


def test_beams_light_the_sector_and_the_mirrored_ones_do_not():
    """Power delivered by all beams to a far point: high on the sector, tens of dB lower for the other sign."""
    array = PlanarArray(NX, NZ, 3e9)
    wave = array.steering(jnp.float32(CENTRE[0]), jnp.float32(CENTRE[1]))
    power = {
        mirror: float(jnp.sum(jnp.abs(wave @ beams.roi_codebook(NX, NZ, CENTRE, WIDTHS, mirror=mirror)) ** 2))
        for mirror in (False, True)
    }
    # N_b^2 / N_b is one beam aimed at the point; each of 64 beams that are spread over 30 degrees gives a part of that.
    assert power[False] > 64 * 5
    assert 10 * np.log10(power[False] / power[True]) > 12  # one way; the echo takes it twice: 24 dB


def test_one_element_along_an_axis_looks_at_the_centre():
    np.testing.assert_allclose(beams.sector_grid(0.3, 0.5, 1), [0.3], rtol=1e-6)
    np.testing.assert_allclose(beams.sector_grid(0.3, 0.5, 3), [0.05, 0.3, 0.55], rtol=1e-6)
    assert beams.roi_codebook(16, 1, CENTRE, WIDTHS).shape == (16, 16)


@pytest.mark.parametrize("symbols", [64, 100])
def test_unitary_symbols_are_orthogonal(symbols):
    drawn = beams.pilot_symbols(jax.random.key(0), 64, symbols)
    np.testing.assert_allclose(drawn @ drawn.conj().T / symbols, np.eye(64), atol=1e-5)  # float32 sums of 100 terms
    other = beams.pilot_symbols(jax.random.key(1), 64, symbols)
    assert np.abs(np.vdot(drawn, other)) / (64 * symbols) < 0.1  # scrambled anew by every key


def test_gaussian_symbols_have_unit_covariance():
    drawn = beams.pilot_symbols(jax.random.key(0), 4, 20_000, "gaussian")
    np.testing.assert_allclose(drawn @ drawn.conj().T / 20_000, np.eye(4), atol=0.03)  # 4 / sqrt(20000)


@pytest.mark.parametrize("kind", beams.PILOTS)
def test_pilots_have_the_stated_power(kind):
    book = beams.roi_codebook(NX, NZ, CENTRE, WIDTHS)
    sent = beams.pilots(book, beams.pilot_symbols(jax.random.key(2), 64, 80, kind), 0.25)
    np.testing.assert_allclose(jnp.sum(jnp.abs(sent) ** 2) / 80, 0.25, rtol=1e-5)


def test_power_units():
    np.testing.assert_allclose(beams.dbm_to_watt(30.0), 1.0, rtol=1e-6)
    np.testing.assert_allclose(beams.watt_to_dbm(beams.dbm_to_watt(-120.0)), -120.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: beams.pilot_symbols(jax.random.key(0), 64, 32), "32 symbols"),
        (lambda: beams.pilot_symbols(jax.random.key(0), 64, 64, "zadoff"), "zadoff"),
        (lambda: beams.roi_codebook(0, 4, CENTRE, WIDTHS), "0 x 4"),
    ],
)
def test_bad_input_is_named(unchecked, call, words):
    with pytest.raises(ValueError, match=words):
        call()
