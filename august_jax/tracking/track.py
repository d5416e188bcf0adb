"""A track: what was true and what was found, slot after slot."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Complex, Float


@dataclass(frozen=True)
class Track:
    """What was true and what was found in each of T slots; NumPy arrays in the world frame.

    A scheme that answers a place and no cloud has clouds of one point there, whose material and normal are NaN.

    Attributes:
        time_s: time of each slot (T,) [s].
        position: true positions, the surface centroids (T, 3) [m].
        rotation: true attitudes, body to world (T, 3, 3).
        predicted: predicted positions q_pre, about which the cloud is sought (T, 3) [m].
        snr_db: realised SNR of the echo (T,) [dB].
        permittivity, conductivity: the craft's material, [1] and [S/m].
        truth: points of the true surface (T, M, 3) [m].
        resampled: another sample of it (T, M, 3) [m].
        points: reconstructed points (T, n, 3) [m].
        point_permittivity, point_conductivity: their materials (T, n), [1] and [S/m].
        normal_estimate: unit normal of the rotor plane read from each reconstructed cloud (T, 3).
        received, pilots: all that each echo says about ``predicted`` (T, F, K, K), as
            :class:`august_jax.signal.Statistics` has it; None where that was not kept.
        detected: whether a detection said where to listen (T,); None where that is not known.
        lost: whether the craft was noticed not to be where it was looked for (T,); None where nobody asked.
        threshold_m: what the region had to allow for the prediction (T,) [m], NaN at detections; None where no
            predictor states it.
    """

    time_s: Float[np.ndarray, " slots"]
    position: Float[np.ndarray, "slots 3"]
    rotation: Float[np.ndarray, "slots 3 3"]
    predicted: Float[np.ndarray, "slots 3"]
    snr_db: Float[np.ndarray, " slots"]
    permittivity: float
    conductivity: float
    truth: Float[np.ndarray, "slots points 3"]
    resampled: Float[np.ndarray, "slots points 3"]
    points: Float[np.ndarray, "slots found 3"]
    point_permittivity: Float[np.ndarray, "slots found"]
    point_conductivity: Float[np.ndarray, "slots found"]
    normal_estimate: Float[np.ndarray, "slots 3"]
    received: Complex[np.ndarray, "slots tones orders orders"] | None = None
    pilots: Complex[np.ndarray, "slots tones orders orders"] | None = None
    detected: Bool[np.ndarray, " slots"] | None = None
    lost: Bool[np.ndarray, " slots"] | None = None
    threshold_m: Float[np.ndarray, " slots"] | None = None

    @property
    def slots(self) -> int:
        """Number of slots T."""
        return len(self.time_s)

    @property
    def estimated_position(self) -> Float[np.ndarray, "slots 3"]:
        """Estimated positions: the means of the reconstructed clouds (T, 3) [m]."""
        return self.points.mean(axis=1)

    @property
    def normal(self) -> Float[np.ndarray, "slots 3"]:
        """True unit normals of the rotor plane (T, 3)."""
        return self.rotation[..., :, 2]

    def record(self) -> dict[str, np.ndarray]:
        """The attributes as a flat mapping of arrays, for files; those that were not kept are left out."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: np.asarray(value) for name, value in values.items() if value is not None}
