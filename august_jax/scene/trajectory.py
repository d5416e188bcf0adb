"""Random flights: positions, velocities, accelerations and attitudes, slot by slot.

Styles ``smooth`` and ``dynamic``: the acceleration is an Ornstein-Uhlenbeck process with standard deviation sigma_a
a component and correlation time tau, less a weak drag, limited in |a|, in tilt and in |v|. Hardly any such track would
stay for ten seconds in a room of a few metres, so a pilot keeps the craft off the walls. In the outer 30 % of the box
an acceleration that grows linearly to b, half of the limit of |a|, leads it back; and the component towards a wall is
capped such that it can always stop: with a distance d to go the safe speed is u = sqrt(2 b d), and

    a <= (u - v) / T - b v / u

keeps v <= u. A track that leaves the box all the same is drawn anew.

Attitude by differential flatness: the thrust axis is z_B = (a + g e_z) / |a + g e_z|, followed with a first-order
lag and held within the tilt limit; the heading wanders slowly and freely (its rate is an Ornstein-Uhlenbeck process).

Style ``jump``: straight flight at constant velocity, with instant turns at random slots and at the walls. No
multirotor can fly it within the tilt limit: the recorded acceleration is the change of velocity over a slot and may be
ten times larger than the attitude, which stays within the limit, could give. It stands for the abrupt tracks whose
prediction misses by metres.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.special import ndtr
from jaxtyping import Bool, Float

from august_jax.arrays import Array, ArrayLike
from august_jax.config import FlightConfig, Style
from august_jax.constants import GRAVITY
from august_jax.scene.pose import rotation_from_axis_yaw


class Flight(NamedTuple):
    """One flight of T slots (or many, with a leading axis); a pytree.

    Attributes:
        positions: (T, 3) [m], at the start of each slot.
        velocities: (T, 3) [m/s].
        accelerations: (T, 3) [m/s^2].
        rotations: body to world (T, 3, 3).
    """

    positions: Float[Array, "*flights slots 3"]
    velocities: Float[Array, "*flights slots 3"]
    accelerations: Float[Array, "*flights slots 3"]
    rotations: Float[Array, "*flights slots 3 3"]


class _Style(NamedTuple):
    speed: float
    """Limit of |v| [m/s]."""
    acceleration: float
    """Limit of |a| [m/s^2]."""
    spread: float
    """Standard deviation of a component of the acceleration [m/s^2]."""
    time: float
    """Correlation time of the acceleration [s]."""


_STYLES: dict[Style, _Style] = {
    "smooth": _Style(5.0, 3.0, 0.8, 1.2),
    "dynamic": _Style(10.0, 5.66, 4.0, 0.35),
    "jump": _Style(10.0, 0.0, 0.0, 0.0),
}
_STEP_S = 0.02
_DRAWS = 16
_CAP_S = 0.25
"""T of the cap at the walls."""
_MARGIN = 0.03
"""The cap aims to stop this part of the box's edge ahead of the wall."""
_ZONE = 0.3
"""Depth of the zone along a wall in which the craft is led back, in parts of the box's edge."""
_DRAG = 0.2
"""Decay rate of the velocity [1/s]."""
_ATTITUDE_S = 0.12
"""Lag of the thrust axis."""
_YAW_RATE = 0.35
"""Standard deviation of the yaw rate [rad/s]."""
_YAW_S = 2.0
_TURN = 0.3
"""Probability of a turn in a slot of a ``jump`` flight."""


def fly(key: jax.Array, flight: FlightConfig) -> Flight:
    """A random flight, a function of ``key`` alone; call it outside of ``jax.jit`` (inside: :func:`draw_track`).

    Raises:
        ValueError: the box is so small that none of 16 tracks stayed inside.
    """
    return jax.tree.map(lambda leaf: leaf[0], fly_many(key[None], flight))


def fly_many(keys: jax.Array, flight: FlightConfig) -> Flight:
    """One flight for each of ``keys`` (B,): :func:`fly` with a leading axis B."""
    _check(flight)
    flights, stayed = _draw_flights(keys, flight)
    if not bool(stayed.all()):
        raise ValueError(
            f"flight.box_m: {flight.box_m!r}: {int((~stayed).sum())} of {len(keys)} flights of {flight.slots} slots "
            f"left the box in each of {_DRAWS} draws; enlarge the box, fly fewer slots, or use flight.style=smooth"
        )
    return flights


