"""How accurate networks are, beside answers that need none: rows of a scheme, an SNR and the paper's metrics.

Schemes:

- ``august``: the networks (whatever their ``model.scheme``).
- ``prior``: answers the predicted position q_pre; it defines MPE alone.
- ``up``: answers a level craft; it defines MDE alone.
- ``mean_shape``: answers :func:`mean_shape` at q_pre; it defines WD and MCD.
- ``resampling``: the true surface, sampled anew: the floor that the clouds' finite number of points sets.

The attitude of a cloud is the plane of its rotor points (``mde``), and, as the paper has it, the mean normal of random
triples of them (``mde_triples``), both of :mod:`august_jax.tracking.attitude`. The metrics are those of
:mod:`august_jax.metrics`; ``wd_size_db`` is WD with the half-wheelbase as the unit of length.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from august_jax import metrics
from august_jax.config import Config
from august_jax.data import Dataset, Sample, Target, batch_of, generate, observed_anew, prepare_targets
from august_jax.models import reconstruct
from august_jax.physics import PlanarArray, fisher_information, mean_position_error, tilt_bound
from august_jax.physics.information import Prior
from august_jax.pipeline import Networks, Track, rotor_plane_normal
from august_jax.scene import (
    Airframe, from_cloud, position_estimate, resolve_airframe, rotation_from_euler, transform,
)
from august_jax.signal.beams import direction_angles, roi_codebook
from august_jax.tracking import rotor_points, triple_normal

ABOUT = {
    "august": "the networks",
    "prior": "answering the predicted position",
    "up": "answering a level drone",
    "mean_shape": "the average drone at the prediction",
    "resampling": "the true surface sampled anew: the floor",
}
"""What each scheme is, in a few words."""

NOTE = (
    "MPE: mean distance between true and estimated position. MDE: mean of 1 - cos between true and estimated normal. "
    "MCD: squared distance to the nearest neighbour, both ways, of clouds about their own means; WD adds the squared "
    "position error; both in dB re 1 m^2."
)

_FRESH = 2**30
"""Added to the seed of an evaluation, so that no seed of a training set gives the same samples."""
_SCORED = 1 << 20
"""Number of the stream that scores; the first children of the same seed make the samples."""
_BOUNDED = 100
"""Samples over which the bound is averaged."""
_PIECE = 50
"""Clouds reconstructed together."""


def evaluate(networks: Networks, config: Config, *, seed: int,
             progress: Callable[[str], None] = lambda line: None) -> list[dict[str, Any]]:
    """Rows of accuracy on freshly simulated samples, ``config.evaluate.count`` of them, each from its own flight.

    All SNRs share the samples, their predictions and the draws of the noise, so that only the SNR makes a difference.

    ``bound_m`` is the mean position error that the Fisher information of the first 100 samples leaves to an
    estimator that knows the airframe but neither heading nor complex gain, under a Gaussian prior of the
    configuration's spread (:mod:`august_jax.physics.information`); ``bound_mde`` is half the mean square of the tilt
    error that it leaves. For the estimator ``dft``, whose pilots get the power but not the SNR, neither is known.

    Returns:
        For each SNR and scheme a row ``scheme``, ``snr_db``, the metrics of :func:`score`, ``along_m`` and ``across_m``
        (the position's root-mean-square error along the line of sight and across it) [m], ``count``, ``bound_m`` [m]
        and ``bound_mde``; None where a scheme does not define a metric or the bound is not known.
    """
    count, slots = config.evaluate.count, config.flight.slots
    fresh = replace(config, data=replace(config.data, seed=_FRESH + seed))
    targets = prepare_targets(config, progress)
    progress(f"simulating {count} samples")
    numbers = np.arange(count)
    samples = generate(fresh, numbers * slots + numbers % slots, targets)
    airframes = [target.airframe for target in targets]
    root = jax.random.fold_in(jax.random.key(_FRESH + seed), _SCORED)
    again_key, shape_key, seen_key, cloud_key, normal_key = jax.random.split(root, 5)
    again = _resampled(again_key, samples, airframes, config.target.points)
    mean = mean_shape(shape_key, airframes, config.target.points)
    truth = {"position": samples.position, "normal": samples.rotation[:, :, 2],
             "cloud": samples.points + samples.position[:, None]}
    size = config.target.half_wheelbase_m
    progress("bounding what any estimator could do")
    predicted = observed_anew(seen_key, samples, config, config.evaluate.snr_db[0]).predicted  # the same at any SNR
    information = unit_information(samples, np.asarray(predicted), targets, config)
    rows, others = [], None
    for snr_db in config.evaluate.snr_db:
        batch = observed_anew(seen_key, samples, config, snr_db)
        clouds, normals, triples = [], [], []
        for start in range(0, count, _PIECE):
            piece = batch.at(slice(start, start + _PIECE))
            cloud = reconstruct(networks.graphdef, networks.state, jax.random.fold_in(cloud_key, start), piece.heard,
                                piece.predicted, piece.snr_db,
                                count=config.target.points, sampler=config.evaluate.sampler,
                                steps=config.evaluate.sampler_steps)
            clouds.append(from_cloud(cloud, piece.predicted, config.region).points)
            both = _normals(jax.random.fold_in(normal_key, start), clouds[-1])
            normals.append(both[0])
            triples.append(both[1])
        answer = {"cloud": jnp.concatenate(clouds), "normal": jnp.concatenate(normals),
                  "triples": jnp.concatenate(triples)}
        answer["position"] = jnp.mean(answer["cloud"], axis=1)
        if others is None:
            others = baselines(batch.predicted, mean, again, normal_key)
        scored = {"august": answer, **others}
        bounds: dict[str, float | None] = {"bound_m": None, "bound_mde": None}
        if information is not None:
            known, prior = 10.0 ** (snr_db / 10.0) * information, _prior(config)
            tilts = tilt_bound(known, samples.rotation[_bounded(samples), :, 2], prior)
            bounds = {"bound_m": float(np.mean(mean_position_error(known, prior))),
                      "bound_mde": float(np.mean(0.5 * tilts**2))}  # 1 - cos of small angles
        rows += [{"scheme": scheme, "snr_db": snr_db, **score(each, truth, size), **_split(each, truth),
                  "count": count, **bounds} for scheme, each in scored.items()]
        progress(f"SNR {snr_db:g} dB: MPE {rows[-len(scored)]['mpe_m']:.3f} m")
    return rows


def unit_information(samples: Sample, predicted: np.ndarray, targets: Sequence[Target],
                     config: Config) -> np.ndarray | None:
    """Fisher information (n, 10, 10) of the first samples, airframe by airframe, at an SNR of 1, pilots of the RoI
    about ``predicted`` (B, 3) [m]; it grows in proportion to the SNR. None for the estimator ``dft``, which sends
    others, and where the data's solver is not the one whose channel can be differentiated here."""
    if config.signal.estimator == "dft" or any(target.body is None for target in targets):
        return None
    array = PlanarArray(config.array.nx, config.array.nz, config.array.frequency_hz)
    widths = tuple(np.deg2rad(config.signal.beam_width_deg))
    repeats = (config.signal.symbols or array.count) / array.count  # fisher_information counts one symbol an antenna
    found = []
    for kind, target in enumerate(targets):
        mine = np.flatnonzero(samples.airframe[:_BOUNDED] == kind)
        if len(mine):
            books = [roi_codebook(array.nx, array.nz, direction_angles(jnp.asarray(place)), widths,
                                  mirror=config.signal.mirror_beams) for place in predicted[mine]]
            lit = np.stack([np.asarray(book @ book.conj().T) for book in books])
            found.append(fisher_information(
                target.body, array, samples.rotation[mine], samples.position[mine],
                samples.permittivity[mine], samples.conductivity[mine], repeats, illumination=lit))
    return np.concatenate(found)


def _bounded(samples: Sample) -> np.ndarray:
    """The samples that :func:`unit_information` takes, in its order."""
    return np.argsort(samples.airframe[:_BOUNDED], kind="stable")


def _prior(config: Config) -> Prior:
    """What is known before the echo: the prediction's threshold, the ranges of tilt and material, any heading."""
    def uniform(low, high):
        return max(high - low, 1e-6 * max(abs(high), 1e-9)) / np.sqrt(12.0)

    return Prior(
        position_m=max(uniform(-config.region.threshold_m, config.region.threshold_m), 1e-6),
        turn_rad=uniform(*np.deg2rad([-config.flight.tilt_deg, config.flight.tilt_deg])),
        heading_rad=uniform(-np.pi, np.pi),
        permittivity=uniform(*config.target.permittivity), conductivity=uniform(*config.target.conductivity_s_m),
    )


def score(answer: Mapping[str, Any], truth: Mapping[str, Any], size_m: float) -> dict[str, float | None]:
    """The metrics that ``answer`` defines by its ``position`` (B, 3), ``normal`` (B, 3) and ``cloud`` (B, M, 3) [m].

    Args:
        answer: a cloud without a position of its own is one about q_pre, given as ``about``. ``triples`` (B, 3) are
            normals by the paper's method; a scheme without clouds of its own (``up``) answers one normal to both.
        truth: ``position``, ``normal`` and ``cloud``.
        size_m: half-wheelbase of the craft [m].

    Returns:
        ``mpe_m`` [m] and its standard error ``mpe_se_m`` [m] (None for one sample), ``mde``, ``mde_triples``, ``wd_db``
        and ``mcd_db`` [dB re 1 m^2], ``wd_size_db`` [dB].
    """
    place = answer.get("position", answer.get("about"))
    values: dict[str, float | None] = dict.fromkeys(
        ("mpe_m", "mpe_se_m", "mde", "mde_triples", "wd_db", "wd_size_db", "mcd_db"))
    if "position" in answer:
        values["mpe_m"] = float(metrics.mpe_m(answer["position"], truth["position"]))
        errors = np.linalg.norm(np.asarray(answer["position"]) - truth["position"], axis=-1)
        if len(errors) > 1:
            values["mpe_se_m"] = float(np.std(errors, ddof=1) / np.sqrt(len(errors)))
    if "normal" in answer:
        values["mde"] = float(metrics.mde(answer["normal"], truth["normal"]))
        values["mde_triples"] = float(metrics.mde(answer.get("triples", answer["normal"]), truth["normal"]))
    if "cloud" in answer:
        values["wd_db"] = float(metrics.wd_db(answer["cloud"], truth["cloud"], place, truth["position"]))
        values["wd_size_db"] = values["wd_db"] - float(20.0 * np.log10(size_m))
        values["mcd_db"] = float(metrics.mcd_db(answer["cloud"], truth["cloud"]))
    return values


def _split(answer: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, float | None]:
    if "position" not in answer:
        return {"along_m": None, "across_m": None}
    along, across = metrics.along_and_across_m(answer["position"], truth["position"])
    return {"along_m": float(along), "across_m": float(across)}


def baselines(predicted, mean, again, key: jax.Array) -> dict[str, dict[str, Any]]:
    """What the schemes without networks answer, as :func:`score` takes it.

    Args:
        predicted: q_pre (B, 3) [m].
        mean: the mean shape (M, 3) [m], about q_pre; None leaves its scheme out.
        again: the true clouds sampled anew, in the world (B, M, 3) [m].
        key: of the attitude estimates.
    """
    predicted, again = jnp.asarray(predicted), jnp.asarray(again)
    normals, triples = _normals(key, again)
    found = {
        "prior": {"position": predicted},
        "up": {"normal": jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), predicted.shape)},
        "resampling": {"position": jnp.mean(again, axis=1), "cloud": again, "normal": normals, "triples": triples},
    }
    if mean is not None:
        found["mean_shape"] = {"cloud": predicted[:, None] + mean, "about": predicted}
    return {scheme: found[scheme] for scheme in ABOUT if scheme in found}


