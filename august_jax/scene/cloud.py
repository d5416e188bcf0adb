"""The 5-D cloud and its region.

A point of the cloud is ((x, y, z) - q_pre) / s, eps / eps_max, sigma / sigma_max: where the surface lies, relative
to the predicted position q_pre and in units of the region's scale s, and what it is made of (paper, eq. 5D pc). The
scale is a plain one: it bounds nothing and clips nothing. The position follows as q_est = q_pre + s * mean.
Everything broadcasts over leading axes.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from august_jax.arrays import Array, ArrayLike
from august_jax.config import RegionConfig


class WorldCloud(NamedTuple):
    """A cloud in the world, in physical units.

    Attributes:
        points: world points (..., M, 3) [m].
        permittivity: relative permittivity of each (..., M).
        conductivity: conductivity of each (..., M) [S/m].
    """

    points: Float[Array, "*batch points 3"]
    permittivity: Float[Array, "*batch points"]
    conductivity: Float[Array, "*batch points"]


def to_cloud(
    points: Float[Array, "*batch points 3"],
    position: Float[Array, "*batch 3"],
    predicted: Float[Array, "*batch 3"],
    permittivity: ArrayLike,
    conductivity: ArrayLike,
    region: RegionConfig,
) -> Float[jax.Array, "*batch points 5"]:
    """The normalised cloud (..., M, 5).

    Args:
        points: surface points in the world's axes, relative to ``position`` (..., M, 3) [m].
        position: true position (..., 3) [m].
        predicted: predicted position q_pre (..., 3) [m].
        permittivity: relative permittivity of the craft (...,).
        conductivity: its conductivity (...,) [S/m].
        region: scale and material limits.
    """
    offset = (jnp.asarray(position) - jnp.asarray(predicted))[..., None, :]
    where = (jnp.asarray(points) + offset) / region.scale_m
    what = jnp.stack(
        [jnp.asarray(permittivity) / region.permittivity_max, jnp.asarray(conductivity) / region.conductivity_max_s_m],
        axis=-1,
    )[..., None, :]
    return jnp.concatenate([where, jnp.broadcast_to(what, (*where.shape[:-1], 2))], axis=-1)


def from_cloud(
    cloud: Float[Array, "*batch points 5"], predicted: Float[Array, "*batch 3"], region: RegionConfig
) -> WorldCloud:
    """Inverse of :func:`to_cloud`: cloud (..., M, 5), predicted (..., 3) [m] -> world points and materials."""
    cloud = jnp.asarray(cloud)
    return WorldCloud(
        points=cloud[..., :3] * region.scale_m + jnp.asarray(predicted)[..., None, :],
        permittivity=cloud[..., 3] * region.permittivity_max,
        conductivity=cloud[..., 4] * region.conductivity_max_s_m,
    )


def position_estimate(
    cloud: Float[Array, "*batch points 5"], predicted: Float[Array, "*batch 3"], region: RegionConfig
) -> Float[jax.Array, "*batch 3"]:
    """q_est (..., 3) [m], the mean of the cloud (..., M, 5) put back into the world."""
    return jnp.asarray(predicted) + region.scale_m * jnp.mean(jnp.asarray(cloud)[..., :3], axis=-2)
