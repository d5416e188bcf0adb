"""One echo, one posterior: screen, refine, polish, weigh."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from august_jax import streams
from august_jax.arrays import Array
from august_jax.data.simulator import FAINTEST, contrast_of
from august_jax.inference.echo import bearing, chance, degrees_left, echo_energy, echo_snr_db
from august_jax.inference.hypotheses import (
    Hypotheses,
    Posterior,
    covariances,
    distinct,
    evenly_drawn,
    evidence,
    nearest,
    shared_out,
)
from august_jax.inference.library import Library
from august_jax.inference.population import Mixture, Poses, mixture, populate
from august_jax.inference.prior import Prior
from august_jax.inference.refine import Candidates, begin, corrections, cost, improved, polished, scored
from august_jax.inference.screen import screen
from august_jax.physics.parameters import rotation_from_vector
from august_jax.signal.station import Statistics

LEVEL = 0.01
"""Where noise alone leaves as much as the best hypothesis less often than this, the echo counts as unexplained."""


class _Stage(NamedTuple):
    """Candidates that survive, steps taken, and the SNR [dB] of which the noise is at least taken to be."""

    kept: int
    steps: int
    snr_db: float


class _Plan(NamedTuple):
    """How many of the first look's candidates are kept, and what is done with them."""

    looked: int
    stages: tuple[_Stage, ...]


_QUICK = _Plan(
    16_000,
    (
        _Stage(8000, 1, 18.0),
        _Stage(4000, 1, 18.0),
        _Stage(1500, 1, 20.0),
        _Stage(500, 2, 24.0),
        _Stage(192, 4, 34.0),
        _Stage(128, 6, 60.0),
    ),
)
# Of one slot in forty the first steps, too long ones, are all refused, and the truth is left behind. In a few the
# pattern is so sharp that no attitude of the lattice leads to the truth: others are looked at.
_PATIENT = _Plan(
    32_000,
    (
        _Stage(16_000, 3, 18.0),
        _Stage(8000, 2, 18.0),
        _Stage(3000, 2, 20.0),
        _Stage(1000, 3, 24.0),
        _Stage(256, 4, 34.0),
        _Stage(128, 6, 60.0),
    ),
)
# A weak echo has wide valleys and many of them: fewer candidates meet them all, and each is to be walked further down.
_WEAK = _Plan(
    12_000,
    (_Stage(4000, 2, 18.0), _Stage(2000, 2, 20.0), _Stage(800, 3, 24.0), _Stage(256, 4, 34.0), _Stage(128, 6, 60.0)),
)
_WEAK_SNR_DB = 6.0
_DOUBTED = 0.05
"""Where noise alone leaves as much less often than this, the search is made again with more patience."""
_MODES = 12
_SHAKEN = 16
_SHAKEN_SNR_DB = 14.0
_MOST = 32
_SEEN = 2000
_DRAWN = 320
_TEMPER, _FLATTER = 0.4, 0.3
_MATTERS = 0.3


@streams.pin
def find_craft(
    library: Library, statistics: Statistics, prior: Prior, *, key: jax.Array, level: float = LEVEL
) -> Posterior:
    """Search the known craft, attitudes, places and materials for what explains one echo.

    Args:
        library: the known craft.
        statistics: of one slot, with the tones of the library.
        prior: what is known before the echo.
        key: of the posterior's samples.
        level: below which the best residual's probability under noise counts as unexplained.

    Raises:
        ValueError: an echo that is not finite, or of other tones or another array than the library's; a prior that
            leaves nothing to look at, or materials or places that the library's tables do not hold.
    """
    _check(library, statistics, prior)
    seconds: dict[str, float] = {}
    clock = _Clock(seconds)
    table, subspace = library.table, library.subspace
    statistics = jax.tree.map(jnp.asarray, statistics)
    snr_db = echo_snr_db(statistics, subspace)
    exact = _beyond_the_table(library, statistics)
    met: list[Candidates] = []
    modes: Candidates | None = None
    for plan in (_WEAK if snr_db < _WEAK_SNR_DB else _QUICK, _PATIENT):
        attitudes = library.others if plan is _PATIENT else library.attitudes
        found = _looked(library, statistics, prior, snr_db, plan, attitudes, met, clock)
        met.append(_shaken(library, statistics, prior, found, snr_db))
        clock("refine")
        modes = _modes(library, statistics, prior, met[-1] if modes is None else _joined([met[-1], modes]), exact)
        clock("polish")
        if chance(_least(modes, statistics, prior), degrees_left(statistics)) > _DOUBTED:
            break
    assert modes is not None
    first, corrections = _first(library, statistics, prior, modes, _joined(met), exact)
    poses, log_weight = populate(key, table, subspace, statistics, prior, first, corrections)
    clock("sample")
    return _posterior(library, statistics, prior, modes, poses, log_weight, level, seconds)


