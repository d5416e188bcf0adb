r"""The coupling of moving cells in real planes, one for each pair of components: the least memory it takes.

    G_ab(p_i, p_j) = A d_a d_b + B delta_ab,    d = p_i - p_j,

has six different components, each of them symmetric in i and j. They are kept as six real and six imaginary planes,
two thirds of the (3N, 3N) complex matrix, written once and in real arithmetic. With phi_0 = e^{jkr}/(4 pi r) and
phi_{n+1} = (1/r) d phi_n/dr,

    A = phi_2/k^2,    B = phi_0 + phi_1/k^2,    (1/r) dA/dr = phi_3/k^2,    (1/r) dB/dr = phi_1 + A.

A change of positions, too, is computed in blocks of rows: in reverse, the cotangent of a plane is a product of thin
matrices, and is met by the derivative of G while both are in the cache.

Vectors are (3, N, 2R) real: component by component, real parts of R columns before their imaginary parts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

_ROWS = 128  # of a block
_FOUR_PI, _TURN = 4.0 * np.pi, 2.0 * np.pi


class Planes(NamedTuple):
    """G between all pairs of N points, zero where both are one point.

    Attributes:
        real, imaginary: xx, xy, xz, yy, yz, zz (N', N) [1/m]; rows beyond N fill up the last block.
    """

    real: list[jax.Array]
    imaginary: list[jax.Array]


def coupling_planes(points: jax.Array, wavenumber: float | jax.Array) -> Planes:
    """The planes of points (N, 3), no two equal; not meant to be differentiated: see :func:`coupling_change`."""
    planes = jax.lax.map(lambda index: _block(points, index, wavenumber), _row_blocks(points.shape[0]))
    return jax.tree.map(lambda plane: plane.reshape(-1, plane.shape[-1]), planes)


def planes_product(planes: Planes, vectors: jax.Array) -> jax.Array:
    """G x for x (3, N, 2R): (3, N', 2R)."""
    half = vectors.shape[-1] // 2
    real, imaginary = (_symmetric_product(part, vectors) for part in planes)
    return real + jnp.concatenate([-imaginary[..., half:], imaginary[..., :half]], axis=-1)


def coupled_fields(planes: Planes, sources: jax.Array) -> jax.Array:
    """G x for x (3N, R) complex, point by point as everywhere else."""
    return _from_planar(planes_product(planes, _planar(sources))[:, : sources.shape[0] // 3])


@jax.custom_jvp
def coupling_change(points: jax.Array, wavenumber: float | jax.Array, sources: jax.Array) -> jax.Array:
    """Zero (R, R), with the derivative x^T dG x for x (3N, R), which is held fixed."""
    return jnp.zeros((sources.shape[-1],) * 2, sources.dtype)


def _coupling_change_tangent(primals, tangents):
    points, wavenumber, sources = primals
    moved, tuned, _ = (None if isinstance(t, SymbolicZero) else t for t in tangents)
    vectors, count = _planar(sources), points.shape[0]
    nothing = coupling_change(points, wavenumber, sources)

    def of_block(index):
        inside = jnp.minimum(index, count - 1)
        mine = _from_planar(jnp.where(index[:, None] < count, vectors[:, inside], 0.0))

        def form(planes):
            return mine.T @ _from_planar(planes_product(planes, vectors))

        change = nothing
        if moved is not None:
            one_end = form(_moved_block(points, index, wavenumber, moved[inside]))
            change = change + one_end + one_end.T  # to move the other end of each pair gives the transpose
        if tuned is not None:
            change = change + form(jax.jvp(lambda k: _block(points, index, k), (wavenumber,), (tuned,))[1])
        return change

    # Computed again for the backward pass: kept, the derivatives of G would take more memory than G.
    of_block = jax.checkpoint(of_block, prevent_cse=False)
    return nothing, jax.lax.map(of_block, _row_blocks(count)).sum(axis=0)


coupling_change.defjvp(_coupling_change_tangent, symbolic_zeros=True)


def _row_blocks(count):
    """Row numbers (blocks, rows of a block); those of ``count`` and more fill up the last block."""
    blocks = -(-count // _ROWS)
    rows = 2 * -(-count // (2 * blocks))
    return jnp.arange(blocks * rows, dtype=jnp.int32).reshape(blocks, rows)


def _block(points, index, wavenumber):
    """Rows of the planes."""
    (x, y, z), along, alike = _radial(points, index, wavenumber)[:3]
    planes = []
    for a, b in zip(along, alike):
        ax, ay = a * x, a * y
        planes.append([ax * x + b, ax * y, ax * z, ay * y + b, ay * z, a * z * z + b])
    return Planes(*planes)


def _moved_block(points, index, wavenumber, moved):
    """The change of rows of the planes where the points of these rows move by (rows, 3), to which it is linear."""
    d, along, _, along_slope, alike_slope = _radial(points, index, wavenumber)
    # As whole planes: backwards, their cotangents are then added up before they are summed over a row, once.
    moved = [jnp.broadcast_to(moved[:, axis, None], d[axis].shape) for axis in range(3)]
    farther = sum(part * change for part, change in zip(d, moved))  # r dr
    planes = []
    for a, steeper, b in zip(along, along_slope, alike_slope):
        b, half = b * farther, (0.5 * steeper) * farther
        h = [a * change + half * part for part, change in zip(d, moved)]
        # d(A d d^T + B I) = d h^T + h d^T + dB I
        planes.append(
            [
                2.0 * (d[0] * h[0]) + b,
                d[0] * h[1] + d[1] * h[0],
                d[0] * h[2] + d[2] * h[0],
                2.0 * (d[1] * h[1]) + b,
                d[1] * h[2] + d[2] * h[1],
                2.0 * (d[2] * h[2]) + b,
            ]
        )
    return Planes(*planes)


def _radial(points, index, wavenumber):
    """d (three parts), A, B, (1/r) dA/dr and (1/r) dB/dr (real and imaginary part each) of rows."""
    here = jnp.minimum(index, points.shape[0] - 1)

    def displacements(here):
        return [points[here, axis, None] - points[:, axis] for axis in range(3)]

    def wave(here):
        x, y, z = displacements(here)
        square = x * x + y * y + z * z
        same = here[:, None] == jnp.arange(points.shape[0])
        inverse = jnp.where(same, 0.0, jax.lax.rsqrt(jnp.where(same, 1.0, square)))
        cosine, sine = _cosine_and_sine((wavenumber / _TURN) * (square * inverse))
        amplitude = inverse / _FOUR_PI
        return amplitude * cosine, amplitude * sine, inverse

    # In a loop, because the compiler would otherwise fuse it into each plane and compute the sines for each again.
    cosine, sine, inverse = (part.reshape(-1, points.shape[0]) for part in jax.lax.map(wave, here.reshape(2, -1)))
    x = inverse / wavenumber  # 1/(kr)
    rate, xx = inverse * inverse, x * x

    def of_wave(real, imaginary):
        return real * cosine - imaginary * sine, real * sine + imaginary * cosine

    along = of_wave(rate * (3.0 * xx - 1.0), rate * (-3.0 * x))
    alike = of_wave(1.0 - xx, x)
    along_slope = of_wave(rate * rate * (6.0 - 15.0 * xx), rate * (15.0 * rate * x - wavenumber * inverse))
    alike_slope = of_wave(rate * (3.0 * xx - 2.0), wavenumber * inverse - 3.0 * rate * x)
    return displacements(here), along, alike, along_slope, alike_slope


def _cosine_and_sine(turns):
    """cos and sin of 2 pi ``turns``: in single precision both from one half angle and by polynomials, which the
    compiler vectorises; the library's are computed number by number."""
    if turns.dtype != jnp.float32:
        return jnp.cos(_TURN * turns), jnp.sin(_TURN * turns)
    half = np.float32(np.pi) * (turns - jnp.round(turns))  # within pi/2: the Taylor series leave out 6e-9
    square = half * half
    cosine, sine = 0.0, 0.0
    for order in range(6, -1, -1):
        cosine = cosine * square + np.float32((-1) ** order / math.factorial(2 * order))
        sine = sine * square + np.float32((-1) ** order / math.factorial(2 * order + 1))
    sine = half * sine
    return 1.0 - 2.0 * sine * sine, 2.0 * sine * cosine


def _symmetric_product(planes, x):
    """Six planes of a symmetric tensor times x (3, N, C)."""
    xx, xy, xz, yy, yz, zz = planes
    columns = x.shape[-1]

    def both(plane, a, b):
        """The plane's share in rows a and b: one product with twice the columns."""
        product = plane @ jnp.concatenate([x[b], x[a]], axis=-1)
        return product[:, :columns], product[:, columns:]

    xy, yx = both(xy, 0, 1)
    xz, zx = both(xz, 0, 2)
    yz, zy = both(yz, 1, 2)
    return jnp.stack([xx @ x[0] + xy + xz, yx + yy @ x[1] + yz, zx + zy + zz @ x[2]])


def _planar(x):
    """(3N, R) complex to (3, N, 2R) real."""
    parts = x.reshape(-1, 3, x.shape[-1]).transpose(1, 0, 2)
    return jnp.concatenate([parts.real, parts.imag], axis=-1)


def _from_planar(x):
    """(3, N, 2R) real to (3N, R) complex."""
    half = x.shape[-1] // 2
    return jax.lax.complex(x[..., :half], x[..., half:]).transpose(1, 0, 2).reshape(-1, half)
