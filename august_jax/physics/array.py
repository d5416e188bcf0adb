"""Antenna arrays: the base station's planar one with its steering vectors (paper, Section II-A), and any other."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.config import ArrayConfig
from august_jax.constants import SPEED_OF_LIGHT
from august_jax.physics.green import inner


def wavenumber(frequency_hz: float | jax.Array) -> float | jax.Array:
    """k = 2 pi f / c [rad/m]."""
    return 2.0 * np.pi * frequency_hz / SPEED_OF_LIGHT


@jax.tree_util.register_static
@dataclass(frozen=True)
class PlanarArray:
    """nx x nz half-wavelength array in the x-O-z plane, centred at the origin.

    Element n = b + a nz has the a-th place along x and the b-th along z (both from 0). Every element is a point
    dipole along ``polarization``, at transmission and reception. To jit it is a constant, not data.

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

    @classmethod
    def from_config(cls, array: ArrayConfig) -> PlanarArray:
        """The base station's array as it is configured."""
        return cls(array.nx, array.nz, array.frequency_hz)

    @property
    def count(self) -> int:
        """Number of elements N_b."""
        return self.nx * self.nz

    @property
    def wavelength(self) -> float:
        """Carrier wavelength [m]."""
        return SPEED_OF_LIGHT / self.frequency_hz

    @property
    def spacing_m(self) -> float:
        """Distance between neighbours, half a wavelength [m]."""
        return self.wavelength / 2.0

    @property
    def wavenumber(self) -> float:
        """k at the carrier [rad/m]."""
        return wavenumber(self.frequency_hz)

    @property
    def positions(self) -> np.ndarray:
        """Element positions (N_b, 3), float64 [m]."""
        x = (np.arange(self.nx) - (self.nx - 1) / 2.0) * self.spacing_m
        z = (np.arange(self.nz) - (self.nz - 1) / 2.0) * self.spacing_m
        grid_x, grid_z = np.meshgrid(x, z, indexing="ij")
        return np.stack([grid_x, np.zeros_like(grid_x), grid_z], axis=-1).reshape(-1, 3)

    @property
    def moments(self) -> np.ndarray:
        """Unit vectors of the elements' dipoles (N_b, 3), float64."""
        return np.tile(np.asarray(self.polarization, np.float64), (self.count, 1))

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
        return jnp.exp(1j * self.wavenumber * jnp.sqrt(inner(offset, offset)))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class AntennaArray:
    """Point dipoles anywhere, each along its own direction; a pytree, so that channels have gradients in all of it.

    Attributes:
        positions: (N, 3) [m]; best within a few metres of their mean, where single precision keeps its digits: put
            stations that lie apart into arrays of their own.
        moments: unit vectors of the dipoles (N, 3).
        frequency_hz: the carrier [Hz].

    Raises:
        ValueError: mismatched shapes, positions that are not finite, moments that are no unit vectors, or a frequency
            that is not positive.
    """

    positions: jax.Array | np.ndarray
    moments: jax.Array | np.ndarray
    frequency_hz: float = field(metadata={"static": True})

    def __post_init__(self):
        for name in ("positions", "moments"):
            if isinstance(getattr(self, name), (list, tuple)):
                object.__setattr__(self, name, np.asarray(getattr(self, name), float))
        if not all(hasattr(part, "shape") for part in (self.positions, self.moments)):
            return  # JAX rebuilds pytrees with placeholders
        shape = self.positions.shape
        if len(shape) < 2 or shape[-1] != 3 or shape[-2] == 0:
            raise ValueError(f"positions: got shape {shape}; give (N, 3) with N at least 1")
        if self.moments.shape != shape:
            raise ValueError(f"moments: got shape {self.moments.shape}; give {shape}, one unit vector an antenna")
        if not 0.0 < self.frequency_hz < np.inf:
            raise ValueError(f"frequency_hz: got {self.frequency_hz!r}; give a positive frequency in Hz, e.g. 3e9")
        if any(isinstance(part, (jax.core.Tracer, jax.ShapeDtypeStruct)) for part in (self.positions, self.moments)):
            return
        positions, moments = np.asarray(self.positions), np.asarray(self.moments)
        if not np.all(np.isfinite(positions)):
            raise ValueError("positions: holds NaN or infinity; remove those antennas")
        length = np.linalg.norm(moments, axis=-1)
        if not np.all(np.abs(length - 1.0) < 1e-5):
            worst = int(np.argmax(np.where(np.isnan(length), np.inf, np.abs(length - 1.0))))
            raise ValueError(f"moments: row {worst} has length {length.flat[worst]:.3g}; give unit vectors")

    @classmethod
    def joined(cls, *arrays: PlanarArray | AntennaArray) -> AntennaArray:
        """One array of all antennas of several, in order; the first one's carrier. Crossed dipoles are two arrays."""
        if not arrays:
            raise ValueError("arrays: got none; give at least one array")
        positions, moments = ([getattr(array, name) for array in arrays] for name in ("positions", "moments"))
        concrete = all(isinstance(part, np.ndarray) for part in positions + moments)
        join = np.concatenate if concrete else jnp.concatenate
        return cls(join(positions), join(moments), arrays[0].frequency_hz)

    @property
    def count(self) -> int:
        """Number of antennas N."""
        return self.positions.shape[-2]

    @property
    def wavenumber(self) -> float:
        """k at the carrier [rad/m]."""
        return wavenumber(self.frequency_hz)
