"""What studies of a search share: slots that are observed and searched, and lines from which a stopped run goes on."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from august_jax import streams
from august_jax.config import Config
from august_jax.data import Sample, Target, fresh_samples, unpack
from august_jax.data.fields import pack
from august_jax.data.observe import draw_prediction
from august_jax.data.simulator import simulated_channel
from august_jax.evaluation.bound import spread_of, unit_information
from august_jax.inference import Library, Posterior, Prior, find_craft
from august_jax.physics.information import error_covariance, mean_position_error, tilt_bound
from august_jax.signal.station import Statistics, observe_region

SEED = 1


def fresh(config: Config, targets: Sequence[Target], count: int) -> Sample:
    """``count`` samples, each from its own flight, as an evaluation draws them; craft take turns."""
    flown = replace(config, data=replace(config.data, solver="mom"))
    return fresh_samples(flown, np.arange(count), targets, seed=SEED, domain="evaluate")


def heard_elsewhere(samples: Sample, config: Config, targets: Sequence[Target], farther: float) -> Sample:
    """The same craft in the same attitudes, so many times as far away in the same direction, before another array."""
    own = replace(config, data=replace(config.data, solver="mom"))
    moved = samples._replace(position=np.float32(farther) * np.asarray(samples.position))
    channels = [
        _channel(
            targets[int(moved.airframe[row])].body,
            own,
            *(jnp.asarray(part[row]) for part in (moved.rotation, moved.position, moved.permittivity)),
            jnp.asarray(moved.conductivity[row]),
        )
        for row in range(moved.rows)
    ]
    return moved._replace(true_channel=np.stack(channels))


@partial(jax.jit, static_argnames="config")
def _channel(body, config: Config, rotation, position, permittivity, conductivity):
    return pack(simulated_channel(config, body, rotation, position, permittivity, conductivity))


@streams.pin
def look(library: Library, prior: Prior, samples: Sample, slot: int, snr_db: float) -> tuple[np.ndarray, Posterior]:
    """q_pre (3,) [m] of a slot and the posterior; prediction and noise are drawn alike at every SNR."""
    predicted_key, echo_key = jax.random.split(streams.key(SEED, "evaluate.observation", slot))
    predicted = draw_prediction(predicted_key, jnp.asarray(samples.position[slot]), library.config)
    channel = unpack(jnp.asarray(samples.true_channel[slot]))
    statistics = observed(echo_key, channel, predicted, library.config, snr_db)
    found = find_craft(library, statistics, prior, key=streams.key(SEED, "inference.samples", slot))
    return np.asarray(predicted, float), found


@partial(jax.jit, static_argnames="config")
def observed(key, channel, predicted, config: Config, snr_db) -> Statistics:
    """All that an echo about q_pre says, at an SNR that the power is set to."""
    array, signal, region = config.array, config.signal, config.region
    seen = observe_region(key, channel, predicted, array=array, signal=signal, region=region, snr_db=snr_db)
    return seen.statistics


class SlotBound:
    """The bound of single slots, as :mod:`august_jax.evaluation.bound` has it.

    Args:
        config, targets: of the slots.
        samples: the slots.
    """

    def __init__(self, config: Config, targets: Sequence[Target], samples: Sample):
        self._config, self._targets, self._samples = config, targets, samples
        self._unit: dict[int, np.ndarray] = {}

    def at(self, slot: int, snr_db: float, predicted: np.ndarray) -> dict[str, float]:
        """``bound_m``, mean position error [m], ``bound_mde``, and ``bound_rms_m``, root-mean-square position error."""
        if slot not in self._unit:
            one = self._samples.at(slice(slot, slot + 1))
            found = unit_information(one, predicted[None], self._targets, self._config)
            assert found is not None
            self._unit[slot] = found
        known, spread = 10.0 ** (snr_db / 10.0) * self._unit[slot], spread_of(self._config)
        tilt = tilt_bound(known, np.asarray(self._samples.rotation[slot : slot + 1, :, 2], float), spread)
        squares = np.trace(error_covariance(known, spread)[0, :3, :3])
        return {
            "bound_m": float(mean_position_error(known, spread)[0]),
            "bound_mde": float(0.5 * tilt[0] ** 2),
            "bound_rms_m": float(np.sqrt(squares)),
        }


class Lines:
    """Lines of JSON in a file, one a piece of work that is done; without a file they are kept in memory alone.

    Args:
        path: the file; its last line is taken away where a run was stopped in the middle of it.
    """

    def __init__(self, path: Path | None):
        self._path = path
        self.rows: list[dict[str, Any]] = []
        if path is not None and path.exists():
            text = path.read_text()
            whole = text[: text.rfind("\n") + 1]
            if whole != text:
                path.write_text(whole)
            self.rows = [json.loads(line) for line in whole.splitlines()]
        elif path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)

    def add(self, row: dict[str, Any]) -> None:
        """Keep a line."""
        self.rows.append(row)
        if self._path is not None:
            with self._path.open("a") as out:
                out.write(json.dumps(row) + "\n")


def columns(rows: Iterable[dict[str, Any]]) -> dict[str, np.ndarray]:
    """One array a name, one entry a row; NaN where a row lacks it."""
    rows = list(rows)
    names = dict.fromkeys(name for row in rows for name in row)
    return {name: np.array([row.get(name, np.nan) for row in rows]) for name in names}