def draw_track(key: jax.Array, flight: FlightConfig) -> tuple[Flight, Bool[jax.Array, ""]]:
    """The first of up to 16 tracks that stays in the box, and whether it does (); pure, ``flight`` static."""
    walls = jnp.asarray(flight.box_m)

    def draw(attempt):
        track = _track(jax.random.fold_in(key, attempt), flight)
        return track, jnp.all((track.positions >= walls[:, 0]) & (track.positions <= walls[:, 1]))

    def again(state):
        attempt, _, stayed = state
        return (attempt < _DRAWS) & ~stayed

    nothing = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(draw, 0)[0])
    start = (0, nothing, jnp.array(False))
    _, track, stayed = jax.lax.while_loop(again, lambda state: (state[0] + 1, *draw(state[0])), start)
    return track, stayed


@partial(jax.jit, static_argnums=1)
def _draw_flights(keys: jax.Array, flight: FlightConfig) -> tuple[Flight, jax.Array]:
    return jax.vmap(lambda key: draw_track(key, flight))(keys)


def _check(flight: FlightConfig) -> None:
    for axis, (low, high) in zip("xyz", flight.box_m):
        if not low < high:
            raise ValueError(f"flight.box_m: {flight.box_m!r} has no extent along {axis}; wanted low < high")


def _track(key: jax.Array, flight: FlightConfig) -> Flight:
    # one draw for everything: each separate one costs a second of compilation
    jumps = flight.style == "jump"
    steps = 2 if jumps else max(1, round(flight.slot_s / _STEP_S))
    normal = jax.random.normal(key, (12 + flight.slots * (3 * steps + 1),))
    first, later = normal[:12], normal[12:].reshape(flight.slots, 3 * steps + 1)
    motion = _jump if jumps else _pilot
    positions, velocities, accelerations, axes = motion(first[:9], later[:, :-1].reshape(-1, steps, 3), flight)
    rotations = rotation_from_axis_yaw(axes, _yaw(first[9:], later[:, -1], flight))
    return Flight(positions, velocities, accelerations, rotations)


def _pilot(first: jax.Array, later: jax.Array, flight: FlightConfig):
    """Ornstein-Uhlenbeck acceleration between the walls of the box, driven by normal numbers (9,), (T, steps, 3)."""
    style = _STYLES[flight.style]
    dt = flight.slot_s / later.shape[1]
    walls = jnp.asarray(flight.box_m)
    edges = walls[:, 1] - walls[:, 0]
    low, high = walls[:, 0] + _MARGIN * edges, walls[:, 1] - _MARGIN * edges
    braking = 0.5 * style.acceleration
    keep = jnp.exp(-dt / style.time)
    follow = 1.0 - jnp.exp(-dt / _ATTITUDE_S)
    slope = jnp.tan(jnp.radians(flight.tilt_deg))

    def safe(distance):
        return jnp.sqrt(2.0 * braking * jnp.maximum(distance, 1e-6))

    def cap(speed, limit):
        return (limit - speed) / _CAP_S - braking * jnp.clip(speed / limit, 0.0, 1.0)

    def steered(push, position, velocity):
        nearness = 1.0 - jnp.stack([position - walls[:, 0], walls[:, 1] - position]) / (_ZONE * edges)
        inward = jnp.maximum(nearness[0], 0.0) - jnp.maximum(nearness[1], 0.0)
        wish = push + braking * inward - _DRAG * velocity
        wish = jnp.clip(wish, -cap(-velocity, safe(position - low)), cap(velocity, safe(high - position)))
        return _within_tilt(_shorten(wish, style.acceleration), slope)

    def step(state, noise):
        position, velocity, push, axis, _ = state
        push = keep * push + style.spread * jnp.sqrt(1.0 - keep**2) * noise
        following = _shorten(velocity + dt * steered(push, position, velocity), style.speed)
        acceleration = (following - velocity) / dt
        position = position + 0.5 * dt * (velocity + following)
        axis = axis + follow * (_thrust_axis(acceleration, slope) - axis)
        return (position, following, push, axis / jnp.linalg.norm(axis), acceleration), None

    def slot(state, noise):
        position, velocity, _, axis, acceleration = state
        return jax.lax.scan(step, state, noise)[0], (position, velocity, acceleration, axis)

    position = low + ndtr(first[:3]) * (high - low)
    velocity = _shorten(style.speed / 3.0 * first[3:6], style.speed)
    velocity = jnp.clip(velocity, -safe(position - low), safe(high - position))
    push = style.spread * first[6:]
    acceleration = steered(push, position, velocity)
    state = (position, velocity, push, _thrust_axis(acceleration, slope), acceleration)
    return jax.lax.scan(slot, state, later)[1]


