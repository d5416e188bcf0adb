r"""Positioning by the model of a single point: a matched filter over direction and range (paper, Section VI-A).

An echo of one point at q, r = |q| from the array's middle, has at the tone of wavenumber k the channel

    H_mn = g e^{2jkr} b_m b_n,    b_n = exp(jk(|q - p_n| - r)).

With a complex gain g that nobody knows and all tones share, whoever looks for q maximises the two-way matched filter

    |S(q)|^2,    S(q) = sum_f e^{-2j(k_f - k')r} b_f^H H_f conj(b_f),    k' the mean of the k_f,

over the polar coordinates (u_x, u_z, 1/r), in which the phases of b are nearly even: linear in the direction cosines u
and in 1/r, which bends them. Several tones tell r by the phase between them; one alone by that bend, which is faint
beyond a few metres. First a grid, four points to a resolution cell, then Newton's steps from its best point, damped, of
which none is taken that does not climb. Both stay in the region of interest: the directions that pass q_pre by no more
than s, the ranges within s of |q_pre|.

In a region's subspace, H = U A U^T about a centre c (:mod:`august_jax.signal.roi`), and the same S is at hand:

    b^H H conj(b) = v^H A conj(v),    v = P^T exp(jk(d(q) - d(c))),    d_n(q) = |q - p_n| - r;

a channel that is known whole is one with P = I.

The schemes: ``polar`` answers the place that is found, ``polar_angles`` its direction at the range |q_pre|. The third
variant that is compared, the prediction alone, is the baseline ``prediction``.
"""

from __future__ import annotations

import math
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.array import AntennaArray, PlanarArray, wavenumber
from august_jax.physics.checks import check_finite, settled
from august_jax.physics.green import path_difference
from august_jax.schemes.answer import Answer, Ask, Scheme, Setting, Slots
from august_jax.signal.roi import Coefficients, Subspace, project

OVERSAMPLING = 4
"""Grid points to a resolution cell of direction and of range."""
STEPS = 16
"""Of the refinement; half as many end in the same place where the echo is a point's."""
_HORIZON = 0.999
"""Direction cosines along the array add up, squared, to no more than this squared: behind it is another half space."""
_FIRST, _EASIER, _HARDER = 1e-2, 0.1, 10.0
"""Damping of the first step, and its factors after steps that climb and that do not."""
_TINY = 1e-30


class Peak(NamedTuple):
    """Where a matched filter is largest.

    Attributes:
        position: (3,) [m].
        grid: the grid's best point (3,) [m], from which it was refined.
    """

    position: Float[Array, "*batch 3"]
    grid: Float[Array, "*batch 3"]


class Response(NamedTuple):
    """One slot's channel, H = U A U^T with U = diag(exp(jk d(c))) P; places count from the antennas' middle.

    Attributes:
        values: A of each tone (F, K, K).
        centre: c (3,) [m].
        basis: P (N, K).
        positions: of the antennas (N, 3) [m].
        wavenumbers: k of each tone (F,) [rad/m].
    """

    values: Complex[Array, "tones orders orders"]
    centre: Float[Array, "3"]
    basis: Float[Array, "antennas orders"]
    positions: Float[Array, "antennas 3"]
    wavenumbers: Float[Array, " tones"]


