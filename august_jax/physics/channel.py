"""The sensing channel of a body: three solvers behind one signature (paper, eqs. Ei to signal yl).

H = k^2 M^T D V (I - k^2 G D V)^{-1} M for solid cells; see :mod:`august_jax.physics.mom` for partly filled ones.

``mom``
    the full coupled system, dense LU.
``local_field_born``
    each cell answers the incident field alone, with the quasi-static self term: for solid cells, first-order
    Born times 3/(3 + chi).
``born``
    first order in chi.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.physics.array import PlanarArray, wavenumber
from august_jax.physics.cells import Cells
from august_jax.physics.checks import check_cells, check_contrast, is_concrete
from august_jax.physics.green import dipole_fields
from august_jax.physics.mom import interaction_matrix, solve_dense, weighted_fields


def sensing_channel(
    array: PlanarArray,
    cells: Cells,
    contrast: jax.Array | complex,
    *,
    solver: str = "mom",
    frequencies_hz: Sequence[float] | None = None,
) -> jax.Array:
    """Sensing channel H of cells in the world frame.

    Args:
        array: the antennas, transmitting and receiving.
        cells: N cells, in the world frame.
        contrast: chi, scalar or (N,). With ``frequencies_hz``, a leading axis of F is taken as one value (or row)
            a tone: (F, 1) or (F, N).
        solver: ``mom``, ``local_field_born`` or ``born``.
        frequencies_hz: F tones [Hz]; None means the array's own frequency and no tone axis.

    Returns:
        H [1/m] (N_b, N_b), or (F, N_b, N_b); complex, symmetric, of the precision of ``cells``. Differentiable in
        positions and contrast; ``jax.vmap`` makes batches.

    Raises:
        ValueError: unknown solver, mismatched shapes, malformed cells, or an antenna within a cell.
    """
    if solver not in SOLVERS:
        raise ValueError(f"solver: unknown solver {solver!r}; choose one of {', '.join(SOLVERS)}")
    check_cells(cells)
    count = cells.positions.shape[0]
    if is_concrete(cells):
        gap = np.linalg.norm(np.asarray(cells.positions)[:, None] - array.positions, axis=-1).min()
        if gap < np.cbrt(np.max(cells.volumes)):
            raise ValueError(f"cells.positions: a cell is {gap:.3g} m from an antenna; keep the array outside the body")
    if frequencies_hz is None:
        check_contrast(contrast, count)
        return _channel(array, cells, jnp.asarray(contrast), solver, array.frequency_hz)
    tones = tuple(float(tone) for tone in frequencies_hz)
    if np.ndim(contrast) == 2:
        if np.shape(contrast)[0] != len(tones) or np.shape(contrast)[1] not in (1, count):
            raise ValueError(
                f"contrast: got shape {np.shape(contrast)}; give ({len(tones)}, 1) or ({len(tones)}, {count}) for these "
                "tones"
            )
        rows = [contrast[tone] if np.shape(contrast)[1] == count else contrast[tone, 0] for tone in range(len(tones))]
    else:
        check_contrast(contrast, count)
        rows = [contrast] * len(tones)
    return jnp.stack([
        _channel(array, cells, jnp.asarray(row), solver, tone) for row, tone in zip(rows, tones, strict=True)
    ])


@partial(jax.jit, static_argnames=("array", "solver", "frequency_hz"))
def _channel(array, cells, contrast, solver, frequency_hz):
    k = wavenumber(frequency_hz)
    cells = jax.tree.map(jnp.asarray, cells)
    dtype = cells.positions.dtype
    fields = dipole_fields(
        cells.positions, jnp.asarray(array.positions, dtype), jnp.asarray(array.polarization, dtype), k
    )
    fields = weighted_fields(cells, fields)
    channel = k**2 * fields.T @ SOLVERS[solver](cells, contrast, fields, k)
    return 0.5 * (channel + channel.T)


def _mom(cells: Cells, contrast, fields, k):
    return solve_dense(interaction_matrix(cells, k), contrast, fields).polarization


def _born(cells: Cells, contrast, fields, k):
    chi = jnp.repeat(jnp.broadcast_to(contrast, cells.volumes.shape), 3).astype(fields.dtype)
    return chi[:, None] * fields


def _local_field_born(cells: Cells, contrast, fields, k):
    chi = jnp.broadcast_to(contrast, cells.volumes.shape)[:, None, None].astype(fields.dtype)
    fill = cells.fractions()[:, None, None]
    identity = jnp.eye(3, dtype=fields.dtype)
    block = identity + chi * (fill / 3.0 * identity + (1.0 - fill) * cells.tensors())
    incident = fields.reshape(-1, 3, fields.shape[-1])
    return jnp.linalg.solve(block, chi * incident).reshape(fields.shape)


SOLVERS: dict[str, Callable] = {"mom": _mom, "local_field_born": _local_field_born, "born": _born}
"""Polarisations P of the weighted cells under the fields E', by solver name."""
