"""From an airframe in the air to its reconstructed cloud: the one place where the rooms of the house are joined.

Scenario (who flies where, made of what) -> full-wave channel in each slot -> what the base station estimates of it
-> cloud about the predicted position -> position and attitude, which feed the next prediction.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from august_jax import config as configuration
from august_jax.config import Config
from august_jax.data import channels_along
from august_jax.models import Networks, reconstruct
from august_jax.scene import Airframe, fly, from_cloud, resolve_airframe, rotation_from_euler
from august_jax.signal import observe_for
from august_jax.tracking import kalman_predict, kalman_start, kalman_update, plane_normal, rotor_points

SHIPPED = Path(__file__).parent / "weights" / "laptop"
"""Weights that come with the package."""

SIZE_RATIO = (0.8, 1.25)
"""A drone's half-wheelbase may be this many times that of the weights."""


@dataclass(frozen=True)
class Scenario:
    """An airframe of one material in T poses.

    Attributes:
        airframe: the body.
        time_s: (T,) [s].
        positions: of the surface centroid (T, 3) [m].
        rotations: body to world (T, 3, 3).
        permittivity, conductivity: of the whole craft, [1] and [S/m].
    """

    airframe: Airframe
    time_s: np.ndarray
    positions: np.ndarray
    rotations: np.ndarray
    permittivity: float
    conductivity: float


@dataclass(frozen=True)
class Track:
    """What was true and what was reconstructed in each of T slots; NumPy arrays in the world frame.

    Attributes:
        time_s: time of each slot (T,) [s].
        position: true positions, the surface centroids (T, 3) [m].
        rotation: true attitudes, body to world (T, 3, 3).
        predicted: predicted positions q_pre, about which the cloud is sought (T, 3) [m].
        snr_db: realised SNR of the echo (T,) [dB].
        permittivity, conductivity: the craft's material, [1] and [S/m].
        truth: points of the true surface (T, M, 3) [m].
        again: another sample of it (T, M, 3) [m].
        points: reconstructed points (T, M, 3) [m].
        point_permittivity, point_conductivity: their materials (T, M), [1] and [S/m].
        normal_estimate: unit normal of the rotor plane read from each reconstructed cloud (T, 3).
    """

    time_s: np.ndarray
    position: np.ndarray
    rotation: np.ndarray
    predicted: np.ndarray
    snr_db: np.ndarray
    permittivity: float
    conductivity: float
    truth: np.ndarray
    again: np.ndarray
    points: np.ndarray
    point_permittivity: np.ndarray
    point_conductivity: np.ndarray
    normal_estimate: np.ndarray

    @property
    def estimate(self) -> np.ndarray:
        """Estimated positions: the means of the reconstructed clouds (T, 3) [m]."""
        return self.points.mean(axis=1)

    @property
    def normal(self) -> np.ndarray:
        """True unit normals of the rotor plane (T, 3)."""
        return self.rotation[..., :, 2]

    def record(self) -> dict[str, np.ndarray]:
        """The attributes as a flat mapping, fit for :func:`august_jax.app.export.write_record`."""
        return {name: np.asarray(value) for name, value in asdict(self).items()}


def run_files(run: str | Path | None = None) -> tuple[Path, Path]:
    """Where the configuration and the weights of a training run are, or the shipped ones.

    Raises:
        ValueError: one of them is not in ``run``.
    """
    folder = SHIPPED if run is None else Path(run)
    files = folder / "config.yaml", folder / "weights.npz"
    for path in files:
        if not path.is_file():
            raise ValueError(f"{path}: no such file; give a run that august train wrote, or use the shipped weights")
    return files


def load_networks(run: str | Path | None = None) -> Networks:
    """The networks of a training run, or the shipped ones.

    Raises:
        ValueError: no weights in ``run``.
    """
    from august_jax.training.checkpoint import load_weights

    settings, weights = run_files(run)
    config = configuration.read(settings)
    graphdef, state = load_weights(weights, config)
    return Networks("shipped laptop weights" if run is None else str(run), config, graphdef, state)