class Cone(NamedTuple):
    """The region of interest, and the moves in it: three numbers within [-1, 1], of u_x and u_z about those of the
    sight in units of ``width``, and of 1/r about the middle of its ends.

    Attributes:
        sight: direction of q_pre (3,).
        width: largest chord between ``sight`` and a direction ().
        ends: 1/r of the farthest and of the nearest range (2,) [1/m].
    """

    sight: Float[Array, "3"]
    width: Float[Array, ""]
    ends: Float[Array, "2"]

    @classmethod
    def about(cls, predicted: Float[Array, "3"], reach_m: ArrayLike) -> Cone:
        """That of q_pre (3,) [m] and s [m]; nothing nearer than a tenth of the range belongs to it."""
        distance = jnp.linalg.norm(predicted)
        ends = 1.0 / jnp.stack([distance + reach_m, jnp.maximum(distance - reach_m, 0.1 * distance)])
        return cls(predicted / distance, jnp.minimum(reach_m / distance, 1.0), ends)

    def direction(self, moves: Float[Array, "3"]) -> Float[jax.Array, "3"]:
        """The unit vector of moves, on the side of the array where the sight is."""
        x, z = self._cosines(moves)
        y = jnp.sqrt(jnp.maximum(1.0 - x**2 - z**2, 1.0 - _HORIZON**2))
        return jnp.stack([x, jnp.where(self.sight[1] < 0.0, -y, y), z])

    def place(self, moves: Float[Array, "3"]) -> Float[jax.Array, "3"]:
        """The point (3,) [m] of moves."""
        inverse = 0.5 * (self.ends[0] + self.ends[1]) + 0.5 * (self.ends[1] - self.ends[0]) * moves[2]
        return self.direction(moves) / inverse

    def holds(self, moves: Float[Array, "3"]) -> jax.Array:
        """Whether the region holds a direction; of ranges it does where the third move is within [-1, 1]."""
        chord = jnp.linalg.norm(self.direction(moves) - self.sight)
        return (chord <= self.width * (1.0 + 1e-5)) & (jnp.linalg.norm(self._cosines(moves)) <= _HORIZON)

    def kept(self, moves: Float[Array, "3"]) -> Float[jax.Array, "3"]:
        """Moves that the region holds: as they are, or those at its edge on the way to where they lead."""
        cosines = self._cosines(moves)
        cosines = cosines * jnp.minimum(1.0, _HORIZON / jnp.maximum(jnp.linalg.norm(cosines), _TINY))
        direction = self.direction(jnp.append((cosines - self.sight[::2]) / self.width, 0.0))
        along = direction @ self.sight
        aside = direction - along * self.sight
        far = jnp.maximum(jnp.linalg.norm(aside), _TINY)
        most = 2.0 * jnp.arcsin(0.5 * self.width)
        edge = jnp.cos(most) * self.sight + jnp.sin(most) * aside / far
        inside = jnp.where(jnp.arctan2(far, along) <= most, direction, edge)
        return jnp.append((inside - self.sight)[::2] / self.width, jnp.clip(moves[2], -1.0, 1.0))

    def _cosines(self, moves: Array) -> jax.Array:
        return jnp.asarray(self.sight)[::2] + self.width * moves[:2]


def matched(response: Response, place: Float[Array, "3"]) -> Complex[jax.Array, ""]:
    """S (), but for a phase that all places share, at a place (3,) [m] from the antennas' middle."""
    differences = path_difference(response.positions, place) - path_difference(response.positions, response.centre)
    angle = response.wavenumbers[:, None] * differences
    waves = jax.lax.complex(jnp.cos(angle) @ response.basis, -jnp.sin(angle) @ response.basis)  # v^H of each tone
    tones = jnp.einsum("fk,fkl,fl->f", waves, response.values, waves)
    turn = 2.0 * (response.wavenumbers - jnp.mean(response.wavenumbers)) * jnp.linalg.norm(place)
    return jnp.sum(tones * jax.lax.complex(jnp.cos(turn), -jnp.sin(turn)))


def grid_counts(
    array: PlanarArray | AntennaArray, frequencies_hz: tuple[float, ...], nearest_m: float, reach_m: float
) -> tuple[int, int, int]:
    """Points of the grid along u_x, u_z and 1/r, odd, for regions no nearer than ``nearest_m`` of s = ``reach_m`` [m].

    Cells are lambda/D of a direction cosine, D the aperture along its axis; of 1/r what bends the phase at the
    aperture's edge by half a turn, there and back; of r half a wavelength of the band that the tones span.
    """
    positions = np.asarray(array.positions, np.float64)
    apertures = np.ptp(positions[:, ::2], axis=0)
    largest = float(np.linalg.norm(np.ptp(positions, axis=0)))
    k = np.array([wavenumber(tone) for tone in frequencies_hz])
    near, far = max(nearest_m - reach_m, 0.1 * nearest_m), nearest_m + reach_m
    cells = [2.0 * reach_m / nearest_m * aperture * k.max() / (2.0 * np.pi) for aperture in apertures]
    # k D^2/8 (1/r - 1/r') is the bend one way, 2 (k_max - k_min)(r - r') the phase between the outer tones
    bend = k.max() * largest**2 / 4.0 * (1.0 / near - 1.0 / far) / np.pi
    band = 2.0 * float(np.ptp(k)) * (far - near) / np.pi / 2.0
    x, z, inverse = (2 * math.ceil(0.5 * OVERSAMPLING * each) + 1 for each in (*cells, max(bend, band)))
    return max(x, 3), max(z, 3), max(inverse, 3)