def _jump(first: jax.Array, later: jax.Array, flight: FlightConfig):
    """Straight lines with instant turns, driven by normal numbers (9,), (T, 2, 3); a wall ahead reflects."""
    style = _STYLES[flight.style]
    dt = flight.slot_s
    walls = jnp.asarray(flight.box_m)
    follow = 1.0 - jnp.exp(-dt / _ATTITUDE_S)
    slope = jnp.tan(jnp.radians(flight.tilt_deg))

    def any_velocity(direction, chance):
        return style.speed * ndtr(chance) * direction / jnp.linalg.norm(direction)

    def slot(state, noise):
        position, velocity, axis, acceleration = state
        following = jnp.where(ndtr(noise[1, 0]) < _TURN, any_velocity(noise[0], noise[1, 1]), velocity)
        ahead = position + dt * velocity
        onward = ahead + dt * following
        following = jnp.where((onward < walls[:, 0]) | (onward > walls[:, 1]), -following, following)
        change = (following - velocity) / dt
        tilted = axis + follow * (_thrust_axis(change, slope) - axis)
        return (ahead, following, tilted / jnp.linalg.norm(tilted), change), (position, velocity, acceleration, axis)

    position = walls[:, 0] + ndtr(first[:3]) * (walls[:, 1] - walls[:, 0])
    velocity = any_velocity(first[3:6], first[6])
    ahead = position + dt * velocity
    velocity = jnp.where((ahead < walls[:, 0]) | (ahead > walls[:, 1]), -velocity, velocity)
    return jax.lax.scan(slot, (position, velocity, jnp.array([0.0, 0.0, 1.0]), jnp.zeros(3)), later)[1]


def _yaw(first: jax.Array, later: jax.Array, flight: FlightConfig) -> jax.Array:
    """Headings (T,) [rad]: any at first, then slow and free; driven by normal numbers (2 or more,), (T,)."""
    keep = jnp.exp(-flight.slot_s / _YAW_S)

    def slot(state, noise):
        yaw, rate = state
        following = keep * rate + _YAW_RATE * jnp.sqrt(1.0 - keep**2) * noise
        return (yaw + 0.5 * flight.slot_s * (rate + following), following), yaw

    return jax.lax.scan(slot, (jnp.pi * (2.0 * ndtr(first[0]) - 1.0), _YAW_RATE * first[1]), later)[1]


def _shorten(vector: jax.Array, longest: ArrayLike) -> jax.Array:
    return vector * jnp.minimum(1.0, longest / jnp.maximum(jnp.linalg.norm(vector), 1e-9))


def _within_tilt(acceleration: jax.Array, slope: jax.Array) -> jax.Array:
    """The horizontal part shortened until the thrust that it asks for stays within the tilt limit."""
    horizontal = _shorten(acceleration[:2], slope * jnp.maximum(GRAVITY + acceleration[2], 0.0))
    return jnp.append(horizontal, acceleration[2])


def _thrust_axis(acceleration: jax.Array, slope: jax.Array) -> jax.Array:
    # free fall, which only a jump can ask for, leaves the axis no direction: half of g stays
    lifted = acceleration.at[2].set(jnp.maximum(acceleration[2], -0.5 * GRAVITY))
    thrust = _within_tilt(lifted, slope) + jnp.array([0.0, 0.0, GRAVITY])
    return thrust / jnp.linalg.norm(thrust)
