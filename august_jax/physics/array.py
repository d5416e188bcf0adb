"""Antenna arrays: the base station's planar one with its steering vectors (paper, Section II-A), and any other."""

from __future__ import annotations

import numbers
from dataclasses import dataclass, field
from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from august_jax.arrays import Array, ArrayLike
from august_jax.config import ArrayConfig
from august_jax.constants import SPEED_OF_LIGHT
from august_jax.physics.checks import check_ends, check_finite, check_frequency, is_concrete, settled
from august_jax.physics.green import inner


def wavenumber(frequency_hz: ArrayLike) -> ArrayLike:
    """k = 2 pi f / c [rad/m] of f [Hz]; of the argument's type and shape.

    Raises:
        ValueError: a plain number that is not positive.
    """
    if isinstance(frequency_hz, (int, float)):
        check_frequency("frequency_hz", frequency_hz)
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
        for name in ("nx", "nz"):
            count = getattr(self, name)
            if isinstance(count, bool) or not isinstance(count, numbers.Integral):
                raise ValueError(f"{name}: got {count!r}; give a whole number of elements")
            object.__setattr__(self, name, int(count))
        if self.nx < 1 or self.nz < 1:
            raise ValueError(f"nx, nz: got {self.nx} x {self.nz} elements; each must be at least 1")
        object.__setattr__(self, "frequency_hz", check_frequency("frequency_hz", self.frequency_hz))
        along = np.asarray(settled("polarization", self.polarization))
        if along.shape != (3,) or not abs(np.linalg.norm(along) - 1.0) < 1e-6:
            raise ValueError(f"polarization: got {self.polarization!r}; give a unit vector of three numbers")
        object.__setattr__(self, "polarization", tuple(along.tolist()))  # what jit takes for a constant has a hash

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

    @cached_property
    def positions(self) -> Float[np.ndarray, "n 3"]:
        """Element positions (N_b, 3), float64 [m]; not to be written to."""
        x = (np.arange(self.nx) - (self.nx - 1) / 2.0) * self.spacing_m
        z = (np.arange(self.nz) - (self.nz - 1) / 2.0) * self.spacing_m
        grid_x, grid_z = np.meshgrid(x, z, indexing="ij")
        places = np.stack([grid_x, np.zeros_like(grid_x), grid_z], axis=-1).reshape(-1, 3)
        places.flags.writeable = False
        return places

    @cached_property
    def moments(self) -> Float[np.ndarray, "n 3"]:
        """Unit vectors of the elements' dipoles (N_b, 3), float64; not to be written to."""
        return np.broadcast_to(np.asarray(self.polarization, np.float64), (self.count, 3))

    def steering(self, azimuth: ArrayLike, elevation: ArrayLike) -> Complex[jax.Array, " n"]:
        """Plane-wave vector (N_b,): e^{-jk u.p_n} for a far point in direction u, phases relative to the origin.

        u = (cos(el) cos(az), cos(el) sin(az), sin(el)); angles in rad. It is the far limit of
        :meth:`spherical` with the common phase removed.
        """
        direction = jnp.stack(
            [jnp.cos(elevation) * jnp.cos(azimuth), jnp.cos(elevation) * jnp.sin(azimuth), jnp.sin(elevation)]
        )
        return jnp.exp(-1j * self.wavenumber * jnp.asarray(self.positions, direction.dtype) @ direction)

    def spherical(self, point: Float[Array, "3"]) -> Complex[jax.Array, " n"]:
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

    Whole and half-precision numbers become float32.

    Raises:
        ValueError: mismatched shapes, positions that are not finite, moments that are no unit vectors, or a frequency
            that is not positive.
    """

    positions: Float[Array, "*batch n 3"]
    moments: Float[Array, "*batch n 3"]
    frequency_hz: float = field(metadata={"static": True})

    def __post_init__(self):
        for name in ("positions", "moments"):
            part = getattr(self, name)
            if isinstance(part, (list, tuple)):
                part = np.asarray(part, float)
            if isinstance(part, (jax.Array, np.ndarray)):
                object.__setattr__(self, name, settled(name, part))
        if not all(hasattr(part, "shape") for part in (self.positions, self.moments)):
            return  # JAX rebuilds pytrees with placeholders
        shape = self.positions.shape
        if len(shape) < 2 or shape[-1] != 3 or shape[-2] == 0:
            raise ValueError(f"positions: got shape {shape}; give (N, 3) with N at least 1")
        if self.moments.shape != shape:
            raise ValueError(f"moments: got shape {self.moments.shape}; give {shape}, one unit vector an antenna")
        object.__setattr__(self, "frequency_hz", check_frequency("frequency_hz", self.frequency_hz))
        if not is_concrete((self.positions, self.moments)):
            return
        check_finite("positions", self.positions, "remove those antennas")
        length = np.linalg.norm(np.asarray(self.moments), axis=-1)
        if not np.all(np.abs(length - 1.0) < 1e-5):
            worst = int(np.argmax(np.where(np.isnan(length), np.inf, np.abs(length - 1.0))))
            raise ValueError(f"moments: row {worst} has length {length.flat[worst]:.3g}; give unit vectors")

    @classmethod
    def joined(cls, *arrays: PlanarArray | AntennaArray) -> AntennaArray:
        """One array of all antennas of several, in order. Crossed dipoles are two arrays.

        Raises:
            ValueError: no arrays, or arrays of different carriers.
        """
        if not arrays:
            raise ValueError("arrays: got none; give at least one array")
        for other in arrays[1:]:
            check_ends(arrays[0], other, "arrays")
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
