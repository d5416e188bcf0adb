"""From candidates to explanations: Levenberg-Marquardt in pose, material and gain, many at a time, fewer and fewer.

theta are the ten numbers of :mod:`august_jax.physics.parameters`. With Z = A C + N of unit noise and a Gaussian prior
of standard deviations s about theta_0,

    minimise  ||Z - e^{log-gain + j phase} A(theta) C||^2 / tau + sum ((theta - theta_0) / s)^2 / 2,

whose first term is minus the log likelihood; tau is a temperature, by which the noise is taken for greater than it is.
Every step asks for A and its derivatives about the craft's own place (:mod:`august_jax.physics.body.local`), which is
taken where it is no worse than what it came from; else the next is shorter.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from august_jax import streams
from august_jax.arrays import Array
from august_jax.inference.prior import Prior
from august_jax.physics.body import Body
from august_jax.physics.body.local import local_coefficients
from august_jax.physics.body.table import Table
from august_jax.physics.parameters import Parameters, parameter_channel, rotation_from_vector
from august_jax.signal.roi import Subspace, change_of_centre, project
from august_jax.signal.station import Statistics

SCALES = np.array([0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0.5, 2e-3, 0.1, 0.3], np.float32)
"""Of theta, so that the normal equations are of one size."""
FIRST, EASIER, _HARDER = 1e-2, 0.2, 8.0
_BEYOND_M = 0.2
_TOGETHER = 64
_PIECE = 128


class Candidates(NamedTuple):
    """n explanations; a pytree.

    Attributes:
        craft: which of the library's (n,).
        rotation: body to world (n, 3, 3).
        position: (n, 3) [m].
        permittivity, conductivity: (n,), [1] and [S/m].
        log_gain, phase: of the complex gain about the place (n,), [1] and [rad].
        residual: ||Z - model||^2 (n,).
        information: Hessian of the residual in theta (n, 10, 10), Gauss-Newton's.
        slope: minus the residual's gradient in theta (n, 10).
        damping: of the next step (n,).
    """

    craft: Int[Array, " n"]
    rotation: Float[Array, "n 3 3"]
    position: Float[Array, "n 3"]
    permittivity: Float[Array, " n"]
    conductivity: Float[Array, " n"]
    log_gain: Float[Array, " n"]
    phase: Float[Array, " n"]
    residual: Float[Array, " n"]
    information: Float[Array, "n 10 10"]
    slope: Float[Array, "n 10"]
    damping: Float[Array, " n"]

    def at(self, rows: Int[Array, " m"]) -> Candidates:
        """Those at ``rows``."""
        return jax.tree.map(lambda leaf: leaf[rows], self)


def begin(
    table: Table,
    subspace: Subspace,
    statistics: Statistics,
    craft: Int[Array, " n"],
    rotation: Float[Array, "n 3 3"],
    position: Float[Array, "n 3"],
    permittivity: Float[Array, " n"],
    conductivity: Float[Array, " n"],
) -> Candidates:
    """Candidates of given poses and materials, with the phase of the gain that suits them and its level as known."""
    reals = [np.asarray(part, np.float32) for part in (rotation, position, permittivity, conductivity)]
    return in_pieces(lambda piece: _begun(table, subspace, statistics, *piece), (np.asarray(craft, np.int32), *reals))


def improved(
    table: Table,
    subspace: Subspace,
    statistics: Statistics,
    prior: Prior,
    candidates: Candidates,
    temperature: float | Float[Array, ""] = 1.0,
    *,
    steps: int = 1,
) -> Candidates:
    """Candidates after ``steps`` steps each."""
    return in_pieces(lambda piece: _improved(table, subspace, statistics, prior, piece, temperature, steps), candidates)


def in_pieces(function: Callable[[Any], Any], tree: Any) -> Any:
    """``function`` of a tree of arrays with a common first axis, so many rows at a time: one shape to compile for."""
    tree = jax.tree.map(np.asarray, tree)
    count = len(jax.tree.leaves(tree)[0])
    rows = np.resize(np.arange(count), (max(-(-count // _PIECE), 1), _PIECE))
    found = two_at_once(lambda each: function(jax.tree.map(lambda leaf: leaf[each], tree)), rows)
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *found)


def two_at_once(function: Callable[[Any], Any], pieces: Iterable[Any]) -> list[Any]:
    """``function`` of every piece, as NumPy arrays: two at once, because small products keep one core busy. What JAX is
    set to is a thread's own, so that each of the two is pinned as the search is."""

    @streams.pin
    def fetched(piece: Any) -> Any:
        return jax.tree.map(np.asarray, function(piece))

    with ThreadPoolExecutor(2) as pool:
        return list(pool.map(fetched, pieces))


