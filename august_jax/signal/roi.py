"""The field subspace of the region of interest: few numbers that hold all a channel says about a target near q_pre.

Under e^{+jkr} a target near the predicted position q has the channel H ~ sum_ij T_ij g_i g_j^T with g_i the spherical
wave of its i-th part. Divided by the spherical-wave phases of q itself, every g_i varies slowly over the aperture, so
that low-order polynomials P (products of Legendre polynomials along x and z, made orthonormal on the elements) hold it:

    H ~ U A U^T,    U = diag(conj(phases)) P,    phases_n = exp(-jk(|q - p_n| - |q|)),    A = U^H H conj(U).

A means nothing without q, so :class:`Coefficients` carry it as their centre.

U has orthonormal columns: white noise stays white in A, and the projection is an orthogonal one. A is symmetric where
H is. On a 16 x 4 array at 3 GHz fifteen functions keep all but 1e-9 of a channel's energy for targets within 0.5 m of q
in the paper's box (17 to 47 m away), and all but 2e-6 on average in a box 5 to 11 m away, where ten lose 1e-4. A
16 x 16 array needs 28 for as little in the near box.

The functions take one sample with all its tones; ``jax.vmap`` supplies a batch.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from august_jax.arrays import Array, ArrayLike
from august_jax.config import ArrayConfig
from august_jax.physics.array import PlanarArray, wavenumber
from august_jax.physics.green import path_difference


class Coefficients(NamedTuple):
    """A channel in the field subspace of a region: no channel itself, and of a type of its own.

    Attributes:
        values: A of each tone (..., F, K, K) complex64, symmetric where the channel is.
        centre: the point q (..., 3) [m] about which they are taken.
    """

    values: Complex[Array, "*batch tones orders orders"]
    centre: Float[Array, "*batch 3"]


@jax.tree_util.register_static
@dataclass(frozen=True)
class Subspace:
    """The polynomials P of an array, and its tones; to jit it is a constant.

    Attributes:
        array: the antennas.
        frequencies_hz: the tones [Hz].
        count: K; None takes :func:`default_count`.
    """

    array: PlanarArray
    frequencies_hz: tuple[float, ...]
    count: int | None = None

    @classmethod
    def from_config(cls, array: ArrayConfig) -> Subspace:
        """The subspace of a configuration's array and tones."""
        return cls(PlanarArray.from_config(array), array.frequencies_hz)

    @property
    def basis(self) -> Float[np.ndarray, "antennas orders"]:
        """P (N_b, K) float32 of :func:`legendre_basis`."""
        return _cached_basis(self.array.nx, self.array.nz, self.count)

    @property
    def orders(self) -> int:
        """K."""
        return default_count(self.array.nx, self.array.nz) if self.count is None else self.count

    @property
    def positions(self) -> Float[np.ndarray, "antennas 3"]:
        """Elements (N_b, 3) float32 [m]."""
        return self.array.positions.astype(np.float32)

    @property
    def wavenumbers(self) -> Float[np.ndarray, " tones"]:
        """k of each tone (F,) float32 [rad/m]."""
        return np.array([wavenumber(tone) for tone in self.frequencies_hz], np.float32)

    def waves(self, centre: Float[Array, "3"]) -> Complex[Array, "tones antennas orders"]:
        """U (F, N_b, K) about a centre (3,) [m]: orthonormal columns."""
        return jax.vmap(lambda k: field_basis(centre, self.positions, k, self.basis))(self.wavenumbers)


def default_count(nx: int, nz: int) -> int:
    """K where none is asked for: 15 up to 64 antennas, 28 beyond, and fewer than antennas where there are several."""
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


@lru_cache(maxsize=64)
def _cached_basis(nx: int, nz: int, count: int | None) -> np.ndarray:
    basis = legendre_basis(nx, nz, count)
    basis.flags.writeable = False  # shared by all who ask
    return basis


def _orthonormal_legendre(count: int) -> np.ndarray:
    """Legendre polynomials of degree 0 to count-1 on ``count`` equal steps, orthonormalised in order of degree."""
    places = (np.arange(count) - (count - 1) / 2.0) * (2.0 / count)
    columns, triangle = np.linalg.qr(np.polynomial.legendre.legvander(places, count - 1))
    return columns * np.sign(np.diag(triangle))


