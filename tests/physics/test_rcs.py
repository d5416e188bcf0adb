"""Radar cross-sections: against Mie at four radii and over angle, reciprocal, the optical theorem, flat over range."""

import jax
import jax.numpy as jnp
import mie
import numpy as np
import pytest
from lattices import cross, sphere, turned

from august_jax.physics import (
    AntennaArray,
    body_channel,
    dbsm,
    factor_body,
    looking,
    polarisations,
    scattering_matrix,
    seen_from,
    stack_tables,
    tabulate,
)

FREQUENCY = 299792458.0  # a wavelength of 1 m
K = 2.0 * np.pi
CHI = 2.0 + 0.3j


@pytest.fixture(scope="module")
def body():
    return factor_body(cross(), 3e9, nearest_m=2.0, cache=False)


def mie_matrix(permittivity, ka, scattering_deg):
    """|S| [m] of a sphere, horizontal and vertical, where both directions lie in the horizontal plane."""
    s1, s2 = mie.amplitudes(permittivity, ka, np.radians(scattering_deg))
    # vertical fields are across the scattering plane (S1), horizontal ones in it (S2)
    return np.sqrt(4.0 * np.pi) / K * np.abs(s2), np.sqrt(4.0 * np.pi) / K * np.abs(s1)


@pytest.mark.parametrize("ka, across, within_db", [(0.2, 7, 0.05), (0.4, 7, 0.1), (0.7, 9, 0.2), (1.0, 9, 0.35)])
def test_a_sphere_has_the_cross_section_of_mie_over_angle(ka, across, within_db):
    cells = sphere(ka / K, across)
    scattering = np.array([0.0, 30.0, 60.0, 120.0, 150.0, 180.0])
    with jax.enable_x64(True):
        # a wave from azimuth 0 travels on towards azimuth 180, the scattering angle 0
        found = np.asarray(
            scattering_matrix(
                cells, looking(180.0 - scattering, 0.0), 1.0, transmit=looking(0.0, 0.0), frequency_hz=FREQUENCY
            )
        )
    horizontal, vertical = mie_matrix(2.0, ka, scattering)
    strongest = max(horizontal.max(), vertical.max())
    for values, wanted in ((found[:, 0, 0], horizontal), (found[:, 1, 1], vertical)):
        seen = wanted > 0.2 * strongest  # away from nulls, where decibels mean nothing
        assert np.all(np.abs(dbsm(values[seen]) - dbsm(wanted[seen])) < within_db)
    assert np.all(np.abs(found[:, 0, 1]) < 1e-3 * strongest) and np.all(np.abs(found[:, 1, 0]) < 1e-3 * strongest)


@pytest.mark.parametrize("shifted", [False, True])
def test_a_factored_body_answers_plane_waves_as_the_coupled_solve_of_its_cells(shifted):
    cells = cross()
    if shifted:  # the material lies beside the middles of its cells
        aside = np.random.default_rng(4).uniform(-0.004, 0.004, cells.positions.shape)
        cells = cells._replace(centroids=cells.positions + aside)
    body = factor_body(cells, 3e9, nearest_m=2.0, cache=False)
    receive, transmit = (
        looking(np.array([0.0, 50.0, 130.0, 250.0]), np.array([0.0, -30.0, 70.0, 10.0])),
        looking(20.0, -50.0),
    )
    fast = np.asarray(scattering_matrix(body, receive, CHI, transmit=transmit))
    with jax.enable_x64(True):
        slow = np.asarray(scattering_matrix(cells, receive, CHI, transmit=transmit, frequency_hz=3e9))
    assert np.linalg.norm(fast - slow) < 1e-3 * np.linalg.norm(slow)


def test_what_is_sent_and_received_may_be_exchanged(body):
    here, there = looking(np.array([10.0, 80.0]), np.array([-20.0, 35.0])), looking(np.array([200.0, 300.0]), 5.0)
    one = np.asarray(scattering_matrix(body, here, CHI, transmit=there))
    other = np.asarray(scattering_matrix(body, there, CHI, transmit=here))
    np.testing.assert_allclose(one, np.swapaxes(other, -1, -2), rtol=0.0, atol=2e-6 * np.abs(one).max())


