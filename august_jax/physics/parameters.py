"""What a known body's echo depends on, as one vector theta about a pose and a material: the parametrisation that the
information bound, the refinement of a pose and the tests share.

theta holds, in this order, a displacement [m] (3), a rotation vector w in world axes [rad] (3), changes of permittivity
and conductivity [S/m], and log-amplitude and phase [rad] of a complex gain. With R(w) the turn about w by |w|
(Rodrigues),

    place q + dq,    attitude R(w) R,    contrast chi(eps + d eps, sigma + d sigma),    H -> e^{log-gain + j phase} H.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Complex, Float, Real

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.array import AntennaArray, PlanarArray
from august_jax.physics.body import Body
from august_jax.physics.environment import Plane, environment_channel
from august_jax.physics.green import inner
from august_jax.physics.materials import contrast

PARAMETERS = ("x", "y", "z", "turn_x", "turn_y", "turn_z", "permittivity", "conductivity", "log_gain", "phase")
"""Names of the ten numbers of theta, in their order."""


class Parameters(NamedTuple):
    """theta by its parts; zero is the pose and the material themselves, with a gain of one.

    Attributes:
        position: displacement (3,) [m].
        turn: rotation vector in world axes (3,) [rad].
        permittivity, conductivity: changes of the material, [1] and [S/m].
        log_gain, phase: of the complex gain, [1] and [rad].
    """

    position: Float[Array, "3"] | tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn: Float[Array, "3"] | tuple[float, float, float] = (0.0, 0.0, 0.0)
    permittivity: ArrayLike = 0.0
    conductivity: ArrayLike = 0.0
    log_gain: ArrayLike = 0.0
    phase: ArrayLike = 0.0

    @classmethod
    def split(cls, theta: Float[Array, "10"]) -> Parameters:
        """The parts of a vector in the order of ``PARAMETERS``."""
        return cls(theta[:3], theta[3:6], *(theta[row] for row in range(6, 10)))


def rotation_from_vector(vector: Float[Array, "3"]) -> Float[jax.Array, "3 3"]:
    """The rotation about a vector (3,) by its length [rad], I + (sin t / t) K + ((1 - cos t) / t^2) K^2.

    K is the matrix of the cross product with the vector. Differentiable any number of times, at zero too.
    """
    x, y, z = vector = jnp.asarray(vector)
    square = inner(vector, vector)
    small = square < 0.05  # the series leave out 1e-12
    safe = jnp.where(small, 1.0, square)
    angle = jnp.sqrt(safe)
    s = square
    sine = jnp.where(
        small, 1.0 - s / 6.0 * (1.0 - s / 20.0 * (1.0 - s / 42.0 * (1.0 - s / 72.0))), jnp.sin(angle) / angle
    )
    cosine = jnp.where(
        small,
        0.5 - s / 24.0 * (1.0 - s / 30.0 * (1.0 - s / 56.0 * (1.0 - s / 90.0))),
        2.0 * (jnp.sin(0.5 * angle) / angle) ** 2,
    )
    zero = jnp.zeros_like(x)
    cross = jnp.stack([jnp.stack([zero, -z, y]), jnp.stack([z, zero, -x]), jnp.stack([-y, x, zero])])
    return jnp.eye(3, dtype=vector.dtype) + sine * cross + cosine * cross @ cross


def moved(
    theta: Parameters, rotation: Real[Array, "3 3"], position: Real[Array, "3"]
) -> tuple[Float[jax.Array, "3 3"], Float[jax.Array, "3"]]:
    """The pose theta away: R(w) R (3, 3) and q + dq (3,) [m]."""
    turn = rotation_from_vector(jnp.asarray(theta.turn))
    return turn @ jnp.asarray(rotation), jnp.asarray(position) + jnp.asarray(theta.position)


def parameter_channel(
    body: Body,
    array: PlanarArray | AntennaArray,
    theta: Parameters,
    rotation: Real[Array, "3 3"],
    position: Real[Array, "3"],
    permittivity: ArrayLike,
    conductivity: ArrayLike,
    receiver: PlanarArray | AntennaArray | None = None,
    planes: Sequence[Plane] = (),
) -> Complex[jax.Array, "tones receive transmit"]:
    """Channel of a factored body theta away from a pose and a material, at each of its tones.

    Args:
        body: from :func:`august_jax.physics.factor_body`.
        array: the antennas, transmitting and, without ``receiver``, receiving.
        theta: what is changed.
        rotation, position: body axes to world axes (3, 3), and the body's origin (3,) [m].
        permittivity, conductivity: of the body, [1] and [S/m].
        receiver: the antennas that receive, where they are not those that transmit.
        planes: ground and walls, known ones, of which each reflects once.

    Returns:
        H (F, N_r, N_b) complex64; differentiable in theta.

    Raises:
        ValueError: as :func:`august_jax.physics.environment_channel`.
    """
    tones = jnp.asarray(body.frequencies_hz, jnp.float32)
    chi = contrast(permittivity + theta.permittivity, conductivity + theta.conductivity, tones).astype(jnp.complex64)
    turned, place = moved(theta, rotation, position)
    material = chi[0] if body.single else chi
    channel = environment_channel(body, array, turned, place, material, planes, receiver=receiver)
    return channel.reshape(len(body.frequencies_hz), *channel.shape[-2:]) * jnp.exp(theta.log_gain + 1j * theta.phase)
