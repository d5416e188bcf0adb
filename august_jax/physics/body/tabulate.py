"""Making tables of factored bodies: T of :mod:`august_jax.physics.body.table` for a grid of directions.

In each direction, the fields of dipoles at points of the patch are fitted by its functions (least squares over the
patch, in functions that are orthonormal there), thinned to the directions that they span, brought to the body's modes
by W, and multiplied out at each contrast of the table. The principal axes of what comes out are kept.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import lru_cache, partial

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.physics.array import AntennaArray, PlanarArray, wavenumber
from august_jax.physics.body.body import Body, _body_channel, evened
from august_jax.physics.body.cache import Factors, cached, lengthened, shortened
from august_jax.physics.body.patch import Patch, covering, frames
from august_jax.physics.body.table import Table, _table_channel, contrast_nodes
from august_jax.physics.checks import is_concrete
from august_jax.physics.green import inner, path_difference, radial_factors
from august_jax.progress import Progress, silent

_PHASE = 2.95  # k a rho, the phase of the body's edge at a patch's: farther, functions cost more than directions
_COVER = (math.radians(3.0), math.radians(12.0))  # how far a direction may lie from the grid's nearest, least and most
_WIDEST = math.radians(45.0)  # of the angles at which antennas may lie from their middle
_NODES = 4
_TAIL = 4e-3  # relative norm of what the axes that are dropped leave out, in most of the directions
_SPANNED = 72  # axes of the fields that are kept before the body is asked
_PILOTS = 24  # directions from which the number of axes is chosen
_POSES = 192  # by which a table's error is measured
_VERSION = 2.0  # of what is stored


def tabulate(
    body: Body,
    array: PlanarArray | AntennaArray,
    *,
    distance_m: tuple[float, float],
    contrast: tuple[float, float] = (0.5, 4.2),
    loss: float = 0.1,
    elevation_deg: tuple[float, float] = (-90.0, 90.0),
    cache: bool = True,
    progress: Progress = silent,
) -> Table:
    """Tabulate a factored body, or read its table from the cache.

    Args:
        body: from :func:`august_jax.physics.factor_body`, factored for the nearest antenna.
        array: antennas whose extent the table is for; any others that the body sees within as small an angle will do.
            For a transmitter and a receiver apart, ``AntennaArray.joined`` of both.
        distance_m: nearest and farthest the body's origin will be from the antennas' middle [m].
        contrast: range of the real part of chi, permittivity less one.
        loss: largest imaginary part of chi, sigma/(2 pi f eps0); a conductivity of 0.01 S/m at 3 GHz makes 0.06.
        elevation_deg: range of the elevation of the antennas' middle as the body sees it, over its x-y plane [deg]; a
            craft that flies above them and tilts little never sees them overhead.
        cache: keep the table with the factored bodies, in :func:`august_jax.physics.cache_folder`.
        progress: told how far it is.

    Returns:
        A :class:`Table`, its error measured.

    Raises:
        ValueError: ranges that are empty or not finite, antennas nearer than the body was factored for, a traced body
            or array.
    """
    return tabulate_bodies(
        [body],
        array,
        distance_m=distance_m,
        contrast=contrast,
        loss=loss,
        elevation_deg=elevation_deg,
        cache=cache,
        progress=progress,
    )[0]


def tabulate_bodies(
    bodies: Sequence[Body],
    array: PlanarArray | AntennaArray,
    *,
    distance_m: tuple[float, float],
    contrast: tuple[float, float] = (0.5, 4.2),
    loss: float = 0.1,
    elevation_deg: tuple[float, float] = (-90.0, 90.0),
    cache: bool = True,
    progress: Progress = silent,
) -> list[Table]:
    """:func:`tabulate` of several bodies of the same tones, alike in shape: they stack, and share compilations."""
    if not bodies:
        return []
    if len({(body.frequencies_hz, body.single) for body in bodies}) > 1:
        raise ValueError("bodies: they were factored for different frequencies; factor all for the same tones")
    if not is_concrete((list(bodies), array)):
        raise ValueError("body, array: are traced; tabulate outside jit, grad and vmap, and pass the table in")
    places = np.asarray(array.positions, np.float64)
    extent = float(np.linalg.norm(places - places.mean(axis=0), axis=1).max())
    near, far = _checked_ranges(bodies, distance_m, contrast, loss, elevation_deg, extent)
    radius, tones = max(body.radius_m for body in bodies), bodies[0].frequencies_hz
    k = float(wavenumber(max(tones)))
    angle = math.asin(extent / near)
    if angle > _WIDEST:
        raise ValueError(
            f"distance_m: at {near:g} m the body sees antennas {math.degrees(angle):.3g} degrees from their "
            f"middle; keep them within {math.degrees(_WIDEST):.3g}, or take body_channel"
        )
    wanted = math.asin(min(_PHASE / (k * radius), 1.0)) - angle
    cover = min(max(wanted, _COVER[0]), _COVER[1])
    patch = Patch.for_body(k, radius, angle + cover, (near - extent, far + extent))
    directions = covering(cover)
    low, high = (math.sin(math.radians(min(max(bound, -90.0), 90.0))) for bound in elevation_deg)
    lies = directions[:, 2]
    directions = directions[
        (lies >= math.sin(max(math.asin(low) - cover, -0.5 * math.pi)) - 1e-9)
        & (lies <= math.sin(min(math.asin(high) + cover, 0.5 * math.pi)) + 1e-9)
    ]
    axes, nodes = frames(directions), contrast_nodes(contrast, loss, _NODES)
    outline = partial(
        Table,
        directions=jnp.asarray(directions, jnp.float32),
        axes=jnp.asarray(axes, jnp.float32),
        patch=patch,
        nodes=nodes,
        distance_m=(near, far),
        extent_m=extent,
        contrast=(float(contrast[0]), float(contrast[1])),
        loss=float(loss),
        elevation_deg=(float(elevation_deg[0]), float(elevation_deg[1])),
        radius_m=radius,
    )
    settings = np.asarray(
        [
            _VERSION,
            _TAIL,
            _SPANNED,
            _POSES,
            radius,
            near,
            far,
            extent,
            cover,
            *contrast,
            loss,
            *elevation_deg,
            *map(float, patch.across),
            patch.along,
            patch.sine,
        ]
    )
    # Of one shape they are compiled for once, which on an accelerator takes longer than all else; what the cache has
    # needs none.
    shaped = lru_cache(maxsize=None)(lambda: evened(bodies))
    jobs = [(row, tone) for row in range(len(bodies)) for tone in range(len(tones))]
    found = []
    for row, tone in jobs:
        body = bodies[row]

        def make(row=row, tone=tone):
            return _tabulated(shaped()[row], tone, array, axes, outline, progress)

        leaves = [np.asarray(leaf[tone]) for leaf in (body.weights, body.eigenvalues, body.points, body.rows)]
        key = (settings, np.asarray([tones[tone]]), *leaves, places, np.asarray(array.moments, np.float64))
        names = ("functions", "responses", "errors")
        found.append(cached(key, names, make) if cache else make())
    kept = max(factors["functions"].shape[-2] for factors in found)
    unpacked = [_unpacked(factors, kept) for factors in found]
    count = len(tones)
    return [
        outline(
            **{
                name: jnp.asarray(np.stack([each[name] for each in unpacked[row * count : (row + 1) * count]]))
                for name in ("functions", "responses", "errors")
            },
            frequencies_hz=tones,
            single=body.single,
        )
        for row, body in enumerate(bodies)
    ]


def _checked_ranges(bodies, distance_m, contrast, loss, elevation_deg, extent):
    """Nearest and farthest, floats."""
    for name, pair in (("distance_m", distance_m), ("contrast", contrast), ("elevation_deg", elevation_deg)):
        if len(pair) != 2 or not np.all(np.isfinite(pair)) or not pair[0] < pair[1]:
            raise ValueError(f"{name}: got {pair!r}; give two finite numbers, the smaller first")
    if not contrast[0] > 0.0:
        raise ValueError(f"contrast: got {contrast!r}; give a range above 0")
    if not 0.0 <= loss < math.inf:
        raise ValueError(f"loss: got {loss!r}; give the largest imaginary part of chi, 0 or more")
    near, far = map(float, distance_m)
    needed = max(body.nearest_m for body in bodies)
    if near - extent < needed * (1.0 - 1e-6):
        raise ValueError(
            f"distance_m: at {near:g} m an antenna may be {near - extent:.3g} m from the body, which was "
            f"factored for {needed:g} m and beyond; pass a smaller nearest_m to factor_body"
        )
    return near, far


def _tabulated(body, tone, array, axes, outline, progress) -> Factors:
    """V, M (the symmetric halves) and the error of one tone."""
    import scipy.linalg  # noqa: F401  SciPy's own BLAS, which JAX's eigensolver calls: only what is loaded is limited
    from threadpoolctl import threadpool_limits

    frequency = body.frequencies_hz[tone]
    k = wavenumber(frequency)
    patch, nodes = outline.keywords["patch"], np.asarray(outline.keywords["nodes"])
    eigenvalues = np.asarray(body.eigenvalues[tone])
    gains = k**2 * nodes[:, None] / (1.0 - nodes[:, None] * eigenvalues) / (4.0 * np.pi) ** 2
    sines, inverse = patch.samples()
    with jax.enable_x64(True):
        scalars = [np.asarray(part) for part in patch.scalars(jnp.asarray(sines), jnp.asarray(inverse))]
    # Of functions that are orthonormal over the samples, o = s R^{-1}, a field's coefficients are its means with them.
    roots = [np.linalg.qr(part / math.sqrt(len(part))) for part in scalars]
    fits, turns = zip(*((q / math.sqrt(len(q)), np.linalg.inv(r)) for q, r in roots))
    constants = jax.tree.map(lambda part: jnp.asarray(part, jnp.float32), (sines, inverse, fits, turns))
    # W for all components of the field at the points, x first of all points: what it does not take gets no weight.
    count, rows = body.points.shape[1], np.asarray(body.rows[tone])
    weights = np.zeros((*body.weights.shape[1:3], 3 * count), np.float32)
    np.add.at(weights, (slice(None), slice(None), count * (rows % 3) + rows // 3), np.asarray(body.weights[tone]))
    args = (body.points[tone], jnp.asarray(weights), jnp.asarray(gains, jnp.complex64), *constants)
    axes = axes.astype(np.float32)
    pilots = axes[:: max(len(axes) // _PILOTS, 1)]
    spanned = min(_SPANNED, patch.size)
    tails = np.stack([np.asarray(_direction(row, *args, k=k, spanned=spanned)[2]) for row in pilots])
    left = np.sqrt(np.maximum(np.cumsum(tails, axis=1), 0.0) / tails.sum(axis=1, keepdims=True))  # smallest first
    dropped = int(np.sum(np.quantile(left, 0.9, axis=0) < _TAIL))
    kept = min(-8 * (-(spanned - dropped) // 8), spanned)  # as many as processors multiply at a time
    upper = np.triu_indices(kept)
    functions = np.empty((len(axes), patch.size, kept), np.float32)
    responses = np.empty((len(axes), len(nodes), 2, len(upper[0])), np.float32)

    # a thread's own setting, which those of a pool do not inherit
    double = bool(jax.config.jax_enable_x64)  # type: ignore[attr-defined]

    def fill(row):
        with jax.enable_x64(double):
            made, answer, _ = _direction(axes[row], *args, k=k, spanned=spanned)
        functions[row] = made[:, spanned - kept :]
        responses[row] = np.asarray(answer)[..., spanned - kept + upper[0], spanned - kept + upper[1]]
        if row % 200 == 199:
            progress(f"table: {row + 1} of {len(axes)} directions")

    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    # LAPACK's eigensolver works in small steps: threads that wait for each other make it slower.
    with threadpool_limits(1), ThreadPoolExecutor(cores) as pool:
        list(pool.map(fill, range(len(axes))))
    made = {"functions": shortened(functions), "responses": shortened(responses), "errors": np.zeros(2, np.float32)}
    leaves = {name: jnp.asarray(leaf[None]) for name, leaf in _unpacked(made, kept).items()}
    table = outline(**leaves, frequencies_hz=(frequency,), single=True)
    alone = replace(
        body,
        **{name: getattr(body, name)[tone : tone + 1] for name in ("weights", "eigenvalues", "points", "rows")},
        frequencies_hz=(frequency,),
        single=True,
    )
    errors = _measured(table, alone, array)
    return made | {"errors": np.quantile(errors, (0.5, 0.95)).astype(np.float32)}


def _unpacked(factors, kept):
    """Whole symmetric matrices, padded to ``kept`` axes."""
    functions, packed = lengthened(factors["functions"]), lengthened(factors["responses"])
    own = functions.shape[-1]
    upper = np.triu_indices(own)
    responses = np.zeros((*packed.shape[:-1], kept, kept), np.float32)
    responses[..., upper[0], upper[1]] = packed
    responses[..., upper[1], upper[0]] = packed
    return {
        "functions": np.pad(functions, [(0, 0), (0, 0), (0, kept - own)]),
        "responses": responses,
        "errors": factors["errors"],
    }


@partial(jax.jit, static_argnames=("k", "spanned"))
def _direction(axes, points, weights, gains, sines, inverse, fits, turns, *, k, spanned):
    """V (functions, spanned), M (nodes, 2, spanned, spanned) and what each axis holds, squared, smallest first."""
    real, imag = _fitted(axes, points, sines, inverse, fits, k)
    _, span = jnp.linalg.eigh(real.T @ real + imag.T @ imag)
    span = span[:, -spanned:]
    real, imag = real @ span, imag @ span
    plain, difference, total = weights
    both = plain @ (real + imag)
    real, imag = both - total @ imag, both + difference @ real
    parts = jnp.concatenate([real, imag], axis=1)

    def response(gain):
        a, b = gain.real[:, None], gain.imag[:, None]
        blocks = parts.T @ jnp.concatenate([a * real - b * imag, a * imag + b * real], axis=1)
        answer = jnp.stack(
            [
                blocks[:spanned, :spanned] - blocks[spanned:, spanned:],
                blocks[:spanned, spanned:] + blocks[spanned:, :spanned],
            ]
        )
        return 0.5 * (answer + jnp.swapaxes(answer, -1, -2))

    answers = jnp.stack([response(gain) for gain in gains])
    level = jnp.sqrt(jnp.sum(answers**2, axis=(1, 2, 3), keepdims=True))
    flat = (answers / level).reshape(-1, spanned)
    values, vectors = jnp.linalg.eigh(flat.T @ flat)
    answers = jnp.einsum("ar,cpab,bs->cprs", vectors, answers, vectors)
    chosen = span @ vectors
    split = jnp.split(chosen, (fits[0].shape[1], 2 * fits[0].shape[1]))
    functions = jnp.concatenate([turn @ part for turn, part in zip((turns[0], *turns), split, strict=True)])
    return functions, answers, values


def _fitted(axes, points, sines, inverse, fits, k):
    """Real and imaginary coefficients (3 p, functions) of the fields at the points, the spherical waves taken out."""
    height = jnp.sqrt(1.0 - sines[:, 0] ** 2 - sines[:, 1] ** 2)
    unit = jnp.concatenate([sines, height[:, None]], axis=1) @ axes
    sources = unit / inverse[:, None]
    offset = points[:, None]
    longer = path_difference(offset, sources)
    distance = 1.0 / inverse + longer
    displacement = offset - sources
    g, h = radial_factors(k * distance)
    wave = jax.lax.complex(jnp.cos(k * longer), jnp.sin(k * longer)) / (inverse * distance)
    lengthwise, plain = wave * g / distance**2, wave * h
    slope = (axes[2] + unit) / (1.0 + height)[:, None]
    # The radial moment comes as m_r/r, so that its field is fitted times r.
    moments = (axes[0] - sines[:, :1] * slope, axes[1] - sines[:, 1:] * slope, unit / inverse[:, None])
    found = []
    for moment, fit in zip(moments, (fits[0], *fits), strict=True):
        along = inner(displacement, moment)
        pair = []
        for first, second in ((lengthwise.real, plain.real), (lengthwise.imag, plain.imag)):
            strength = first * along
            field = jnp.stack([strength * displacement[..., axis] - second * moment[:, axis] for axis in range(3)])
            pair.append(field.reshape(-1, field.shape[-1]) @ fit)
        found.append(pair)
    return tuple(jnp.concatenate([part[row] for part in found], axis=1) for row in range(2))


def _measured(table, body, array):
    """Relative errors of channels in random poses, all about the array."""
    random = np.random.default_rng(0)
    toward = random.normal(size=(_POSES, 3))
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    centre = np.asarray(array.positions, np.float64).mean(axis=0)
    places = centre + random.uniform(*table.distance_m, size=(_POSES, 1)) * toward
    turns = _random_rotations(random, _POSES)
    low, high = (math.sin(math.radians(bound)) for bound in table.elevation_deg)
    for row in range(_POSES):
        while not low <= -(toward[row] @ turns[row])[2] <= high:
            turns[row] = _random_rotations(random, 1)[0]
    chi = random.uniform(*table.contrast, _POSES) + 1j * random.uniform(0.0, table.loss, _POSES)

    poses = (jnp.asarray(turns, jnp.float32), jnp.asarray(places, jnp.float32), jnp.asarray(chi, jnp.complex64))
    return np.asarray(_errors(table, body, array, poses))


@jax.jit
def _errors(table, body, array, poses):
    def error(pose):
        fast = _table_channel(table, array, None, *pose, None, None)
        slow = _body_channel(body, array, None, *pose)
        return jnp.linalg.norm(fast - slow) / jnp.linalg.norm(slow)

    return jax.lax.map(error, poses, batch_size=16)


def _random_rotations(random, count):
    """Rotation matrices (count, 3, 3), uniform: the orthogonal part of random matrices, mirrors turned over."""
    q, r = np.linalg.qr(random.normal(size=(count, 3, 3)))
    q = q * np.sign(np.diagonal(r, axis1=1, axis2=2))[:, None]
    return q * np.sign(np.linalg.det(q))[:, None, None]
