"""The scatterer's quadrature: cells of a lattice, partly filled with material (thin-sheet mixing)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Cells(NamedTuple):
    """Cells that discretise a body; a pytree of arrays.

    Attributes:
        positions: centres (N, 3) [m].
        volumes: full cell volumes (N,) [m^3], filled or not.
        fill: fraction of each cell that holds material (N,), or one number; 1 for solid parts.
        normals: area-weighted mean of n n^T of the sheet in each cell (N, 3, 3), or unit normals (N, 3), or
            None where every cell is solid or the sheet's direction is to be ignored.
    """

    positions: jax.Array | np.ndarray
    volumes: jax.Array | np.ndarray
    fill: jax.Array | np.ndarray | float = 1.0
    normals: jax.Array | np.ndarray | None = None

    @property
    def count(self) -> int:
        """Number of cells N."""
        return self.positions.shape[-2]

    def fractions(self) -> jax.Array:
        """Fill fractions as (N,)."""
        return jnp.broadcast_to(jnp.asarray(self.fill), self.volumes.shape)

    def tensors(self) -> jax.Array:
        """n n^T as (N, 3, 3); zero where no normals are given."""
        if self.normals is None:
            return jnp.zeros((*self.volumes.shape, 3, 3), jnp.asarray(self.positions).dtype)
        normals = jnp.asarray(self.normals)
        if normals.ndim == jnp.ndim(self.volumes) + 1:
            return normals[..., :, None] * normals[..., None, :]
        return normals

    def moved(self, rotation, translation) -> Cells:
        """The cells after x -> R x + t; rotation (3, 3), translation (3,) [m]."""
        normals = None
        if self.normals is not None:
            normals = jnp.einsum("ab,nbc,dc->nad", rotation, self.tensors(), rotation)
        return self._replace(positions=self.positions @ jnp.asarray(rotation).T + translation, normals=normals)
