"""A process that lives long: what `soak.py` measures in an hour, briefly, and that its measure can fail."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
ROUNDS = 4

spec = importlib.util.spec_from_file_location("soak", HERE / "soak.py")
soak = importlib.util.module_from_spec(spec)
spec.loader.exec_module(soak)


def test_the_trend_finds_a_leak_within_its_error():
    """The error covers the truth in 19 of 20 draws: the slope of a leak of half a MiB a minute, and of none."""
    generator, minutes = np.random.default_rng(0), np.linspace(30.0, 60.0, 40)
    for leak in (0.0, 0.5):
        found = [soak.trend(minutes, 2000.0 + leak * minutes + generator.normal(0.0, 20.0, 40)) for _ in range(400)]
        slopes, errors = np.array(found).T
        covered = np.mean(np.abs(slopes - leak) < 2.0 * errors)
        assert 0.9 < covered < 0.99  # 0.95, of 400 draws within 0.01
        # the error's own formula: sigma over the root of the sum of squared times
        expected = 20.0 / np.sqrt(np.sum((minutes - minutes.mean()) ** 2))
        np.testing.assert_allclose(slopes.std(), expected, rtol=0.15)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="it reads /proc")
def test_a_few_rounds_compile_nothing_twice_and_leave_nothing_open(tmp_path):
    """From the second round on no run compiles a step of its own, whose program took 950 mappings and 45 MiB each."""
    record = tmp_path / "record.json"
    subprocess.run(
        [sys.executable, HERE / "soak.py", "--minutes", "0", "--rounds", str(ROUNDS), "--record", record],
        cwd=HERE.parents[1],
        capture_output=True,
        check=False,  # too short for a trend
    )
    found = json.loads(record.read_text())
    assert found["rounds"] == ROUNDS and not found["not_finite"] and not found["different"]
    later = found["ends"][1:]
    for end in later:
        assert not {"simulate", "train"} & set(end["compiled"]), end
        assert end["files"] == later[0]["files"] and end["threads"] == later[0]["threads"]
    if later[0]["live_mib"] is not None:
        # at most 0.3 a round, and 1.4 a program that the search compiles for numbers of candidates it has not met
        programs = sum(end["compiled"].get("search", 0) for end in later[1:])
        assert later[-1]["live_mib"] - later[0]["live_mib"] < 5.0 + 2.0 * programs
    assert later[-1]["mappings"] - later[0]["mappings"] < 500 * (len(later) - 1)
