"""The sensing channel of a body: four solvers behind one signature (paper, eqs. Ei to signal yl).

H = k^2 M^T D V (I - k^2 G D V)^{-1} M for solid cells; see :mod:`august_jax.physics.mom` for partly filled ones.

``mom``
    the full coupled system, dense LU.
``krylov``
    the same system by an iterative solver (:mod:`august_jax.physics.krylov`), for moving positions and contrasts: a
    gradient needs no second solve.
``local_field_born``
    each cell answers the incident field alone, with the quasi-static self term: for solid cells, first-order
    Born times 3/(3 + chi).
``born``
    first order in chi.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex

from august_jax import memory
from august_jax.arrays import Array, ArrayLike
from august_jax.physics.array import AntennaArray, PlanarArray, wavenumber
from august_jax.physics.cells import Cells
from august_jax.physics.checks import (
    check_apart,
    check_cells,
    check_contrast,
    check_ends,
    check_frequency,
    edges_and_fills,
    is_concrete,
    settled,
    settled_cells,
    warn_of_coarse_cells,
)
from august_jax.physics.green import dipole_fields
from august_jax.physics.krylov import LEFT_OUT, differentiable_once, moving_channel, solve_moving
from august_jax.physics.mom import interaction_matrix, solve_dense, weighted_fields

Solver = Literal["mom", "krylov", "local_field_born", "born"]
SOLVERS: tuple[Solver, ...] = get_args(Solver)


def sensing_channel(
    array: PlanarArray | AntennaArray,
    cells: Cells,
    contrast: ArrayLike | Sequence,
    *,
    solver: Solver = "mom",
    frequencies_hz: Sequence[ArrayLike] | Array | None = None,
    receiver: PlanarArray | AntennaArray | None = None,
) -> Complex[jax.Array, "*tones receive transmit"]:
    """Sensing channel H of cells in the world frame.

    Args:
        array: the antennas, transmitting and, without ``receiver``, receiving.
        cells: N cells, in the world frame.
        contrast: chi, scalar or (N,). With ``frequencies_hz``, a leading axis of F is taken as one value (or row)
            a tone: (F, 1) or (F, N).
        solver: ``mom``, ``krylov``, ``local_field_born`` or ``born``.
        frequencies_hz: F tones [Hz]; None means the array's own frequency and no tone axis. They take the carrier's
            place: the antennas stay where they are. Plain numbers keep more digits of the phase than traced ones (1e-6
            against 1e-4 rad at 25 m in single precision).
        receiver: the antennas that receive, where they are not those that transmit; of the same carrier.

    Returns:
        H [1/m] (N_b, N_b), or (F, N_b, N_b); row m is what antenna m receives, column n what n transmits. Complex, of
        the precision of ``cells``, symmetric without ``receiver``. Differentiable in positions, contrast, tones and an
        :class:`AntennaArray`; ``jax.vmap`` makes batches.

    Whole and half-precision numbers among the arguments become float32.

    Raises:
        ValueError: unknown solver, mismatched shapes, malformed cells, a contrast that is not finite, tones that are
            none or not positive, ends of different carriers, or an antenna within a cell.

    Warns where cells are too coarse for the wavelength in their material (in one of permittivity 3, where the contrast
    is traced), and of a contrast that is zero everywhere. Second derivatives through ``krylov`` raise
    NotImplementedError.
    """
    if solver not in SOLVERS:
        raise ValueError(f"solver: unknown solver {solver!r}; choose one of {', '.join(SOLVERS)}")
    cells, rows, tones = _checked(array, cells, contrast, frequencies_hz, receiver)
    if frequencies_hz is None:
        return _channel(array, receiver, cells, jnp.asarray(rows[0]), solver, array.frequency_hz)
    channels = []
    for row, tone in zip(rows, tones, strict=True):
        # A frequency that is differentiated is inside a trace already and cannot be a constant of another.
        solve = _channel if isinstance(tone, float) else _solved
        channels.append(solve(array, receiver, cells, jnp.asarray(row), solver, tone))
    return jnp.stack(channels)


def _checked(array, cells, contrast, frequencies_hz, receiver):
    """Cells of a float type, and contrast and frequency of each tone, all refused or warned of where they should be."""
    cells, contrast = check_cells(cells), settled("contrast", contrast)
    count = cells.count
    check_ends(array, receiver)
    for end in (array, receiver):
        if end is not None:
            check_apart(end, cells)
    if frequencies_hz is None:
        tones = [array.frequency_hz]
    else:
        tones = [] if isinstance(frequencies_hz, (str, float, int)) else list(frequencies_hz)
        if not tones:
            raise ValueError(
                f"frequencies_hz: got {frequencies_hz!r}; give a sequence of tones in Hz, e.g. [3e9], or "
                "None for the array's carrier"
            )
        tones = [check_frequency("frequencies_hz", tone) if is_concrete(tone) else tone for tone in tones]
    if frequencies_hz is not None and np.ndim(contrast) == 2:
        check_contrast(
            contrast,
            ((len(tones), 1), (len(tones), count)),
            f"({len(tones)}, 1) or ({len(tones)}, {count}) for these tones",
        )
        rows = [row[0] if np.shape(row) == (1,) else row for row in contrast]
    else:
        check_contrast(contrast, ((), (count,)), f"a scalar or ({count},), one value a cell")
        rows = [contrast] * len(tones)
    if is_concrete((cells.volumes, cells.fill)):  # they may be constants of a trace in which the body moves
        sizes = edges_and_fills(cells)
        for row, tone in zip(rows, tones, strict=True):
            warn_of_coarse_cells(*sizes, row, wavenumber(tone))
    return cells, rows, tones


def sensing_channels(
    array: PlanarArray | AntennaArray,
    cells: Cells,
    contrast: ArrayLike | Sequence,
    *,
    solver: Solver = "mom",
    frequencies_hz: Sequence[float] | Array | None = None,
    receiver: PlanarArray | AntennaArray | None = None,
    microbatch: int | None = None,
) -> Complex[jax.Array, "batch *tones receive transmit"]:
    """Channels of B targets of equally many cells: :func:`sensing_channel` mapped over their leading axis.

    A dense target needs two matrices of (3N)^2 complex numbers while it is solved, so only ``microbatch`` of them are
    in flight; the result does not depend on it.

    Args:
        array: the antennas.
        cells: every leaf with a leading axis B; ``fill`` may also be one number.
        contrast: (B,), (B, N), and with tones (B, F, 1) or (B, F, N).
        solver, frequencies_hz, receiver: as in :func:`sensing_channel`.
        microbatch: targets in flight; None takes what a quarter of the free memory holds, at most 16, and one for
            ``krylov``: several side by side would each pay for the LU that one of them might need.

    Returns:
        (B, N_b, N_b), or (B, F, N_b, N_b).

    Raises:
        ValueError: as :func:`sensing_channel`, of any of the targets; a batch whose parts disagree in size.

    Warns as :func:`sensing_channel`.
    """
    cells, contrast = settled_cells(cells), settled("contrast", contrast)
    shape = np.shape(cells.positions)
    if len(shape) != 3 or np.shape(contrast)[:1] != shape[:1]:
        raise ValueError(
            f"cells.positions, contrast: got shapes {shape} and {np.shape(contrast)}; give (B, N, 3) and "
            "(B,), one target a row"
        )
    many, count = shape[:2]
    if is_concrete(cells):
        for row in range(many):
            target = Cells(*(part if part is None or np.ndim(part) == 0 else part[row] for part in cells))
            _checked(array, target, contrast[row], frequencies_hz, receiver)
    size = microbatch or (1 if solver == "krylov" else _microbatch(count, jnp.result_type(cells.positions)))
    fill = jnp.broadcast_to(jnp.asarray(cells.fill), np.shape(cells.volumes))

    def one(target):
        body, chi = target
        return sensing_channel(array, body, chi, solver=solver, frequencies_hz=frequencies_hz, receiver=receiver)

    # A batch of one would still be a vmap, in which both sides of a condition are computed.
    targets = (cells._replace(fill=fill), jnp.asarray(contrast))
    return jax.lax.map(one, targets, batch_size=size if size > 1 else None)


def _microbatch(count: int, dtype) -> int:
    """Targets of ``count`` cells whose two matrices fit into a quarter of the memory that is free now."""
    statistics = jax.devices()[0].memory_stats() or {}
    if "bytes_limit" in statistics:
        free = statistics["bytes_limit"] - statistics.get("bytes_in_use", 0)
    else:
        found = memory.memory()
        free = 2**31 if found is None else found.free
    each = 2 * (3 * count) ** 2 * 2 * jnp.dtype(dtype).itemsize
    return int(np.clip(0.25 * free // each, 1, 16))


def _solved(array, receiver, cells, contrast, solver, frequency_hz):
    k = wavenumber(frequency_hz)
    cells = jax.tree.map(jnp.asarray, cells)
    dtype = cells.positions.dtype
    fields = [
        weighted_fields(
            cells, dipole_fields(cells.sites(), jnp.asarray(end.positions, dtype), jnp.asarray(end.moments, dtype), k)
        )
        for end in (array, receiver)
        if end is not None
    ]
    if solver == "krylov":
        # The stationary form wants both ends' fields solved for: one joint problem, of which one block is the answer.
        both = jnp.concatenate(fields, axis=1)
        solution = solve_moving(*jax.lax.stop_gradient((cells, k, contrast, both)))

        def of_few(cells, contrast, both):
            return moving_channel(cells, k, contrast, both, solution)

        @jax.checkpoint  # of what is seldom taken nothing is kept for a gradient
        def of_all(cells, contrast, both):
            return both.T @ _mom(cells, contrast, both, k)

        if both.shape[1] == solution.combinations.shape[1]:
            channel = of_few(cells, contrast, both)
        else:
            channel = jax.lax.cond(solution.missed > LEFT_OUT, of_all, of_few, cells, contrast, both)
        channel = k**2 * channel
        channel = differentiable_once(channel[-fields[-1].shape[1] :, : fields[0].shape[1]])
    else:
        channel = k**2 * fields[-1].T @ _POLARIZATIONS[solver](cells, contrast, fields[0], k)
    return channel if receiver is not None else 0.5 * (channel + channel.T)


_channel = jax.jit(_solved, static_argnames=("solver", "frequency_hz"))


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


_POLARIZATIONS: dict[str, Callable] = {"mom": _mom, "local_field_born": _local_field_born, "born": _born}
"""Polarisations P of the weighted cells under the fields E', by solver name."""