def locate(
    channel: Complex[Array, "tones antennas antennas"] | Coefficients,
    predicted: Float[Array, "3"],
    array: PlanarArray | AntennaArray,
    frequencies_hz: tuple[float, ...],
    *,
    reach_m: float,
    nearest_m: float | None = None,
) -> Peak:
    """The point that explains most of one slot's channel; ``jax.vmap`` over channels and predictions makes a batch.

    A channel of a planar array is looked at in the subspace about the prediction, which keeps all but some 1e-6 of it.

    Args:
        channel: H_est (F, N, N), or its coefficients in the subspace of a planar array.
        predicted: q_pre (3,) [m].
        array: the antennas, transmitting and receiving.
        frequencies_hz: the tones.
        reach_m: s, how far from q_pre the point may be, across the line of sight and along it [m].
        nearest_m: the least distance of a prediction from the antennas' middle, which sets the grid's size [m]; None
            takes that of this one, which is then no traced number.

    Raises:
        ValueError: a channel of another array or of other tones, or one that is not finite; coefficients where the
            array has no subspace; a reach that is not positive.
    """
    if not reach_m > 0.0:
        raise ValueError(f"reach_m: got {reach_m:g} m, which leaves nothing to look at; give s, above 0")
    for name, value in (("channel", channel), ("predicted", predicted)):
        check_finite(name, value, "leave that slot out")
    predicted = jnp.asarray(settled("predicted", predicted))
    middle = np.asarray(array.positions).mean(axis=0)
    if nearest_m is None:
        nearest_m = float(np.linalg.norm(np.asarray(predicted) - middle))
    response = _response(channel, predicted, array, tuple(frequencies_hz))
    counts = grid_counts(array, tuple(frequencies_hz), nearest_m, reach_m)
    offset = jnp.asarray(middle, predicted.dtype)
    found = _located(response, predicted - offset, jnp.asarray(reach_m, predicted.dtype), counts)
    return found._replace(position=found.position + offset, grid=found.grid + offset)


def _response(
    channel: Array | Coefficients,
    predicted: Array,
    array: PlanarArray | AntennaArray,
    frequencies_hz: tuple[float, ...],
) -> Response:
    tones, antennas = len(frequencies_hz), array.count
    k = jnp.asarray([wavenumber(tone) for tone in frequencies_hz], predicted.dtype)
    if isinstance(array, PlanarArray):
        subspace = Subspace(array, frequencies_hz)
        if isinstance(channel, Coefficients):
            _check_shape("coefficients", channel.values, (tones, subspace.orders, subspace.orders))
        else:
            _check_shape("a channel", channel, (tones, antennas, antennas))
            channel = project(channel, predicted, subspace)
        positions, basis = (jnp.asarray(each, predicted.dtype) for each in (array.positions, subspace.basis))
        return Response(channel.values, channel.centre, basis, positions, k)
    if isinstance(channel, Coefficients):
        raise ValueError("channel: got coefficients, which only a planar array's subspace has; give H itself")
    _check_shape("a channel", channel, (tones, antennas, antennas))
    positions = jnp.asarray(array.positions, predicted.dtype)
    middle = jnp.mean(positions, axis=0)
    positions, centre = positions - middle, predicted - middle
    angle = k[:, None] * path_difference(positions, centre)
    unturned = jax.lax.complex(jnp.cos(angle), -jnp.sin(angle))
    values = unturned[:, :, None] * channel * unturned[:, None, :]
    return Response(values, centre, jnp.eye(antennas, dtype=predicted.dtype), positions, k)


