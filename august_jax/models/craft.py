r"""What a cloud says as a whole, and the frame in which its points are diffused: the region's, or the craft's own.

Points are independent of each other given the condition, so whatever the condition leaves open is drawn anew for every
point: a craft whose range is known to 10 cm comes out as 10 cm of fog. With `config.model.frame` = ``craft`` the
cloud commits to one place and one thrust axis, which a linear readout of the condition states, and to one heading; the
diffusion then draws points about that place, in the craft's axes, in units of the half-wheelbase. Row by row:

    p' = Z(a)^T R(n)^T (B^T p - m) s/h,

B the rotation about z that turns e_x into the horizontal direction in which the base station sees the region, m the
mean of the points B^T p, n the normal of their flattest plane, R(n) the smallest rotation of e_z to n, Z(a) the
rotation by the heading a about z, s the region's scale and h the half-wheelbase. An echo tells headings relative to the
line of sight, and a craft seen from its side looks the same wherever it flies: with B this need not be learned.
Material numbers stay as they are. The frame ``region`` is the paper's: p' = p. docs/model.md draws the chain.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from august_jax.arrays import Array
from august_jax.config import Config

HARMONICS = 8
"""Orders n of the harmonics c_1..c_n of a :class:`Reading`."""


class Reading(NamedTuple):
    """What clouds (..., M, 5) say as a whole, in their own units; a pytree.

    Attributes:
        place: mean of the points (..., 3).
        material: mean of the two material numbers (..., 2).
        normal: upward unit normal of the plane in which the cloud is flattest (..., 3).
        harmonics: real, then imaginary parts of c_n = <r^2 e^{jn phi}>/(2 <r^2>) for n = 1..8 (..., 16), with r and phi
            the polar coordinates of the points in the craft's level axes, those of R(n): a craft of n arms has a large
            c_n, whose phase is n times its heading.
    """

    place: Float[Array, "*batch 3"]
    material: Float[Array, "*batch 2"]
    normal: Float[Array, "*batch 3"]
    harmonics: Float[Array, "*batch 16"]

    @classmethod
    def of_cloud(cls, cloud: Float[Array, "*batch points 5"]) -> Reading:
        """The reading of clouds (..., M, 5), M at least 1."""
        mean = jnp.mean(cloud, axis=-2)
        centred = cloud[..., :3] - mean[..., None, :3]
        _, axes = jnp.linalg.eigh(jnp.einsum("...ma,...mb->...ab", centred, centred) / cloud.shape[-2])
        normal = axes[..., 0] * jnp.where(axes[..., 2:, 0] < 0.0, -1.0, 1.0)
        level = jnp.einsum("...ma,...ab->...mb", centred, _level_axes(normal)[..., :2])
        squared = jnp.sum(level**2, axis=-1)
        turn = jax.lax.complex(level[..., 0], level[..., 1]) / jnp.sqrt(jnp.maximum(squared, 1e-12))
        spread = jnp.maximum(jnp.sum(squared, axis=-1), 1e-12)
        powers, harmonics = turn, []
        for _ in range(HARMONICS):
            harmonics.append(0.5 * jnp.sum(squared * powers, axis=-1) / spread)
            powers = powers * turn
        stacked = jnp.stack(harmonics, axis=-1)
        return cls(mean[..., :3], mean[..., 3:], normal, jnp.concatenate([stacked.real, stacked.imag], axis=-1))

    @classmethod
    def from_vector(cls, numbers: Float[Array, "*batch 24"]) -> Reading:
        """Inverse of :meth:`vector`."""
        return cls(*jnp.split(numbers, (3, 5, 8), axis=-1))

    def vector(self) -> Float[jax.Array, "*batch 24"]:
        """The parts in the order to which a readout is trained (..., 24)."""
        return jnp.concatenate(self, axis=-1)

    def heading(self) -> Float[jax.Array, "*batch"]:
        """The angle a (...,) [rad] that the strongest harmonic states: arg(c_n)/n.

        A craft of n equal arms has one at a, and looks the same from each of the n headings among which a is chosen.
        """
        values = _complex(self.harmonics)
        order = jnp.argmax(jnp.abs(values), axis=-1)
        return jnp.angle(jnp.take_along_axis(values, order[..., None], axis=-1)[..., 0]) / (order + 1.0)

    def axes(self) -> Float[jax.Array, "*batch 3 3"]:
        """R(n) Z(a) (..., 3, 3): its columns are the craft's axes."""
        rotation, angle = _level_axes(self.normal), self.heading()
        cosine, sine = jnp.cos(angle)[..., None], jnp.sin(angle)[..., None]
        x, y = rotation[..., 0], rotation[..., 1]
        return jnp.stack([cosine * x + sine * y, cosine * y - sine * x, rotation[..., 2]], axis=-1)

    def kind(self) -> Float[jax.Array, "*batch 18"]:
        """What does not depend on place and attitude (..., 18): the harmonics in the craft's own axes, the material."""
        turn = jnp.exp(-1j * self.heading()[..., None] * jnp.arange(1, HARMONICS + 1))
        values = _complex(self.harmonics) * turn
        return jnp.concatenate([values.real, values.imag, self.material], axis=-1)


