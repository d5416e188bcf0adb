"""From an airframe in the air to its reconstructed cloud: the one place where the rooms of the house are joined.

Scenario (who flies where, made of what) -> full-wave channel in each slot -> what the base station estimates of it
-> what a scheme finds about the predicted position, a cloud or a place -> the next prediction.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from august_jax import config as configuration
from august_jax import streams
from august_jax.config import Config
from august_jax.data import channels_along
from august_jax.models import Networks
from august_jax.physics import Body
from august_jax.progress import Progress, silent
from august_jax.scene import Scenario, WorldCloud, draw_scenario, pose_scenario
from august_jax.schemes.looped import check_follows, follow_by
from august_jax.tracking import Kalman, Predictor, Track

__all__ = ["SHIPPED", "Networks", "Scenario", "Track", "draw_scenario", "load_networks", "pose_scenario",
           "run_files", "sense"]  # fmt: skip

SHIPPED = Path(__file__).parent / "weights" / "laptop"
"""Weights that come with the package."""


def run_files(run: str | Path | None = None) -> tuple[Path, Path]:
    """Where the configuration and the weights of a training run are, or the shipped ones.

    Raises:
        ValueError: one of them is not in ``run``.
    """
    folder = SHIPPED if run is None else Path(run)
    files = folder / "config.yaml", folder / "weights.npz"
    for path in files:
        if not path.is_file():
            raise ValueError(
                f"run: {folder} holds a predictor, and no networks; give what august train wrote of these, or use the "
                "shipped weights"
                if (folder / "predictor.npz").is_file()
                else f"run: {path} is not there; give what august train wrote, or use the shipped weights"
            )
    return files


def load_networks(run: str | Path | None = None) -> Networks:
    """The networks of a training run, or the shipped ones.

    Raises:
        ValueError: no weights in ``run``, or damaged ones.
    """
    from august_jax.training.checkpoint import load_weights

    settings, weights = run_files(run)
    config = configuration.read(settings)
    return Networks("shipped laptop weights" if run is None else str(run), config, *load_weights(weights, config))


@streams.pin
def sense(
    networks: Networks | None,
    config: Config,
    scenario: Scenario,
    *,
    seed: int,
    snr_db: float,
    predictor: Predictor | None = None,
    scheme: str = "august",
    body: Body | None = None,
    progress: Progress = silent,
) -> Track:
    """Simulate the echo of every slot and find the craft in it, in closed loop.

    In the first three slots the predicted position misses the true one uniformly within ``region.threshold_m`` along
    each axis, as a detection would: speed and acceleration are not known before. From then on a predictor over the
    estimates says where to look. Where the craft is noticed to be lost (:mod:`august_jax.tracking.loss`), it is
    detected anew, and the predictor starts again.

    Args:
        networks: what reconstructs; None for a scheme without.
        config: that of the networks, possibly with other settings of signal and sampler.
        scenario: what flies.
        seed: of the first prediction, pilots, noise, samplers and labels.
        snr_db: SNR to which the power is set in each slot [dB].
        predictor: None takes a Kalman filter for the configuration's style of flight.
        scheme: what finds the craft, of :data:`august_jax.schemes.SCHEMES`; one that needs no library.
        body: the craft's, where it was factored already; see :func:`august_jax.data.channels_along`.
        progress: takes lines of progress.

    Raises:
        ValueError: an SNR beyond what single precision can tell, or a scheme that cannot follow, or lacks what it
            needs.
    """
    if not abs(snr_db) <= configuration.SNR_LIMIT_DB:
        raise ValueError(
            f"snr_db: {snr_db:g} dB is beyond {configuration.SNR_LIMIT_DB:g} dB; the weights know "
            f"{config.signal.snr_db[0]:g} to {config.signal.snr_db[1]:g} dB"
        )
    check_follows(scheme, networks, config)
    progress("computing the full-wave channels")
    material = scenario.permittivity, scenario.conductivity
    channels = channels_along(config, scenario.airframe, scenario.rotations, scenario.positions, *material, body)
    progress("following the flight" if scheme != "august" else "estimating the channels and reconstructing the clouds")
    threshold = config.region.threshold_m
    detected = jnp.asarray(scenario.positions, jnp.float32) + jax.random.uniform(
        streams.key(seed, "sense.detection"), scenario.positions.shape, minval=-threshold, maxval=threshold
    )
    predictor = Kalman.for_flight(config.flight) if predictor is None else predictor
    seen = jax.tree.map(
        lambda leaf: np.asarray(leaf, np.float64 if jnp.issubdtype(leaf.dtype, jnp.floating) else leaf.dtype),
        follow_by(scheme, networks, streams.key(seed, "sense.slot"), channels, detected, config, predictor, snr_db),
    )
    found = seen.found
    unknown = np.full((scenario.slots, 1), np.nan)
    cloud: Any = found.cloud or WorldCloud(found.position[:, None], unknown, unknown)
    return Track(
        time_s=np.asarray(scenario.time_s),
        position=scenario.positions,
        rotation=scenario.rotations,
        permittivity=scenario.permittivity,
        conductivity=scenario.conductivity,
        truth=scenario.surface(streams.key(seed, "sense.label"), config.target.points),
        resampled=scenario.surface(streams.key(seed, "sense.resampling"), config.target.points),
        predicted=seen.predicted,
        snr_db=seen.snr_db,
        points=cloud.points,
        point_permittivity=cloud.permittivity,
        point_conductivity=cloud.conductivity,
        normal_estimate=found.normal if found.normal is not None else np.repeat(unknown, 3, axis=1),
        received=seen.statistics.received,
        pilots=seen.statistics.pilots,
        detected=seen.detected,
        lost=seen.lost,
        threshold_m=seen.threshold_m,
    )