@partial(jax.jit, static_argnames="subspace")
def _improved(table, subspace, statistics, prior, candidates, temperature, steps):
    def one(each):
        return jax.lax.fori_loop(
            0, steps, lambda _, now: _step(table, subspace, statistics, prior, now, temperature), each
        )

    return jax.lax.map(one, candidates, batch_size=_TOGETHER)


@partial(jax.jit, static_argnames="subspace")
def polished(
    body: Body,
    table: Table,
    subspace: Subspace,
    statistics: Statistics,
    prior: Prior,
    candidates: Candidates,
    *,
    steps: int | Int[Array, ""] = 6,
) -> Candidates:
    """Candidates of one craft after ``steps`` steps each on its factored body; slopes are the table's."""

    def one(each):
        pose = (each.craft, each.rotation, each.position, each.permittivity, each.conductivity, each.log_gain, None)
        each = judged(table, subspace, statistics, pose, jnp.float32(FIRST), body)
        return jax.lax.fori_loop(
            0, steps, lambda _, now: _step(table, subspace, statistics, prior, now, 1.0, body), each
        )

    return jax.lax.map(one, candidates)


@partial(jax.jit, static_argnames="subspace")
def _begun(table, subspace, statistics, craft, rotation, position, permittivity, conductivity):
    def one(each):
        craft, rotation, position, permittivity, conductivity = each
        zero = jnp.float32(0.0)
        return judged(
            table,
            subspace,
            statistics,
            (craft, rotation, position, permittivity, conductivity, zero, None),
            jnp.float32(FIRST),
        )

    return jax.lax.map(one, (craft, rotation, position, permittivity, conductivity), batch_size=_TOGETHER)


def _exact(body, subspace, rotation, position, permittivity, conductivity):
    """The factored body's channel (F, N_b, N_b), the phase e^{2jk'|q|} of the mean wavenumber and the place taken out
    as a table's is."""
    wave = jnp.exp(-2j * np.mean(subspace.wavenumbers) * jnp.linalg.norm(position))
    channel = parameter_channel(body, subspace.array, Parameters(), rotation, position, permittivity, conductivity)
    return channel * wave


def judged(table, subspace, statistics, pose, damping, body=None):
    """A candidate with its residual, slope and information; a phase of None takes the best.

    With a body the coefficients are its own, and the table's serve for the derivatives alone.
    """
    craft, rotation, position, permittivity, conductivity, log_gain, phase = pose
    found = local_coefficients(
        table, subspace.array, subspace.basis, craft, rotation, position, permittivity, conductivity
    )
    change = change_of_centre(statistics.centre, position, subspace)
    pilots = jnp.swapaxes(change, -1, -2) @ statistics.pilots
    if body is None:
        heard = change @ (found.values @ pilots)
    else:
        exact = _exact(body, subspace, rotation, position, permittivity, conductivity)
        heard = project(exact, statistics.centre, subspace).values @ statistics.pilots
    overlap = jnp.sum(heard.conj() * statistics.received)
    phase = jnp.angle(overlap) if phase is None else phase
    gain = jnp.exp(log_gain) * jax.lax.complex(jnp.cos(phase), jnp.sin(phase))
    model = gain * heard
    slopes = gain * (change @ (found.derivatives @ pilots))
    slopes = jnp.concatenate([slopes, model[None], 1j * model[None]]).reshape(10, -1)
    left = (statistics.received - model).reshape(-1)
    both = jnp.concatenate([slopes.real, slopes.imag], axis=1)
    against = jnp.concatenate([left.real, left.imag])
    return Candidates(
        craft, rotation, position, permittivity, conductivity, log_gain, phase,
        jnp.sum(jnp.abs(left) ** 2), 2.0 * both @ both.T, 2.0 * both @ against, damping,
    )  # fmt: skip


def departure(candidates: Candidates, statistics: Statistics, prior: Prior) -> Float[jax.Array, "*n 10"]:
    """theta - theta_0 (..., 10), how far candidates are from the prior's middle; turns and phases count as none."""
    middle, loss = prior.middle()
    zero = jnp.zeros_like(candidates.log_gain)
    rest = (candidates.permittivity - middle, candidates.conductivity - loss, candidates.log_gain, zero)
    offset = jnp.asarray(candidates.position) - statistics.centre
    return jnp.concatenate([offset, jnp.zeros_like(offset), jnp.stack(rest, axis=-1)], axis=-1)


def cost(
    candidates: Candidates, statistics: Statistics, prior: Prior, temperature: float | Float[Array, ""] = 1.0
) -> Float[jax.Array, "*n"]:
    """What is minimised (...,)."""
    apart = departure(candidates, statistics, prior) / prior.spreads()
    return jnp.asarray(candidates.residual) / temperature + 0.5 * jnp.sum(apart**2, axis=-1)