def _check_shape(what: str, values: Array, wanted: tuple[int, int, int]) -> None:
    if values.shape != wanted:
        raise ValueError(
            f"channel: got {what} of shape {values.shape}; this array's are {wanted}, map over slots with jax.vmap"
        )


@partial(jax.jit, static_argnames="counts")
def _located(response: Response, predicted: jax.Array, reach_m: jax.Array, counts: tuple[int, int, int]) -> Peak:
    """:func:`locate` of places that count from the antennas' middle."""
    loudness = jnp.linalg.norm(response.values.ravel())  # of 1e-6, whose squares single precision would lose
    response = response._replace(values=response.values / jnp.maximum(loudness, _TINY))
    cone = Cone.about(predicted, reach_m)

    def height(moves: jax.Array) -> jax.Array:
        value = matched(response, cone.place(moves))
        return jnp.log(value.real**2 + value.imag**2 + _TINY)

    def curved(moves: jax.Array) -> tuple[jax.Array, jax.Array]:
        slope = jax.grad(height)(moves)
        return slope, slope

    axes = [np.linspace(-1.0, 1.0, count) for count in counts]
    grid = jnp.asarray(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3), predicted.dtype)
    heights = jax.lax.map(height, grid, batch_size=64)
    best = grid[jnp.argmax(jnp.where(jax.vmap(cone.holds)(grid), heights, -jnp.inf))]

    def step(_, state):
        moves, reached, damping = state
        rise, slope = jax.jacfwd(curved, has_aux=True)(moves)
        # at an end of the range that the slope leads beyond, the range stays
        free = jnp.append(jnp.ones(2, bool), jnp.abs(moves[2] + 1e-3 * jnp.sign(slope[2])) <= 1.0)
        slope, bend = jnp.where(free, slope, 0.0), jnp.where(free & free[:, None], -rise, 0.0)
        scale = jnp.max(jnp.abs(bend))
        system = bend + (damping * scale + _TINY) * jnp.eye(3, dtype=bend.dtype)
        tried = cone.kept(moves + jnp.linalg.solve(system, slope))
        there = height(tried)
        climbs = there > reached  # never where it is not a number
        damping = damping * jnp.where(climbs, _EASIER, _HARDER)
        return jnp.where(climbs, tried, moves), jnp.where(climbs, there, reached), jnp.maximum(damping, 1e-9)

    start = best, height(best), jnp.asarray(_FIRST, predicted.dtype)
    moves, _, _ = jax.lax.fori_loop(0, STEPS, step, start)
    return Peak(cone.place(moves), cone.place(best))


def _nearest_m(setting: Setting) -> float:
    """Least distance of a prediction from the array, of craft in the flight box [m]."""
    box = np.asarray(setting.config.flight.box_m, float)
    place = np.linalg.norm(np.clip(0.0, box[:, 0], box[:, 1]))
    return float(max(place - setting.config.region.threshold_m, 0.1 * place))


def _prepare(setting: Setting, *, ranged: bool) -> Ask | None:
    config = setting.config
    array, tones = PlanarArray.from_config(config.array), config.array.frequencies_hz
    find = partial(
        locate, array=array, frequencies_hz=tones, reach_m=config.region.scale_m, nearest_m=_nearest_m(setting)
    )
    many = jax.jit(jax.vmap(find))

    def ask(key: jax.Array, slots: Slots) -> Answer:
        if slots.heard is None:
            raise ValueError("slots: heard is None, where the scheme 'polar' looks for a point; give what is heard")
        predicted = jnp.asarray(slots.predicted)
        position = many(slots.heard, predicted).position
        if not ranged:
            distance = jnp.linalg.norm(predicted, axis=-1, keepdims=True)
            position = position * distance / jnp.linalg.norm(position, axis=-1, keepdims=True)
        return Answer(position=position)

    return ask


POLAR = Scheme("polar", "a point's angles and range, by matched filter", partial(_prepare, ranged=True), hears=True)
POLAR_ANGLES = Scheme(
    "polar_angles", "a point's angles, at the predicted range", partial(_prepare, ranged=False), hears=True
)
