"""The offline reduction of a body's coupled system (I/chi - K') P = E', H = k^2 E'^T P, in its own frame.

1. The fields of dipoles beyond a few metres span far fewer than 3N dimensions on the body. Their span U is found
   from random sources, and m rows of it (:mod:`august_jax.physics.body.spans`) determine all others:
   E' = U U_S^{-1} E'_S.
2. The polarisations that such fields excite span a space Q little larger than U. Galerkin projection with the
   symmetric form keeps H = H^T and makes its error second order in what Q misses. Q is built from solutions at
   the contrasts ``NODES``, as finely as the error measured at another, :attr:`Body.error`, asks for.
3. The projected matrix Q^T K' Q is diagonalised by complex-symmetric eigenvectors, Y^T Y = I, so that

       H = k^2 F^T diag(chi / (1 - chi lambda)) F,    F = W E'_S,    W = Y^T Q^T U U_S^{-1}.

U and Q are real, and all that grows with the cube of the cells is real arithmetic in single precision. Fields of far
sources are sums of standing waves, which are real. In (I/chi - Re K') P = E' + j Im K' P at real chi, Im K' P is a sum
of such waves too (Im G is regular), so that real solutions span what the complex ones do, but for one thing: cells
couple at their positions and hear at their centroids. The part of Im K' P that U lacks is small and drives solutions
of its own.

It runs on the CPU with NumPy and SciPy.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.physics.array import wavenumber
from august_jax.physics.body.body import CHECKS, Body
from august_jax.physics.body.cache import Factors, cached
from august_jax.physics.body.spans import pivots, spanned
from august_jax.physics.cells import Cells
from august_jax.physics.checks import (
    check_cells,
    check_frequency,
    coarseness,
    edges_and_fills,
    is_concrete,
    warn_of_coarse_cells,
)
from august_jax.physics.green import dyadic_green, radial_factors
from august_jax.physics.mom import own_blocks

NODES = (0.5, 2.0, 5.0)
"""Contrasts whose solutions span Q: permittivities from 1 to 7, little loss. Farther out the error grows; what it is
there is measured (:attr:`Body.errors`)."""

_CHECK = CHECKS[0]
_BEYOND = (12.0, 40.0)  # contrasts of the solutions that the error beyond the nodes is measured by
_PROBES = 8  # fields that it is measured with
_ERROR = 3e-5  # relative error of H at _CHECK that is good enough; a weak echo has several times as much
_SPAN_TOLERANCE = 5e-7  # smallest singular value kept of the incident fields, relative to the largest
_BASIS_TOLERANCES = (7e-3, 3e-3, 1e-3)  # the same of the polarisations, tried in turn: H errs by about their square
_FACTORS = ("weights", "eigenvalues", "points", "rows", "errors")


def factor_body(
    cells: Cells, frequency_hz: float | Sequence[float], *, nearest_m: float = 2.0, cache: bool = True
) -> Body:
    """Reduce and diagonalise a body's coupled system, or read it from the cache.

    Args:
        cells: the body's cells in its own frame; poses rotate about that frame's origin.
        frequency_hz: one frequency, or several tones [Hz].
        nearest_m: every antenna will be at least this far from the origin of the body's frame [m]; a larger
            distance needs fewer functions.
        cache: keep the result in :func:`cache_folder` under a hash of all that it depends on.

    Returns:
        A :class:`Body`. Half a minute on one core for 1000 cells, two to three minutes on two cores for 3700.

    Raises:
        ValueError: malformed cells, frequencies that are none or not positive, or ``nearest_m`` inside the body.

    Warns where the cells are too coarse for a material of permittivity 3; :func:`body_channel` judges the one it gets.
    """
    return factor_bodies([cells], frequency_hz, nearest_m=nearest_m, cache=cache)[0]


def factor_bodies(
    bodies: Sequence[Cells], frequency_hz: float | Sequence[float], *, nearest_m: float = 2.0, cache: bool = True
) -> list[Body]:
    """:func:`factor_body` of several bodies, and of several tones, side by side: one core each, where that suffices.

    Much of the work does not profit from a second core. A body takes 1 GB of memory for 1000 cells, 3 GB for 3700.
    """
    single = np.ndim(frequency_hz) == 0
    tones = tuple(check_frequency("frequency_hz", tone) for tone in np.atleast_1d(np.asarray(frequency_hz, object)))
    if not tones:
        raise ValueError("frequency_hz: got no tones; give at least one frequency in Hz, e.g. 3e9")
    plain, radii, coarsest = [], [], []
    for cells in bodies:
        if not is_concrete(cells):
            raise ValueError("cells: are traced; factor the body outside jit, grad and vmap, and pass it in")
        cells = check_cells(cells)
        plain.append(Cells(*(None if part is None else np.asarray(part, np.float64) for part in cells)))
        edges, fills = edges_and_fills(plain[-1])
        warn_of_coarse_cells(edges, fills, None, wavenumber(max(tones)))
        worst = int(np.argmax(coarseness(edges, fills)))
        coarsest.append((float(edges[worst]), float(fills[worst])))
        radii.append(float(np.linalg.norm(plain[-1].sites(), axis=1).max()))
        if not 1.2 * radii[-1] < nearest_m < np.inf:
            raise ValueError(
                f"nearest_m: {nearest_m:g} m is no farther than the body's own radius, {radii[-1]:.3g} m, and a margin "
                "of 20 %"
            )
    jobs = [(cells, tone) for cells in plain for tone in tones]
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    workers = min(len(jobs), cores)
    if workers > 1:
        import scipy.linalg  # noqa: F401  SciPy's own BLAS: only what is loaded is limited
        from threadpoolctl import threadpool_limits

        with threadpool_limits(cores // workers), ThreadPoolExecutor(workers) as pool:
            factors = list(pool.map(lambda job: _cached(job[0], job[1], float(nearest_m), cache), jobs))
    else:
        factors = [_cached(cells, tone, float(nearest_m), cache) for cells, tone in jobs]
    count = len(tones)
    return [
        _joined(factors[row * count : (row + 1) * count], tones, single, radius, float(nearest_m), cells.count, *cell)
        for row, (cells, radius, cell) in enumerate(zip(plain, radii, coarsest, strict=True))
    ]


def _joined(factors, tones, single, radius, nearest_m, count, edge_m, fill) -> Body:
    """One body of its tones' factors, padded to a common size."""
    sizes = (("weights", 1), ("rows", 0), ("points", 0))
    modes, columns, points = (max(factor[name].shape[axis] for factor in factors) for name, axis in sizes)

    def padded(name, *shape):
        return np.stack(
            [np.pad(f[name], [(0, n - s) for s, n in zip(f[name].shape, shape, strict=True)]) for f in factors]
        )

    return Body(
        weights=jnp.asarray(padded("weights", 3, modes, columns)),
        eigenvalues=jnp.asarray(padded("eigenvalues", modes)),
        points=jnp.asarray(padded("points", points, 3)),
        rows=jnp.asarray(padded("rows", columns)),
        frequencies_hz=tones,
        single=single,
        radius_m=radius,
        nearest_m=nearest_m,
        errors=tuple(np.max([factor["errors"] for factor in factors], axis=0).tolist()),
        cells=count,
        edge_m=edge_m,
        fill=fill,
    )


