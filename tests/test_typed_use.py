"""The names that others build on, used as they would: mypy reads this file (pyproject.toml), and the tests run it.

What a user may pass (arrays of NumPy and of JAX, numbers of Python's own) must pass the checker, and what comes back
must be known to it: ``assert_type`` does nothing as the test runs, and fails mypy where a type has come apart.
"""

from pathlib import Path
from typing import assert_type

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.config import Config, preset
from august_jax.physics import (
    AntennaArray,
    Body,
    Cells,
    PlanarArray,
    body_channel,
    factor_body,
    fisher_information,
    position_bound,
    sensing_channel,
)
from august_jax.pipeline import load_networks, sense
from august_jax.scene import load_airframe, procedural_airframe
from august_jax.scene.airframes import Airframe
from august_jax.scene.scenario import draw_scenario

_CORNERS = 0.01 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
_CUBE = Cells(_CORNERS, np.full(8, 1e-6))


_ARRAYS = [PlanarArray(2, 2, 3e9), AntennaArray(5.0 * _CORNERS, np.tile([0.0, 0.0, 1.0], (8, 1)), 3e9)]


@pytest.mark.parametrize("array", _ARRAYS)
def test_channels_take_numpy_jax_and_python_numbers(array: PlanarArray | AntennaArray) -> None:
    body = factor_body(_CUBE, 3e9, cache=False)
    assert_type(body, Body)
    place, turn = np.array([1.0, 5.0, 2.0]), np.eye(3)
    dense = sensing_channel(array, _CUBE.moved(turn, place), 2.0 + 0.05j)
    fast = body_channel(body, array, jnp.asarray(turn), jnp.asarray(place), 2.0 + 0.05j)
    assert_type(dense, jax.Array)
    assert_type(fast, jax.Array)
    assert np.linalg.norm(dense - fast) < 1e-3 * np.linalg.norm(dense)
    information = fisher_information(body, array, turn, place, 3.0, 5e-3, 100.0)
    assert 0.0 < float(position_bound(information)) < 1.0


def test_airframes_are_read_and_made(tmp_path: Path) -> None:
    made = procedural_airframe("quad_x", 0.25)
    assert_type(made, Airframe)
    path = tmp_path / "corner.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n")
    read = load_airframe(path, unit="m", up="z", forward="x", half_wheelbase_m=0.25)
    for airframe in (made, read):
        assert_type(airframe.cells(0.03, 0.002), Cells)
        assert airframe.sample_surface(jax.random.key(0), 10).shape == (10, 3)


def _sensed() -> np.ndarray | jax.Array:
    """Read by mypy, not run: the commands' own tests do."""
    networks = load_networks()
    config: Config = networks.config
    track = sense(networks, config, draw_scenario(config, 0, 3, "quad_x"), seed=0, snr_db=20.0)
    return track.points


def test_presets_are_configurations() -> None:
    assert_type(preset("smoke"), Config)
    assert preset("smoke").array.count == 8