def test_what_a_lossless_craft_scatters_is_what_it_takes_from_the_wave():
    """Optical theorem: 4 pi/k Im q.F ahead is the scattered power where nothing is absorbed; with loss it is more."""
    cells = cross(arm=3)
    nodes, weights = np.polynomial.legendre.leggauss(12)
    azimuth = np.arange(24) * 15.0
    directions = looking(azimuth[:, None], np.degrees(np.arcsin(nodes))).reshape(-1, 3)
    area = np.broadcast_to(weights * 2.0 * np.pi / len(azimuth), (len(azimuth), len(nodes))).ravel()
    transmit = looking(40.0, 25.0)
    k = 2.0 * np.pi * 3e9 / 299792458.0
    for chi, lossy in ((2.5, False), (2.5 + 0.5j, True)):
        with jax.enable_x64(True):
            arguments = {"transmit": transmit, "frequency_hz": 3e9}
            matrix = np.asarray(scattering_matrix(cells, directions, chi, **arguments)) / np.sqrt(4.0 * np.pi)
            ahead = np.asarray(scattering_matrix(cells, -transmit[None], chi, **arguments))[0] / np.sqrt(4.0 * np.pi)
        scattered = np.einsum("d,dab->b", area, np.abs(matrix) ** 2)
        # ahead, the horizontal of the receiver's direction is against the transmitter's
        taken = 4.0 * np.pi / k * np.imag(np.diag(ahead) * [-1.0, 1.0])
        if lossy:
            assert np.all(scattered < 0.95 * taken)
        else:
            np.testing.assert_allclose(scattered, taken, rtol=2e-2)


def test_far_antennas_say_the_same_at_every_range(body):
    """Flat over range, and the plane wave's at the end: a monostatic look by two crossed dipoles."""
    towards = np.asarray(looking(35.0, -40.0))
    pair = np.asarray(polarisations(jnp.asarray(towards)))
    rotation = turned((0.4, -0.2, 0.1))
    wanted = np.asarray(scattering_matrix(body, towards[None], CHI))[0]
    for distance, within in ((30.0, 2e-2), (100.0, 6e-3), (300.0, 4e-3)):
        # the antennas stand at the origin; the craft is turned, and lies against the line of sight
        places = np.zeros((2, 3))
        array = AntennaArray(jnp.asarray(places), jnp.asarray(pair @ rotation.T), 3e9)
        channel = body_channel(body, array, rotation, -distance * rotation @ towards, CHI)
        found = np.asarray(seen_from(channel, distance, distance, 3e9))
        assert np.linalg.norm(found - wanted) < within * np.linalg.norm(wanted)


@pytest.fixture(scope="module")
def table(body):
    pair = AntennaArray(np.array([[0.4, 0.0, 0.0], [-0.4, 0.0, 0.0]]), np.eye(3)[:2], 3e9)
    reach = {"distance_m": (4.0, 16.0), "elevation_deg": (-60.0, 60.0)}
    return tabulate(body, pair, contrast=(1.0, 3.0), loss=0.6, cache=False, **reach)