def spherical_phases(
    positions: Float[Array, "antennas 3"], centre: Float[Array, "3"], wavenumber: ArrayLike
) -> Complex[Array, " antennas"]:
    """Factors that take the spherical wave of q out of a channel: exp(-jk(|q - p_n| - |q|)).

    A point at q has H_mn ~ e^{jk(r_m + r_n)}; multiplying H_mn by the m-th and the n-th factor leaves a constant.

    Args:
        positions: elements (N_b, 3) [m].
        centre: q (3,) [m].
        wavenumber: k [rad/m].

    Returns:
        (N_b,) complex of modulus one.
    """
    positions = jnp.asarray(positions, jnp.result_type(centre, jnp.float32))
    angle = wavenumber * path_difference(positions, centre)
    return jax.lax.complex(jnp.cos(angle), -jnp.sin(angle))


def field_basis(
    centre: Float[Array, "3"],
    positions: Float[Array, "antennas 3"],
    wavenumber: ArrayLike,
    basis: Float[Array, "antennas orders"],
) -> Complex[Array, "antennas orders"]:
    """U = diag(conj(phases)) P of one tone; arguments as in :func:`spherical_phases` and :class:`Subspace`."""
    return spherical_phases(positions, centre, wavenumber).conj()[:, None] * basis


def project(
    channel: Complex[Array, "tones antennas antennas"], centre: Float[Array, "3"], subspace: Subspace
) -> Coefficients:
    """A channel's coefficients about a point, A = U^H H conj(U).

    Args:
        channel: H of each tone (F, N_b, N_b) complex.
        centre: q (3,) [m].
        subspace: of the array that hears it.
    """
    waves = subspace.waves(centre).conj()
    return Coefficients(jnp.swapaxes(waves, -1, -2) @ channel @ waves, centre)


def lift(coefficients: Coefficients, subspace: Subspace) -> Complex[Array, "tones antennas antennas"]:
    """The channel (F, N_b, N_b) of given coefficients, H = U A U^T."""
    waves = subspace.waves(coefficients.centre)
    return waves @ coefficients.values @ jnp.swapaxes(waves, -1, -2)


def change_of_centre(
    centre: Float[Array, "3"], other: Float[Array, "3"], subspace: Subspace
) -> Complex[Array, "tones orders orders"]:
    """T = U^H U' (F, K, K): coefficients A' about ``other`` (3,) [m] are T A' T^T about ``centre`` (3,) [m]."""
    return jnp.swapaxes(subspace.waves(centre).conj(), -1, -2) @ subspace.waves(other)


def recentre(coefficients: Coefficients, centre: Float[Array, "3"], subspace: Subspace) -> Coefficients:
    """Coefficients about another point (3,) [m]: T A T^T; what leaves the subspace on the way is lost."""
    change = change_of_centre(centre, coefficients.centre, subspace)
    return Coefficients(change @ coefficients.values @ jnp.swapaxes(change, -1, -2), centre)


def towards(coefficients: Coefficients, subspace: Subspace) -> Float[Array, "3"]:
    """The point at the centre's range from which the echo comes: q' (3,) [m], |q'| = |q|.

    The mean phase step between neighbouring antennas (the pulse-pair estimate of a frequency) of the columns of
    P A tells by how much the echo's direction cosines differ from those of the centre. A step of 2 pi would need an
    offset as large as the range, so nothing is ambiguous. Range itself is left alone: it bends phases a hundred times
    less.
    """
    centre, array = coefficients.centre, subspace.array
    waves = jnp.einsum("nk,fkl->fnl", jnp.asarray(subspace.basis), coefficients.values)
    waves = waves.reshape(-1, array.nx, array.nz, waves.shape[-1])
    steps = [
        jnp.sum(waves[:, 1:] * waves[:, :-1].conj(), axis=(1, 2, 3)),
        jnp.sum(waves[:, :, 1:] * waves[:, :, :-1].conj(), axis=(1, 2, 3)),
    ]
    distance = jnp.linalg.norm(centre)
    cosines = []
    for step, start in zip(steps, (centre[0], centre[2])):
        weight = jnp.abs(step)
        turn = jnp.angle(step) / (subspace.wavenumbers * array.spacing_m)
        cosines.append(start / distance - jnp.sum(weight * turn) / jnp.maximum(jnp.sum(weight), 1e-30))
    x, z = cosines
    # A glimpse of pure noise may point beyond the horizon of the array's half space.
    shrink = jnp.minimum(1.0, 0.999 / jnp.maximum(jnp.sqrt(x**2 + z**2), 1e-9))
    x, z = shrink * x, shrink * z
    y = jnp.sqrt(1.0 - x**2 - z**2)
    return distance * jnp.stack([x, jnp.where(centre[1] < 0.0, -y, y), z])
