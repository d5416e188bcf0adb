"""The coupled system of volume cells (method of moments with one pulse a cell) and its dense solution.

With partly filled cells (thin sheets mixed in parallel along the sheet and in series across it), the contrast
of a cell obeys 1/chi_cell = 1/(f chi) + ((1 - f)/f) n n^T. Scaling each cell by sqrt(f V) leaves a symmetric system

    (D^{-1} - K') P = E',    D = diag(chi_i) (x) I3,    E'_i = sqrt(f_i V_i) M_i,    H = k^2 E'^T P,

in which K' holds k^2 sqrt(f_i V_i f_j V_j) G(p_i, p_j) off the diagonal and f M0 I - (1 - f) n n^T on it. For
f = 1 this is the paper's discretised Lippmann-Schwinger equation, H = k^2 M^T D V (I - k^2 G D V)^{-1} M.

Self term, equal-volume sphere a = (3 V / 4 pi)^{1/3}: M0 = (2/3)(1 - jka) e^{jka} - 1, so that a lone solid cell
obeys [1 + chi/3 - (2 chi/3)((1 - jka) e^{jka} - 1)] E = E_inc. Its imaginary part starts with (ka)^3 2/9
= k^3 V/(6 pi), the radiation that keeps the energy balance.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Inexact

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.cells import Cells
from august_jax.physics.green import coupling_matrix


class Solution(NamedTuple):
    """Polarisations that solve the coupled system.

    Attributes:
        polarization: P (3N, R) complex, one column a right-hand side.
        residual: largest relative residual over the columns, real.
    """

    polarization: Complex[Array, "3*n r"]
    residual: Float[Array, ""]


def self_term(volumes: Float[Array, "*n"] | float, wavenumber: ArrayLike) -> Complex[jax.Array, "*n"]:
    """M0 of cells of the given volumes [m^3]; same shape, complex, dimensionless."""
    radius = (3.0 * volumes / (4.0 * np.pi)) ** (1.0 / 3.0)
    x = wavenumber * radius
    # Expanded for small ka, where the closed form loses digits in single precision.
    series = -1.0 / 3.0 + x**2 / 3.0 - x**4 / 12.0 + 1j * x**3 * (2.0 / 9.0 - x**2 / 45.0)
    exact = (2.0 / 3.0) * (1.0 - 1j * x) * jnp.exp(1j * x) - 1.0
    return jnp.where(x < 0.02, series, exact)


def interaction_matrix(cells: Cells, wavenumber: ArrayLike) -> Complex[jax.Array, "rows rows"]:
    """K' (3N, 3N), complex symmetric: it knows the geometry, not the material."""
    count = cells.positions.shape[0]
    weight = jnp.repeat(jnp.sqrt(cells.fractions() * cells.volumes), 3)
    matrix = (wavenumber**2 * weight[:, None] * weight) * coupling_matrix(centred(cells), wavenumber)
    blocks = matrix.reshape(count, 3, count, 3)
    place = jnp.arange(count)
    return blocks.at[place, :, place, :].add(own_blocks(cells, wavenumber)).reshape(3 * count, 3 * count)


def centred(cells: Cells) -> Float[jax.Array, "n 3"]:
    """Positions (N, 3) about their mean [m]: differences of small numbers keep their digits."""
    positions = jnp.asarray(cells.positions)
    return positions - jnp.mean(positions, axis=0)


def coupling_weights(cells: Cells, wavenumber: ArrayLike) -> Float[jax.Array, "rows 1"]:
    """w = k sqrt(f V) (3N, 1), of K'_ij = w_i w_j G(p_i, p_j)."""
    return wavenumber * jnp.repeat(jnp.sqrt(cells.fractions() * cells.volumes), 3)[:, None]


def own_blocks(cells: Cells, wavenumber: ArrayLike) -> Complex[jax.Array, "n 3 3"]:
    """What cells do to themselves, f M0 I - (1 - f) n n^T: the diagonal blocks (N, 3, 3) of K'."""
    fill = cells.fractions()
    identity = jnp.eye(3, dtype=jnp.result_type(cells.positions))
    own = (fill * self_term(jnp.asarray(cells.volumes), wavenumber))[:, None, None] * identity
    return own - (1.0 - fill)[:, None, None] * cells.tensors()


def weighted_fields(cells: Cells, fields: Inexact[Array, "rows r"]) -> Inexact[jax.Array, "rows r"]:
    """E' = sqrt(f V) E for fields (3N, R)."""
    return jnp.repeat(jnp.sqrt(cells.fractions() * cells.volumes), 3)[:, None] * fields


def solve_dense(matrix: Complex[Array, "rows rows"], contrast: ArrayLike, fields: Inexact[Array, "rows r"]) -> Solution:
    """Solve (D^{-1} - K') P = E' by LU, in the form (I - D K') P = D E', which also admits chi = 0.

    Args:
        matrix: K' (3N, 3N).
        contrast: chi, scalar or (N,).
        fields: E' (3N, R).
    """
    chi = jnp.repeat(jnp.broadcast_to(contrast, (matrix.shape[0] // 3,)), 3)[:, None].astype(matrix.dtype)
    system = jnp.eye(matrix.shape[0], dtype=matrix.dtype) - chi * matrix
    right = chi * fields
    polarization = jnp.linalg.solve(system, right)
    residual = jnp.linalg.norm(system @ polarization - right, axis=0)
    scale = jnp.maximum(jnp.linalg.norm(right, axis=0), jnp.finfo(residual.dtype).tiny)
    return Solution(polarization, jnp.max(residual / scale))
