"""What the base station transmits: a beam codebook over the region's sector and power-limited pilots.

Time convention e^{-jwt}: an echo from direction u reaches element p_n with phase e^{-jk u.p_n}, so the beam that
adds up in direction u has the weights e^{+jk u.p_n}. On half-wavelength spacing, with azimuth t and elevation p,

    [w_ij]_n = exp(+j pi (a cos(p_j) cos(t_i) + b sin(p_j))) / sqrt(N_b),    n = b + a nz.

The paper (Section II-A) prints a minus sign; under e^{+jkr} it lights the mirror image of the sector through the
array's broadside, and is kept as the option ``mirror``. Its bound on the transmit power, tr(X X^H)/L <= P_s, fixes
the scale of the pilots X = W S.
"""

from __future__ import annotations

from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Inexact

from august_jax.arrays import Array, ArrayLike
from august_jax.config import Pilots

PILOTS: tuple[Pilots, ...] = get_args(Pilots)
Angles = tuple[ArrayLike, ArrayLike]
"""Azimuth and elevation [rad]."""


def dbm_to_watt(power_dbm: ArrayLike) -> jax.Array:
    """Power [W] from [dBm]."""
    return 10.0 ** (jnp.asarray(power_dbm) / 10.0 - 3.0)


def watt_to_dbm(power_w: ArrayLike) -> jax.Array:
    """Power [dBm] from [W]."""
    return 10.0 * jnp.log10(power_w) + 30.0


def direction_angles(point: Float[Array, "3"]) -> tuple[Float[jax.Array, ""], Float[jax.Array, ""]]:
    """Azimuth and elevation [rad] of a point (3,) [m] seen from the origin.

    x = r cos(el) cos(az), y = r cos(el) sin(az), z = r sin(el).
    """
    x, y, z = point
    return jnp.arctan2(y, x), jnp.arctan2(z, jnp.hypot(x, y))


def sector_grid(centre: ArrayLike, width: float, count: int) -> Float[Array, " {count}"]:
    """``count`` equally spaced angles (count,) [rad] about ``centre``, both ends included; the centre if one."""
    return centre + width * (np.linspace(-0.5, 0.5, count) if count > 1 else np.zeros(1))


def codebook_factors(
    nx: int, nz: int, centre: Angles, widths: tuple[float, float], *, mirror: bool = False
) -> tuple[Complex[jax.Array, "{nx} {nx} {nz}"], Complex[jax.Array, "{nz} {nz}"]]:
    """The beams of :func:`roi_codebook` by axis of the array: [w_ij]_(a, b) = x[a, i, j] z[b, j].

    Returns:
        x (nx, nx, nz) of modulus one and z (nz, nz) of modulus 1/sqrt(N_b).
    """
    azimuth = sector_grid(centre[0], widths[0], nx)
    elevation = sector_grid(centre[1], widths[1], nz)
    turn = -np.pi if mirror else np.pi
    places_x = turn * (np.arange(nx) - (nx - 1) / 2.0)
    places_z = turn * (np.arange(nz) - (nz - 1) / 2.0)
    phase_x = places_x[:, None, None] * (jnp.cos(azimuth)[:, None] * jnp.cos(elevation))
    phase_z = places_z[:, None] * jnp.sin(elevation)
    return (
        jax.lax.complex(jnp.cos(phase_x), jnp.sin(phase_x)),
        jax.lax.complex(jnp.cos(phase_z), jnp.sin(phase_z)) / np.sqrt(nx * nz),
    )


def roi_codebook(
    nx: int, nz: int, centre: Angles, widths: tuple[float, float], *, mirror: bool = False
) -> Complex[jax.Array, "antennas antennas"]:
    """Beams over an angular sector (paper, eq. beamforming matrix element).

    Args:
        nx, nz: elements along x and z; also the number of azimuths and elevations.
        centre: azimuth and elevation of the sector's centre [rad].
        widths: full widths in azimuth and elevation [rad].
        mirror: the paper's printed sign.

    Returns:
        W (N_b, N_b) complex; columns of unit norm, column j + i nz for azimuth i and elevation j. W is numerically
        singular for every sector narrower than the half-space.
    """
    if nx < 1 or nz < 1:
        raise ValueError(f"nx, nz: got {nx} x {nz} elements; each must be at least 1")
    along_x, along_z = codebook_factors(nx, nz, centre, widths, mirror=mirror)
    return (along_x[:, None] * along_z[None, :, None, :]).reshape(nx * nz, nx * nz)


def pilot_symbols(
    key: jax.Array, count: int, symbols: int, kind: Pilots = "unitary"
) -> Complex[jax.Array, "{count} {symbols}"]:
    """Pseudo-random symbols with zero mean and E[s s^H] = I.

    Args:
        key: random key.
        count: streams N_b.
        symbols: L.
        kind: ``unitary``: ``count`` rows of the L-point DFT matrix, every row and every column turned by a random
            phase, so that S S^H = L I exactly (needs L >= N_b); ``gaussian``: independent circular Gaussian entries.

    Returns:
        S (count, symbols) complex64.
    """
    if kind not in PILOTS:
        raise ValueError(f"kind: unknown pilots {kind!r}; choose one of {', '.join(PILOTS)}")
    if kind == "gaussian":
        parts = jax.random.normal(key, (2, count, symbols), jnp.float32)
        return jax.lax.complex(parts[0], parts[1]) * np.float32(np.sqrt(0.5))
    if symbols < count:
        raise ValueError(f"symbols: {symbols} symbols cannot be orthogonal over {count} streams; give at least {count}")
    dft = 2.0 * np.pi * (np.arange(count)[:, None] * np.arange(symbols) % symbols) / symbols
    turns = 2.0 * np.pi * jax.random.uniform(key, (count + symbols,))
    phase = dft.astype(np.float32) + turns[:count, None] + turns[count:]
    return jax.lax.complex(jnp.cos(phase), jnp.sin(phase))


def pilots(
    codebook: Inexact[Array, "antennas antennas"], symbols: Inexact[Array, "antennas symbols"], power_w: ArrayLike
) -> Inexact[jax.Array, "antennas symbols"]:
    """Transmitted matrix X = W S sqrt(P_s L) / ||W S||_F.

    Args:
        codebook: W (N_b, N_b).
        symbols: S (N_b, L).
        power_w: P_s, the mean transmit power over the L symbols, tr(X X^H)/L [W].

    Returns:
        X (N_b, L) [sqrt(W)].
    """
    product = codebook @ symbols
    energy = jnp.sum(jnp.real(product) ** 2 + jnp.imag(product) ** 2)
    return product * jnp.sqrt(power_w * symbols.shape[-1] / energy)
