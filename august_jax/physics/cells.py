"""The scatterer's quadrature: cells of a lattice, partly filled with material (thin-sheet mixing)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float, Real

from august_jax.arrays import Array, ArrayLike


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

    positions: Float[Array, "*batch n 3"]
    volumes: Float[Array, "*batch n"]
    fill: Float[Array, "*batch n"] | ArrayLike = 1.0
    normals: Float[Array, "*batch n 3"] | Float[Array, "*batch n 3 3"] | None = None
    centroids: Float[Array, "*batch n 3"] | None = None

    @property
    def count(self) -> int:  # type: ignore[override]  # of cells, not tuple's
        """Number of cells N."""
        return jnp.shape(self.positions)[-2]

    def fractions(self) -> Float[Array, "*batch n"]:
        """Fill fractions as (N,)."""
        return jnp.broadcast_to(jnp.asarray(self.fill), jnp.shape(self.volumes))

    def sites(self) -> Float[Array, "*batch n 3"]:
        """Where the antennas' fields are taken (N, 3) [m]: the material's centroids, else ``positions``."""
        return self.positions if self.centroids is None else self.centroids

    def tensors(self) -> Float[jax.Array, "*batch n 3 3"]:
        """n n^T as (N, 3, 3); zero where no normals are given."""
        if self.normals is None:
            return jnp.zeros((*jnp.shape(self.volumes), 3, 3), jnp.asarray(self.positions).dtype)
        normals = jnp.asarray(self.normals)
        if normals.ndim == jnp.ndim(self.volumes) + 1:
            return normals[..., :, None] * normals[..., None, :]
        return normals

    def moved(self, rotation: Real[Array, "3 3"], translation: Real[Array, "3"]) -> Cells:
        """The cells after x -> R x + t; rotation (3, 3), translation (3,) [m].

        Raises:
            ValueError: a matrix that is no rotation, or a place that is not finite.
        """
        from august_jax.physics.checks import check_finite, check_rotation, settled  # they know cells themselves

        check_rotation(rotation)
        check_finite("translation", translation, "give a place (3,) in m")
        rotation, translation = settled("rotation", rotation), settled("translation", translation)
        normals = None
        if self.normals is not None:
            normals = jnp.einsum("ab,nbc,dc->nad", rotation, self.tensors(), rotation)
        turn = jnp.asarray(rotation).T
        positions, centroids = (
            None if places is None else settled("cells", places) @ turn + translation
            for places in (self.positions, self.centroids)
        )
        return self._replace(positions=positions, normals=normals, centroids=centroids)
