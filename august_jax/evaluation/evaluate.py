"""How accurate the schemes are: rows of a scheme, an SNR and the paper's metrics, beside baselines and bound.

The attitude of a cloud is the plane of its rotor points (``mde``), and, as the paper has it, the mean normal of random
triples of them (``mde_triples``), both of :mod:`august_jax.tracking.attitude`. The metrics are those of
:mod:`august_jax.evaluation.metrics`; ``wd_size_db`` is WD with the half-wheelbase as the unit of length.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from august_jax import streams
from august_jax.config import Config, ConfigError, check_weights
from august_jax.config.fields import near, repeated
from august_jax.data import Dataset, Sample, Target, batch_of, fresh_samples, observed_anew, prepare_targets
from august_jax.evaluation import metrics
from august_jax.evaluation.bound import Bound
from august_jax.evaluation.score import Row, score
from august_jax.inference import Library, known_craft
from august_jax.models import Networks, State, reconstruct
from august_jax.progress import Progress, TimeLeft, silent
from august_jax.scene.airframes import Airframe
from august_jax.scene.cloud import position_estimate
from august_jax.scene.pose import transform
from august_jax.schemes import SCHEMES, Answer, Ask, Scheme, Setting, Slots, Truth, title_of
from august_jax.schemes.networks import AUGUST

_PIECE = 50
"""Slots answered together."""
_PATIENCE_S = 5.0
"""Without a line of progress."""


@streams.pin
def evaluate(
    networks: Networks | Mapping[str, Networks],
    config: Config,
    *,
    seed: int,
    schemes: Sequence[str] | None = None,
    progress: Progress = silent,
) -> list[Row]:
    """Rows of accuracy on freshly simulated samples, ``config.evaluate.count`` of them, each from its own flight.

    All SNRs share the samples, their predictions and the draws of the noise, so that only the SNR makes a difference.
    So do several networks, whatever their encoders, and the draws of their samplers.

    ``bound_m`` is the mean position error that the Fisher information of the first 100 samples leaves to an
    estimator that knows the airframe but neither heading nor complex gain, under a Gaussian prior of the
    configuration's spread; ``bound_mde`` is half the mean square of the tilt error that it leaves
    (:mod:`august_jax.evaluation.bound`). For the estimator ``dft``, whose pilots get the power but not the SNR, neither
    is known.

    A search among the known craft, ``matched_field``, takes seconds a slot and answers the first ``evaluate.searched``
    samples alone, by the same simulator that made them: it is never told of a craft that it does not know.

    Args:
        networks: trained; or several, each of which is a line under its name in the place of ``august``
            (:func:`august_jax.schemes.lines_of` names them). Of several the first one's encoder says what schemes
            without networks hear, and the first one's answer is that of a search that explains nothing.
        config: of the samples, the station and the sampler; that of the networks, possibly with other settings of
            these. Of several each keeps its own ``model`` and ``train``.
        seed: of the samples and all that is drawn.
        schemes: which of :data:`august_jax.schemes.SCHEMES` to ask; None asks all.
        progress: told how far it is.

    Returns:
        For each SNR and scheme (:data:`august_jax.schemes.SCHEMES`) a row ``scheme``, ``label``, ``snr_db``, the
        metrics of :func:`~august_jax.evaluation.score.score`, ``count``, ``bound_m`` [m] and ``bound_mde``, and
        ``own_bound_m`` and ``own_bound_mde``, the same of the slots that the scheme answered (the first 100 at most):
        what a search expects to err by (``expected_mpe_m``, ``expected_mde``) compares with these. None where a scheme
        does not define a metric or the bound is not known.

    Raises:
        ValueError: an unknown scheme, no networks, or a name that a scheme has.
        ConfigError: nobody is left to ask; networks that were trained for another array, region or flight box than
            ``config`` is of; names them.
    """
    several = _fitted(networks, config)
    config = next(iter(several.values())).config
    chosen = asked_of(config, schemes)
    count = config.evaluate.count
    targets = prepare_targets(config, progress)
    progress(f"simulating {count} samples")
    samples = fresh_samples(config, np.arange(count), targets, seed=seed, domain="evaluate")
    airframes = [target.airframe for target in targets]
    truth = truth_of(streams.key(seed, "evaluate.resampling"), samples, airframes)._replace(craft=samples.airframe)
    library = _library(config, targets, progress) if any(SCHEMES[name].slow for name in chosen) else None
    lines = _lines(chosen, several, airframes, streams.key(seed, "evaluate.answer"), library)
    hearing = {line.config.model.encoder: line.config for line in lines} | {config.model.encoder: config}
    seen_key = streams.key(seed, "evaluate.observation")
    rows: list[Row] = []
    deaf: dict[str, dict[str, float | None]] = {}
    bound = None
    levels = config.evaluate.snr_db
    clock = TimeLeft(len(levels))
    for done, snr_db in enumerate(levels, 1):
        heard = {}
        for encoder, own in hearing.items():
            batch = observed_anew(seen_key, samples, own, snr_db, statistics=True)
            heard[encoder] = Slots(batch.predicted, batch.snr_db, batch.heard, truth, batch.statistics)
        if bound is None:  # predictions are the same at any SNR
            progress("bounding what any estimator could do")
            bound = Bound(samples, heard[config.model.encoder].predicted, targets, config)
        for line in lines:
            scored, slow, asked = deaf.get(line.name), line.scheme.slow, heard[line.config.model.encoder]
            those = asked.at(slice(0, config.evaluate.searched)) if slow else asked
            if scored is None:
                if slow and done == 1:
                    progress(
                        f"{line.name} answers {those.slots} slots at each SNR; before the first one it is compiled"
                    )
                where = f"SNR {snr_db:g} dB, {line.name}"
                answer = _in_pieces(line.ask, line.key, those, 1 if slow else _PIECE, where, progress)
                assert those.truth is not None
                scored = score(answer, those.truth, config.target.half_wheelbase_m)
                if not line.scheme.hears:
                    deaf[line.name] = scored
            rows.append(
                {
                    "scheme": line.name,
                    "label": line.label,
                    "snr_db": snr_db,
                    **scored,
                    "count": those.slots,
                    **bound.at(snr_db),
                    **{f"own_{metric}": value for metric, value in bound.at(snr_db, those.slots).items()},
                }
            )
        errors = {row["scheme"]: row["mpe_m"] for row in rows[-len(lines) :] if row["mpe_m"] is not None}
        told = ", ".join(f"{name} {error:.3f}" for name, error in errors.items())
        progress(f"SNR {snr_db:g} dB: MPE {told} m  {clock.after_one()}")
    return rows


class _Line(NamedTuple):
    """Who answers under a name: prepared, with the configuration that says what it hears and the key that it draws
    from."""

    name: str
    label: str
    scheme: Scheme
    ask: Ask
    config: Config
    key: jax.Array


class _Fitted(NamedTuple):
    """Networks with the configuration that they are evaluated under."""

    networks: Networks
    config: Config
    label: str


def asked_of(config: Config, schemes: Sequence[str] | None = None) -> list[str]:
    """Names of the schemes that :func:`evaluate` asks under a configuration, in the registry's order.

    Args:
        config: without bodies, or with ``evaluate.searched=0``, nobody searches.
        schemes: which are wanted; None wants all.

    Raises:
        ValueError: an unknown scheme.
        ConfigError: nobody is left to ask, or a search is wanted among craft of which one is named twice.
    """
    for name in schemes or ():
        if name not in SCHEMES:
            hint = near(name, list(SCHEMES))
            raise ValueError(
                f"schemes: unknown scheme {name!r}; {hint + ' ' if hint else ''}choose of {', '.join(SCHEMES)}"
            )
    wanted = [name for name in SCHEMES if schemes is None or name in schemes]
    searches = config.evaluate.searched > 0 and config.data.dense_solver == "mom"
    asked = [name for name in wanted if searches or not SCHEMES[name].slow]
    if not asked:
        raise ConfigError(
            f"schemes: {', '.join(wanted) or 'none'} leaves nobody to ask under evaluate.searched="
            f"{config.evaluate.searched} and data.solver={config.data.solver}; a search wants some slots and bodies "
            "(mom or table)"
        )
    twice = repeated(config.target.airframes)
    if twice is not None and any(SCHEMES[name].slow for name in asked):
        raise ConfigError(
            f"target.airframes: names {twice} twice, which a search could not tell apart; name each craft once, or set "
            "evaluate.searched=0, which leaves the search out"
        )
    return asked


def _fitted(networks: Networks | Mapping[str, Networks], config: Config) -> dict[str, _Fitted]:
    """Networks by the name of their line, each under ``config`` with its own model; refused where that does not fit."""
    if isinstance(networks, Networks):
        check_weights(config, networks.config)
        return {AUGUST.name: _Fitted(networks, config, AUGUST.label)}
    if not networks:
        raise ValueError("networks: got none; give networks, or several by name")
    found = {}
    for name, each in networks.items():
        if name in SCHEMES and name != AUGUST.name:
            raise ValueError(f"networks: {name!r} is the name of a scheme; give these networks another")
        try:
            own = replace(config, model=each.config.model, train=each.config.train)
            check_weights(own, each.config)
        except ConfigError as error:
            raise ConfigError(f"networks: {name!r} ({each.name}) cannot stand beside the others\n{error}") from None
        found[name] = _Fitted(each, own, title_of(each))
    return found


def _lines(
    chosen: Sequence[str],
    several: Mapping[str, _Fitted],
    airframes: Sequence[Airframe],
    root: jax.Array,
    library: Library | None,
) -> list[_Line]:
    """All who answer, in the registry's order, several networks in the place of one."""
    first = next(iter(several.values()))
    lines = []
    for name in chosen:
        scheme, prepared = SCHEMES[name], streams.named(root, name)
        key = jax.random.fold_in(prepared, 1)  # shared by several networks
        those = several if name == AUGUST.name else {name: first._replace(label=scheme.label)}
        for line, (networks, config, label) in those.items():
            ask = scheme.prepare(Setting(config, networks, airframes, prepared, library))
            if ask is not None:
                lines.append(_Line(line, label, scheme, ask, config, key))
    return lines


