"""What the rows of a data set and of a batch hold, by name: a true channel, an estimated one and coefficients are
three things.

A :class:`Sample` is what flew: position, attitude, material, label and true channel H. Who simulates makes it
(:mod:`august_jax.data.generate`). What a base station made of it, :class:`Observed`, is kept beside it only where
``data.observed`` asks for that. A :class:`Batch` is what networks are trained and asked with; who observes makes it
(:mod:`august_jax.data.observe`), with either the estimated channel H_est or, for the encoder ``roi``, its coefficients
in the region's field subspace.

Channels are symmetric and stored as upper triangles: :func:`pack` and :func:`unpack`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Complex, Float, Int

from august_jax.arrays import Array
from august_jax.signal.roi import Coefficients
from august_jax.signal.station import Statistics


class Observed(NamedTuple):
    """What a base station made of n samples when they were simulated.

    Attributes:
        predicted: q_pre (n, 3) [m].
        snr_db: realised SNR (n,) [dB].
        snr_estimate_db: the SNR as the receiver estimates it (n,) [dB].
        power_dbm: transmit power (n,) [dBm].
        estimated_channel: upper triangles of H_est (n, F, N_b (N_b + 1)/2) complex64.
    """

    predicted: Float[Array, "n 3"]
    snr_db: Float[Array, " n"]
    snr_estimate_db: Float[Array, " n"]
    power_dbm: Float[Array, " n"]
    estimated_channel: Complex[Array, "n tones triangle"]


class Sample(NamedTuple):
    """n samples, one a row; float32, complex64 and int32.

    Attributes:
        position: surface centroids (n, 3) [m].
        rotation: body to world (n, 3, 3).
        permittivity, conductivity: of the craft (n,), [1] and [S/m].
        airframe: place of the airframe in ``target.airframes`` (n,).
        flight, slot: number of the flight and the slot in it (n,).
        points: surface points in world axes about ``position`` (n, M, 3) [m].
        true_channel: upper triangles of H (n, F, N_b (N_b + 1)/2).
        observed: what the base station made of them, where it is kept.
    """

    position: Float[Array, "n 3"]
    rotation: Float[Array, "n 3 3"]
    permittivity: Float[Array, " n"]
    conductivity: Float[Array, " n"]
    airframe: Int[Array, " n"]
    flight: Int[Array, " n"]
    slot: Int[Array, " n"]
    points: Float[Array, "n points 3"]
    true_channel: Complex[Array, "n tones triangle"]
    observed: Observed | None = None

    @property
    def rows(self) -> int:
        """Number of rows n."""
        return len(self.position)

    def columns(self) -> dict[str, Array]:
        """The arrays by name, those of ``observed`` among them: what is stored and exported."""
        own = {name: value for name, value in self._asdict().items() if name != "observed"}
        return own | (self.observed._asdict() if self.observed is not None else {})

    @classmethod
    def of_columns(cls, columns: Mapping[str, Any]) -> Sample:
        """Inverse of :meth:`columns`."""
        observed = None
        if "estimated_channel" in columns:
            observed = Observed(**{name: columns[name] for name in Observed._fields})
        return cls(**{name: columns[name] for name in cls._fields if name != "observed"}, observed=observed)

    def at(self, rows: Any) -> Sample:
        """The samples at ``rows``, in that order: whatever indexes an array's first axis and keeps it."""
        return jax.tree.map(lambda value: value[rows], self)

    def each(self, function: Callable[[Array], Array]) -> Sample:
        """``function`` of every array."""
        return jax.tree.map(function, self)


class Batch(NamedTuple):
    """What networks see of B slots, and the clouds that they are to find.

    Attributes:
        predicted: q_pre (B, 3) [m].
        snr_db: the SNR as the receiver estimates it (B,) [dB].
        cloud: the true clouds about q_pre (B, M, 5).
        estimated_channel: H_est (B, F, N_b, N_b) complex64; None where ``coefficients`` stand for it.
        coefficients: of H_est about q_pre, values (B, F, K, K).
        reference_channel: what the scheme ``refchannel`` learns from: channels at the reference place, in the form of
            what is heard; None for the others.
        statistics: all that the echoes say, for who searches for what explains them; None where nobody asked.
    """

    predicted: Float[Array, "batch 3"]
    snr_db: Float[Array, " batch"]
    cloud: Float[Array, "batch points 5"]
    estimated_channel: Complex[Array, "batch tones antennas antennas"] | None = None
    coefficients: Coefficients | None = None
    reference_channel: Complex[Array, "batch tones antennas antennas"] | Coefficients | None = None
    statistics: Statistics | None = None

    @classmethod
    def of(
        cls,
        predicted: Float[Array, "batch 3"],
        snr_db: Float[Array, " batch"],
        cloud: Float[Array, "batch points 5"],
        heard: Complex[Array, "batch tones antennas antennas"] | Coefficients,
    ) -> Batch:
        """A batch of what was heard, in whichever form that is."""
        form = {"coefficients" if isinstance(heard, Coefficients) else "estimated_channel": heard}
        return cls(predicted=predicted, snr_db=snr_db, cloud=cloud, **form)

    @property
    def heard(self) -> Array | Coefficients:
        """What the encoder takes: the coefficients, or the estimated channel where there are none.

        Raises:
            ValueError: the batch holds both or neither.
        """
        if (self.estimated_channel is None) == (self.coefficients is None):
            raise ValueError("batch: give exactly one of estimated_channel and coefficients")
        return self.coefficients if self.estimated_channel is None else self.estimated_channel

    def at(self, rows: Any) -> Batch:
        """The slots at ``rows``: whatever indexes an array's first axis and keeps it."""
        return jax.tree.map(lambda value: value[rows], self)


def pack(channel: Array) -> Array:
    """Upper triangles (..., N(N + 1)/2) of symmetric matrices (..., N, N)."""
    return channel[..., *np.triu_indices(channel.shape[-1])]


def unpack(packed: Array) -> Array:
    """Symmetric matrices (..., N, N) from :func:`pack`'s triangles.

    Raises:
        ValueError: a last axis that is no triangle's.
    """
    size = int((np.sqrt(8 * packed.shape[-1] + 1) - 1) / 2)
    if size * (size + 1) // 2 != packed.shape[-1]:
        raise ValueError(
            f"packed: got {packed.shape[-1]} numbers a matrix, which no upper triangle has; give what pack made"
        )
    rows, columns = np.triu_indices(size)
    place = np.zeros((size, size), np.int32)
    place[rows, columns] = place[columns, rows] = np.arange(len(rows))
    return packed[..., place]