def draw_flight(config: Config, seed: int, slots: int, airframe: str | None = None) -> Scenario:
    """A random flight in the configuration's box, with a material from its ranges.

    Args:
        config: box, style, materials and airframes.
        seed: of all that is drawn.
        slots: T.
        airframe: name of a procedural family or path of a mesh; drawn from the configuration when None.
    """
    if slots < 1:
        raise ValueError(f"slots: {slots} is too short a flight; wanted at least 1")
    path, body, matter = jax.random.split(jax.random.key(seed), 3)
    target = config.target
    if airframe is None:
        airframe = target.airframes[int(jax.random.randint(body, (), 0, len(target.airframes)))]
    craft = resolve_airframe(airframe, target.half_wheelbase_m)
    flight = fly(path, replace(config.flight, slots=slots))
    share = np.asarray(jax.random.uniform(matter, (2,)), float)
    return Scenario(
        airframe=craft,
        time_s=config.flight.slot_s * np.arange(slots),
        positions=np.asarray(flight.positions, np.float64),
        rotations=np.asarray(flight.rotations, np.float64),
        permittivity=_between(target.permittivity, share[0]),
        conductivity=_between(target.conductivity_s_m, share[1]),
    )


def pose(
    config: Config,
    airframe: Airframe,
    *,
    position: Sequence[float] | None = None,
    yaw_deg: float = 0.0,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
    permittivity: float | None = None,
    conductivity: float | None = None,
) -> Scenario:
    """One pose of one craft, checked against what networks trained with ``config`` have seen.

    Place and material are the middle of their ranges where they are not given.

    Raises:
        ValueError: the craft's size, its place, attitude or material lies outside the configuration's ranges.
    """
    flight, target = config.flight, config.target
    ratio = airframe.half_wheelbase_m / target.half_wheelbase_m
    if not SIZE_RATIO[0] <= ratio <= SIZE_RATIO[1]:
        raise ValueError(
            f"half_wheelbase: {airframe.name} has {airframe.half_wheelbase_m:.3g} m, the weights know "
            f"{SIZE_RATIO[0] * target.half_wheelbase_m:.3g} to {SIZE_RATIO[1] * target.half_wheelbase_m:.3g} m\n"
            f"scale it with --half-wheelbase {target.half_wheelbase_m:g}, or check --unit"
        )
    if position is None:
        position = tuple(_between(span, 0.5) for span in flight.box_m)
    if not all(low <= value <= high for value, (low, high) in zip(position, flight.box_m)):
        box = ", ".join(f"{axis} {low:g} to {high:g}" for axis, (low, high) in zip("xyz", flight.box_m))
        raise ValueError(f"position: ({', '.join(f'{value:g}' for value in position)}) m is outside the box that the "
                         f"weights know: {box} m\nchoose a place inside it, e.g. --position "
                         + ",".join(f"{_between(span, 0.5):g}" for span in flight.box_m))
    rotation = np.asarray(rotation_from_euler(*np.radians([roll_deg, pitch_deg, yaw_deg])), np.float64)
    slope = np.tan(np.radians(flight.tilt_deg))
    if not (rotation[2, 2] > 0.0 and np.hypot(*rotation[:2, 2]) <= slope * rotation[2, 2] * (1.0 + 1e-5)):
        tilt = np.degrees(np.arccos(np.clip(rotation[2, 2], -1.0, 1.0)))
        raise ValueError(f"pitch, roll: {pitch_deg:g} and {roll_deg:g} degrees tilt the drone by {tilt:.3g} degrees, "
                         f"more than the {flight.tilt_deg:g} degrees that the weights know; use smaller angles")
    material = []
    for name, value, span in (("permittivity", permittivity, target.permittivity),
                              ("conductivity", conductivity, target.conductivity_s_m)):
        value = _between(span, 0.5) if value is None else value
        if not span[0] <= value <= span[1]:
            raise ValueError(f"{name}: {value:g} is outside the range that the weights know, "
                             f"{span[0]:g} to {span[1]:g}{' S/m' if name == 'conductivity' else ''}")
        material.append(float(value))
    return Scenario(airframe, np.zeros(1), np.asarray([position], np.float64), rotation[None], *material)