def _in_pieces(ask: Ask, key: jax.Array, slots: Slots, together: int, where: str, progress: Progress) -> Answer:
    """The answer to all slots, asked about ``together`` of them at a time."""
    answers: list[Answer] = []
    before = told = time.monotonic()
    for start in range(0, slots.slots, together):
        answers.append(ask(jax.random.fold_in(key, start), slots.at(slice(start, start + together))))
        now, done = time.monotonic(), min(start + together, slots.slots)
        if start and now - told > _PATIENCE_S and done < slots.slots:  # the first ones compile: they promise nothing
            told = now
            left = (now - before) * (slots.slots - done) / together  # by the last ones
            progress(f"{where}: {done} of {slots.slots} slots, {left:.0f} s left")
        before = now
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *answers)


def _library(config: Config, targets: Sequence[Target], progress: Progress) -> Library:
    """The configuration's own craft to search among."""
    try:
        return known_craft(config, targets, progress=progress)
    except ValueError as error:
        raise ValueError(f"{error}; evaluate.searched=0 leaves the search out") from None


def truth_of(key: jax.Array, samples: Sample, airframes: Sequence[Airframe]) -> Truth:
    """What was true of samples in which these craft fly, in the world, its surface drawn a second time from ``key``;
    without what craft they are, which need not be known."""
    bodies = jnp.stack(
        [
            airframe.sample_surface(jax.random.fold_in(key, row), samples.points.shape[1])
            for row, airframe in enumerate(airframes[index] for index in samples.airframe)
        ]
    )
    resampled = jnp.asarray(transform(bodies, samples.rotation, samples.position))
    clouds = samples.points + samples.position[:, None]
    return Truth(samples.position, samples.rotation[:, :, 2], clouds, resampled)


