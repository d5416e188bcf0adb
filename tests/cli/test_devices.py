"""A device that is asked for and not there: every command names the variable and the way out."""

import os
import subprocess
import sys

import pytest

from august_jax.app.devices import describe_backend_error

_FIRST_USE = """
import august_jax, jax
from august_jax.app.devices import describe_backend_error
try:
    jax.numpy.ones(3)
except Exception as error:
    print(describe_backend_error(error))
"""


@pytest.mark.parametrize("platform", ["cuda", "tpu", "abacus"])
def test_a_platform_that_is_not_there_is_named(platform):
    run = subprocess.run(
        [sys.executable, "-c", _FIRST_USE],
        env=os.environ | {"JAX_PLATFORMS": platform},
        text=True,
        capture_output=True,
        check=True,
    )
    if platform in ("cuda", "tpu") and not run.stdout:
        pytest.skip(f"this machine has a {platform} device")
    assert run.stdout.startswith(f"JAX_PLATFORMS: '{platform}', but") and "set JAX_PLATFORMS=cpu" in run.stdout


@pytest.mark.parametrize("error", [AssertionError(), RuntimeError("out of memory"), ValueError("no")])
def test_other_errors_are_left_alone(error):
    assert describe_backend_error(error) is None
