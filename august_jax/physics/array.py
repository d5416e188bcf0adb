"""The base station's planar array: element positions, plane-wave and spherical-wave vectors (paper, Section II-A)."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.constants import SPEED_OF_LIGHT


def wavenumber(frequency_hz: float) -> float:
    """k = 2 pi f / c [rad/m]."""
    return 2.0 * np.pi * frequency_hz / SPEED_OF_LIGHT


@dataclass(frozen=True)
class PlanarArray:
    """nx x nz half-wavelength array in the x-O-z plane, centred at the origin.

    Element n = b + a nz has the a-th place along x and the b-th along z (both from 0). Every element is a point
    dipole along ``polarization``, at transmission and reception.

    Attributes:
        nx, nz: elements along x and z.
        frequency_hz: the carrier [Hz]; it sets the spacing.
        polarization: unit vector (3,).

    Raises:
        ValueError: a count below 1, a frequency that is not positive, or a polarization that is no unit vector.
    """

    nx: int
    nz: int
    frequency_hz: float
    polarization: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def __post_init__(self):
        if self.nx < 1 or self.nz < 1:
            raise ValueError(f"nx, nz: got {self.nx} x {self.nz} elements; each must be at least 1")
        if not 0.0 < self.frequency_hz < np.inf:
            raise ValueError(f"frequency_hz: got {self.frequency_hz!r}; give a positive frequency in Hz, e.g. 3e9")
        if np.shape(self.polarization) != (3,) or abs(np.linalg.norm(self.polarization) - 1.0) > 1e-6:
            raise ValueError(f"polarization: got {self.polarization!r}; give a unit vector of three numbers")

    @property
    def count(self) -> int:
        """Number of elements N_b."""
        return self.nx * self.nz

    @property
    def wavelength(self) -> float:
        """Carrier wavelength [m]."""
        return SPEED_OF_LIGHT / self.frequency_hz

    @property
    def wavenumber(self) -> float:
        """k at the carrier [rad/m]."""
        return wavenumber(self.frequency_hz)

    @property
    def positions(self) -> np.ndarray:
        """Element positions (N_b, 3), float64 [m]."""
        x = (np.arange(self.nx) - (self.nx - 1) / 2.0) * self.wavelength / 2.0
        z = (np.arange(self.nz) - (self.nz - 1) / 2.0) * self.wavelength / 2.0
        grid_x, grid_z = np.meshgrid(x, z, indexing="ij")
        return np.stack([grid_x, np.zeros_like(grid_x), grid_z], axis=-1).reshape(-1, 3)

    def steering(self, azimuth: float | jax.Array, elevation: float | jax.Array) -> jax.Array:
        """Plane-wave vector (N_b,): e^{-jk u.p_n} for a far point in direction u, phases relative to the origin.

        u = (cos(el) cos(az), cos(el) sin(az), sin(el)); angles in rad. It is the far limit of
        :meth:`spherical` with the common phase removed.
        """
        direction = jnp.stack(
            [jnp.cos(elevation) * jnp.cos(azimuth), jnp.cos(elevation) * jnp.sin(azimuth), jnp.sin(elevation)]
        )
        return jnp.exp(-1j * self.wavenumber * jnp.asarray(self.positions, direction.dtype) @ direction)

    def spherical(self, point: jax.Array) -> jax.Array:
        """Spherical-wave vector (N_b,): e^{jk|q - p_n|} of a point q (3,) [m]."""
        offset = point - jnp.asarray(self.positions, point.dtype)
        return jnp.exp(1j * self.wavenumber * jnp.sqrt(jnp.sum(offset**2, axis=-1)))
