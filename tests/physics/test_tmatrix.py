"""T-matrices: Mie's on spheres, energy, reciprocity, the same scattering as the craft's own, and treams beside them."""

import jax
import mie
import numpy as np
import pytest
from lattices import cross, sphere

from august_jax.physics import (
    degree_for,
    factor_body,
    looking,
    regular_waves,
    scattering_from_t_matrix,
    scattering_matrix,
    spherical_basis,
    t_matrix,
    wavenumber,
)

FREQUENCY = 299792458.0  # a wavelength of 1 m
K = 2.0 * np.pi
CRAFT_HZ = 3e9
CHI = 2.0 + 0.3j


@pytest.fixture(scope="module")
def cells():
    """A cross whose material lies beside the middles of its cells."""
    made = cross(arm=2)
    aside = np.random.default_rng(4).uniform(-0.004, 0.004, made.positions.shape)
    return made._replace(centroids=made.positions + aside)


def test_regular_waves_are_solutions_with_curls_as_they_should_be():
    """N = curl M/k and M = curl N/k, by differences; no divergence follows."""
    k, points, step = 5.0, np.random.default_rng(0).normal(0.0, 0.3, (5, 3)), 1e-5
    points = np.concatenate([points, [[0.0, 0.0, 0.2], [0.0, 0.0, -0.3], [0.0, 0.0, 0.0]]])  # poles, the origin
    slopes = np.stack(
        [(regular_waves(points + move, k, 3) - regular_waves(points - move, k, 3)) / (2.0 * step)
         for move in step * np.eye(3)], axis=1,
    )  # fmt: skip
    curl = np.stack([slopes[:, a, b] - slopes[:, b, a] for a, b in ((1, 2), (2, 0), (0, 1))], axis=1) / k
    waves, electric = regular_waves(points, k, 3), spherical_basis(3).electric == 1
    np.testing.assert_allclose(curl[..., ~electric], waves[..., electric], atol=1e-6)
    np.testing.assert_allclose(curl[..., electric], waves[..., ~electric], atol=1e-6)


@pytest.mark.parametrize("ka, permittivity, within", [(0.3, 2.0, 0.01), (0.8, 3.0 + 0.2j, 0.02)])
def test_a_sphere_has_the_coefficients_of_mie(ka, permittivity, within):
    single = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), sphere(ka / K, 9))
    matrix = t_matrix(single, permittivity - 1.0, 2, frequency_hz=FREQUENCY)
    a, b = mie.coefficients(permittivity, ka)
    basis = spherical_basis(2)
    wanted = -np.diag(np.where(basis.electric == 1, a[basis.degree - 1], b[basis.degree - 1]))
    assert np.linalg.norm(matrix - wanted) < within * np.linalg.norm(wanted)


@pytest.mark.parametrize("lossy", [False, True])
def test_energy_is_kept_or_lost(lossy):
    """Of a lossless craft T + T^H + 2 T^H T = 0; with loss it is negative: more is taken than scattered. Cells that
    hear beside where they couple would keep it to 2 % alone."""
    matrix = t_matrix(cross(arm=2), 2.5 + (0.5j if lossy else 0.0), 4, frequency_hz=CRAFT_HZ)
    kept = matrix + matrix.conj().T + 2.0 * matrix.conj().T @ matrix
    if lossy:
        assert np.linalg.eigvalsh(kept).max() < 0.02 * np.abs(np.linalg.eigvalsh(kept)).max()
    else:
        assert np.linalg.norm(kept) < 0.02 * np.linalg.norm(matrix + matrix.conj().T)


def test_what_is_sent_and_received_may_be_exchanged(cells):
    matrix, basis = t_matrix(cells, CHI, 3, frequency_hz=CRAFT_HZ), spherical_basis(3)
    triples = list(zip(*basis))
    mirror = [triples.index((degree, -order, kind)) for degree, order, kind in triples]
    signs = (-1.0) ** (basis.order[:, None] + basis.order)
    np.testing.assert_allclose(matrix, signs * matrix[np.ix_(mirror, mirror)].T, atol=3e-5 * np.abs(matrix).max())


