"""Two processes on one folder: the second is refused with the first's number, or both work; never a mixture."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the harness reads /proc")


def test_a_second_process_is_refused_by_number_and_the_first_ends_well():
    done = subprocess.run(
        [sys.executable, HERE / "together.py", "simulate", "train", "cache"],
        capture_output=True, text=True, cwd=HERE.parents[1],
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    found = {each["work"]: each for each in map(json.loads, done.stdout.splitlines())}
    assert not [each for each in found.values() if each["fault"]]
    for name in ("simulate", "train"):
        assert f"is being written by process {found[name]['first']} on " in found[name]["second"]
    assert found["cache"]["second"] is None
