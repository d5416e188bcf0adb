r"""The frame in which points are diffused: the region's, or the craft's own.

Points are independent of each other given the condition, so whatever the condition leaves open is drawn anew for every
point: a craft whose range is known to 10 cm comes out as 10 cm of fog. With `config.model.frame` = ``craft`` the
cloud commits to one place and one thrust axis, which a linear readout of the condition states; the diffusion then
draws points about that place, in level axes, in units of the half-wheelbase:

    p' = Z(a)^T R(n)^T (B^T p - m) s/h,

B the rotation about z that turns e_x into the horizontal direction in which the base station sees the region, m the
mean of the points B^T p, n the normal of their flattest plane, R(n) the smallest rotation of e_z to n, Z(a) the
rotation by the :func:`heading` a about z, s the region's scale and h the half-wheelbase. An echo tells headings
relative to the line of sight, and a craft seen from its side looks the same wherever it flies: with B this need not be
learned. Material numbers stay as they are. The frame ``region`` is the paper's: p' = p.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

_PAIRS = np.triu_indices(3)
HARMONICS = 8
"""Orders n of the harmonics c_1..c_n that :func:`moments` takes."""
READINGS = 14 + 2 * HARMONICS
"""Length of :func:`moments`."""


def moments(cloud: jax.Array) -> jax.Array:
    """What the readout is trained to (..., 30), of clouds (..., M, 5) in their own units.

    The mean of the five numbers; ten times the covariances xx, xy, xz, yy, yz, zz of the three coordinates, a factor
    that brings them to the size of the means; the upward unit normal of the plane in which the cloud is flattest; and
    the harmonics of heading, real and imaginary parts of c_n = <r^2 e^{jn phi}>/(2 <r^2>) for n = 1..8, with r and phi
    the polar coordinates of the points in the craft's level axes: a craft of n arms has a large c_n, whose phase is n
    times its heading.
    """
    mean = jnp.mean(cloud, axis=-2)
    centred = cloud[..., :3] - mean[..., None, :3]
    covariance = jnp.einsum("...ma,...mb->...ab", centred, centred) / cloud.shape[-2]
    _, axes = jnp.linalg.eigh(covariance)
    normal = axes[..., 0] * jnp.where(axes[..., 2:, 0] < 0.0, -1.0, 1.0)
    reading = jnp.concatenate([mean, 10.0 * covariance[..., *_PAIRS], normal], axis=-1)
    level = jnp.einsum("...ma,...ab->...mb", centred, pose(reading)[1][..., :2])
    squared = jnp.sum(level**2, axis=-1)
    turn = jax.lax.complex(level[..., 0], level[..., 1]) / jnp.sqrt(jnp.maximum(squared, 1e-12))
    spread = jnp.maximum(jnp.sum(squared, axis=-1), 1e-12)
    powers, harmonics = turn, []
    for _ in range(HARMONICS):
        harmonics.append(0.5 * jnp.sum(squared * powers, axis=-1) / spread)
        powers = powers * turn
    stacked = jnp.stack(harmonics, axis=-1)
    return jnp.concatenate([reading, stacked.real, stacked.imag], axis=-1)


def pose(reading: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Place m (..., 3) and rotation R(n) (..., 3, 3) that a reading (..., 30) as of :func:`moments` states."""
    normal = reading[..., 11:14]
    # A mean over opposite tilts is short; a normal that points down is no flight attitude.
    normal = normal.at[..., 2].set(jnp.maximum(normal[..., 2], 1e-3))
    x, y, z = jnp.moveaxis(normal / jnp.linalg.norm(normal, axis=-1, keepdims=True), -1, 0)
    rows = (
        (1.0 - x * x / (1.0 + z), -x * y / (1.0 + z), x),
        (-x * y / (1.0 + z), 1.0 - y * y / (1.0 + z), y),
        (-x, -y, z),
    )
    return reading[..., :3], jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def facing(cloud: jax.Array, place: jax.Array) -> jax.Array:
    """Clouds (..., M, 3 or 5) turned by B^T: x away from the array's axis x = y = 0 at the place (..., 3) [m]."""
    return _about_vertical(cloud, place, -1.0)


def facing_back(cloud: jax.Array, place: jax.Array) -> jax.Array:
    """Inverse of :func:`facing`."""
    return _about_vertical(cloud, place, 1.0)


def _about_vertical(cloud, place, sense):
    distance = jnp.maximum(jnp.linalg.norm(place[..., :2], axis=-1), 1e-6)
    cosine, sine = place[..., 0, None] / distance[..., None], sense * place[..., 1, None] / distance[..., None]
    x, y = cloud[..., 0], cloud[..., 1]
    turned = jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
    return jnp.concatenate([turned, cloud[..., 2:]], axis=-1)


def heading(harmonics: jax.Array) -> jax.Array:
    """The angle a (...,) [rad] that the strongest of c_1..c_8 states: arg(c_n)/n of (..., 16), as in :func:`moments`.

    A craft of n equal arms has one at a, and looks the same from each of the n headings among which a is chosen.
    """
    values = _complex(harmonics)
    order = jnp.argmax(jnp.abs(values), axis=-1)
    return jnp.angle(jnp.take_along_axis(values, order[..., None], axis=-1)[..., 0]) / (order + 1.0)


def straightened(harmonics: jax.Array) -> jax.Array:
    """Harmonics (..., 16) of the cloud after it is turned back by its :func:`heading`."""
    turn = jnp.exp(-1j * heading(harmonics)[..., None] * jnp.arange(1, HARMONICS + 1))
    values = _complex(harmonics) * turn
    return jnp.concatenate([values.real, values.imag], axis=-1)


def _complex(harmonics):
    return jax.lax.complex(harmonics[..., :HARMONICS], harmonics[..., HARMONICS:])


def _axes(reading):
    """Place m and axes R(n) Z(a) of a reading."""
    place, rotation = pose(reading)
    angle = heading(reading[..., -2 * HARMONICS :])
    cosine, sine = jnp.cos(angle)[..., None], jnp.sin(angle)[..., None]
    x, y = rotation[..., 0], rotation[..., 1]
    return place, jnp.stack([cosine * x + sine * y, cosine * y - sine * x, rotation[..., 2]], axis=-1)


def into_craft(cloud: jax.Array, reading: jax.Array, scale: float) -> jax.Array:
    """Clouds (..., M, 5), turned by :func:`facing`, in the craft's frame; ``scale`` is s/h."""
    place, rotation = _axes(reading)
    points = scale * jnp.einsum("...ma,...ab->...mb", cloud[..., :3] - place[..., None, :], rotation)
    return jnp.concatenate([points, cloud[..., 3:]], axis=-1)


def out_of_craft(cloud: jax.Array, reading: jax.Array, scale: float) -> jax.Array:
    """Inverse of :func:`into_craft`."""
    place, rotation = _axes(reading)
    points = jnp.einsum("...mb,...ab->...ma", cloud[..., :3] / scale, rotation) + place[..., None, :]
    return jnp.concatenate([points, cloud[..., 3:]], axis=-1)
