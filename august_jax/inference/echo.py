"""What an echo tells before any craft is compared with it: how loud it is, and from where it comes."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from august_jax.signal.estimators import Region, roi_coefficients
from august_jax.signal.roi import Coefficients, Subspace, towards
from august_jax.signal.station import Statistics

_PARAMETERS = 10  # of a craft that is fitted: place, turn, material, gain


def echo_energy(statistics: Statistics) -> float:
    """What the statistics hold beyond the noise's mean, in units of the noise."""
    return float(jnp.sum(jnp.abs(statistics.received) ** 2)) - statistics.received.size


def echo_snr_db(statistics: Statistics, subspace: Subspace) -> float:
    """SNR over all antennas and as many symbols, of the echo's energy in the subspace [dB]."""
    entries = statistics.received.shape[0] * subspace.array.count**2
    return float(10.0 * np.log10(max(echo_energy(statistics) / entries, 1e-3)))


def degrees_left(statistics: Statistics) -> int:
    """Real degrees of freedom that a fitted craft leaves to the noise."""
    return 2 * int(statistics.received.size) - _PARAMETERS


def chance(energy: float, degrees: int) -> float:
    """Probability that noise of so many real degrees of freedom has as much energy, in units of the noise."""
    from scipy.stats import chi2

    return float(chi2.sf(2.0 * energy, degrees))


@partial(jax.jit, static_argnames=("subspace", "half_m"))
def bearing(statistics: Statistics, subspace: Subspace, half_m: float) -> Float[jax.Array, "3"]:
    """The place (3,) [m] at the distance of the statistics' centre from whose direction most of the echo comes.

    Args:
        statistics: of one slot.
        subspace: of the station.
        half_m: half the edge of the region about the centre [m].
    """
    values = jax.vmap(
        lambda received, pilots, k: roi_coefficients(
            received, pilots, Region(statistics.centre, half_m, subspace.positions, k, subspace.basis)
        )
    )(statistics.received, statistics.pilots, subspace.wavenumbers)
    return jnp.asarray(towards(Coefficients(values, statistics.centre), subspace))