def mean_shape(key: jax.Array, airframes: Sequence[Airframe], count: int) -> jax.Array:
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


def score_track(track: Track, config: Config, size_m: float) -> dict[str, Any]:
    """Errors of a track, slot by slot and on average, beside the baselines.

    Where a mesh that the networks were trained on is not there any more, a warning says so and ``mean_shape`` is left
    out.

    Returns:
        ``slots``: one entry a slot, plain numbers and lists: ``slot``, ``time_s``, ``snr_db``; ``position``,
        ``predicted``, ``estimate`` [m]; ``normal``, ``normal_estimate``; ``tilt_deg``, ``tilt_estimate_deg``;
        ``permittivity``, ``conductivity`` [S/m] and their estimates, the clouds' means; ``position_error_m``,
        ``predicted_error_m``, ``normal_error_deg``, and ``normal_error_up_deg``, that of answering a level craft.
        ``schemes``: one row a scheme: ``scheme``, ``about`` and the metrics over all slots.
    """
    up = np.array([0.0, 0.0, 1.0])
    estimate, normal = track.estimate, track.normal
    slots = [
        {
            "slot": slot,
            "time_s": float(track.time_s[slot]),
            "snr_db": float(track.snr_db[slot]),
            "position": track.position[slot].tolist(),
            "predicted": track.predicted[slot].tolist(),
            "estimate": estimate[slot].tolist(),
            "position_error_m": float(np.linalg.norm(estimate[slot] - track.position[slot])),
            "predicted_error_m": float(np.linalg.norm(track.predicted[slot] - track.position[slot])),
            "normal": normal[slot].tolist(),
            "normal_estimate": track.normal_estimate[slot].tolist(),
            "normal_error_deg": _angle_deg(track.normal_estimate[slot], normal[slot]),
            "normal_error_up_deg": _angle_deg(up, normal[slot]),
            "tilt_deg": _angle_deg(up, normal[slot]),
            "tilt_estimate_deg": _angle_deg(up, track.normal_estimate[slot]),
            "permittivity": track.permittivity,
            "permittivity_estimate": float(track.point_permittivity[slot].mean()),
            "conductivity": track.conductivity,
            "conductivity_estimate": float(track.point_conductivity[slot].mean()),
        }
        for slot in range(len(track.time_s))
    ]
    # about the true positions: single precision keeps the digits of a centimetre better there than in the world
    about = track.position[:, None]
    truth = {"position": np.zeros_like(track.position), "normal": normal, "cloud": track.truth - about}
    shape_key, normal_key = jax.random.split(jax.random.key(_FRESH))
    answer = {"position": estimate - track.position, "normal": track.normal_estimate, "cloud": track.points - about}
    answer["triples"] = _normals(normal_key, jnp.asarray(answer["cloud"]))[1]
    try:
        airframes = [resolve_airframe(name, config.target.half_wheelbase_m) for name in config.target.airframes]
        mean = mean_shape(shape_key, airframes, config.target.points)
    except ValueError as error:
        warnings.warn(f"no mean_shape to compare with, of the airframes that the weights know: {error}", stacklevel=2)
        mean = None
    others = baselines(track.predicted - track.position, mean, track.again - about, normal_key)
    schemes = [{"scheme": scheme, "about": ABOUT[scheme], **score(each, truth, size_m)}
               for scheme, each in {"august": answer, **others}.items()]
    return {"slots": slots, "schemes": schemes}


