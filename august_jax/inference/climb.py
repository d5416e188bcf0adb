"""Candidates that climb an echo's likelihood times a prediction of the state, by Levenberg-Marquardt.

As :mod:`august_jax.inference.refine`, but that the prior is a Gaussian over the seen numbers of a state
(:mod:`august_jax.inference.motion`): place, thrust axis, heading, material and level of the gain depend on one another.
In what follows n candidates each climb under one of P predictions.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from august_jax.arrays import Array
from august_jax.inference.motion import HEADING, SEEN
from august_jax.inference.refine import EASIER, FIRST, SCALES, Candidates, judged, shortened, solved, taken
from august_jax.physics.parameters import rotation_from_vector


class Expectation(NamedTuple):
    """Gaussians over the seen numbers: means (P, 9), inverse covariances (P, 9, 9)."""

    middle: Float[Array, "parents 9"]
    precision: Float[Array, "parents 9 9"]


@partial(jax.jit, static_argnames="subspace")
def begun_at(
    table, subspace, statistics, craft, rotation, position, permittivity, conductivity, log_gain
) -> Candidates:
    """Candidates of given poses, materials and levels of the gain, with the phase that suits them."""

    def one(each):
        return judged(table, subspace, statistics, (*each, None), jnp.float32(FIRST))

    return jax.lax.map(one, (craft, rotation, position, permittivity, conductivity, log_gain), batch_size=64)


@partial(jax.jit, static_argnames="subspace")
def climbed(table, subspace, statistics, expected, ranges, candidates, which, temperature, steps):
    """Candidates after ``steps`` steps each on tables, and ``which`` as it was.

    Args:
        table, subspace, statistics: of the library, the station, the slot.
        expected: P predictions.
        ranges: of permittivity and conductivity (2, 2).
        candidates: n of them.
        which: the prediction of each (n,).
        temperature: by which the noise is taken for greater than it is.
        steps: how many.
    """

    def one(each):
        now, number = each
        own = Expectation(expected.middle[number], expected.precision[number])

        def step(_, state):
            return _step(table, subspace, statistics, own, ranges, state, temperature)

        return jax.lax.fori_loop(0, steps, step, now), number

    return jax.lax.map(one, (candidates, which), batch_size=64)


@partial(jax.jit, static_argnames="subspace")
def polished_about(body, table, subspace, statistics, expected, ranges, candidates, which, steps) -> Candidates:
    """As :func:`climbed`, candidates of one craft, on its factored body; slopes are the table's."""

    def one(each):
        now, number = each
        own = Expectation(expected.middle[number], expected.precision[number])
        pose = (now.craft, now.rotation, now.position, now.permittivity, now.conductivity, now.log_gain, None)
        now = judged(table, subspace, statistics, pose, jnp.float32(FIRST), body)

        def step(_, state):
            return _step(table, subspace, statistics, own, ranges, state, 1.0, body)

        return jax.lax.fori_loop(0, steps, step, now)

    return jax.lax.map(one, (candidates, which))


def worth_about(candidates, expected, which, temperature):
    """What is minimised of candidates, each under its prediction (n,), float64."""
    rotation = np.asarray(candidates.rotation, np.float64)
    heading = np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])
    rest = np.stack([heading, candidates.permittivity, candidates.conductivity, candidates.log_gain], axis=1)
    apart = np.concatenate([candidates.position, rotation[:, :2, 2], rest], axis=1)
    apart = apart - np.asarray(expected.middle, np.float64)[which]
    apart[:, HEADING] = (apart[:, HEADING] + np.pi) % (2.0 * np.pi) - np.pi
    precision = np.asarray(expected.precision, np.float64)[which]
    square = np.einsum("ni,nij,nj->n", apart, precision, apart)
    return np.asarray(candidates.residual, np.float64) / float(temperature) + 0.5 * square


def _apart(now, middle):
    """How far the seen numbers are from a prediction (9,)."""
    heading = jnp.arctan2(now.rotation[1, 0], now.rotation[0, 0]) - middle[HEADING]
    heading = heading - 2.0 * jnp.pi * jnp.round(heading / (2.0 * jnp.pi))
    rest = jnp.stack([now.permittivity, now.conductivity, now.log_gain]) - middle[6:]
    return jnp.concatenate([now.position - middle[:3], now.rotation[:2, 2] - middle[3:5], heading[None], rest])


def _step(table, subspace, statistics, expected, ranges, now, temperature, body=None):
    """One step of Levenberg-Marquardt towards the most probable, given a prediction."""
    scales = jnp.asarray(SCALES)

    def cost(each):
        apart = _apart(each, expected.middle)
        return each.residual / temperature + 0.5 * apart @ expected.precision @ apart

    change = jnp.eye(SEEN, 10).at[3:6, 3:6].set(turning(now.rotation))
    pull = change.T @ expected.precision
    slope = now.slope / temperature - pull @ _apart(now, expected.middle)
    system = (now.information / temperature + pull @ change) * scales * scales[:, None]
    system = system + now.damping * jnp.diag(jnp.diagonal(system))
    step = shortened(scales * solved(system, scales * slope))
    tried = judged(
        table,
        subspace,
        statistics,
        (
            now.craft,
            rotation_from_vector(step[3:6]) @ now.rotation,
            now.position + jnp.clip(step[:3], -0.3, 0.3),
            jnp.clip(now.permittivity + step[6], ranges[0, 0], ranges[0, 1]),
            jnp.clip(now.conductivity + step[7], ranges[1, 0], ranges[1, 1]),
            now.log_gain + step[8],
            now.phase + step[9],
        ),
        now.damping * EASIER,
        body,
    )
    return taken(tried, now, cost(tried) <= cost(now))


def turning(rotation):
    """How axis and heading change in a turn about the world's axes (3, 3)."""
    axis, nose = rotation[:, 2], rotation[:, 0]
    zero, flat = jnp.zeros_like(axis[0]), nose[0] ** 2 + nose[1] ** 2
    return jnp.stack(
        [
            jnp.stack([zero, axis[2], -axis[1]]),
            jnp.stack([-axis[2], zero, axis[0]]),
            jnp.stack([-nose[0] * nose[2] / flat, -nose[1] * nose[2] / flat, jnp.ones_like(flat)]),
        ]
    )
