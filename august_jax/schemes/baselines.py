"""Answers that need neither echo nor training: what no information gives, and the floor that sampling sets.

- ``prediction``: answers the predicted position q_pre; it defines MPE alone.
- ``up``: answers a level craft; it defines MDE alone.
- ``mean_shape``: answers :func:`mean_shape` at q_pre; it defines WD and MCD.
- ``resampling``: the true surface, sampled anew: the floor that the clouds' finite number of points sets.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Float

from august_jax.scene.airframes import Airframe
from august_jax.scene.cloud import WorldCloud
from august_jax.scene.pose import rotation_from_euler
from august_jax.schemes.answer import Answer, Ask, Scheme, Setting, Slots
from august_jax.tracking.attitude import cloud_normals


def mean_shape(key: jax.Array, airframes: Sequence[Airframe], count: int) -> Float[jax.Array, "{count} 3"]:
    """The average craft (count, 3) [m] about its centroid: surface points of all airframes in equal shares, level, each
    point turned to a heading of its own, uniform over the circle."""
    share = -(-count // len(airframes))
    points = []
    for index, airframe in enumerate(airframes):
        surface_key, yaw_key = jax.random.split(jax.random.fold_in(key, index))
        yaw = jax.random.uniform(yaw_key, (share,), maxval=2.0 * jnp.pi)
        turn = rotation_from_euler(jnp.zeros(share), jnp.zeros(share), yaw)
        points.append(jnp.einsum("nab,nb->na", turn, airframe.sample_surface(surface_key, share)))
    # interleaved, so that what is cut off at the end is shared out too
    return jnp.stack(points, axis=1).reshape(-1, 3)[:count]


def _of_points(points: jax.Array) -> WorldCloud:
    """A cloud whose materials nobody states."""
    unknown = jnp.full(points.shape[:-1], jnp.nan)
    return WorldCloud(points, unknown, unknown)


def _prediction(setting: Setting) -> Ask:
    return lambda key, slots: Answer(position=jnp.asarray(slots.predicted))


def _up(setting: Setting) -> Ask:
    def ask(key: jax.Array, slots: Slots) -> Answer:
        up = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), (slots.slots, 3))
        return Answer(normal=up, triple_normal=up)

    return ask


def _mean_shape(setting: Setting) -> Ask | None:
    if setting.airframes is None:
        return None
    mean = mean_shape(setting.key, setting.airframes, setting.config.target.points)

    def ask(key: jax.Array, slots: Slots) -> Answer:
        predicted = jnp.asarray(slots.predicted)
        return Answer(cloud=_of_points(predicted[:, None] + mean), centre=predicted)

    return ask


def _resampling(setting: Setting) -> Ask:
    def ask(key: jax.Array, slots: Slots) -> Answer:
        if slots.truth is None:
            raise ValueError("truth: got None; the scheme 'resampling' answers from the truth")
        points = jnp.asarray(slots.truth.resampled)
        normal, triple = cloud_normals(key, points)
        return Answer(jnp.mean(points, axis=1), normal, triple, _of_points(points))

    return ask


PREDICTION = Scheme("prediction", "answering the predicted position", _prediction, hears=False)
UP = Scheme("up", "answering a level drone", _up, hears=False, follows=False)
MEAN_SHAPE = Scheme("mean_shape", "the average drone at the prediction", _mean_shape, hears=False, follows=False)
RESAMPLING = Scheme("resampling", "the true surface sampled anew: the floor", _resampling, hears=False, follows=False)
