"""Dyadic Green's function of free space and the fields of point dipoles.

Time convention e^{-jwt}: outgoing waves go as e^{+jkr}. With r = |p1 - p2| and the unit vector r^ (paper,
eq. green funcion),

    G(p1, p2) = (I + grad grad / k^2) e^{jkr} / (4 pi r) = [g r^ r^T - h I] e^{jkr} / (4 pi r),
    g = 3/(kr)^2 - 3j/(kr) - 1,    h = 1/(kr)^2 - j/(kr) - 1.

No factor j w mu0 is applied anywhere, as in the paper.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

_FOUR_PI = 4.0 * np.pi


def dyadic_green(displacement: jax.Array, wavenumber: float | jax.Array) -> jax.Array:
    """G for displacements p1 - p2.

    Args:
        displacement: (..., 3) [m], nowhere zero.
        wavenumber: k [rad/m].

    Returns:
        (..., 3, 3) complex [1/m], of the precision of ``displacement``.
    """
    r = jnp.sqrt(jnp.sum(displacement**2, axis=-1))
    unit = displacement / r[..., None]
    g, h = _radial_factors(wavenumber * r)
    wave = jnp.exp(1j * wavenumber * r) / (_FOUR_PI * r)
    outer = unit[..., :, None] * unit[..., None, :]
    identity = jnp.eye(3, dtype=displacement.dtype)
    return (wave * g)[..., None, None] * outer - (wave * h)[..., None, None] * identity


def coupling_matrix(positions: jax.Array, wavenumber: float | jax.Array) -> jax.Array:
    """G between all pairs of points, with zero blocks on the diagonal.

    Args:
        positions: (N, 3) [m], no two equal.
        wavenumber: k [rad/m].

    Returns:
        (3N, 3N) complex [1/m]; row 3i + a, column 3j + b holds G_ab(p_i, p_j).
    """
    count = positions.shape[0]
    same = jnp.eye(count, dtype=bool)[..., None]
    # A unit vector in place of the zero displacement keeps values and derivatives of the masked blocks finite.
    separation = jnp.where(same, jnp.ones(3, positions.dtype), positions[:, None] - positions[None])
    blocks = jnp.where(same[..., None], 0.0, dyadic_green(separation, wavenumber))
    return blocks.transpose(0, 2, 1, 3).reshape(3 * count, 3 * count)


def dipole_fields(
    points: jax.Array, sources: jax.Array, moments: jax.Array, wavenumber: float | jax.Array
) -> jax.Array:
    """Fields of point dipoles at the cells of a body: the columns of M (paper, eqs. Ei, Ei n).

    Args:
        points: (N, 3) [m].
        sources: antenna positions (N_b, 3) [m].
        moments: unit vectors of the dipoles, (3,) or (N_b, 3).
        wavenumber: k [rad/m].

    Returns:
        (3N, N_b) complex [1/m]; row 3i + a is component a at point i.
    """
    middle, centre = jnp.mean(points, axis=0), jnp.mean(sources, axis=0)
    fields = dipole_fields_about(points - middle, middle - centre, sources - centre, moments, wavenumber)
    return fields.transpose(0, 2, 1).reshape(3 * points.shape[0], sources.shape[0])


def dipole_fields_about(
    local: jax.Array, base: jax.Array, elements: jax.Array, moments: jax.Array, wavenumber: float | jax.Array
) -> jax.Array:
    """Fields at ``base + local`` of dipoles at ``elements``: single precision keeps the digits of the phase k r.

    Only |base| is long. It is carried in two floats, and what each point and each element add to it is computed
    from small numbers, so that the phase at 25 m errs by 1e-6 rad and not by 1e-4 rad.

    Args:
        local: points of the body about its centre (N, 3) [m].
        base: from the array's centre to the body's centre (3,) [m].
        elements: antennas about the array's centre (N_b, 3) [m].
        moments: unit vectors of the dipoles, (3,) or (N_b, 3).
        wavenumber: k [rad/m].

    Returns:
        (N, N_b, 3) complex [1/m].
    """
    distance, remainder = _long_distance(base)
    to_middle = base - elements
    to_middle_r = jnp.sqrt(jnp.sum(to_middle**2, axis=-1))
    element_shift = jnp.sum(elements * (elements - 2.0 * base), axis=-1) / (distance + to_middle_r)
    displacement = local[:, None] + to_middle
    r = jnp.sqrt(jnp.sum(displacement**2, axis=-1))
    local_shift = (2.0 * local @ to_middle.T + jnp.sum(local**2, axis=-1)[:, None]) / (r + to_middle_r)
    per_turn = jnp.asarray(wavenumber / (2.0 * np.pi), distance.dtype)
    turns = distance * per_turn
    fraction = turns - jax.lax.stop_gradient(jnp.round(turns)) + _product_error(distance, per_turn, turns)
    phase = 2.0 * np.pi * fraction + wavenumber * (remainder + element_shift + local_shift)
    g, h = _radial_factors(wavenumber * r)
    wave = jnp.exp(1j * phase) / (_FOUR_PI * r)
    moments = jnp.broadcast_to(jnp.asarray(moments, local.dtype), elements.shape)
    along = jnp.sum(displacement * moments, axis=-1) / r**2
    return (wave * g * along)[..., None] * displacement - (wave * h)[..., None] * moments


def _radial_factors(kr):
    inverse = 1.0 / kr
    square = inverse**2
    return 3.0 * square - 3j * inverse - 1.0, square - 1j * inverse - 1.0


def _split(value):
    """Veltkamp's split of a float into two halves whose products are exact."""
    bits = jnp.finfo(value.dtype).nmant + 1
    scaled = value * (2.0 ** ((bits + 1) // 2) + 1.0)
    high = scaled - (scaled - value)
    return high, value - high


def _product_error(a, b, product):
    """a b - product, the rounding error of ``product`` (Dekker); a constant for differentiation."""
    (a_high, a_low), (b_high, b_low) = _split(a), _split(b)
    error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
    return jax.lax.stop_gradient(error)


def _long_distance(vector):
    """|vector| and what its rounding left out."""
    square = jnp.sum(vector**2)
    length = jnp.sqrt(square)
    remainder = -length * length - _product_error(length, length, length * length)
    for axis in range(3):
        part = vector[axis] * vector[axis]
        remainder = remainder + part + _product_error(vector[axis], vector[axis], part)
    return length, jax.lax.stop_gradient(remainder / (2.0 * length))