@pytest.mark.parametrize("apart_deg", [0.0, 8.0])
def test_a_table_says_what_crossed_dipoles_at_its_farthest_distance_see(body, table, apart_deg):
    azimuth, elevation = np.arange(0.0, 360.0, 20.0), np.linspace(-50.0, 50.0, 18)
    receive, transmit = looking(azimuth, elevation), looking(azimuth + apart_deg, elevation)
    apart = {"transmit": transmit} if apart_deg else {}
    fast = np.asarray(scattering_matrix(table, receive, CHI, **apart))
    far = table.distance_m[1]
    slow = []
    for here, there in zip(receive, transmit):
        ends = [AntennaArray(np.tile(far * np.asarray(way), (2, 1)), np.asarray(polarisations(way)), 3e9)
                for way in (here, there)]  # fmt: skip
        channel = body_channel(body, ends[1], np.eye(3), np.zeros(3), CHI, receiver=ends[0])
        slow.append(np.asarray(seen_from(channel, far, far, 3e9)))
    assert np.linalg.norm(fast - np.array(slow)) < 1e-2 * np.linalg.norm(slow)
    plane = np.asarray(scattering_matrix(body, receive, CHI, **apart))
    assert np.linalg.norm(fast - plane) < 3e-2 * np.linalg.norm(plane)


def test_what_a_table_does_not_hold_is_refused(table):
    level = looking(np.array([0.0, 90.0]), 0.0)
    for arguments, message in (
        ({"transmit": looking(np.array([0.0, 120.0]), 0.0)}, "transmit: stands 30 degrees from the receiver"),
        ({"receive": looking(0.0, np.array([0.0, 80.0]))}, "receive: is at an elevation of 80 degrees"),
        ({"contrast": 5.0}, r"contrast: got 5\+0j; the table holds 1 to 3"),
        ({"frequency_hz": 3e9}, "frequency_hz: got 3e.09; a body has its own"),
        ({"craft": stack_tables([table, table])}, "craft: the table is a stack"),
    ):
        with pytest.raises(ValueError, match=message):
            scattering_matrix(**({"craft": table, "receive": level, "contrast": CHI} | arguments))


def test_several_tones_and_more_looks_than_a_block():
    pair = factor_body(cross(arm=2), [2.9e9, 3.1e9], nearest_m=2.0, cache=False)
    looks = looking(np.linspace(0.0, 359.0, 150), 10.0)
    both = np.asarray(scattering_matrix(pair, looks, CHI))
    assert both.shape == (2, 150, 2, 2) and np.all(np.isfinite(both))
    few = np.asarray(scattering_matrix(pair, looks[140:], CHI))
    np.testing.assert_allclose(both[:, 140:], few, rtol=1e-4, atol=1e-6 * np.abs(both).max())


def test_polarisations_are_right_handed_with_the_direction_at_poles_too():
    directions = jnp.concatenate([looking(np.array([0.0, 77.0, 200.0]), np.array([0.0, 40.0, -85.0])),
                                  jnp.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])])  # fmt: skip
    horizontal, vertical = np.moveaxis(np.asarray(polarisations(directions)), -2, 0)
    np.testing.assert_allclose(np.cross(directions, horizontal), vertical, atol=1e-6)
    assert np.all(np.abs(horizontal[:, 2]) < 1e-7) and np.all(vertical[:4, 2] >= 0.0)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    "change, message",
    [
        ({"receive": np.ones((2, 3))}, "receive: got a vector of length 1.73"),
        ({"receive": np.ones((2, 2))}, r"receive: got shape \(2, 2\)"),
        ({"receive": np.array([1.0, 0.0, 0.0])}, r"receive: got shape \(3,\); give unit vectors \(D, 3\)"),
        ({"receive": np.ones((0, 3))}, r"receive: got shape \(0, 3\)"),
        ({"transmit": np.full(3, np.nan)}, "transmit: got a vector of length nan"),
        ({"frequency_hz": 3e9}, "frequency_hz: got 3e.09; a body has its own"),
        ({"contrast": np.ones(3)}, "contrast: "),
    ],
)
def test_bad_looks_are_refused(unchecked, body, change, message):
    arguments = {"receive": looking(np.zeros(2), 0.0), "contrast": CHI} | change
    with pytest.raises(ValueError, match=message):
        scattering_matrix(body, **arguments)


def test_cells_need_a_frequency():
    with pytest.raises(ValueError, match="frequency_hz: got None; cells need"):
        scattering_matrix(cross(arm=1), looking(np.zeros(1), 0.0), CHI)
