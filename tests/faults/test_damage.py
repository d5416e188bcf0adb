"""Damaged files, full and read-only disks: told in a few lines with the way out, and right again when it is taken.

`damage.py` damages and looks; like `harness.py` it runs in a process of its own.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
WORKS = ["simulate", "train", "track", "reproduce", "cache"]
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the harness reads /proc")


def damages(*words: str) -> list[dict]:
    done = subprocess.run(
        [sys.executable, HERE / "damage.py", *words], capture_output=True, text=True, cwd=HERE.parents[1]
    )
    if "no file system of its own" in done.stderr:
        pytest.skip(done.stderr.strip())
    assert done.returncode == 0, done.stderr[-2000:]
    return [json.loads(line) for line in done.stdout.splitlines()]


def faults(found: list[dict]) -> list[str]:
    return [f"{each['work']} {each['file']}, {each['kind']}: {each['fault']}" for each in found if each["fault"]]


def test_damage_is_noticed_and_mended():
    found = damages("simulate", "train", "track", "cache", "--most", "3")
    assert not faults(found)
    assert len(found) == 12 and sum(each["noticed"] for each in found) >= 4


@pytest.mark.slow
@pytest.mark.parametrize("work", WORKS)
def test_any_damage_is_noticed_and_mended(work):
    found = damages(work, "--most", "150")
    assert not faults(found)
    assert work in ("cache", "reproduce") or sum(each["noticed"] for each in found) > 0.15 * len(found)


@pytest.mark.slow
@pytest.mark.parametrize("work", WORKS)
def test_a_disk_that_fills_or_is_read_only_is_told_and_nothing_is_half_written(work):
    found = damages(work, "--full", "--read-only", "--most", "12")
    assert not faults(found)
    assert work == "cache" or sum(each["noticed"] for each in found) > 0.5 * len(found)
