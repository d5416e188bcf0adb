"""From lossy to metal: spheres of rising conductivity against Mie's series and its limit, the perfect conductor.

Measured, far field over angle, against the series at the same conductivity: at most 3 % while a cell is up to 0.3 of a
skin depth, then rising; beyond one skin depth a cell they err by 4 to 205 %, and a skin is better. Closed skins of
17 ohm a square are 14 to 20 % off the perfect conductor, 0.8 dB in power, where a radius is 2.5 cells or more.

    python tests/physics/test_metal.py      prints the tables of docs/scattering.md
"""

import warnings

import jax
import mie
import numpy as np
import pytest
import trimesh
from lattices import cross, sphere

from august_jax.constants import SPEED_OF_LIGHT, VACUUM_PERMITTIVITY
from august_jax.physics import PlanarArray, contrast, factor_body, looking, scattering_matrix, sensing_channel
from august_jax.physics.body import body_channel
from august_jax.physics.checks import skin_depths
from august_jax.scene.lattice import shell_cells

FREQUENCY = 3e9
K = 2.0 * np.pi * FREQUENCY / SPEED_OF_LIGHT
SCATTERING = np.arange(0.0, 181.0, 15.0)
SKIN = 2e-3

pytestmark = pytest.mark.filterwarnings("ignore:contrast. cells of")


def far_field(cells, chi):
    """|S| [m] (2, D) of a sphere, vertical and horizontal, over scattering angles."""
    single = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), cells)
    arguments = {"transmit": looking(0.0, 0.0), "frequency_hz": FREQUENCY}
    matrix = np.abs(np.asarray(scattering_matrix(single, looking(180.0 - SCATTERING, 0.0), chi, **arguments)))
    return np.stack([matrix[:, 1, 1], matrix[:, 0, 0]])


def series(permittivity, ka):
    return np.sqrt(4.0 * np.pi) / K * np.abs(mie.amplitudes(permittivity, ka, np.radians(SCATTERING)))


def off(found, wanted):
    return np.linalg.norm(found - wanted) / np.linalg.norm(wanted)


@pytest.mark.parametrize("ka", [0.3, 1.0, 2.5])
def test_the_series_of_metal_tends_to_that_of_a_perfect_conductor(ka):
    """As the skin depth does, with the root of the conductivity."""
    apart = [off(series(1.0 + 1j * loss, ka), series(np.inf, ka)) for loss in (1e3, 4e3, 16e3)]
    np.testing.assert_allclose(np.divide(apart[:-1], apart[1:]), 2.0, atol=0.15)
    assert apart[-1] < 0.04


@pytest.mark.parametrize(
    "ka, across, loss, within",
    [(0.3, 5, 8.0, 0.01), (0.3, 9, 30.0, 0.04), (0.7, 9, 8.0, 0.025), (0.7, 9, 30.0, 0.07), (0.7, 9, 1000.0, 0.1)],
)
def test_solid_spheres_of_rising_conductivity(ka, across, loss, within):
    cells = sphere(ka / K, across)
    permittivity = 1.0 + 1j * loss
    assert off(far_field(cells, permittivity - 1.0), series(permittivity, ka)) < within


def test_a_small_solid_metal_sphere_is_what_cells_cannot_do():
    """Its magnetic moment is that of currents around it, for which cells stand only up to the skin depth."""
    assert off(far_field(sphere(0.3 / K, 9), 1e6j), series(np.inf, 0.3)) > 0.5


@pytest.mark.parametrize("radius_m, cell_m", [(0.02, 0.008), (0.03, 0.012), (0.03, 0.006), (0.045, 0.012)])
def test_a_closed_skin_of_17_ohm_a_square_stands_for_metal(radius_m, cell_m):
    triangles = np.asarray(trimesh.creation.icosphere(4, radius_m).triangles)
    cells = shell_cells(triangles, cell_m, SKIN)
    found = far_field(cells, complex(contrast(3.0, 1.0 / (17.0 * SKIN), FREQUENCY)))
    wanted = series(np.inf, K * (radius_m + 0.5 * SKIN))
    assert off(found, wanted) < 0.25
    assert abs(10.0 * np.log10(np.sum(found**2) / np.sum(wanted**2))) < 1.2


def test_a_cell_is_as_many_skin_depths_as_the_good_conductors_formula_says():
    """delta = sqrt(2/(omega mu0 sigma)); copper at 3 GHz: 1.2 micrometres."""
    chi = complex(contrast(1.0, 5.8e7, FREQUENCY))
    delta = np.sqrt(2.0 / (2.0 * np.pi * FREQUENCY * 4e-7 * np.pi * 5.8e7))
    np.testing.assert_allclose(1e-3 / skin_depths(1e-3, 1.0, chi, K), delta, rtol=1e-4)
    assert delta == pytest.approx(1.2e-6, rel=0.02)