READING_SIZE = 3 + 2 + 3 + 2 * HARMONICS
"""Length of :meth:`Reading.vector`."""
KIND_SIZE = 2 * HARMONICS + 2
"""Length of :meth:`Reading.kind`."""


class RegionFrame:
    """The paper's frame: points are diffused as the cloud has them. The interface of :class:`CraftFrame`."""

    def faced(self, points: Float[Array, "*batch points coordinates"]) -> Float[jax.Array, "*batch points coordinates"]:
        """The points as they are."""
        return jnp.asarray(points)

    def read(self, cloud: Float[Array, "*batch points 5"]) -> Reading:
        """The reading of region clouds."""
        return Reading.of_cloud(cloud)

    def into(self, cloud: Float[Array, "*batch points 5"], reading: Reading) -> Float[jax.Array, "*batch points 5"]:
        """The cloud as it is."""
        return jnp.asarray(cloud)

    def out(self, points: Float[Array, "*batch points 5"], reading: Reading) -> Float[jax.Array, "*batch points 5"]:
        """The points as they are."""
        return jnp.asarray(points)


class CraftFrame(NamedTuple):
    """The chain between the region's coordinates and a craft's own, one way and the other; a pytree.

    Attributes:
        centre: where the region is seen (..., 3) [m]; its bearing gives B.
        scale: s/h, region units to half-wheelbases.
    """

    centre: Float[Array, "*batch 3"]
    scale: float

    def faced(self, points: Float[Array, "*batch points coordinates"]) -> Float[jax.Array, "*batch points coordinates"]:
        """Points (..., M, 3 or 5) turned by B^T: x away from the array's axis x = y = 0."""
        return _about_vertical(points, self.centre, -1.0)

    def read(self, cloud: Float[Array, "*batch points 5"]) -> Reading:
        """The reading of region clouds (..., M, 5) as they are faced, which is the one that the frame takes."""
        return Reading.of_cloud(self.faced(cloud))

    def into(self, cloud: Float[Array, "*batch points 5"], reading: Reading) -> Float[jax.Array, "*batch points 5"]:
        """Region clouds (..., M, 5) in the frame of a craft of that reading."""
        faced = self.faced(cloud)
        offsets = faced[..., :3] - reading.place[..., None, :]
        points = self.scale * jnp.einsum("...ma,...ab->...mb", offsets, reading.axes())
        return jnp.concatenate([points, faced[..., 3:]], axis=-1)

    def out(self, points: Float[Array, "*batch points 5"], reading: Reading) -> Float[jax.Array, "*batch points 5"]:
        """Inverse of :meth:`into`."""
        offsets = jnp.einsum("...mb,...ab->...ma", points[..., :3] / self.scale, reading.axes())
        faced = jnp.concatenate([offsets + reading.place[..., None, :], points[..., 3:]], axis=-1)
        return _about_vertical(faced, self.centre, 1.0)


def frame_of(config: Config, centre: Float[Array, "*batch 3"]) -> RegionFrame | CraftFrame:
    """The frame that ``config.model.frame`` names, of regions that are seen at ``centre`` (..., 3) [m]."""
    if config.model.frame == "region":
        return RegionFrame()
    return CraftFrame(centre, config.region.scale_m / config.target.half_wheelbase_m)


def _level_axes(normal: Array) -> jax.Array:
    """R(n) (..., 3, 3) of normals (..., 3) of any length."""
    # A mean over opposite tilts is short; a normal that points down is no flight attitude.
    normal = jnp.concatenate([normal[..., :2], jnp.maximum(normal[..., 2:], 1e-3)], axis=-1)
    x, y, z = jnp.moveaxis(normal / jnp.linalg.norm(normal, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1.0 - x * x / (1.0 + z), -x * y / (1.0 + z), x),
        (-x * y / (1.0 + z), 1.0 - y * y / (1.0 + z), y),
        (-x, -y, z),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def _about_vertical(points: Array, centre: Array, sense: float) -> jax.Array:
    """Points (..., M, D) turned about z by the bearing of a place (..., 3), times ``sense``."""
    distance = jnp.maximum(jnp.linalg.norm(centre[..., :2], axis=-1), 1e-6)
    cosine, sine = centre[..., 0, None] / distance[..., None], sense * centre[..., 1, None] / distance[..., None]
    x, y = points[..., 0], points[..., 1]
    turned = jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
    return jnp.concatenate([turned, points[..., 2:]], axis=-1)


def _complex(harmonics: Array) -> jax.Array:
    return jax.lax.complex(harmonics[..., :HARMONICS], harmonics[..., HARMONICS:])