def validator(
    source: Dataset | Sample, config: Config, count: int = 256
) -> Callable[[nnx.GraphDef, State, int], dict[str, float]] | None:
    """A function (graphdef, state, step) -> position error on validation samples, beside that of q_pre.

    Args:
        source: a data set, or samples that are all for validation; ``count`` of them, evenly spread, are used, observed
            alike at every call.
        config: of the training run.
        count: how many at most.

    Returns:
        The function, or None where the data hold no validation samples.
    """
    places = source.rows("validation") if isinstance(source, Dataset) else np.arange(source.rows)
    if not len(places):
        return None
    spread = places[np.linspace(0, len(places) - 1, min(count, len(places))).astype(int)]
    samples = source.read(spread) if isinstance(source, Dataset) else source.at(spread)
    seen_key, cloud_key = jax.random.split(streams.key(config.train.seed, "train.validation"))
    batch = batch_of(seen_key, samples, config)
    position = jnp.asarray(samples.position)

    def validate(graphdef: nnx.GraphDef, state: State, step: int) -> dict[str, float]:
        cloud = reconstruct(
            graphdef,
            state,
            cloud_key,
            batch.heard,
            batch.predicted,
            batch.snr_db,
            count=min(128, config.target.points),
            sampler=config.evaluate.sampler,
            steps=config.evaluate.sampler_steps,
        )
        estimate = position_estimate(cloud, batch.predicted, config.region)
        return {
            "validation_mpe_m": float(metrics.mpe_m(estimate, position)),
            "validation_prediction_m": float(metrics.mpe_m(batch.predicted, position)),
        }

    return validate