class TestTheWarning:
    """One rule, behind every door."""

    CELLS = cross(arm=1)._replace(fill=1.0)
    METAL = 1j * 1e4 / (2.0 * np.pi * FREQUENCY * VACUUM_PERMITTIVITY)
    SAID = r"cells of 12 mm, filled to 1, are \d+ skin depths of their material, and cannot tell it from a perfect cond"

    def test_of_a_channel(self):
        with pytest.warns(UserWarning, match=self.SAID):
            sensing_channel(PlanarArray(2, 1, FREQUENCY), self.CELLS._replace(positions=self.CELLS.positions + 2.0),
                            self.METAL)  # fmt: skip

    def test_of_a_cross_section(self):
        with pytest.warns(UserWarning, match=self.SAID):
            scattering_matrix(self.CELLS, looking(np.zeros(1), 0.0), self.METAL, frequency_hz=FREQUENCY)

    @pytest.mark.filterwarnings("ignore:contrast. at")
    def test_of_a_body(self):
        body = factor_body(self.CELLS, FREQUENCY, nearest_m=2.0, cache=False)
        with pytest.warns(UserWarning, match=self.SAID):
            body_channel(body, PlanarArray(2, 1, FREQUENCY), np.eye(3), np.array([0.0, 3.0, 0.0]), self.METAL)

    @pytest.mark.parametrize(
        "fill, ohm, said",
        [(0.2, 17.0, "a closed skin is within 20 % of its far field"), (0.2, 1.7, r"of 17 ohm a square \(0.1 of this"),
         (0.9, 17.0, "a solid part errs by 4 to 200 %"), (0.2, 2000.0, None)],
    )  # fmt: skip
    def test_names_the_figure(self, recwarn, fill, ohm, said):
        edge = 0.012
        chi = complex(contrast(1.0, 1.0 / (ohm * fill * edge), FREQUENCY))
        cells = self.CELLS._replace(fill=fill)
        scattering_matrix(cells, looking(np.zeros(1), 0.0), chi, frequency_hz=FREQUENCY)
        told = [str(warning.message) for warning in recwarn]
        assert not told if said is None else len(told) == 1
        if said is not None:
            with pytest.warns(UserWarning, match=said):
                scattering_matrix(cells, looking(np.zeros(1), 0.0), chi, frequency_hz=FREQUENCY)


def tables():
    """Of solid spheres, 9 cells across, and of closed skins: what docs/scattering.md says, line by line."""
    losses = (2.0, 8.0, 30.0, 100.0, 300.0, 1e3, 1e4, 1e6)
    print("ka   " + "".join(f"{loss:>16g}j" for loss in losses))
    for ka in (0.3, 0.7, 1.5):
        edge, row = 2.0 * ka / K / 9, []
        for loss in losses:
            error = off(far_field(sphere(ka / K, 9), 1j * loss), series(np.inf if loss > 1e5 else 1.0 + 1j * loss, ka))
            row.append(f"{error:8.1%} ({skin_depths(edge, 1.0, 1j * loss, K):5.2f})")
        print(f"{ka:<5g}" + " ".join(f"{each:>16s}" for each in row))
    print("skins of 2 mm: radius, cell [mm]: far field, power [dB]; at 17 ohm a square, and without loss (chi of 1e4)")
    for radius_mm, cells_mm in ((20.0, (12.0, 8.0, 4.0)), (30.0, (15.0, 12.0, 6.0)), (45.0, (15.0, 12.0, 8.0))):
        for cell_mm in cells_mm:
            triangles = np.asarray(trimesh.creation.icosphere(4, 1e-3 * radius_mm).triangles)
            cells = shell_cells(triangles, 1e-3 * cell_mm, SKIN)
            wanted = series(np.inf, K * (1e-3 * radius_mm + 0.5 * SKIN))
            told = []
            for chi in (complex(contrast(3.0, 1.0 / (17.0 * SKIN), FREQUENCY)), 1e4):
                found = far_field(cells, chi)
                power = 10.0 * np.log10(np.sum(found**2) / np.sum(wanted**2))
                told.append(f"{off(found, wanted):6.1%} {power:+5.1f}")
            print(f"{radius_mm:5g} {cell_mm:5g}:   " + "     ".join(told))


@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_parts_may_differ_and_where_they_do_not_nothing_changes():
    cells = cross(arm=2)
    looks = looking(np.array([0.0, 70.0]), -20.0)
    chi = 2.0 + 0.1j
    one = np.asarray(scattering_matrix(cells, looks, chi, frequency_hz=FREQUENCY))
    each = np.asarray(scattering_matrix(cells, looks, np.full(cells.count, chi), frequency_hz=FREQUENCY))
    np.testing.assert_allclose(each, one, rtol=1e-5)
    mixed = np.where(np.abs(cells.positions[:, 0]) > 0.02, chi, 0.0)
    kept = np.flatnonzero(mixed)
    alone = type(cells)(*(np.asarray(part)[kept] for part in cells[:4]))
    wanted = np.asarray(scattering_matrix(alone, looks, chi, frequency_hz=FREQUENCY))
    found = np.asarray(scattering_matrix(cells, looks, mixed, frequency_hz=FREQUENCY))
    np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5 * np.abs(wanted).max())  # air is not there


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    tables()
