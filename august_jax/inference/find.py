"""One echo, one posterior: screen, refine, polish, weigh."""

from __future__ import annotations

import time
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from august_jax.arrays import Array
from august_jax.data.simulator import contrast_of
from august_jax.inference.hypotheses import (
    Hypotheses,
    Mixture,
    Posterior,
    covariances,
    distinct,
    evidence,
    sampled,
    shared_out,
)
from august_jax.inference.library import Library
from august_jax.inference.prior import Prior
from august_jax.inference.refine import Candidates, begin, corrections, cost, improved, polished
from august_jax.inference.screen import screen
from august_jax.physics.parameters import rotation_from_vector
from august_jax.signal.estimators import Region, roi_coefficients
from august_jax.signal.roi import Coefficients, Subspace, towards
from august_jax.signal.station import Statistics

LEVEL = 0.01
"""Where noise alone leaves as much as the best hypothesis less often than this, the echo counts as unexplained."""


class _Stage(NamedTuple):
    """Candidates that survive, steps taken, and the SNR [dB] of which the noise is at least taken to be."""

    kept: int
    steps: int
    snr_db: float


_LOOKED = 16_000
_STAGES = (
    _Stage(8000, 1, 18.0),
    _Stage(4000, 1, 18.0),
    _Stage(1500, 1, 20.0),
    _Stage(500, 2, 24.0),
    _Stage(192, 4, 34.0),
    _Stage(128, 6, 60.0),
)
_MODES = 12
_SHAKEN = 16
_SHAKEN_SNR_DB = 14.0
_PARTS = 32
_PILOTS = 1024
_FOLLOWED = 32
_NARROWER = 0.6
_SAMPLES = 2048


def find_craft(
    library: Library,
    statistics: Statistics,
    prior: Prior,
    *,
    key: jax.Array,
    level: float = LEVEL,
    proposals: Candidates | None = None,
) -> Posterior:
    """Search the known craft, attitudes, places and materials for what explains one echo.

    Args:
        library: the known craft.
        statistics: of one slot, with the tones of the library.
        prior: what is known before the echo.
        key: of the posterior's samples.
        level: below which the best residual's probability under noise counts as unexplained.
        proposals: explanations to begin with in place of the screen, such as a tracker's.

    Raises:
        ValueError: an echo that is not finite, or of other tones or another array than the library's; a prior that
            leaves nothing to look at, or materials or places that the library's tables do not hold.
    """
    _check(library, statistics, prior)
    seconds: dict[str, float] = {}
    clock = _Clock(seconds)
    table, subspace = library.table, library.subspace
    statistics = jax.tree.map(jnp.asarray, statistics)
    snr_db = _snr_db(statistics, subspace)
    if proposals is None:
        place = _bearing(statistics, subspace, library.config.region.scale_m)
        reach_m = float(np.sqrt(3.0) * prior.half_m)  # of the prediction's range, which bearings leave alone
        seen = screen(library.survey, subspace, statistics, place, library.attitudes, _LOOKED, reach_m)
        low, high = np.asarray(prior.permittivity)
        permittivity = np.clip(1.0 + library.survey_contrast * np.abs(seen.gain), low, high)
        loss = np.full(len(permittivity), float(prior.middle()[1]), np.float32)
        clock("screen")
        found = begin(table, subspace, statistics, seen.craft, seen.rotation, seen.position, permittivity, loss)
        for stage in _STAGES:
            heat = max(1.0, 10.0 ** ((snr_db - stage.snr_db) / 10.0))
            found = improved(table, subspace, statistics, prior, found, heat, steps=stage.steps)
            found = _best(found, statistics, prior, heat, stage.kept)
    else:
        found = improved(table, subspace, statistics, prior, proposals, 1.0, steps=6)
    found = _shaken(library, statistics, prior, found, snr_db)
    clock("refine")
    return _weighed(library, statistics, prior, found, key, level, clock, seconds)


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


def _mixture(library: Library, modes: Candidates, factor, share, size: int) -> Mixture:
    """Student distributions about modes, filled up to ``size`` with parts that are never drawn."""
    exact = [
        corrections(
            library.body(int(modes.craft[row])),
            library.table,
            library.subspace,
            jax.tree.map(lambda leaf, row=row: jnp.asarray(leaf[row]), modes),
        )
        for row in range(len(share))
    ]
    spare = size - len(share)
    rows = np.pad(np.arange(len(share)), (0, spare), mode="edge")
    log_share = np.where(np.arange(size) < len(share), np.log(share[rows] / share.sum() + 1e-30), -1e9)
    return Mixture(
        jnp.asarray(modes.craft[rows]),
        jnp.asarray(modes.rotation[rows]),
        jnp.asarray(modes.position[rows]),
        jnp.asarray(modes.permittivity[rows]),
        jnp.asarray(factor[rows], jnp.float32),
        jnp.asarray(log_share, jnp.float32),
        jnp.stack(exact + exact[:1] * spare),
    )


def _resampled(poses, log_weight, part, modes: Candidates, factor):
    """Parts about samples of the posterior, with narrower shapes than those that they were drawn from; None where no
    sample lies inside the prior."""
    if not np.any(log_weight > -np.inf):
        return None
    weight = np.exp(0.7 * (log_weight - log_weight.max()))  # tempered: one sample may weigh more than all others
    places = (np.arange(_FOLLOWED) + 0.5) / _FOLLOWED
    rows = np.minimum(np.searchsorted(np.cumsum(weight) / weight.sum(), places), len(weight) - 1)
    craft, rotation, position, permittivity, conductivity = (leaf[rows] for leaf in poses)
    own = part[rows]
    followed = modes.at(own)._replace(
        craft=craft, rotation=rotation, position=position, permittivity=permittivity, conductivity=conductivity
    )
    return followed, _NARROWER * factor[own]


