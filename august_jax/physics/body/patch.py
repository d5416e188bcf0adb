"""What a point source puts on a body, as few functions of where it stands within a small patch of directions.

Seen from the body's origin, a source at distance r in the direction u puts on the cells at x the field

    G(x, r u) m = e^{jkr}/(4 pi r) f(x; u, 1/r, m),

and f, with the spherical wave out, is smooth: linear in the moment m, nearly linear in 1/r, and over a patch of
directions about u_g a polynomial of the two direction sines d = (u.e1, u.e2), whose degree grows with k a rho (a the
body's radius, rho the sine of the patch's). Hence, with Chebyshev's polynomials T of d/rho and of 1/r, both scaled to
[-1, 1],

    f = sum_i f_i(x) phi_i,    phi = (m_1 T_a T_b T_c,  m_2 T_a T_b T_c,  (m_r/r) T_a T_b).

The moment is taken along the source's own direction (m_r) and along e1, e2 turned with u_g into u the shortest way
(m_1, m_2): along axes that stay, the radial part would enter the others at first order in d, and cost 2e-2. It is
itself of order a/r, the field that a body sees along a dipole.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.green import inner

_EXTENT = 0.85  # of the body's radius: little of it lies at its very edge
_TRUNCATION = 7e-4  # relative size of the first polynomial that is left out
_LESSER = 2.0 * _TRUNCATION  # the same of those in 1/r and of the radial moment


class Patch(NamedTuple):
    """A patch of directions and a range of distances, and the functions in it; hashable, a constant to jit.

    Attributes:
        sine: rho, the sine of the angle from the patch's middle to its edge.
        inverse_m: middle and half width of the range of 1/r [1/m].
        across: highest degree in the direction sines of the functions of a moment across the line of sight, for each
            degree in 1/r from 0.
        along: the same for a moment along it, constant in 1/r but for its own factor.
    """

    sine: float
    inverse_m: tuple[float, float]
    across: tuple[int, ...]
    along: int

    @classmethod
    def for_body(cls, wavenumber: float, radius_m: float, angle: float, distance_m: tuple[float, float]) -> Patch:
        """Degrees for a body of a radius [m], sources within an angle [rad] and a range of distances [m].

        The phase k a d of the body's edge has Chebyshev coefficients of order (k a rho/2)^n / n!; the curvature of the
        wave adds k a^2/2r, and a radial moment a/r.
        """
        near, far = distance_m
        sine = math.sin(angle)
        middle, half = 0.5 * (1.0 / near + 1.0 / far), 0.5 * (1.0 / near - 1.0 / far)
        a = _EXTENT * radius_m
        bend, rest = 0.25 * wavenumber * a**2 * half, _degree(wavenumber * a * sine, 1.0, _TRUNCATION)
        across = [rest]
        while len(across) < 6:
            weight = bend ** len(across) / math.factorial(len(across))
            if weight < _LESSER:
                break
            across.append(_degree(wavenumber * a * sine, weight, _LESSER))
        return cls(sine, (middle, max(half, 1e-9)), tuple(across), _degree(wavenumber * a * sine, a * middle, _LESSER))

    @property
    def size(self) -> int:
        """Number of functions."""
        return 2 * sum(_terms(degree) for degree in self.across) + _terms(self.along)

    def scalars(
        self, sines: Float[Array, "n 2"], inverse_m: Float[Array, " n"]
    ) -> tuple[Float[jax.Array, "n across"], Float[jax.Array, "n along"]]:
        """The functions without the moments, at direction sines (n, 2) and 1/r (n,) [1/m]."""
        top = max(*self.across, self.along)
        first, second = (_chebyshev(sines[:, axis] / self.sine, top) for axis in (0, 1))
        products = jnp.stack([first[total - b] * second[b] for total in range(top + 1) for b in range(total + 1)], -1)
        middle, half = self.inverse_m
        bends = _chebyshev((inverse_m - middle) / half, max(len(self.across) - 1, 1))
        across = [
            products[:, : _terms(degree)] * bend[:, None]
            for degree, bend in zip(self.across, bends[: len(self.across)], strict=True)
        ]
        return jnp.concatenate(across, axis=1), products[:, : _terms(self.along)]

    def functions(
        self, displacements: Float[Array, "n 3"], distances: Float[Array, " n"], moments: Float[Array, "n 3"]
    ) -> Float[jax.Array, "n functions"]:
        """phi (n, functions) of sources, by their displacements from the body's origin and moments in the patch's axes.

        Args:
            displacements: r u (n, 3) [m], along e1, e2 and u_g.
            distances: r (n,) [m].
            moments: unit vectors (n, 3) along the same axes.
        """
        inverse = 1.0 / distances
        unit = displacements * inverse[:, None]
        radial = inner(unit, moments)
        rest = (moments[:, 2] + radial) / (1.0 + unit[:, 2])
        across, along = self.scalars(unit[:, :2], inverse)
        first, second = ((moments[:, axis] - unit[:, axis] * rest)[:, None] for axis in (0, 1))
        return jnp.concatenate([first * across, second * across, (radial * inverse)[:, None] * along], axis=1)

    @property
    def flat(self) -> Patch:
        """The same without the polynomials in 1/r: for the functions of :meth:`at_distance`."""
        return self._replace(across=self.across[:1])

    def at_distance(self, functions: Float[Array, "n r"], distance: ArrayLike) -> Float[jax.Array, "m r"]:
        """Rows of a matrix of functions (n, R) with the polynomials in 1/r at one distance [m] summed up: (m, R), one
        for each function of :attr:`flat`."""
        middle, half = self.inverse_m
        bends = _chebyshev(jnp.asarray((1.0 / distance - middle) / half), max(len(self.across) - 1, 1))
        most, size = _terms(self.across[0]), sum(map(_terms, self.across))
        merged = []
        for row in (0, size):
            total = jnp.zeros((most, functions.shape[1]), functions.dtype)
            for degree, bend in zip(self.across, bends):
                total = total.at[: _terms(degree)].add(functions[row : row + _terms(degree)] * bend)
                row += _terms(degree)
            merged.append(total)
        return jnp.concatenate([*merged, functions[2 * size :]])

    def samples(self) -> tuple[np.ndarray, np.ndarray]:
        """Direction sines (n, 2) and 1/r (n,) [1/m] at which fields are fitted: rings, and Chebyshev's nodes."""
        top = max(*self.across, self.along)
        squares = 0.5 * (np.polynomial.legendre.leggauss(top // 2 + 1)[0] + 1.0)
        turns = 2.0 * np.pi * np.arange(2 * top + 1) / (2 * top + 1)
        disc = np.concatenate(
            [
                self.sine * math.sqrt(square) * np.stack([np.cos(turns + ring), np.sin(turns + ring)], -1)
                for ring, square in enumerate(squares)
            ]
        )
        count = len(self.across)
        nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
        middle, half = self.inverse_m
        return np.tile(disc, (count, 1)), np.repeat(middle + half * nodes, len(disc))


def frames(directions: Float[np.ndarray, "d 3"]) -> Float[np.ndarray, "d 3 3"]:
    """Right-handed axes e1, e2, u (d, 3, 3), row by row, of unit vectors u (d, 3)."""
    x, y, z = directions.T
    sign = np.where(z >= 0.0, 1.0, -1.0)
    share = -1.0 / (sign + z)
    first = np.stack([1.0 + sign * x**2 * share, sign * x * y * share, -sign * x], axis=-1)
    second = np.stack([x * y * share, sign + y**2 * share, -y], axis=-1)
    return np.stack([first, second, directions], axis=1)


def covering(angle: float) -> Float[np.ndarray, "d 3"]:
    """Unit vectors (d, 3) of which every direction is within an angle [rad] of one: a Fibonacci lattice."""
    return fibonacci_lattice(max(math.ceil((_COVERING / angle) ** 2), 12))


def fibonacci_lattice(count: int, height: float = 2.0) -> Float[np.ndarray, "d 3"]:
    """``count`` unit vectors (d, 3), evenly over the part of the sphere from its top down to z = 1 - ``height``."""
    place = np.arange(count)
    z = 1.0 - height * (place + 0.5) / count
    turn = place * (math.pi * (3.0 - math.sqrt(5.0)))
    across = np.sqrt(1.0 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1)


_COVERING = 2.74
"""No direction is farther than this over sqrt(d) [rad] from a lattice of d points, as tried for d from 12 to 6000."""


def _degree(phase, weight, tolerance):
    """The smallest n at which weight (phase/2)^(n+1) / (n+1)! falls below the tolerance."""
    degree = 0
    while weight * (0.5 * phase) ** (degree + 1) / math.factorial(degree + 1) > tolerance:
        degree += 1
    return degree


def _terms(degree):
    """Number of products of a total degree at most this."""
    return (degree + 1) * (degree + 2) // 2


def _chebyshev(x, degree):
    found = [jnp.ones_like(x), x]
    while len(found) <= degree:
        found.append(2.0 * x * found[-1] - found[-2])
    return found
