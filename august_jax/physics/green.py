"""Dyadic Green's function of free space and the fields of point dipoles.

Time convention e^{-jwt}: outgoing waves go as e^{+jkr}. With r = |p1 - p2| and the unit vector r^ (paper,
eq. green funcion),

    G(p1, p2) = (I + grad grad / k^2) e^{jkr} / (4 pi r) = [g r^ r^T - h I] e^{jkr} / (4 pi r),
    g = 3/(kr)^2 - 3j/(kr) - 1,    h = 1/(kr)^2 - j/(kr) - 1.

No factor j w mu0 is applied anywhere, as in the paper.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Num

from august_jax.arrays import Array, ArrayLike

_FOUR_PI = 4.0 * np.pi


def inner(first: Num[Array, "... 3"], second: Num[Array, "... 3"]) -> Num[Array, "..."]:
    """Scalar products (...,) of vectors (..., 3).

    Written out: XLA for CPUs (jaxlib 0.10.2) fuses ``jnp.sum(a * b, axis=-1)`` with the broadcast of its result into a
    kernel that reads wrong rows where the result is large, which under ``vmap`` spoiled the fields of all of 64 targets
    but the first.
    """
    return (first[..., 0] * second[..., 0] + first[..., 1] * second[..., 1]) + first[..., 2] * second[..., 2]


def length(vector: Float[Array, "*shape 3"]) -> Float[Array, "*shape"]:
    """|v| (...,) of vectors (..., 3), whose derivative at zero is zero."""
    squared = inner(vector, vector)
    some = squared > 0.0
    return jnp.where(some, jnp.sqrt(jnp.where(some, squared, 1.0)), 0.0)


def path_difference(offset: Float[Array, "... 3"], base: Float[Array, "... 3"]) -> Float[Array, "..."]:
    """|b - o| - |b|: how much nearer or farther a place b is from a point o than from the origin, to all digits.

    The difference of two long distances is written as (o.o - 2 o.b)/(|b - o| + |b|), a quotient without cancellation:
    its relative error stays that of one rounding, which keeps the phases of float32 over 25 m.

    Args:
        offset: o (..., 3) [m], short beside b; an antenna about its array's centre, say.
        base: b (3,) or (..., 3) [m], nowhere equal to o where derivatives are taken. At zero |b| counts as constant
            there, as in all that goes with it.

    Returns:
        (...,) [m], of the precision of the arguments. Differentiable in both.
    """
    rest = base - offset
    return inner(offset, offset - 2.0 * base) / (jnp.sqrt(inner(rest, rest)) + length(base))


def dyadic_green(displacement: Float[Array, "*pairs 3"], wavenumber: ArrayLike) -> Complex[jax.Array, "*pairs 3 3"]:
    """G for displacements p1 - p2.

    Args:
        displacement: (..., 3) [m], nowhere zero.
        wavenumber: k [rad/m].

    Returns:
        (..., 3, 3) complex [1/m], of the precision of ``displacement``.
    """
    r = jnp.sqrt(inner(displacement, displacement))
    unit = displacement / r[..., None]
    g, h = radial_factors(wavenumber * r)
    wave = jnp.exp(1j * wavenumber * r) / (_FOUR_PI * r)
    outer = unit[..., :, None] * unit[..., None, :]
    identity = jnp.eye(3, dtype=displacement.dtype)
    return (wave * g)[..., None, None] * outer - (wave * h)[..., None, None] * identity


def coupling_matrix(positions: Float[Array, "n 3"], wavenumber: ArrayLike) -> Complex[jax.Array, "3*n 3*n"]:
    """G between all pairs of points, with zero blocks on the diagonal.

    Args:
        positions: (N, 3) [m], no two equal.
        wavenumber: k [rad/m].

    Returns:
        (3N, 3N) complex [1/m]; row 3i + a, column 3j + b holds G_ab(p_i, p_j). Differentiable in positions and, where
        it is an array, in the wavenumber.
    """
    if isinstance(wavenumber, (int, float)):
        return _coupling(positions, float(wavenumber))
    return _coupling.fun(positions, wavenumber)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _coupling(positions, wavenumber):
    separation, same = _separations(positions)
    return _in_rows(jnp.where(same[..., None, None], 0.0, dyadic_green(separation, wavenumber)))


@_coupling.defjvp
def _coupling_tangent(wavenumber, primals, tangents):
    """The derivative by hand, in (N, N) arrays: what autodiff keeps and reads back is several times larger.

    G = A r^ r^T + B I, with A = g w and B = -h w; s is the change of distance.
    """
    (positions,), (moved,) = primals, tangents
    separation, same = _separations(positions)
    r = jnp.sqrt(inner(separation, separation))
    unit = [separation[..., axis] / r for axis in range(3)]
    k = wavenumber
    g, h = radial_factors(k * r)
    wave = jnp.where(same, 0.0, jnp.exp(1j * k * r) / (_FOUR_PI * r))
    slope = wave * (1j * k - 1.0 / r)
    square, cube = 1.0 / (k * r**2), 1.0 / (k**2 * r**3)
    along = g * slope + (3j * square - 6.0 * cube) * wave
    across = g * wave / r
    isotropic = -(h * slope + (1j * square - 2.0 * cube) * wave)
    change = [moved[:, None, axis] - moved[None, :, axis] for axis in range(3)]
    farther = sum(u * d for u, d in zip(unit, change))
    radial, trace = (along - 2.0 * across) * farther, isotropic * farther
    blocks = [
        [
            radial * (unit[a] * unit[b])
            + across * (change[a] * unit[b] + unit[a] * change[b])
            + (trace if a == b else 0.0)
            for b in range(3)
        ]
        for a in range(3)
    ]
    tangent = jnp.stack([jnp.stack(row, axis=-1) for row in blocks], axis=1)
    return _coupling(positions, wavenumber), tangent.reshape(3 * len(positions), -1)


def _separations(positions):
    """p_i - p_j (N, N, 3) and where i = j."""
    same = jnp.eye(positions.shape[0], dtype=bool)
    # A unit vector in place of the zero displacement keeps values and derivatives of the masked blocks finite.
    return jnp.where(same[..., None], jnp.ones(3, positions.dtype), positions[:, None] - positions[None]), same


def _in_rows(blocks):
    """(N, N, 3, 3) to (3N, 3N), point by point."""
    count = blocks.shape[0]
    return blocks.transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)


def dipole_fields(
    points: Float[Array, "n 3"],
    sources: Float[Array, "antennas 3"],
    moments: Float[Array, "antennas 3"] | Float[Array, "3"],
    wavenumber: ArrayLike,
) -> Complex[jax.Array, "3*n antennas"]:
    """The incident field: what point dipoles put on the cells of a body, E_n(p_i) = G(p_i, p_n) v_n.

    The fields of antenna n at all N cells are a column of the paper's M (Section II-A, the incident field).

    Args:
        points: p_i (N, 3) [m].
        sources: antenna positions p_n (N_b, 3) [m].
        moments: unit vectors v_n of the dipoles, (3,) or (N_b, 3).
        wavenumber: k [rad/m].

    Returns:
        M (3N, N_b) complex [1/m]; row 3i + a is component a at point i.
    """
    # Halfway between extremes, which any order of evaluation gives alike: a mean that the compiler computes twice, for
    # the points and for the long way, may differ by 1e-6 m. Either end moves through what is taken about its middle.
    middle, centre = (
        jax.lax.stop_gradient(0.5 * (jnp.min(places, axis=0) + jnp.max(places, axis=0))) for places in (points, sources)
    )
    fields = dipole_fields_about(points - middle, middle - centre, sources - centre, moments, wavenumber)
    return fields.transpose(0, 2, 1).reshape(3 * points.shape[0], sources.shape[0])


def dipole_fields_about(
    local: Float[Array, "n 3"],
    base: Float[Array, "3"],
    elements: Float[Array, "antennas 3"],
    moments: Float[Array, "antennas 3"] | Float[Array, "3"],
    wavenumber: ArrayLike,
) -> Complex[jax.Array, "n antennas 3"]:
    """Fields at ``base + local`` of dipoles at ``elements``: single precision keeps the digits of the phase k r.

    Only |base| is long. It is carried in two parts, and what each point and each element add to it is computed
    from small numbers, so that the phase at 25 m errs by 1e-6 rad and not by 1e-4 rad.

    Args:
        local: points of the body about its centre (N, 3) [m].
        base: from the array's centre to the body's centre (3,) [m].
        elements: antennas about the array's centre (N_b, 3) [m].
        moments: unit vectors of the dipoles, (3,) or (N_b, 3).
        wavenumber: k [rad/m]; as a plain number it keeps more digits of the phase.

    Returns:
        (N, N_b, 3) complex [1/m].
    """
    whole, rest = _long_distance(base)
    to_middle = base - elements
    to_middle_r = jnp.sqrt(inner(to_middle, to_middle))
    displacement = local[:, None] + to_middle
    r = jnp.sqrt(inner(displacement, displacement))
    # path_difference of all pairs at once, with the numerator as a matrix product: 5 % of a factored channel's time.
    local_shift = (2.0 * local @ to_middle.T + inner(local, local)[:, None]) / (r + to_middle_r)
    shift = path_difference(elements, base) + local_shift
    # Whole turns of the long part go: twelve bits of distance times as many of 1/wavelength make an exact product.
    per_turn = wavenumber / (2.0 * np.pi)
    short_turn = np.round(16.0 * per_turn) / 16.0
    turns = whole * short_turn
    fraction = (turns - jnp.round(turns)) + whole * (per_turn - short_turn)
    phase = 2.0 * np.pi * fraction + wavenumber * (rest + shift)
    g, h = radial_factors(wavenumber * r)
    wave = jnp.exp(1j * phase) / (_FOUR_PI * r)
    moments = jnp.broadcast_to(jnp.asarray(moments, local.dtype), elements.shape)
    along = inner(displacement, moments) / r**2
    return (wave * g * along)[..., None] * displacement - (wave * h)[..., None] * moments


def radial_factors(kr: Array) -> tuple[Array, Array]:
    """g and h of G at kr > 0, arrays of any shape."""
    inverse = 1.0 / kr
    square = inverse**2
    return 3.0 * square - 3j * inverse - 1.0, square - 1j * inverse - 1.0


def _long_distance(vector):
    """|vector| as a number of twelve bits, a constant for differentiation, and the rest with all its digits."""
    long = length(vector)
    size = jnp.where(long > 0.0, jax.lax.stop_gradient(long), 1.0)
    unit = jnp.exp2(jnp.ceil(jnp.log2(size)) - 12.0)
    whole, coarse = (jax.lax.stop_gradient(jnp.round(value / unit) * unit) for value in (long, vector))
    fine = vector - coarse
    # |vector|^2 - whole^2: the squares of twelve-bit numbers and their sum are exact, the other terms are small.
    excess = (inner(coarse, coarse) - whole**2) + inner(fine, 2.0 * coarse + fine)
    return whole, excess / jnp.where(long > 0.0, long + whole, 1.0)
