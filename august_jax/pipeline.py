"""From an airframe in the air to its reconstructed cloud: the one place where the rooms of the house are joined.

Scenario (who flies where, made of what) -> full-wave channel in each slot -> what the base station estimates of it
-> cloud about the predicted position -> position and attitude, which feed the next prediction.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from august_jax import config as configuration
from august_jax import streams
from august_jax.arrays import Array, ArrayLike
from august_jax.config import Config
from august_jax.data import channels_along
from august_jax.models import Networks
from august_jax.progress import Progress, silent
from august_jax.scene import Scenario, draw_scenario, pose_scenario
from august_jax.schemes import SCHEMES, Answer, Setting, Slots
from august_jax.signal import Coefficients, Statistics
from august_jax.tracking import Followed, Kalman, Predictor, Track, follow

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
            raise ValueError(f"run: {path} is not there; give what august train wrote, or use the shipped weights")
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
    networks: Networks,
    config: Config,
    scenario: Scenario,
    *,
    seed: int,
    snr_db: float,
    predictor: Predictor | None = None,
    progress: Progress = silent,
) -> Track:
    """Simulate the echo of every slot and reconstruct the craft from it.

    In the first three slots the predicted position misses the true one uniformly within ``region.threshold_m`` along
    each axis, as a detection would: speed and acceleration are not known before. From then on a predictor over the
    estimates says where to look.

    Args:
        networks: what reconstructs.
        config: that of the networks, possibly with other settings of signal and sampler.
        scenario: what flies.
        seed: of the first prediction, pilots, noise, samplers and labels.
        snr_db: SNR to which the power is set in each slot [dB].
        predictor: None takes a Kalman filter for the configuration's style of flight.
        progress: takes lines of progress.

    Raises:
        ValueError: an SNR beyond what single precision can tell.
    """
    if not abs(snr_db) <= configuration.SNR_LIMIT_DB:
        raise ValueError(
            f"snr_db: {snr_db:g} dB is beyond {configuration.SNR_LIMIT_DB:g} dB; the weights know "
            f"{config.signal.snr_db[0]:g} to {config.signal.snr_db[1]:g} dB"
        )
    progress("computing the full-wave channels")
    channels = channels_along(
        config, scenario.airframe, scenario.rotations, scenario.positions, scenario.permittivity, scenario.conductivity
    )
    progress("estimating the channels and reconstructing the clouds")
    threshold = config.region.threshold_m
    detected = jnp.asarray(scenario.positions, jnp.float32) + jax.random.uniform(
        streams.key(seed, "sense.detection"), scenario.positions.shape, minval=-threshold, maxval=threshold
    )
    predictor = Kalman.for_flight(config.flight) if predictor is None else predictor
    seen = jax.tree.map(
        lambda leaf: np.asarray(leaf, np.complex64 if jnp.iscomplexobj(leaf) else np.float64),
        _followed(networks, streams.key(seed, "sense.slot"), channels, detected, config, predictor, snr_db),
    )
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
        points=seen.found.cloud.points,
        point_permittivity=seen.found.cloud.permittivity,
        point_conductivity=seen.found.cloud.conductivity,
        normal_estimate=seen.found.normal,
        received=seen.statistics.received,
        pilots=seen.statistics.pilots,
    )


@partial(jax.jit, static_argnames=("config", "predictor"))
def _followed(
    networks: Networks,
    key: jax.Array,
    channels: jax.Array,
    detected: jax.Array,
    config: Config,
    predictor: Predictor,
    snr_db: ArrayLike,
) -> Followed:
    """The loop over slots, in which the networks find the craft; compiled once."""
    ask = SCHEMES["august"].prepare(Setting(config, networks, None, key))
    assert ask is not None  # it needs networks alone

    def locate(
        key: jax.Array, heard: Array | Coefficients, predicted: jax.Array, snr: jax.Array, statistics: Statistics
    ) -> Answer:
        slot = jax.tree.map(lambda leaf: leaf[None], Slots(predicted, snr, heard, None, statistics))
        return jax.tree.map(lambda leaf: leaf[0], ask(key, slot))

    return follow(key, channels, detected, snr_db, config, predictor, locate)