def scored(
    candidates: Candidates, statistics: Statistics, prior: Prior, temperature: float = 1.0
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """:func:`cost` of any number of candidates (n,) and the prior's log density of their tilts (n,), which steps do not
    know; float64. Compiled once: arrays as long as there happen to be candidates would be compiled for each length."""
    found = in_pieces(lambda piece: _scored(piece, statistics, prior, temperature), candidates)
    return found[0].astype(np.float64), found[1].astype(np.float64)


@jax.jit
def _scored(candidates, statistics, prior, temperature):
    return cost(candidates, statistics, prior, temperature), prior.log_tilt(candidates.rotation)


def _step(table, subspace, statistics, prior, now, temperature, body=None):
    scales = jnp.asarray(SCALES)
    precision = 1.0 / prior.spreads() ** 2
    slope = now.slope / temperature - precision * departure(now, statistics, prior)
    system = (now.information / temperature + jnp.diag(precision)) * scales * scales[:, None]
    system = system + now.damping * jnp.diag(jnp.diagonal(system))
    wanted = scales * solved(system, scales * slope)
    # What would leave its range goes to the end of it, and the rest is solved for again: a step cut short in one number
    # alone is no descent, and a candidate at the end of a range would never move again.
    ranges = jnp.stack([prior.permittivity, prior.conductivity])
    room = ranges - jnp.stack([now.permittivity, now.conductivity])[:, None]
    held = jnp.clip(wanted[6:8], room[:, 0], room[:, 1])
    fixed = jnp.zeros(10, bool).at[6:8].set(held != wanted[6:8])
    given = jnp.where(fixed, jnp.zeros(10).at[6:8].set(held) / scales, 0.0)
    reduced = jnp.where(fixed | fixed[:, None], jnp.eye(10), system)
    step = scales * solved(reduced, jnp.where(fixed, given, scales * slope - system @ given))
    step = shortened(step)
    reach = prior.half_m + _BEYOND_M
    tried = judged(
        table,
        subspace,
        statistics,
        (
            now.craft,
            rotation_from_vector(step[3:6]) @ now.rotation,
            statistics.centre + jnp.clip(now.position + step[:3] - statistics.centre, -reach, reach),
            jnp.clip(now.permittivity + step[6], prior.permittivity[0], prior.permittivity[1]),
            jnp.clip(now.conductivity + step[7], prior.conductivity[0], prior.conductivity[1]),
            now.log_gain + step[8],
            now.phase + step[9],
        ),
        now.damping * EASIER,
        body,
    )
    better = cost(tried, statistics, prior, temperature) <= cost(now, statistics, prior, temperature)
    return taken(tried, now, better)


def shortened(step):
    """A step (10,) that turns by 0.2 rad at most: the model is linear for 10 degrees."""
    length = jnp.sqrt(jnp.sum(step[3:6] ** 2))
    return step * jnp.minimum(1.0, 0.2 / jnp.maximum(length, 1e-9))


def taken(tried, now, better):
    """What was tried where it is better, else the candidate as it was, whose next step is shorter."""
    kept = now._replace(damping=now.damping * _HARDER)
    return jax.tree.map(lambda new, old: jnp.where(better, new, old), tried, kept)


def solved(system, right):
    """A small symmetric positive system, by Cholesky's factors written out: a batch of them is plain arithmetic."""
    size = right.shape[0]
    rows: list[list[Any]] = [[None] * size for _ in range(size)]
    for i in range(size):
        for j in range(i + 1):
            total = system[i, j]
            for k in range(j):
                total = total - rows[i][k] * rows[j][k]
            rows[i][j] = jnp.sqrt(jnp.maximum(total, 1e-12)) if i == j else total / rows[j][j]
    forward: list[Any] = []
    for i in range(size):
        forward.append((right[i] - sum((rows[i][k] * forward[k] for k in range(i)), 0.0)) / rows[i][i])
    back: list[Any] = [None] * size
    for i in reversed(range(size)):
        back[i] = (forward[i] - sum((rows[k][i] * back[k] for k in range(i + 1, size)), 0.0)) / rows[i][i]
    return jnp.stack(back)


@partial(jax.jit, static_argnames="subspace")
def corrections(
    body: Body, table: Table, subspace: Subspace, candidate: Candidates
) -> Complex[jax.Array, "tones orders orders"]:
    """What a table leaves out of one candidate's coefficients about its own place (F, K, K): the body's less its."""
    pose = (candidate.rotation, candidate.position, candidate.permittivity, candidate.conductivity)
    own = local_coefficients(table, subspace.array, subspace.basis, candidate.craft, *pose, derivatives=False)
    exact = project(_exact(body, subspace, *pose), candidate.position, subspace).values
    return jnp.asarray(exact) - own.values
