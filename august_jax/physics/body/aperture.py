"""Thinning the antennas: a few elements of a planar array determine the fields of all others on a body.

Once the spherical-wave phases of the body's centre are removed, the field varies so slowly over the aperture that the
fields of all N_b elements span few dimensions, and a few elements interpolate the others.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.physics.array import PlanarArray, wavenumber
from august_jax.physics.body.spans import pivots, spanned

_TOLERANCE = 3e-6  # smallest singular value kept of the fields over the aperture, relative to the largest
_SOURCES = 512  # that are sampled at first; twice as many while they have fewer than _A_RANK parts a dimension
_A_RANK = 3
_BLOCK = 1 << 20  # complex numbers that are made at a time: 16 MB


class Aperture(NamedTuple):
    """How n antennas determine all N_b: by ``spread`` (N_b, n) real, once ``phases`` (N_b,) are taken out."""

    chosen: np.ndarray
    spread: np.ndarray
    phases: jax.Array

    def over_rows(self, values):
        """(n, m) to (N_b, m); real products, because the compiler's small complex ones are slow."""
        flat = self.phases[self.chosen].conj()[:, None] * values
        parts = jnp.asarray(self.spread, jnp.float32) @ jnp.concatenate([flat.real, flat.imag], axis=1)
        return self.phases[:, None] * jax.lax.complex(*jnp.split(parts, 2, axis=1))


@lru_cache(maxsize=64)
def aperture_skeleton(
    array: PlanarArray, frequency_hz: float, radius_m: float, nearest_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """The few antennas that determine the fields of all on a body, and how.

    With phases e^{-jk(|t - p_n| - |t|)} to the body's centre t removed, the field of antenna n at any point within
    ``radius_m`` of t, for any t beyond ``nearest_m``, is the sum over the chosen antennas j of spread[n, j] times
    theirs.

    Returns:
        Indices (K,) and the interpolation matrix (N_b, K), float64.
    """
    from threadpoolctl import threadpool_limits

    k = wavenumber(frequency_hz)
    elements = array.positions - array.positions.mean(axis=0)
    # LAPACK's eigensolver works in small steps: threads that wait for each other make it up to ten times slower.
    with threadpool_limits(1):
        count = _SOURCES
        # The problem is symmetric under complex conjugation (a mirrored body), hence a real basis.
        basis, _ = spanned(sampled_fields(elements, k, radius_m, nearest_m, count), _TOLERANCE)
        while 2 * count < _A_RANK * basis.shape[1]:
            count *= 2
            basis, _ = spanned(sampled_fields(elements, k, radius_m, nearest_m, count), _TOLERANCE)
        chosen = pivots(basis)
        return chosen, basis @ np.linalg.inv(basis[chosen])


def sampled_fields(elements, k, radius_m, nearest_m, count):
    """Real and imaginary parts (N_b, 2 count) of the elements' fields at random places, less the centre's phases.

    The nearest distance and the surface of the ball are the worst case; nothing beyond varies faster.
    """
    random = np.random.default_rng(0)

    def directions():
        vectors = random.normal(size=(count, 3))
        return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    outward, inside = directions(), radius_m * directions()
    samples = np.empty((2, count, len(elements)))
    step = max(_BLOCK // len(elements), 1)
    for start in range(0, count, step):
        here = slice(start, start + step)
        # From the middle of a large array that distance may end beside an element: on, until it is far from all.
        along = outward[here] @ elements.T
        square = nearest_m**2 - np.sum(elements**2, axis=1) + along**2
        leaves = np.where(square > 0.0, along + np.sqrt(np.maximum(square, 0.0)), 0.0).max(axis=1)
        centre = np.maximum(nearest_m, leaves)[:, None] * outward[here]
        to_centre = np.linalg.norm(centre[:, None] - elements, axis=-1)
        r = np.linalg.norm((centre + inside[here])[:, None] - elements, axis=-1)
        fields = np.exp(1j * k * (r - to_centre)) * nearest_m / r
        samples[:, here] = fields.real, fields.imag
    return samples.reshape(2 * count, -1).T
