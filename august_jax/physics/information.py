r"""How well a known body can be located at all: Fisher information of its channel, and the bound with a prior.

The echo is Y = H(theta) X + N with white circular noise of variance sigma^2. With X X^H proportional to an
illumination Q and the SNR s = ||H X||^2/||N||^2 over n = N_b L noise samples, the Fisher information is

    F_ab = 2 s n Re tr(d_a H Q d_b H^H) / tr(H Q H^H),

whatever the absolute power is. theta is that of :mod:`august_jax.physics.parameters`; a gain that is known is one with
a narrow spread. With independent priors of standard deviation p_a, the errors' covariance is bounded by
(F + diag(1/p^2))^{-1} (the linearised posterior; exact for Gaussian posteriors, optimistic where several places explain
the echo equally well).

One tone's absolute phase repeats every half wavelength of range, 5 cm at 3 GHz: within a prior of decimetres it is
no information that an estimator could use, although F counts it. The unknown gain is the honest case.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Real

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.array import AntennaArray, PlanarArray, wavenumber
from august_jax.physics.body import Body
from august_jax.physics.checks import check_finite, check_nearest, check_rotation, is_concrete
from august_jax.physics.environment import Plane, check_before
from august_jax.physics.parameters import PARAMETERS, Parameters, parameter_channel


class Spread(NamedTuple):
    """Standard deviations of the parameters before the echo is seen.

    Attributes:
        position_m: along each axis [m]; uniform within +-0.5 m by default.
        turn_rad: about each axis [rad]; 20 degrees by default.
        heading_rad: about z, where that is another (any heading: pi/sqrt(3)) [rad]; None is ``turn_rad``.
        permittivity, conductivity: uniform in the paper's ranges by default, [1] and [S/m].
        log_gain, phase: of the complex gain, [1] and [rad]; by default unknown. The phase's prior is far wider than a
            turn: in a linearised bound a turn would stand for 3 cm of range.
    """

    position_m: float = 0.5 / np.sqrt(3.0)
    turn_rad: float = np.deg2rad(20.0)
    permittivity: float = 3.5 / np.sqrt(12.0)
    conductivity: float = 9e-3 / np.sqrt(12.0)
    log_gain: float = 10.0
    phase: float = 1e3
    heading_rad: float | None = None

    def deviations(self) -> np.ndarray:
        """(10,) in the order of ``PARAMETERS``."""
        heading = self.turn_rad if self.heading_rad is None else self.heading_rad
        return np.array(
            [
                *[self.position_m] * 3,
                self.turn_rad,
                self.turn_rad,
                heading,
                self.permittivity,
                self.conductivity,
                self.log_gain,
                self.phase,
            ]
        )


KNOWN_GAIN = Spread(log_gain=1e-4, phase=1e-4)


def fisher_information(
    body: Body,
    array: PlanarArray | AntennaArray,
    rotation: Real[Array, "*poses 3 3"],
    position: Real[Array, "*poses 3"],
    permittivity: ArrayLike,
    conductivity: ArrayLike,
    snr: ArrayLike,
    *,
    illumination: Array | None = None,
    receiver: PlanarArray | AntennaArray | None = None,
    planes: Sequence[Plane] = (),
) -> Float[np.ndarray, "*poses 10 10"]:
    """Fisher information of one pose, or of a batch.

    Args:
        body: a factored body; its tones are used together.
        array: the antennas, transmitting and, without ``receiver``, receiving.
        rotation: body to world (..., 3, 3).
        position: of the body's origin (..., 3) [m].
        permittivity, conductivity: of the body (...,), [1] and [S/m].
        snr: linear, over all antennas, symbols (N_b of them) and tones.
        illumination: Q (..., N_b, N_b), proportional to X X^H; None lights all directions alike.
        receiver: the antennas that receive, where they are not those that transmit. What several receivers know adds
            up, once each one's own gain is marginalised: :func:`without_gain`.
        planes: ground and walls (:class:`august_jax.physics.Plane`) that the estimator knows.

    Returns:
        (..., 10, 10) float64, in the order of ``PARAMETERS``.

    Raises:
        ValueError: numbers that are not finite, a matrix that is no rotation, a body of air (its echo is zero), a body
            nearer than ``body.nearest_m`` to an antenna, an SNR that is not positive, or ends or planes that
            :func:`august_jax.physics.environment_channel` refuses.
    """
    _check(body, array, receiver, rotation, position, permittivity, conductivity, snr)
    planes = tuple(planes)
    check_before(planes, (array, receiver), position, body.radius_m, "position")
    batch = np.shape(position)[:-1]
    lit = jnp.eye(array.count) if illumination is None else jnp.asarray(illumination)
    parts = (
        jnp.broadcast_to(jnp.asarray(rotation, jnp.float32), (*batch, 3, 3)).reshape(-1, 3, 3),
        jnp.asarray(position, jnp.float32).reshape(-1, 3),
        jnp.broadcast_to(jnp.asarray(permittivity, jnp.float32), batch).reshape(-1),
        jnp.broadcast_to(jnp.asarray(conductivity, jnp.float32), batch).reshape(-1),
        jnp.broadcast_to(lit.astype(jnp.complex64), (*batch, array.count, array.count)).reshape(-1, *lit.shape[-2:]),
    )
    gram, energy = (np.asarray(value, np.float64) for value in _gram(body, array, receiver, planes, *parts))
    noise_samples = array.count * (receiver or array).count * len(body.frequencies_hz)
    information = 2.0 * np.reshape(snr, (-1, 1, 1)) * noise_samples * gram / energy[:, None, None]
    # The range's absolute phase, left out of the derivatives for the sake of their digits, comes back here exactly.
    k = np.mean([wavenumber(tone) for tone in body.frequencies_hz])
    change = np.tile(np.eye(len(PARAMETERS)), (len(parts[1]), 1, 1))
    change[:, 9, :3] = k * sum(_toward(end, np.asarray(parts[1], np.float64)) for end in (array, receiver or array))
    information = change.transpose(0, 2, 1) @ information @ change
    return information.reshape(*batch, len(PARAMETERS), len(PARAMETERS))


def _check(body, array, receiver, rotation, position, permittivity, conductivity, snr):
    """Refuse poses and materials of which nothing can be known."""
    check_rotation(rotation)
    for name, value, way_out in (
        ("position", position, "give places (..., 3) in m"),
        ("permittivity", permittivity, "give a number"),
        ("conductivity", conductivity, "give a number"),
        ("snr", snr, "give a linear ratio, 100 for 20 dB"),
    ):
        check_finite(name, value, way_out)
    if is_concrete(snr) and np.any(np.asarray(snr) <= 0.0):
        raise ValueError(f"snr: got {np.min(snr):g}; give a positive linear ratio, 100 for 20 dB")
    if is_concrete((permittivity, conductivity)):
        air = (np.asarray(permittivity) == 1.0) & (np.asarray(conductivity) == 0.0)
        if np.any(air):
            raise ValueError(
                "permittivity: is 1 at a conductivity of 0, a body of air: its echo is zero and holds no "
                "information; give another material"
            )
    for end in (array, receiver):
        if end is not None and is_concrete((position, end)):
            for place in np.reshape(position, (-1, 3)):
                check_nearest(body.nearest_m, end, place, "position")


def error_covariance(
    information: Float[Array, "*poses 10 10"], spread: Spread = Spread()
) -> Float[np.ndarray, "*poses 10 10"]:
    """(F + diag(1/p^2))^{-1}, the bound on the errors' covariance (..., 10, 10), float64."""
    deviation = spread.deviations()
    scaled = deviation[:, None] * np.asarray(information, np.float64) * deviation
    # Derivatives in single precision leave an information that should be zero slightly negative.
    values, vectors = np.linalg.eigh(0.5 * (scaled + np.swapaxes(scaled, -1, -2)))
    inverse = (vectors / (1.0 + np.maximum(values, 0.0))[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return deviation[:, None] * inverse * deviation


def position_bound(
    information: Float[Array, "*poses 10 10"], spread: Spread = Spread()
) -> Float[np.ndarray, "*poses"] | np.floating:
    """Bound on the root-mean-square position error (...,) [m]."""
    return np.sqrt(np.trace(error_covariance(information, spread)[..., :3, :3], axis1=-2, axis2=-1))


def mean_position_error(
    information: Float[Array, "*poses 10 10"], spread: Spread = Spread()
) -> Float[np.ndarray, "*poses"] | np.floating:
    """Mean |error| (...,) [m] of a position whose errors are Gaussian with the bound's covariance.

    The metric MPE is a mean of distances; it compares with this rather than with the root mean square.
    """
    factor = np.linalg.cholesky(error_covariance(information, spread)[..., :3, :3])
    draws = np.random.default_rng(0).normal(size=(3, 4096))
    return np.linalg.norm(factor @ draws, axis=-2).mean(axis=-1)


def tilt_bound(
    information: Float[Array, "*poses 10 10"], normal: Float[Array, "*poses 3"], spread: Spread = Spread()
) -> Float[np.ndarray, "*poses"] | np.floating:
    """Bound on the root-mean-square error of the direction of ``normal`` (..., 3), [rad]."""
    turns = error_covariance(information, spread)[..., 3:6, 3:6]
    # A turn w moves the normal by w x n: what is along n does not count.
    along = np.einsum("...a,...ab,...b->...", normal, turns, normal)
    return np.sqrt(np.trace(turns, axis1=-2, axis2=-1) - along)


def without_gain(information: Float[Array, "*poses 10 10"]) -> Float[np.ndarray, "*poses 8 8"]:
    """What is left of the information (..., 8, 8), float64, when the complex gain is unknown: its Schur complement.

    Echoes that do not share a gain (several stations) add these.
    """
    information = np.asarray(information, np.float64)
    own, cross, gain = information[..., :8, :8], information[..., :8, 8:], information[..., 8:, 8:]
    return own - cross @ np.linalg.solve(gain, np.swapaxes(cross, -1, -2))


def unknown_gain_position_bound(
    body: Body,
    array: PlanarArray | AntennaArray,
    rotation: Real[Array, "3 3"],
    position: Real[Array, "3"],
    permittivity: ArrayLike,
    conductivity: ArrayLike,
    snr: ArrayLike,
    spread: Spread = Spread(),
) -> Float[jax.Array, ""]:
    """:func:`position_bound` of one pose for an unknown gain, as a JAX function: what a design descends.

    Arguments as in :func:`fisher_information`, without a batch; differentiable in all of them and in an
    :class:`AntennaArray`. In single precision: for SNRs up to about 30 dB.

    Returns:
        Root-mean-square position error [m], float32.

    Raises:
        ValueError: as :func:`fisher_information`.
    """
    _check(body, array, None, rotation, position, permittivity, conductivity, snr)
    value, slopes = _slopes(body, array, None, rotation, position, permittivity, conductivity)
    scaled = slopes[..., :8] * jnp.asarray(spread.deviations()[:8], jnp.float32)
    # An unknown gain explains whatever in a slope is parallel to H.
    energy = jnp.sum(jnp.abs(value) ** 2)
    parallel = jnp.einsum("fmn,fmnp->p", value.conj(), scaled) / energy
    scaled = scaled - value[..., None] * parallel
    gram = jnp.real(jnp.einsum("fmnp,fmnq->pq", scaled, scaled.conj()))
    information = 2.0 * snr * value.size / energy * gram
    covariance = jnp.linalg.inv(information + jnp.eye(8, dtype=information.dtype))
    return spread.position_m * jnp.sqrt(jnp.trace(covariance[:3, :3]))


def _toward(array, place):
    """Unit vectors (..., 3) from an array's centre to places (..., 3); zero in the centre."""
    module = np if isinstance(array, PlanarArray) and isinstance(place, np.ndarray) else jnp
    offset = place - module.mean(module.asarray(array.positions), axis=0)
    distance = module.sqrt(module.sum(offset**2, axis=-1, keepdims=True))
    return offset / module.where(distance > 0.0, distance, 1.0)


def _slopes(body, array, receiver, rotation, position, permittivity, conductivity, planes=()):
    """H (F, N_r, N_b) and its derivatives (F, N_r, N_b, 10) at one pose, over H's largest entry.

    The common phase of the two ways there and back is taken out of the derivatives in position.
    """
    middle = float(np.mean([wavenumber(tone) for tone in body.frequencies_hz]))
    ends = (array, receiver if receiver is not None else array)
    outward = sum(_toward(end, jax.lax.stop_gradient(position)) for end in ends)

    def channel(theta):
        h = parameter_channel(
            body, array, Parameters.split(theta), rotation, position, permittivity, conductivity, receiver, planes
        )
        farther = theta[:3] @ outward  # of both ways, to first order, all that a derivative sees
        return h * jnp.exp(-1j * middle * farther)

    start = jnp.zeros(len(PARAMETERS), jnp.float32)
    value, slopes = channel(start), jax.jacfwd(channel)(start)
    # H is near 1e-6: scale it before squaring in single precision.
    scale = jax.lax.stop_gradient(jnp.max(jnp.abs(value)))
    return value / scale, slopes / scale


@jax.jit
def _gram(body, array, receiver, planes, rotation, position, permittivity, conductivity, illumination):
    """Re tr(d_a H Q d_b H^H) (B, 10, 10) and tr(H Q H^H) (B,), with the common phase of the way taken out of H."""

    def one(turn, place, epsilon, sigma, lit):
        value, slopes = _slopes(body, array, receiver, turn, place, epsilon, sigma, planes)
        lit_slopes = jnp.einsum("fmnp,nk->fmkp", slopes, lit)
        gram = jnp.real(jnp.einsum("fmkp,fmkq->pq", lit_slopes, slopes.conj()))
        energy = jnp.real(jnp.sum(jnp.einsum("fmn,nk->fmk", value, lit) * value.conj()))
        return 0.5 * (gram + gram.T), energy

    return jax.lax.map(lambda parts: one(*parts), (rotation, position, permittivity, conductivity, illumination))
