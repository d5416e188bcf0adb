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
    k = wavenumber(frequency_hz)
    elements = array.positions - array.positions.mean(axis=0)
    random = np.random.default_rng(0)
    count = 60 * len(elements)

    def on_sphere(radius):
        vectors = random.normal(size=(count, 3))
        return radius * vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    # The nearest distance and the surface of the ball are the worst case; nothing beyond varies faster.
    centre, inside = on_sphere(nearest_m), on_sphere(radius_m)
    offset = (centre + inside)[:, None] - elements
    r, to_centre = np.linalg.norm(offset, axis=-1), np.linalg.norm(centre[:, None] - elements, axis=-1)
    samples = np.exp(1j * k * (r - to_centre)) * nearest_m / r
    vectors, values = spanned(samples.T, _TOLERANCE)
    # The problem is symmetric under complex conjugation (a mirrored body), hence a real basis exists.
    both = np.concatenate([(vectors * values).real, (vectors * values).imag], axis=1)
    basis, _ = spanned(both, _TOLERANCE)
    chosen = pivots(basis.real)
    return chosen, basis.real @ np.linalg.inv(basis.real[chosen])
