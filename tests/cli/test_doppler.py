"""``august doppler``: the hull's line where 2 v/lambda has it, files that hold the same, refusals with the way out."""

import json
import shlex

import numpy as np
import pytest
import scipy.io
from test_experiments import assert_ink

from august_jax.app import cli
from august_jax.app.cli.doppler import _along
from august_jax.app.cli.parser import parse
from august_jax.constants import SPEED_OF_LIGHT


@pytest.mark.filterwarnings("ignore:cells.volumes")
def test_a_craft_that_comes_nearer_is_heard_higher_and_every_file_says_so(tmp_path, capsys):
    asked = "--velocity 0,-8,0 --position 0,9,0 --seconds 0.05 --pulses 4000 --rate 80 --json"
    words = ["doppler", "quad_x", "--preset", "smoke", "target.cell_m=0.05", *asked.split(), "--out", str(tmp_path)]
    assert cli.main(words) == 0
    told = capsys.readouterr()
    said = json.loads(told.out)
    assert said["hull_shift_hz"] == pytest.approx(2.0 * 8.0 * 3e9 / SPEED_OF_LIGHT)
    assert abs(said["strongest_hz"] - said["hull_shift_hz"]) < 1.0 / 0.05
    assert said["flash_hz"] == [160.0] * 4 and said["pulses"] == 200
    stored = np.load(tmp_path / "doppler.npz")
    assert stored["tip_shift_hz"].max() == pytest.approx(said["tip_shift_hz"])
    matlab = scipy.io.loadmat(tmp_path / "doppler.mat", squeeze_me=True)
    np.testing.assert_array_equal(matlab["channel_hh_1_m"], stored["channel_hh_1_m"])
    assert (str(matlab["units"]["time_s"]), str(matlab["axes"]["time_s"])) == ("s", "pulse")
    assert str(matlab["axes"]["rate_hz"]) == "rotor" and said["command_line"] == str(matlab["command_line"])
    (line,) = (line for line in told.err.splitlines() if line.startswith("next:"))
    following = parse(shlex.split(line.removeprefix("next:").partition("#")[0])[1:], cli.COMMANDS)
    assert (following.rate, following.position, following.pulses) == ((80.0,), (0.0, 9.0, 0.0), 4000.0)
    assert (
        following.velocity == (0.0, -10.0, 0.0)
        and following.out == f"{tmp_path}_moving"
        and following.overrides == ["target.cell_m=0.05"]
    )
    # the spectrum is that of the series: sums over e^{+2 pi j nu t}, Parseval's of the window apart
    window = np.hanning(202)[1:-1]
    wanted = np.exp(2j * np.pi * np.outer(stored["doppler_hz"], stored["time_s"])) @ (window * stored["channel_vv_1_m"])
    np.testing.assert_allclose(stored["spectrum_vv_1_m"], wanted / window.sum(), atol=1e-5 * np.abs(wanted).max())
    assert_ink(tmp_path / "doppler.png")


@pytest.mark.parametrize("place", [(0.0, 11.0, 5.0), (0.0, -11.0, 5.0), (3.0, 1.3, 0.2), (0.0, 1.3, 0.0)])
@pytest.mark.parametrize("seconds", [0.05, 1.0])
def test_the_motion_that_is_advised_does_what_is_said_and_is_not_refused(place, seconds):
    least = 1.1
    words, what = _along(place, least, seconds)
    end = np.array(place) + seconds * np.array([float(each) for each in words.split(",")])
    change = np.linalg.norm(end) - np.linalg.norm(place)
    assert what == ("coming nearer" if change < 0.0 else "going away") and abs(change) > 0.04
    assert np.linalg.norm(end) > least and np.linalg.norm(np.cross(place, end)) < 0.01 * np.linalg.norm(place) ** 2


@pytest.mark.parametrize(
    "words, told",
    [
        ((), "AIRFRAME: give a procedural one (quad_x, "),
        (("drone.stl",), "AIRFRAME: got drone.stl; give a procedural one"),
        (("quad_x", "--rate", "1e5"), "--rate: 1e5 must lie in -1000 to 1000 turns/s"),
        (("quad_x", "--velocity", "1,2"), "--velocity: '1,2' is not x,y,z"),
        (("quad_x", "--position", "0,0.5,0"), "--position: 0.5 m from the antennas at the nearest; keep"),
        (  # which it passes between the first pulse and the middle
            ("quad_x", "--position", "0,6,0", "--velocity", "0,-24,0", "--seconds", "1.2", "--pulses", "500"),
            "--position: 0 m from the antennas at the nearest; keep",
        ),
        (("quad_x", "--seconds", "10", "--pulses", "1e5"), "--seconds, --pulses: 10 s at 100000 pulses/s are 1000000"),
    ],
)
def test_what_makes_no_sense_is_refused(capsys, tmp_path, words, told):
    assert cli.main(["doppler", *words, "--out", str(tmp_path / "out")]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert told in error and not (tmp_path / "out").exists()
