"""From a laptop to a cluster: what holds on eight devices, tried in a process of its own that sees so many."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
EIGHT = "--xla_force_host_platform_device_count=8"
"""Devices of a CPU, in the place of eight GPUs."""


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("which", "those"),
    [
        ("eight_devices.py", "not slow"),
        pytest.param("eight_devices.py", "slow", marks=SLOW),
        pytest.param("eight_devices_search.py", "not slow", marks=SLOW),
    ],
)
def test_on_eight_devices(which, those):
    run = subprocess.run(
        [
            sys.executable,
            "-m",
            "pytest",
            "-n",
            "0",
            "-x",
            "-q",
            "-p",
            "no:cacheprovider",
            "-m",
            those,
            str(HERE / which),
        ],
        env=os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} {EIGHT}"},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert run.returncode == 0, run.stdout[-3000:] + run.stderr[-3000:]