def _looked(library, statistics, prior, snr_db, plan: _Plan, attitudes, met: list, clock) -> Candidates:
    """What is left of a first look at attitudes of all craft; ``met`` gets candidates of its stages."""
    table, subspace = library.table, library.subspace
    place = bearing(statistics, subspace, library.config.region.scale_m)
    reach_m = float(np.sqrt(3.0) * prior.half_m)  # of the prediction's range, which bearings leave alone
    seen = screen(library.shared_survey, subspace, statistics, place, attitudes, plan.looked, reach_m)
    low, high = np.asarray(prior.permittivity)
    permittivity = np.clip(1.0 + library.survey_contrast * np.abs(seen.gain), low, high)
    loss = np.full(len(permittivity), float(prior.middle()[1]), np.float32)
    clock("screen")
    found = begin(table, subspace, statistics, seen.craft, seen.rotation, seen.position, permittivity, loss)
    for stage in plan.stages:
        heat = max(1.0, 10.0 ** ((snr_db - stage.snr_db) / 10.0))
        found = improved(table, subspace, statistics, prior, found, heat, steps=stage.steps)
        found = _best(found, statistics, prior, heat, stage.kept)
        met.append(_best(found, statistics, prior, 1.0, min(stage.kept, _SEEN)))
    return found


@streams.pin
def refined(
    library: Library,
    statistics: Statistics,
    prior: Prior,
    craft: int,
    rotation: Float[Array, "3 3"],
    position: Float[Array, "3"],
    permittivity: float,
    conductivity: float,
    *,
    steps: int = 12,
) -> tuple[Candidates, float]:
    """What one start leads to, on the factored body, and what it costs: a search is no worse than from the truth."""
    start = begin(
        library.table,
        library.subspace,
        statistics,
        np.asarray([craft]),
        np.asarray(rotation)[None],
        np.asarray(position)[None],
        np.asarray([permittivity]),
        np.asarray([conductivity]),
    )
    found = polished(library.body(craft), library.table, library.subspace, statistics, prior, start, steps=steps)
    return found, float(cost(found, statistics, prior)[0])


class _Clock:
    def __init__(self, seconds: dict[str, float]):
        self._seconds, self._began = seconds, time.perf_counter()

    def __call__(self, stage: str) -> None:
        now = time.perf_counter()
        self._seconds[stage] = self._seconds.get(stage, 0.0) + now - self._began
        self._began = now


def _check(library: Library, statistics: Statistics, prior: Prior) -> None:
    tones, orders = len(library.table.frequencies_hz), library.subspace.orders
    for name, value, wanted in (
        ("received", statistics.received, (tones, orders, orders)),
        ("pilots", statistics.pilots, (tones, orders, orders)),
        ("centre", statistics.centre, (3,)),
    ):
        if np.shape(value) != wanted:
            raise ValueError(
                f"statistics: {name} has shape {np.shape(value)}; the library's {tones} tone(s) and {orders} functions "
                f"want {wanted}; give one slot, of the library's tones and array"
            )
        if not np.all(np.isfinite(np.asarray(value))):
            raise ValueError(f"statistics: {name} holds numbers that are not finite; leave that slot out")
    prior.check()
    _check_held(library, statistics, prior)


