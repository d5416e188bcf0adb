"""Thin sheets: partly filled 10 mm cells against the same 2 mm sheet resolved by 2 mm cells, at three tilts.

The sheet lies still in the world while the coarse lattice is tilted under it, so that one resolved solution serves all.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import turned

from august_jax.physics import Cells, PlanarArray, sensing_channel
from august_jax.scene.lattice import shell_cells

ARRAY = PlanarArray(8, 4, 3e9)
PLACE = np.array([0.8, 2.0, 0.6])
SIDE, SKIN = 0.08, 0.002


def resolved():
    steps = (np.arange(40) - 19.5) * SKIN
    grid = np.stack(np.meshgrid(steps, steps, [0.0], indexing="ij"), -1).reshape(-1, 3)
    return Cells(grid, np.full(len(grid), SKIN**3))


@pytest.fixture(scope="module")
def reference():
    cells = resolved().moved(jnp.asarray(turned([0.2, 0.5, 0.3])), jnp.asarray(PLACE))
    cells = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cells)
    return {permittivity: np.asarray(sensing_channel(ARRAY, cells, permittivity - 1.0)) for permittivity in (3.0, 5.0)}


@pytest.mark.parametrize("tilt", [0.0, 0.35, 0.7])
@pytest.mark.parametrize(("permittivity", "ceiling"), [(3.0, 0.05), (5.0, 0.12)])
def test_coarse_cells_stand_for_the_sheet(reference, tilt, permittivity, ceiling):
    half = SIDE / 2
    corners = np.array([[-half, -half, 0], [half, -half, 0], [half, half, 0], [-half, half, 0.0]])
    lean = turned([0.15, tilt, 0.1])  # lattice axes to sheet axes
    coarse = shell_cells((corners @ lean)[np.array([[0, 1, 2], [0, 2, 3]])], 0.01, SKIN)
    cells = coarse.moved(jnp.asarray(turned([0.2, 0.5, 0.3]) @ lean), jnp.asarray(PLACE))
    cells = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cells)
    channel = np.asarray(sensing_channel(ARRAY, cells, permittivity - 1.0))
    exact = reference[permittivity]
    assert np.linalg.norm(channel - exact) < ceiling * np.linalg.norm(exact)