class _Clock:
    def __init__(self, seconds: dict[str, float]):
        self._seconds, self._began = seconds, time.perf_counter()

    def __call__(self, stage: str) -> None:
        now = time.perf_counter()
        self._seconds[stage], self._began = now - self._began, now


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
    if low < table.contrast[0] - slack or high > table.contrast[1] + slack:
        raise ValueError(
            f"prior: permittivity from {1.0 + low:g} to {1.0 + high:g} is beyond the library's tables, which hold "
            f"{1.0 + table.contrast[0]:.3g} to {1.0 + table.contrast[1]:.3g}; make the library with that range "
            "(target.permittivity)"
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


def _snr_db(statistics: Statistics, subspace: Subspace) -> float:
    """The echo's SNR over all antennas and as many symbols, of its energy in the subspace [dB]."""
    energy = float(jnp.sum(jnp.abs(statistics.received) ** 2)) - statistics.received.size
    entries = statistics.received.shape[0] * subspace.array.count**2
    return float(10.0 * np.log10(max(energy / entries, 1e-3)))


def _bearing(statistics, subspace, half_m):
    positions = subspace.positions
    values = jax.vmap(
        lambda received, pilots, k: roi_coefficients(
            received, pilots, Region(statistics.centre, half_m, positions, k, subspace.basis)
        )
    )(statistics.received, statistics.pilots, subspace.wavenumbers)
    return towards(Coefficients(values, statistics.centre), subspace)


def _worth(found: Candidates, statistics: Statistics, prior: Prior, heat: float = 1.0) -> np.ndarray:
    """Cost with the prior of the tilt, which steps do not know: what lies beyond the largest tilt is no explanation."""
    density = np.asarray(prior.log_tilt(jnp.asarray(found.rotation)), np.float64)
    most = float(np.max(np.log(np.asarray(prior.tilt_density))))
    return np.asarray(cost(found, statistics, prior, heat), np.float64) + np.minimum(most - density, 30.0) / heat


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
    return jax.tree.map(lambda one, two: np.concatenate([one, two]), found, moved)


def _weighed(library, statistics, prior, found, key, level, clock, seconds):
    from scipy.stats import chi2

    rows = distinct(found, _worth(found, statistics, prior), prior, _PARTS)
    modes = found.at(rows)
    polished_modes = [
        polished(
            library.body(int(modes.craft[row])),
            library.table,
            library.subspace,
            statistics,
            prior,
            jax.tree.map(lambda leaf, row=row: jnp.asarray(leaf[row : row + 1]), modes),
            steps=24 if row < 4 else 6,
        )
        for row in range(len(rows))
    ]
    modes = jax.tree.map(lambda *leaves: np.concatenate([np.asarray(leaf) for leaf in leaves]), *polished_modes)
    modes = modes.at(distinct(modes, _worth(modes, statistics, prior), prior, _PARTS))
    clock("polish")
    scores = evidence(modes, statistics, prior)
    order = np.argsort(-scores)
    modes, scores = modes.at(order), scores[order]
    weight = np.exp(scores - scores.max())
    weight /= weight.sum()
    tempered = np.exp(0.3 * (scores - scores.max()))
    share = 0.6 * weight + 0.4 * tempered / tempered.sum()
    inverse = covariances(modes, prior)
    narrowed = inverse[:, :7, :7]
    factor = np.linalg.cholesky(narrowed + 1e-12 * np.eye(7) * np.diagonal(narrowed, axis1=1, axis2=2).max())
    first = _mixture(library, modes, factor, share, _PARTS)
    begin_key, end_key = jax.random.split(key)
    shared = (library.table, library.subspace, statistics, prior)
    # The second mixture follows where a posterior bends: it has parts about samples that the first one met.
    *poses, log_weight, part = (np.asarray(leaf) for leaf in sampled(begin_key, *shared, first, _PILOTS))
    found = _resampled(poses, log_weight, part, modes, factor)
    if found is not None:
        followed, narrow = found
        factor = np.concatenate([factor, narrow])
        share = np.concatenate([0.35 * share / share.sum(), np.full(_FOLLOWED, 0.65 / _FOLLOWED)])
        modes_too = jax.tree.map(lambda *leaves: np.concatenate(leaves), modes, followed)
        mixture = _mixture(library, modes_too, factor, share, _PARTS + _FOLLOWED)
    else:
        mixture = first
    samples = sampled(end_key, *shared, mixture, _SAMPLES)
    craft, rotation, position, permittivity, conductivity, log_weight, _ = (np.asarray(leaf) for leaf in samples)
    log_weight = log_weight.astype(np.float64)
    if np.all(np.isneginf(log_weight)):  # every sample fell outside of the prior: the modes lie at its edge
        log_weight = np.zeros_like(log_weight)
    log_weight -= log_weight.max()
    log_weight -= np.log(np.sum(np.exp(log_weight)))
    real = log_weight > -np.inf
    clock("sample")
    count = statistics.received.size
    residual = float(np.min(modes.residual))
    degrees = 2 * count - 10
    return Posterior(
        Hypotheses(
            modes.craft,
            modes.rotation,
            modes.position,
            modes.permittivity,
            modes.conductivity,
            weight,
            modes.residual,
            inverse[:, :8, :8],
        ),
        craft[real],
        rotation[real],
        position[real],
        permittivity[real],
        conductivity[real],
        log_weight[real],
        len(library.targets),
        float(1.0 / np.sum(np.exp(2.0 * log_weight))),
        residual,
        degrees,
        float(chi2.sf(2.0 * residual, degrees)),
        level,
        seconds,
        float(chi2.sf(2.0 * float(jnp.sum(jnp.abs(statistics.received) ** 2)), 2 * count)),
    )
