"""``august rcs``: files that agree with one another and with the library, and refusals with the way out."""

import json
import shlex

import numpy as np
import pytest
import scipy.io
from test_experiments import assert_ink

from august_jax.app import cli
from august_jax.app.cli.parser import parse
from august_jax.app.cli.rcs import _summary
from august_jax.config import preset
from august_jax.data.simulator import lattice_of
from august_jax.physics import contrast, dbsm, looking, scattering_from_t_matrix, scattering_matrix
from august_jax.scene import procedural_airframe

COARSE = ("--preset", "smoke", "target.cell_m=0.05")
LOOKS = ("--azimuth", "-180:180:90", "--elevation", "-30:30:30")


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A folder with the cross-sections of a coarse craft, and what the command said."""
    import contextlib
    import io

    out, said, told = tmp_path_factory.mktemp("rcs"), io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(told):
        words = ["rcs", "quad_x", *COARSE, *LOOKS, "--frequency", "2.9,3.0", "--permittivity", "3", "--out", str(out)]
        assert cli.main([*words, "--json"]) == 0
    return out, json.loads(said.getvalue()) | {"told": told.getvalue()}


@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_every_file_holds_the_same_and_what_the_coupled_solve_gives(found):
    out, said = found
    stored = np.load(out / "rcs.npz")
    assert stored["rcs_vv_dbsm"].shape == (3, 5, 2)
    np.testing.assert_array_equal(stored["azimuth_deg"], [-180, -90, 0, 90, 180])
    np.testing.assert_allclose(stored["rcs_vv_dbsm"][:, 0], stored["rcs_vv_dbsm"][:, -1], atol=1e-3)
    matlab = scipy.io.loadmat(out / "rcs.mat")
    np.testing.assert_array_equal(matlab["rcs_hv_dbsm"], stored["rcs_hv_dbsm"])
    table = np.genfromtxt(out / "rcs.csv", delimiter=",", names=True)
    np.testing.assert_allclose(table["hh_dbsm"].reshape(3, 5, 2), stored["rcs_hh_dbsm"], atol=1e-4)
    np.testing.assert_allclose(table["azimuth_deg"].reshape(3, 5, 2)[0, :, 0], stored["azimuth_deg"])
    assert_ink(out / "rcs.png")
    assert "rcs.html" in {path.name for path in out.iterdir()}
    config = preset("smoke")
    airframe = procedural_airframe("quad_x", config.target.half_wheelbase_m)
    from dataclasses import replace

    cells, _ = lattice_of(airframe, replace(config.target, cell_m=0.05))
    assert said["cells"] == cells.count
    chi = complex(contrast(3.0, sum(config.target.conductivity_s_m) / 2.0, 3e9))
    matrix = scattering_matrix(cells, looking(np.array([90.0]), -30.0), chi, frequency_hz=3e9)
    wanted = np.asarray(dbsm(matrix))[0]
    assert abs(stored["rcs_hh_dbsm"][0, 3, 1] - wanted[0, 0]) < 0.1
    assert abs(stored["rcs_vv_dbsm"][0, 3, 1] - wanted[1, 1]) < 0.1


def test_the_summary_is_of_the_directions_by_solid_angle(found):
    out, said = found
    stored, row = np.load(out / "rcs.npz"), said["summary"][0]
    assert (row["polarisation"], row["frequency_hz"]) == ("hh", 2.9e9)
    values = stored["rcs_hh_dbsm"][..., 0]
    assert row["least_dbsm"] == pytest.approx(values.min()) and row["most_dbsm"] == pytest.approx(values.max())
    weight = np.cos(np.radians(stored["elevation_deg"]))[:, None]
    once = values[:, :-1]  # the last azimuth is the first
    mean = 10.0 * np.log10(np.sum(weight * 10.0 ** (once / 10.0)) / (weight.sum() * once.shape[1]))
    assert row["mean_dbsm"] == pytest.approx(mean, abs=0.02)
    # half of the solid angle lies below the median, whatever crowds at the poles
    alike = np.tile(weight, (1, once.shape[1]))
    share = alike[once < row["median_dbsm"]].sum() / alike.sum()
    assert share <= 0.5 + 1e-3 and share + alike[once == row["median_dbsm"]].sum() / alike.sum() >= 0.5 - 1e-3
    many = np.where(np.arange(19)[:, None] % 18 == 0, 7.0, np.zeros((19, 37)))
    assert _summary(many, np.linspace(-90.0, 90.0, 19), np.linspace(-180.0, 180.0, 37))["median_dbsm"] == 0.0


def test_units_axes_and_how_it_was_made_stand_beside_the_numbers(found):
    out, said = found
    matlab = scipy.io.loadmat(out / "rcs.mat", squeeze_me=True)
    assert str(matlab["units"]["rcs_vv_dbsm"]) == "dB re 1 m^2"
    assert str(matlab["axes"]["scattering_m"]).startswith("elevation x azimuth x frequency")
    again = shlex.split(str(matlab["command_line"]))
    assert again[:3] == ["august", "rcs", "quad_x"] and again[-1] == "--json"
    assert json.loads(str(matlab["configuration"]))["target"]["cell_m"] == 0.05
    assert said["command_line"] == str(np.load(out / "rcs.npz")["command_line"])
    assert str(out) in (out / "rcs.html").read_text()


def test_the_line_to_try_next_asks_for_the_same_craft_and_frequencies(found):
    (line,) = (line for line in found[1]["told"].splitlines() if line.startswith("next:"))
    following = parse(shlex.split(line.removeprefix("next:").partition("#")[0])[1:], cli.COMMANDS)
    assert (following.rest, following.frequency, following.permittivity) == (["quad_x"], (2.9, 3.0), 3.0)
    assert (following.preset, following.overrides) == ("smoke", ["target.cell_m=0.05"])
    assert following.out == f"{found[0]}_bistatic"  # what was written stays
    assert tuple(following.azimuth) == (-180.0, 180.0, 90.0) and following.transmit == (0.0, 0.0)


@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_a_mesh_s_unit_and_axes_are_kept_and_asked_for_again(tmp_path, capsys):
    craft = procedural_airframe("quad_x", 0.25).mesh.copy()
    craft.apply_scale(1000.0)
    craft.export(tmp_path / "mine.stl")
    words = ["rcs", "--mesh", f"{tmp_path}/mine.stl", "--unit", "mm", *COARSE, "--azimuth", "0", "--elevation", "0"]
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "tmatrix.npz").write_bytes(b"of another craft")
    assert cli.main([*words, "--out", f"{tmp_path}/out"]) == 0
    assert not (tmp_path / "out" / "tmatrix.npz").exists()
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("next:"))
    following = parse(shlex.split(line.removeprefix("next:").partition("#")[0])[1:], cli.COMMANDS)
    assert (following.unit, following.up, following.forward) == ("mm", "z", "x")
    kept = json.loads(str(np.load(tmp_path / "out" / "rcs.npz")["craft"]))
    assert kept["mesh"]["unit_m"] == 0.001 and len(kept["mesh_sha256"]) == 64


@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_the_t_matrix_beside_scatters_as_the_cross_sections_say(tmp_path):
    words = ["rcs", "quad_x", *COARSE, *LOOKS, "--frequency", "0.9,1.0", "--half-wheelbase", "0.06", "--t-matrix"]
    assert cli.main([*words, "target.cell_m=0.02", "--out", str(tmp_path)]) == 0
    stored, matrices = np.load(tmp_path / "rcs.npz"), np.load(tmp_path / "tmatrix.npz")
    for tone, frequency in enumerate(stored["frequency_hz"]):
        found = scattering_from_t_matrix(
            matrices["tmatrix"][tone], looking(np.array([90.0]), -30.0), frequency_hz=frequency
        )
        np.testing.assert_allclose(found[0], stored["scattering_m"][0, 3, tone], atol=1e-3 * np.abs(found).max())
    matlab = scipy.io.loadmat(tmp_path / "tmatrix.mat", squeeze_me=True)
    np.testing.assert_array_equal(matlab["tmatrix"], matrices["tmatrix"])
    assert str(matlab["axes"]["tmatrix"]) == "frequency x scattered wave x incident wave"
    assert len(matrices["l"]) == matrices["tmatrix"].shape[-1] == 2 * matrices["l"].max() * (matrices["l"].max() + 2)


@pytest.mark.parametrize(
    "words, told",
    [
        ((), "AIRFRAME: give a procedural one (quad_x, "),
        (("quad_x", "--mesh", "x.stl"), "--mesh FILE, and not both"),
        (("quad_x", "--unit", "mm"), "--unit: says how a mesh file is read; leave it out, or give --mesh FILE"),
        (("quad_x", "--transmit", "0,100"), "--transmit: 100 must lie in -90 to 90 degrees"),
        (("quad_y",), "airframe 'quad_y': neither a family"),
        (("quad_x", "--azimuth", "10:0:1"), "--azimuth: '10:0:1': the end is not above the beginning"),
        (("quad_x", "--azimuth", "0:360"), "--azimuth: '0:360' is neither A:B:STEP nor a number"),
        (("quad_x", "--azimuth", "0:360:0"), "--azimuth: 0 must lie in 0.001 to 360 degrees"),
        (("quad_x", "--elevation", "0:100:5"), "--elevation: 100 must lie in -90 to 90 degrees"),
        (("quad_x", "--azimuth", "-180:180:0.01"), "directions at 1 frequencies are more than 200000"),
        (("quad_x", "--frequency", "3,2"), "--frequency: '3,2': give each frequency once, the lowest first"),
        (("quad_x", "--frequency", "20", "--t-matrix"), "--t-matrix: 1 matrices of degree"),
        (("quad_x", "--frequency", "0"), "--frequency: 0 must lie in 0.1 to 100 GHz"),
    ],
)
def test_what_makes_no_sense_is_refused(capsys, tmp_path, words, told):
    assert cli.main(["rcs", *words, "--out", str(tmp_path / "out")]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert told in error and not (tmp_path / "out").exists()