def validator(dataset: Dataset, config: Config, count: int = 256) -> Callable[..., dict[str, float]] | None:
    """A function (graphdef, state, step) -> position error on validation samples, beside that of q_pre.

    Args:
        dataset: where they come from; the first ``count`` of them are used, observed alike at every call.
        config: of the training run.
        count: how many at most.

    Returns:
        The function, or None where the data hold no validation samples.
    """
    places = dataset.rows("validation")
    if not len(places):
        return None
    samples = dataset.read(places[np.linspace(0, len(places) - 1, min(count, len(places))).astype(int)])
    key = jax.random.key(_FRESH)
    batch = batch_of(key, samples, config)
    position = jnp.asarray(samples.position)

    def validate(graphdef, state, step) -> dict[str, float]:
        cloud = reconstruct(graphdef, state, key, batch.heard, batch.predicted, batch.snr_db,
                            count=min(128, config.target.points), sampler=config.evaluate.sampler,
                            steps=config.evaluate.sampler_steps)
        estimate = position_estimate(cloud, batch.predicted, config.region)
        return {"validation_mpe_m": float(metrics.mpe_m(estimate, position)),
                "validation_prior_m": float(metrics.mpe_m(batch.predicted, position))}

    return validate


def _resampled(key: jax.Array, samples: Sample, airframes: Sequence[Airframe],
               count: int) -> jax.Array:
    """The true clouds in the world (B, count, 3) [m], drawn a second time."""
    bodies = jnp.stack([airframe.sample_surface(jax.random.fold_in(key, row), count)
                        for row, airframe in enumerate(airframes[index] for index in samples.airframe)])
    return transform(bodies, samples.rotation, samples.position)


@jax.jit
def _normals(key: jax.Array, clouds: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Normals (B, 3) of clouds (B, M, 3): of the plane of their rotor points, and the paper's, by triples of these."""
    centred = clouds - jnp.mean(clouds, axis=1, keepdims=True)

    def both(key, cloud):
        plane, triples = jax.random.split(key)
        return rotor_plane_normal(plane, cloud), triple_normal(triples, cloud, weights=rotor_points(cloud))

    return jax.vmap(both)(jax.random.split(key, len(clouds)), centred)


def _angle_deg(first: np.ndarray, second: np.ndarray) -> float:
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second)))
