"""The scatterer's quadrature: cells of a lattice, partly filled with material (thin-sheet mixing)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Cells(NamedTuple):
    """Cells that discretise a body; a pytree of arrays.

    Attributes:
        positions: where cells couple to each other (N, 3) [m]; the centres of solid cells.
        volumes: full cell volumes (N,) [m^3], filled or not.
        fill: fraction of each cell that holds material (N,), or one number; 1 for solid parts.
        normals: area-weighted mean of n n^T of the sheet in each cell (N, 3, 3), or unit normals (N, 3), or
            None where every cell is solid or the sheet's direction is to be ignored.
        centroids: mean place of the material in each cell (N, 3) [m], where the cell hears the antennas and from where
            it answers; None takes ``positions``. On thin skins this removes most of the lattice's error: 2 k times
            half a cell is 0.6 rad at 10 mm and 3 GHz. A copy with other ``positions`` keeps its centroids: move both,
            or use :meth:`moved`.
    """

    positions: jax.Array | np.ndarray
    volumes: jax.Array | np.ndarray
    fill: jax.Array | np.ndarray | float = 1.0
    normals: jax.Array | np.ndarray | None = None
    centroids: jax.Array | np.ndarray | None = None

    @property
    def count(self) -> int:
        """Number of cells N."""
        return self.positions.shape[-2]

    def fractions(self) -> jax.Array:
        """Fill fractions as (N,)."""
        return jnp.broadcast_to(jnp.asarray(self.fill), self.volumes.shape)

    def sites(self) -> jax.Array | np.ndarray:
        """Where the antennas' fields are taken (N, 3) [m]: the material's centroids, else ``positions``."""
        return self.positions if self.centroids is None else self.centroids

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
        turn = jnp.asarray(rotation).T
        centroids = None if self.centroids is None else self.centroids @ turn + translation
        return self._replace(positions=self.positions @ turn + translation, normals=normals, centroids=centroids)