def _check_held(library: Library, statistics: Statistics, prior: Prior) -> None:
    """Beyond a table polynomials grow without bound, and a compiled search cannot tell."""
    table, slack = library.table, 1e-3
    low, high = (float(end) - 1.0 for end in prior.permittivity)
    low = max(low, FAINTEST * high)  # tables begin there: nearer to air they interpolate to nothing
    if low < table.contrast[0] - slack or high > table.contrast[1] + slack:
        raise ValueError(
            f"prior: permittivity from {float(prior.permittivity[0]):g} to {1.0 + high:g} is beyond the library's "
            f"tables, which hold {1.0 + table.contrast[0]:.3g} to {1.0 + table.contrast[1]:.3g}; make the library with "
            "that range (target.permittivity)"
        )
    loss = float(np.imag(contrast_of(library.config, 1.0, float(prior.conductivity[1]))).max())
    if loss > table.loss + slack:
        raise ValueError(
            f"prior: conductivity up to {float(prior.conductivity[1]):g} S/m is beyond the library's tables, which "
            f"hold imaginary contrasts up to {table.loss:.3g}, here {loss:.3g}; make the library with that range "
            "(target.conductivity_s_m)"
        )
    distance = float(np.linalg.norm(np.asarray(statistics.centre, np.float64)))
    reach, (near, far) = np.sqrt(3.0) * float(prior.half_m), table.distance_m
    if distance + reach < near or distance - reach > far:
        raise ValueError(
            f"statistics: the centre is {distance:.3g} m from the array, and no place within {reach:.2g} m of it is in "
            f"the library's tables, which hold {near:.3g} to {far:.3g} m; make the library for those places "
            "(flight.box_m)"
        )


def _worth(found: Candidates, statistics: Statistics, prior: Prior, heat: float = 1.0) -> np.ndarray:
    """Cost with the prior of the tilt, which steps do not know: what lies far beyond the largest is no explanation."""
    costs, density = scored(found, statistics, prior, heat)
    most = float(np.max(np.log(np.asarray(prior.tilt_density))))
    return costs + np.minimum(most - density, 30.0) / heat


def _best(found: Candidates, statistics: Statistics, prior: Prior, heat: float, kept: int) -> Candidates:
    rows = shared_out(_worth(found, statistics, prior, heat), np.asarray(found.craft), kept)[:kept]
    return found.at(rows)


def _shaken(library, statistics, prior, found, snr_db):
    """The best few again from around where they are: a valley's floor is seldom reached in one run."""
    rows = distinct(found, _worth(found, statistics, prior), prior, _MODES)
    rows = np.resize(rows, _MODES)
    best = found.at(rows)
    heat = max(4.0, 10.0 ** ((snr_db - _SHAKEN_SNR_DB) / 10.0))
    hot = best._replace(information=best.information / heat)
    factors = np.linalg.cholesky(covariances(hot, prior)[:, :6, :6] + 1e-12 * np.eye(6))
    steps = np.einsum("nij,mnj->mni", factors, np.random.default_rng(0).standard_normal((_SHAKEN, _MODES, 6))).astype(
        np.float32
    )
    lengths = np.linalg.norm(steps[..., 3:], axis=-1, keepdims=True)
    steps[..., 3:] *= np.minimum(1.0, 0.07 / np.maximum(lengths, 1e-9))
    steps = steps.reshape(-1, 6)
    again = np.tile(np.arange(_MODES), _SHAKEN)
    turned = np.asarray(jax.vmap(rotation_from_vector)(jnp.asarray(steps[:, 3:]))) @ best.rotation[again]
    moved = begin(
        library.table,
        library.subspace,
        statistics,
        best.craft[again],
        turned,
        best.position[again] + np.clip(steps[:, :3], -0.3, 0.3),
        best.permittivity[again],
        best.conductivity[again],
    )
    moved = improved(library.table, library.subspace, statistics, prior, moved, max(1.0, heat / 30.0), steps=3)
    moved = improved(library.table, library.subspace, statistics, prior, moved, 1.0, steps=8)
    return _joined([found, moved])


def _joined(parts: Sequence[Candidates]) -> Candidates:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


def _beyond_the_table(library: Library, statistics: Statistics) -> bool:
    """Whether the echo is so strong that a table's errors stand out of the noise, and factored bodies are asked."""
    return echo_energy(statistics) * float(np.max(np.asarray(library.table.errors)[..., 0])) ** 2 > _MATTERS


