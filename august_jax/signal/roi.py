"""The field subspace of the region of interest: few numbers that hold all a channel says about a target near q_pre.

Under e^{+jkr} a target near the predicted position q has the channel H ~ sum_ij T_ij g_i g_j^T with g_i the spherical
wave of its i-th part. Divided by the spherical-wave phases of q itself, every g_i varies slowly over the aperture, so
that low-order polynomials P (products of Legendre polynomials along x and z, made orthonormal on the elements) hold it:

    H ~ U A U^T,    U = diag(conj(phases)) P,    phases_n = exp(-jk(|q - p_n| - |q|)),    A = U^H H conj(U).

U has orthonormal columns: white noise stays white in A, and the projection is an orthogonal one. A is symmetric where
H is. On a 16 x 4 array at 3 GHz fifteen functions keep all but 1e-9 of a channel's energy for targets within 0.5 m of q
in the paper's box (17 to 47 m away), and all but 2e-6 on average in a box 5 to 11 m away, where ten lose 1e-4. A
16 x 16 array needs 28 for as little in the near box.

The functions take one sample and one tone; ``jax.vmap`` supplies both axes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.physics.green import inner


def default_count(nx: int, nz: int) -> int:
    """K where none is asked for: 15 up to 64 antennas, 28 beyond, and fewer than antennas where there are several.

    So the shape of an array tells coefficients from a channel.
    """
    return min(15 if nx * nz <= 64 else 28, max(nx * nz - 1, 1))


def legendre_degrees(nx: int, nz: int, count: int | None = None) -> tuple[tuple[int, int], ...]:
    """The ``count`` smoothest pairs of degrees (along x, along z) of an nx x nz array, smoothest first.

    A degree weighs less along the longer side, dx/sqrt(nx) + dz/sqrt(nz): a target offset bends the phase more there.

    Args:
        nx, nz: elements along x and z.
        count: K; :func:`default_count` when None.

    Raises:
        ValueError: ``count`` outside [1, N_b].
    """
    if nx < 1 or nz < 1:
        raise ValueError(f"nx, nz: got {nx} x {nz} elements; each must be at least 1")
    count = default_count(nx, nz) if count is None else count
    if not 1 <= count <= nx * nz:
        raise ValueError(f"count: got {count} functions for {nx * nz} antennas; give 1 to {nx * nz}")
    pairs = [(dx, dz) for dx in range(nx) for dz in range(nz)]
    return tuple(sorted(pairs, key=lambda pair: (pair[0] / math.sqrt(nx) + pair[1] / math.sqrt(nz), pair))[:count])


def legendre_basis(
    nx: int, nz: int, count: int | None = None, *, degrees: Sequence[tuple[int, int]] | None = None
) -> np.ndarray:
    """Polynomials over the aperture, orthonormal on its elements.

    Args:
        nx, nz: elements along x and z.
        count: K, for the degrees of :func:`legendre_degrees`.
        degrees: the (dx, dz) to take instead.

    Returns:
        P (N_b, K) float32, P^T P = I, rows ordered n = b + a nz.

    Raises:
        ValueError: a count or a degree that the array cannot tell apart.
    """
    degrees = legendre_degrees(nx, nz, count) if degrees is None else tuple(degrees)
    for dx, dz in degrees:
        if not (0 <= dx < nx and 0 <= dz < nz):
            raise ValueError(f"degrees: got ({dx}, {dz}); a {nx} x {nz} array tells apart degrees below ({nx}, {nz})")
    along_x, along_z = _orthonormal_legendre(nx), _orthonormal_legendre(nz)
    columns = [np.outer(along_x[:, dx], along_z[:, dz]).reshape(-1) for dx, dz in degrees]
    return np.stack(columns, axis=1).astype(np.float32)


def _orthonormal_legendre(count: int) -> np.ndarray:
    """Legendre polynomials of degree 0 to count-1 on ``count`` equal steps, orthonormalised in order of degree."""
    places = (np.arange(count) - (count - 1) / 2.0) * (2.0 / count)
    columns, triangle = np.linalg.qr(np.polynomial.legendre.legvander(places, count - 1))
    return columns * np.sign(np.diag(triangle))


def path_differences(positions: jax.Array, point: jax.Array) -> jax.Array:
    """|q - p_n| - |q| (N_b,) [m] without the cancellation that costs the digits of a float32 phase."""
    distance = jnp.linalg.norm(point)
    offsets = point - positions
    lengths = jnp.sqrt(inner(offsets, offsets))
    return (inner(positions, positions) - 2.0 * positions @ point) / (lengths + distance)


def spherical_phases(positions: jax.Array, predicted: jax.Array, wavenumber) -> jax.Array:
    """Factors that take the spherical wave of q out of a channel: exp(-jk(|q - p_n| - |q|)).

    A point at q has H_mn ~ e^{jk(r_m + r_n)}; multiplying H_mn by the m-th and the n-th factor leaves a constant.

    Args:
        positions: elements (N_b, 3) [m].
        predicted: q (3,) [m].
        wavenumber: k [rad/m].

    Returns:
        (N_b,) complex of modulus one.
    """
    positions = jnp.asarray(positions, jnp.result_type(predicted, jnp.float32))
    angle = wavenumber * path_differences(positions, predicted)
    return jax.lax.complex(jnp.cos(angle), -jnp.sin(angle))


def subspace(predicted: jax.Array, positions: jax.Array, wavenumber, basis: jax.Array) -> jax.Array:
    """U (N_b, K) = diag(conj(phases)) P, orthonormal columns; arguments as in :func:`project`."""
    return spherical_phases(positions, predicted, wavenumber).conj()[:, None] * basis


def project(channel: jax.Array, predicted: jax.Array, positions: jax.Array, wavenumber, basis: jax.Array) -> jax.Array:
    """Coefficients of one channel in the region's subspace, A = U^H H conj(U).

    Args:
        channel: H (N_b, N_b) complex.
        predicted: q_pre (3,) [m].
        positions: elements (N_b, 3) [m].
        wavenumber: k of this tone [rad/m].
        basis: P (N_b, K) from :func:`legendre_basis`.

    Returns:
        A (K, K) complex, symmetric where H is.
    """
    waves = subspace(predicted, positions, wavenumber, basis).conj()
    return waves.T @ channel @ waves


def lift(
    coefficients: jax.Array, predicted: jax.Array, positions: jax.Array, wavenumber, basis: jax.Array
) -> jax.Array:
    """The channel (N_b, N_b) of given coefficients, H = U A U^T; arguments as in :func:`project`."""
    waves = subspace(predicted, positions, wavenumber, basis)
    return waves @ coefficients @ waves.T


def towards(
    coefficients: jax.Array, predicted: jax.Array, shape: tuple[int, int], spacing: float, wavenumbers, basis: jax.Array
) -> jax.Array:
    """The point at the prediction's range from which the echo comes: q' (3,) [m], |q'| = |q_pre|.

    The mean phase step between neighbouring antennas (the pulse-pair estimate of a frequency) of the columns of
    P A tells by how much the echo's direction cosines differ from those of q_pre. A step of 2 pi would need an offset
    as large as the range, so nothing is ambiguous. Range itself is left alone: it bends phases a hundred times less.

    Args:
        coefficients: A (F, K, K) about ``predicted``.
        predicted: q_pre (3,) [m].
        shape: (N_x, N_z) of the array in the x-O-z plane, rows of P ordered n = b + a N_z.
        spacing: distance between neighbours [m].
        wavenumbers: k of each tone (F,) [rad/m].
        basis: P (N_b, K) from :func:`legendre_basis`.
    """
    waves = jnp.einsum("nk,fkl->fnl", basis, coefficients)
    waves = waves.reshape(-1, *shape, waves.shape[-1])
    steps = [
        jnp.sum(waves[:, 1:] * waves[:, :-1].conj(), axis=(1, 2, 3)),
        jnp.sum(waves[:, :, 1:] * waves[:, :, :-1].conj(), axis=(1, 2, 3)),
    ]
    distance = jnp.linalg.norm(predicted)
    cosines = []
    for step, start in zip(steps, (predicted[0], predicted[2])):
        weight = jnp.abs(step)
        turn = jnp.angle(step) / (jnp.asarray(wavenumbers) * spacing)
        cosines.append(start / distance - jnp.sum(weight * turn) / jnp.maximum(jnp.sum(weight), 1e-30))
    x, z = cosines
    # A glimpse of pure noise may point beyond the horizon of the array's half space.
    shrink = jnp.minimum(1.0, 0.999 / jnp.maximum(jnp.sqrt(x**2 + z**2), 1e-9))
    x, z = shrink * x, shrink * z
    y = jnp.sqrt(1.0 - x**2 - z**2)
    return distance * jnp.stack([x, jnp.where(predicted[1] < 0.0, -y, y), z])


def recentre(
    coefficients: jax.Array, predicted: jax.Array, centre: jax.Array, positions: jax.Array, wavenumber, basis: jax.Array
) -> jax.Array:
    """Coefficients (K, K) about another point: T A T^T, T = U'^H U; what leaves the subspace on the way is lost.

    Args:
        coefficients: A (K, K) about ``predicted``.
        predicted, centre: old and new point (3,) [m].
        positions, wavenumber, basis: as in :func:`project`.
    """
    change = subspace(centre, positions, wavenumber, basis).conj().T @ subspace(predicted, positions, wavenumber, basis)
    return change @ coefficients @ change.T