@pytest.mark.parametrize("of", ["cells", "body"])
def test_it_scatters_plane_waves_as_the_craft_itself(cells, of):
    degree = degree_for(0.04, CRAFT_HZ)
    receive = looking(np.array([0.0, 50.0, 130.0, 250.0, 0.0]), np.array([0.0, -30.0, 70.0, 10.0, 90.0]))
    transmit = looking(20.0, -50.0)
    arguments = {"frequency_hz": CRAFT_HZ} if of == "cells" else {}
    craft = cells if of == "cells" else factor_body(cells, CRAFT_HZ, nearest_m=2.0, cache=False)
    wanted = np.asarray(scattering_matrix(craft, receive, CHI, transmit=transmit, **arguments))
    matrix = t_matrix(craft, CHI, degree, **arguments)
    found = scattering_from_t_matrix(matrix, receive, transmit, frequency_hz=CRAFT_HZ)
    assert np.linalg.norm(found - wanted) < 1e-4 * np.linalg.norm(wanted)
    monostatic = np.asarray(scattering_matrix(craft, receive, CHI, **arguments))
    found = scattering_from_t_matrix(matrix, receive, frequency_hz=CRAFT_HZ)
    assert np.linalg.norm(found - monostatic) < 1e-4 * np.linalg.norm(monostatic)


@pytest.mark.filterwarnings("ignore:.scipy.special.sph_harm")
def test_treams_reads_it_and_agrees(cells):
    """Another tool's basis, cross-sections and change of place, from our matrix as it stands."""
    treams = pytest.importorskip("treams", exc_type=ImportError)  # 0.4.7 asks for a SciPy before 1.17
    k, degree = wavenumber(CRAFT_HZ), 4
    basis = treams.SphericalWaveBasis.default(degree)
    ours = spherical_basis(degree)
    np.testing.assert_array_equal(np.stack([basis.l, basis.m, basis.pol]), np.stack(ours))
    matrix = treams.TMatrix(t_matrix(cells, 2.5, degree, frequency_hz=CRAFT_HZ), k0=k, basis=basis, poltype="parity")
    # orientation averages: of a lossless craft what is taken is what is scattered
    assert matrix.xs_sca_avg == pytest.approx(matrix.xs_ext_avg, rel=0.04)
    lossless = t_matrix(cells, 2.5, degree, frequency_hz=CRAFT_HZ)
    assert matrix.xs_sca_avg == pytest.approx(2.0 * np.pi / k**2 * np.sum(np.abs(lossless) ** 2), rel=1e-6)
    # waves at a point, and a sphere's matrix from treams' own Mie series scatters as ours
    point = np.array([[0.02, -0.01, 0.03]])
    theirs = []
    for row, column, electric in zip(*ours):
        wave = treams.special.vsw_rN if electric else treams.special.vsw_rM
        theirs.append(wave(row, column, *spherical(k * point[0])))
    np.testing.assert_allclose(
        to_cartesian(np.array(theirs), point[0]), regular_waves(point, k, degree)[0].T, atol=1e-8
    )
    ball = treams.TMatrix.sphere(2, K, 0.8 / K, [3.0, 1.0], poltype="parity")
    found = np.asarray(t_matrix(sphere(0.8 / K, 9), 2.0, 2, frequency_hz=FREQUENCY))
    assert np.linalg.norm(found - np.asarray(ball)) < 0.03 * np.linalg.norm(np.asarray(ball))


def spherical(point):
    distance = np.linalg.norm(point)
    return distance, np.arccos(point[2] / distance), np.arctan2(point[1], point[0])


def to_cartesian(vectors, point):
    _, polar, turn = spherical(point)
    frame = np.array([[np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)],
                      [np.cos(polar) * np.cos(turn), np.cos(polar) * np.sin(turn), -np.sin(polar)],
                      [-np.sin(turn), np.cos(turn), 0.0]])  # fmt: skip
    return vectors @ frame


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    "call, message",
    [
        (lambda cells: t_matrix(cells, CHI, 0, frequency_hz=3e9), "degree: got 0"),
        (lambda cells: t_matrix(cells, CHI, 2), "frequency_hz: got None; cells need"),
        (lambda cells: t_matrix(cells, np.ones(3), 2, frequency_hz=3e9), "contrast: "),
        (lambda cells: jax.jit(lambda chi: t_matrix(cells, chi, 2, frequency_hz=3e9))(1.0), "contrast: are traced"),
        (lambda cells: scattering_from_t_matrix(np.zeros((5, 5)), looking(np.zeros(1), 0.0), frequency_hz=3e9),
         r"matrix: got shape \(5, 5\)"),
    ],
)  # fmt: skip
def test_what_makes_no_matrix_is_refused(cells, call, message):
    with pytest.raises(ValueError, match=message):
        call(cells)