def sense(networks: Networks, config: Config, scenario: Scenario, *, seed: int, snr_db: float,
          progress: Callable[[str], None] = lambda line: None) -> Track:
    """Simulate the echo of every slot and reconstruct the craft from it.

    In the first three slots the predicted position misses the true one uniformly within ``region.threshold_m`` along
    each axis, as a detection would: speed and acceleration are not known before. From then on a Kalman filter over
    the estimates predicts.

    Args:
        networks: what reconstructs.
        config: that of the networks, possibly with other settings of signal and sampler.
        scenario: what flies.
        seed: of the first prediction, pilots, noise, samplers and labels.
        snr_db: SNR to which the power is set in each slot [dB].
        progress: takes lines of progress.

    Raises:
        ValueError: an SNR beyond what single precision can tell.
    """
    if not abs(snr_db) <= configuration.SNR_LIMIT_DB:
        raise ValueError(f"snr: {snr_db:g} dB is beyond {configuration.SNR_LIMIT_DB:g} dB; the weights know "
                         f"{config.signal.snr_db[0]:g} to {config.signal.snr_db[1]:g} dB")
    start_key, label_key, again_key, slot_key = jax.random.split(jax.random.key(seed), 4)
    progress("computing the full-wave channels")
    channels = channels_along(config, scenario.airframe, scenario.rotations, scenario.positions, scenario.permittivity,
                              scenario.conductivity)
    progress("estimating the channels and reconstructing the clouds")
    threshold = config.region.threshold_m
    detected = jnp.asarray(scenario.positions, jnp.float32) + jax.random.uniform(
        start_key, scenario.positions.shape, minval=-threshold, maxval=threshold)
    seen = _follow(networks.graphdef, networks.state, slot_key, channels, detected, config, snr_db)

    def surface(key):
        body = np.asarray(scenario.airframe.sample_surface(key, config.target.points), np.float64)
        return np.einsum("tab,nb->tna", scenario.rotations, body) + scenario.positions[:, None]

    return Track(
        time_s=np.asarray(scenario.time_s),
        position=scenario.positions,
        rotation=scenario.rotations,
        permittivity=scenario.permittivity,
        conductivity=scenario.conductivity,
        truth=surface(label_key),
        again=surface(again_key),
        **{name: np.asarray(value, np.float64) for name, value in seen.items()},
    )


_JERK_DENSITY = {"smooth": 1.0, "dynamic": 90.0, "jump": 90.0}
"""Of the filter [m^2/s^5], by style of flight: 2 sigma_a^2 / tau of the flights."""
_ESTIMATE_NOISE_M = 0.1
"""Standard deviation that the filter expects of an estimated position [m]."""
_DETECTED_SLOTS = 3
"""Slots whose predicted position comes from detection: a position, a speed and an acceleration take three."""


@partial(jax.jit, static_argnames=("graphdef", "config"))
def _follow(graphdef, state, key, channels, detected, config: Config, snr_db):
    """Slot after slot: echo, estimate, cloud, position, next prediction."""
    evaluate, flight = config.evaluate, config.flight

    def slot(belief, now):
        number, channel, detection = now
        predicted = jnp.where(number < _DETECTED_SLOTS, detection, belief.mean[0])
        echo_key, cloud_key, normal_key = jax.random.split(jax.random.fold_in(key, number), 3)
        seen = observe_for(config, echo_key, channel, predicted, snr_db=snr_db)
        cloud = reconstruct(graphdef, state, cloud_key, jax.tree.map(lambda leaf: leaf[None], seen.heard), predicted[None], seen.snr_estimate_db[None],
                            count=config.target.points, sampler=evaluate.sampler, steps=evaluate.sampler_steps)[0]
        reading = from_cloud(cloud, predicted, config.region)
        normal = rotor_plane_normal(normal_key, reading.points)
        estimate = jnp.mean(reading.points, axis=0)
        begun = kalman_start(estimate, noise_m=_ESTIMATE_NOISE_M)
        updated = kalman_update(belief, estimate, noise_m=_ESTIMATE_NOISE_M)
        belief = jax.tree.map(lambda new, old: jnp.where(number == 0, new, old), begun, updated)
        belief = kalman_predict(belief, slot_s=flight.slot_s, jerk_density=_JERK_DENSITY[flight.style])
        out = {"predicted": predicted, "snr_db": seen.snr_db, "points": reading.points,
               "point_permittivity": reading.permittivity, "point_conductivity": reading.conductivity,
               "normal_estimate": normal}
        return belief, out

    numbers = jnp.arange(channels.shape[0])
    return jax.lax.scan(slot, kalman_start(detected[0], noise_m=_ESTIMATE_NOISE_M), (numbers, channels, detected))[1]


def rotor_plane_normal(key: jax.Array, points: jax.Array) -> jax.Array:
    """Upward unit normal (3,) of the rotor plane, read from a cloud (M, 3) [m] alone."""
    return plane_normal(key, points, weights=rotor_points(points))


def _between(span: Sequence[float], share: float) -> float:
    return float(span[0] + share * (span[1] - span[0]))