def _cached(cells: Cells, frequency_hz: float, nearest_m: float, cache: bool) -> Factors:
    """One tone's factors, from the disk where they are there."""
    settings = (frequency_hz, nearest_m, _SPAN_TOLERANCE, *_BASIS_TOLERANCES, _ERROR, *NODES, *_BEYOND, *CHECKS)

    def make():
        return _factor(cells, frequency_hz, nearest_m)

    return cached((*cells, np.asarray(settings)), _FACTORS, make) if cache else make()


def _factor(cells: Cells, frequency_hz: float, nearest_m: float) -> Factors:
    """The offline computation at one tone."""
    import scipy.linalg
    from threadpoolctl import threadpool_limits

    k = wavenumber(frequency_hz)
    parts = _interaction_parts(cells, k)
    weight = np.repeat(np.sqrt(np.broadcast_to(cells.fill, cells.volumes.shape) * cells.volumes), 3)
    random = np.random.default_rng(0)
    samples, span, values = 854, None, None
    # Samples for 0.6 of the rank, each two columns, interpolate the weakest fields four times worse than for 0.74.
    while span is None or (span.shape[1] > 1.25 * samples and samples < 3 * len(weight)):
        samples = 3 * samples // 2
        fields = weight[:, None] * _random_fields(cells.sites(), k, nearest_m, samples, random)
        span, values = spanned(np.concatenate([fields.real, fields.imag], axis=1), _SPAN_TOLERANCE)
    probe = weight[:, None] * _random_fields(cells.sites(), k, nearest_m, 24, random)
    rows = pivots(span)
    inverse = np.linalg.inv(span[rows])
    interpolated = span @ (inverse @ probe[rows])
    solutions, solve = _solutions(parts, span, values)
    for tolerance in _BASIS_TOLERANCES:
        basis = _polarization_basis(solutions, tolerance)
        reduced = _projected(parts, basis)
        system = np.eye(len(reduced)) / _CHECK - reduced
        seen = basis.T @ interpolated
        fast = seen.T @ np.linalg.solve(system, seen)
        exact = _response(parts, probe, basis @ np.linalg.solve(system, basis.T @ probe), solve)
        error = np.linalg.norm(fast - exact) / np.linalg.norm(exact)
        if error < _ERROR:
            break
    del solutions, solve
    few = probe[:, :_PROBES]
    space, across, corner = _beyond(parts, basis, few)
    beside = basis.T @ few, space.T @ few
    del parts, space
    # LAPACK's eigensolver works in small steps: threads that wait for each other make it up to ten times slower.
    with threadpool_limits(1):
        eigenvalues, vectors = scipy.linalg.eig(reduced, overwrite_a=True, check_finite=False)
    vectors = _symmetric_orthonormal(vectors, eigenvalues)
    errors = _errors_beyond(
        eigenvalues, vectors.T @ seen[:, :_PROBES], vectors.T @ beside[0], beside[1], vectors.T @ across, corner
    )
    incident = (basis.T @ span) @ inverse * weight[rows]
    real, imag = vectors.real.T @ incident, vectors.imag.T @ incident
    points, place = np.unique(rows // 3, return_inverse=True)
    return {
        "weights": np.stack([real, imag - real, real + imag]).astype(np.float32),
        "eigenvalues": eigenvalues.astype(np.complex64),
        "points": cells.sites()[points].astype(np.float32),
        "rows": (3 * place + rows % 3).astype(np.int32),
        "errors": np.array([error, *errors]),
    }


def _interaction_parts(cells, k, slab=128):
    """Re K' and Im K' of :mod:`august_jax.physics.mom` (2, 3N, 3N): float32, made in float64 a few cells at a time."""
    count = cells.count
    weight = k * np.sqrt(np.broadcast_to(cells.fill, cells.volumes.shape) * cells.volumes)
    parts = np.empty((2, 3 * count, 3 * count), np.float32)
    with jax.enable_x64(True):
        for start in range(0, count, slab):
            start = max(min(start, count - slab), 0)  # slabs of one shape: the last overlaps
            here = slice(start, start + slab)
            parts[:, 3 * start : 3 * (start + slab)] = _slab(
                cells.positions[here], cells.positions, weight[here], weight, k
            )
        own = np.asarray(own_blocks(cells, k))
    place = np.arange(count)
    for part, diagonal in zip(parts, (own.real, own.imag), strict=True):
        part.reshape(count, 3, count, 3)[place, :, place, :] = diagonal
    return parts


@jax.jit
def _slab(positions, others, weights, other_weights, k):
    separation = positions[:, None] - others
    itself = jnp.all(separation == 0.0, axis=-1)[..., None]  # its block is finite here and overwritten
    green = dyadic_green(jnp.where(itself, 1.0, separation), k)
    rows = ((weights[:, None] * other_weights)[..., None, None] * green).transpose(0, 2, 1, 3)
    return jnp.stack([rows.real, rows.imag]).astype(jnp.float32).reshape(2, -1, 3 * len(others))


def _real_solver(parts, chi):
    """Solves (I/chi - Re K') P = E' for real E' and chi, in float32."""
    import scipy.linalg

    system = -parts[0].T  # symmetric; LAPACK works in place on columns
    system[np.diag_indices_from(system)] += np.float32(1.0 / chi)
    factors = scipy.linalg.lu_factor(system, overwrite_a=True, check_finite=False)
    return lambda fields: scipy.linalg.lu_solve(factors, fields.astype(np.float32), check_finite=False)


def _solutions(parts, span, values):
    """Polarisations (3N, m) whose span holds the responses to all fields, and the solver at the last of the NODES.

    One set a node, for fields as strong as they are, and one for what the last radiates beyond the span.
    """
    strong = values > 0.3 * _BASIS_TOLERANCES[-1] * values[0]  # weaker fields add nothing above the tolerance
    incident = span[:, strong] * (values[strong] / values[0])
    solutions = []
    for chi in NODES:
        solve = _real_solver(parts, chi)
        solutions.append(solve(incident))
    radiated = parts[1] @ solutions[-1]
    single = span.astype(np.float32)
    return [*solutions, solve(radiated - single @ (single.T @ radiated))], solve


def _times(parts, real):
    """K' times a real matrix."""
    product = np.empty(real.shape, np.complex64)
    product.real, product.imag = parts[0] @ real, parts[1] @ real
    return product


def _projected(parts, basis):
    """Q^T K' Q (n, n) of a real basis, symmetric; complex128, of products in single precision."""
    reduced = (basis.T @ _times(parts, basis)).astype(np.complex128)
    return 0.5 * (reduced + reduced.T)


def _response(parts, fields, solution, solve):
    """E'^T P at _CHECK from an approximate P, corrected to second order by a small space that its residual spans."""
    both = _times(parts, np.concatenate([solution.real, solution.imag], axis=1).astype(np.float32))
    missed = fields - solution / _CHECK + both[:, : both.shape[1] // 2] + 1j * both[:, both.shape[1] // 2 :]
    first = solve(np.concatenate([missed.real, missed.imag], axis=1))
    space, _ = np.linalg.qr(np.concatenate([first, solve(first), solve(parts[1] @ first)], axis=1))
    seen = space.T @ missed
    correction = seen.T @ np.linalg.solve(np.eye(space.shape[1]) / _CHECK - _projected(parts, space), seen)
    return fields.T @ solution + solution.T @ missed + correction


def _beyond(parts, basis, fields):
    """Polarisations Z (3N, m) beside Q that some fields excite at ``_BEYOND``, with Q^T K' Z (n, m) and Z^T K' Z."""
    driven, found = np.concatenate([fields.real, fields.imag], axis=1), []
    for chi in _BEYOND:
        solve = _real_solver(parts, chi)
        found.append(solve(driven))
        for _ in range(2):  # what they radiate drives others
            found.append(solve(parts[1] @ found[-1]))
    space = np.concatenate(found, axis=1)
    space /= np.linalg.norm(space, axis=0)
    for _ in range(2):
        space -= basis @ (basis.T @ space)
    space = spanned(space.astype(np.float64), 1e-5)[0].astype(np.float32)
    space -= basis @ (basis.T @ space)
    image = _times(parts, space)
    corner = (space.T @ image).astype(np.complex128)
    return space, basis.T @ image, 0.5 * (corner + corner.T)


def _errors_beyond(eigenvalues, seen, fields, others, across, corner):
    """Relative errors of the reduced response to some fields at ``CHECKS`` but the first.

    The reference is the response in the larger space of Q and Z: between and about the contrasts that Z was made at it
    errs by the square of what it misses.

    Args:
        eigenvalues: lambda of Q^T K' Q = Y diag(lambda) Y^T (n,).
        seen: the fields as the reduction sees them (n, P), by Y; ``fields`` (n, P) and ``others`` (m, P) as they are,
            by Y and by Z.
        across: Y^T Q^T K' Z (n, m).
        corner: Z^T K' Z (m, m).
    """
    errors = []
    for chi in CHECKS[1:]:
        answer = 1.0 / (1.0 / chi - eigenvalues)[:, None]
        fast = seen.T @ (answer * seen)
        rest = others + across.T @ (answer * fields)
        schur = np.eye(len(corner)) / chi - corner - across.T @ (answer * across)
        exact = fields.T @ (answer * fields) + rest.T @ np.linalg.solve(schur, rest)
        errors.append(np.linalg.norm(fast - exact) / np.linalg.norm(exact))
    return errors


def _random_fields(points, k, nearest_m, count, random):
    """Fields at the points of randomly turned dipoles, each times its distance, beyond ``nearest_m`` (3N, count)."""
    direction, moment = random.normal(size=(2, count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    moment /= np.linalg.norm(moment, axis=1, keepdims=True)
    # Uniform in 1/r, from the nearest place to infinity (here: a hundred times as far).
    distance = nearest_m / random.uniform(0.01, 1.0, size=(count, 1))
    distance[: count // 2] = nearest_m
    offset = points[:, None] - distance * direction
    r = np.linalg.norm(offset, axis=-1)
    g, h = radial_factors(k * r)
    wave = np.exp(1j * k * (r - distance[:, 0])) * distance[:, 0] / (4.0 * np.pi * r)
    along = np.einsum("nsa,sa->ns", offset, moment) / r**2
    field_ = (wave * g * along)[..., None] * offset - (wave * h)[..., None] * moment
    return field_.transpose(0, 2, 1).reshape(-1, count)


def _polarization_basis(solutions, tolerance):
    """Q (3N, n): orthonormal basis of real solutions (3N, m), weighted as the fields are; float32."""
    basis = np.zeros((len(solutions[0]), 0), np.float32)
    largest = np.linalg.norm(solutions[0][:, 0])  # the strongest incident field comes first
    for solution in solutions:
        for _ in range(2):
            solution = solution - basis @ (basis.T @ solution)
        double = solution.astype(np.float64)
        values, vectors = np.linalg.eigh(double.T @ double)
        keep = values > max((tolerance * largest) ** 2, 1e-12 * values[-1])
        basis = np.concatenate([basis, solution @ (vectors[:, keep] / np.sqrt(values[keep])).astype(np.float32)], 1)
    # What is left of solutions that others nearly hold has rounding errors that its scaling magnifies.
    gram = (basis.T @ basis).astype(np.float64)
    return basis @ np.linalg.inv(np.linalg.cholesky(gram)).T.astype(np.float32)


def _symmetric_orthonormal(vectors, eigenvalues):
    """Scale eigenvectors to Y^T Y = I; equal eigenvalues (symmetric bodies) are orthogonalised as a group."""
    import scipy.linalg
    from scipy.sparse.csgraph import connected_components

    vectors = vectors / np.sqrt(np.sum(vectors**2, axis=0))
    close = np.abs(eigenvalues[:, None] - eigenvalues) < 1e-6 * np.abs(eigenvalues).max()
    groups, label = connected_components(close, directed=False)
    for group in np.flatnonzero(np.bincount(label, minlength=groups) > 1):
        place = np.flatnonzero(label == group)
        block = vectors[:, place]
        vectors[:, place] = block @ scipy.linalg.inv(scipy.linalg.sqrtm(block.T @ block))
    return vectors
