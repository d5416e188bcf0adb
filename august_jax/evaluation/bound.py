"""What physics allows on an evaluation's own samples: Fisher information of their channels, under the pilots sent.

The bound is that of an estimator that knows the airframe but neither heading nor complex gain, under a Gaussian prior
of the configuration's spread (:mod:`august_jax.physics.information`).
"""

from __future__ import annotations

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from august_jax.arrays import Array
from august_jax.config import Config
from august_jax.data import Sample, Target
from august_jax.physics import PlanarArray, fisher_information, mean_position_error, tilt_bound
from august_jax.physics.information import Spread
from august_jax.signal.station import codebook
from august_jax.tracking import Track

SAMPLES = 100
"""Samples over which the bound is averaged."""


def unit_information(
    samples: Sample, predicted: Float[Array, "n 3"], targets: Sequence[Target], config: Config
) -> Float[np.ndarray, "m parameters parameters"] | None:
    """Fisher information (n, 10, 10) of samples, airframe by airframe, at an SNR of 1; it grows as the SNR does.

    Args:
        samples: n of them, sorted by airframe.
        predicted: q_pre (n, 3) [m], where the pilots of the region point.
        targets: from ``prepare_targets``.
        config: of array, pilots and solver.

    Returns:
        None for the estimator ``dft``, which sends other pilots, and where the data's solver is not the one whose
        channel can be differentiated here.
    """
    if config.signal.estimator == "dft" or any(target.body is None for target in targets):
        return None
    array = PlanarArray.from_config(config.array)
    repeats = (config.signal.symbols or array.count) / array.count  # fisher_information counts one symbol an antenna
    found = []
    for kind, target in enumerate(targets):
        mine = np.flatnonzero(samples.airframe == kind)
        if len(mine) and target.body is not None:
            books = [codebook(jnp.asarray(place), config.array, config.signal) for place in predicted[mine]]
            lit = np.stack([np.asarray(book @ book.conj().T) for book in books])
            found.append(
                fisher_information(
                    target.body,
                    array,
                    samples.rotation[mine],
                    samples.position[mine],
                    samples.permittivity[mine],
                    samples.conductivity[mine],
                    repeats,
                    illumination=lit,
                )
            )
    return np.concatenate(found)


def spread_of(config: Config) -> Spread:
    """What is known before the echo: the prediction's threshold, the ranges of tilt and material, any heading."""

    def uniform(low: float, high: float) -> float:
        return max(high - low, 1e-6 * max(abs(high), 1e-9)) / np.sqrt(12.0)

    return Spread(
        position_m=max(uniform(-config.region.threshold_m, config.region.threshold_m), 1e-6),
        turn_rad=uniform(*np.deg2rad([-config.flight.tilt_deg, config.flight.tilt_deg])),
        heading_rad=uniform(-np.pi, np.pi),
        permittivity=uniform(*config.target.permittivity),
        conductivity=uniform(*config.target.conductivity_s_m),
    )


class Bound:
    """The bound on the first samples, at any SNR.

    Args:
        samples, predicted, targets, config: as of :func:`unit_information`, the samples in any order.
        most: how many samples, at most.
    """

    def __init__(
        self,
        samples: Sample,
        predicted: Float[Array, "n 3"],
        targets: Sequence[Target],
        config: Config,
        most: int = SAMPLES,
    ):
        order = np.argsort(samples.airframe[:most], kind="stable")
        self._information = unit_information(samples.at(order), np.asarray(predicted)[order], targets, config)
        self._order, self._normal = order, np.asarray(samples.rotation[order, :, 2])
        self._spread = spread_of(config)

    def each(self, snr_db: Float[Array, " n"]) -> dict[str, Float[np.ndarray, " m"]] | None:
        """Sample by sample, each at its own SNR (n,) of at least as many samples [dB]: ``bound_m`` [m] and
        ``bound_mde`` as of :meth:`at`; None where they are not known."""
        if self._information is None:
            return None
        order = self._order
        known = 10.0 ** (np.asarray(snr_db, np.float64)[order] / 10.0)[:, None, None] * self._information
        tilts = np.asarray(tilt_bound(known, self._normal, self._spread))
        back = np.argsort(order)
        return {
            "bound_m": np.asarray(mean_position_error(known, self._spread))[back],
            "bound_mde": 0.5 * tilts[back] ** 2,  # 1 - cos of small angles
        }

    def at(self, snr_db: float, count: int | None = None) -> dict[str, float | None]:
        """``bound_m``, the mean position error [m], and ``bound_mde``, half the mean square of the tilt error, of the
        first ``count`` samples (all that it is on by default); None where they are not known."""
        values = self.each(np.full(len(self._order), snr_db))
        if values is None:
            return {"bound_m": None, "bound_mde": None}
        return {name: float(np.mean(each[:count])) for name, each in values.items()}


def track_bound(track: Track, target: Target, config: Config, snr_db: float) -> dict[str, float | None]:
    """``bound_m`` and ``bound_mde`` over a track's slots, of the craft that flies.

    None where they are not known.
    """
    slots = track.slots
    none = np.zeros(slots, np.int32)
    sample = Sample(
        np.asarray(track.position, np.float32),
        np.asarray(track.rotation, np.float32),
        np.full(slots, track.permittivity, np.float32),
        np.full(slots, track.conductivity, np.float32),
        airframe=none,
        flight=none,
        slot=np.arange(slots, dtype=np.int32),
        points=np.zeros((slots, 1, 3), np.float32),  # of clouds and channels nothing is asked
        true_channel=np.zeros((slots, 1, 1), np.complex64),
    )
    return Bound(sample, np.asarray(track.predicted, np.float32), [target], config, slots).at(snr_db)