def _modes(library, statistics, prior, found, exact):
    """The explanations that differ, at the floors of their valleys, best first."""
    modes = found.at(distinct(found, _worth(found, statistics, prior), prior, _MOST))
    if exact:
        modes = _joined(
            [
                polished(
                    library.body(int(modes.craft[row])),
                    library.table,
                    library.subspace,
                    statistics,
                    prior,
                    jax.tree.map(lambda leaf, row=row: jnp.asarray(leaf[row : row + 1]), modes),
                    steps=24 if row < 4 else 6,
                )
                for row in range(len(modes.craft))
            ]
        )
    else:
        modes = improved(library.table, library.subspace, statistics, prior, modes, steps=8)
    modes = modes.at(distinct(modes, _worth(modes, statistics, prior), prior, _MOST))
    return modes.at(np.argsort(-evidence(modes, statistics, prior), kind="stable"))


def _first(library, statistics, prior, modes, met, exact) -> tuple[Mixture, np.ndarray]:
    """The mixture that samples begin with, and the corrections about its modes: parts about the modes and, because an
    echo of little power has more explanations than can be told apart, about many of the candidates met on the way."""
    scores = evidence(met, statistics, prior)
    weight = np.exp(_TEMPER * (scores - scores.max()))
    parts = _joined([modes, met.at(np.unique(evenly_drawn(weight, _DRAWN)))])
    scores = evidence(parts, statistics, prior)
    share, tempered = np.exp(scores - scores.max()), np.exp(_FLATTER * (scores - scores.max()))
    share = 0.6 * share / share.sum() + 0.4 * tempered / tempered.sum()
    values = np.zeros((_MOST + 1, *statistics.received.shape), np.complex64)  # the last one is none
    for row in range(len(modes.craft) if exact else 0):
        mode = jax.tree.map(lambda leaf, row=row: jnp.asarray(leaf[row]), modes)
        values[row] = corrections(library.body(int(modes.craft[row])), library.table, library.subspace, mode)
    return mixture(parts, share, nearest(modes, parts.craft, parts.rotation, parts.position), prior), values


def _least(modes: Candidates, statistics: Statistics, prior: Prior) -> float:
    """The best residual; a tilt far beyond the largest explains nothing."""
    allowed = scored(modes, statistics, prior)[1] > -np.inf
    return float(np.min(modes.residual[allowed] if np.any(allowed) else modes.residual))


def _posterior(library, statistics, prior, modes: Candidates, poses: Poses, log_weight, level, seconds):
    if np.all(np.isneginf(log_weight)):  # every sample fell outside of the prior: the modes lie at its edge
        log_weight = np.zeros_like(log_weight)
    log_weight = log_weight - np.logaddexp.reduce(log_weight)
    real = log_weight > -np.inf
    poses, log_weight = jax.tree.map(lambda leaf: leaf[real], poses), log_weight[real]
    own = nearest(modes, poses.craft, poses.rotation, poses.position)
    weight = np.bincount(own[own >= 0], np.exp(log_weight[own >= 0]), len(modes.craft))
    order = np.argsort(-weight, kind="stable")
    modes, weight = modes.at(order), weight[order] / weight.sum()
    residual = _least(modes, statistics, prior)
    return Posterior(
        Hypotheses(
            np.asarray(modes.craft),
            np.asarray(modes.rotation),
            np.asarray(modes.position),
            np.asarray(modes.permittivity),
            np.asarray(modes.conductivity),
            weight,
            np.asarray(modes.residual),
            covariances(modes, prior)[:, :8, :8],
        ),
        np.asarray(poses.craft),
        np.asarray(poses.rotation),
        np.asarray(poses.position),
        np.asarray(poses.permittivity),
        np.asarray(poses.conductivity),
        log_weight,
        len(library.targets),
        float(1.0 / np.sum(np.exp(2.0 * log_weight))),
        residual,
        degrees_left(statistics),
        chance(residual, degrees_left(statistics)),
        level,
        seconds,
        chance(float(jnp.sum(jnp.abs(statistics.received) ** 2)), 2 * int(statistics.received.size)),
    )
