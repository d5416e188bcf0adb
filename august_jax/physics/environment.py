r"""Ground and walls by image sources: what a station hears of a body beside planes that reflect.

A plane through p with the unit normal n mirrors places, x -> x - 2 n n.(x - p), and vectors, by S = I - 2 n n^T. What
it sends on of a dipole v_n at p_n seems to come from a dipole v_n' at the mirrored place p_n',

    E_n(x) = G(x, p_n) v_n + sum over planes G(x, p_n') v_n',    v_n' = M S v_n.

For a constant coefficient M = Gamma. Gamma = -1 is a perfect conductor, exactly: a dipole along the plane is reversed,
one along its normal is kept, and no field is left along the plane. For a half-space of complex relative permittivity
eps, M has Fresnel's coefficients at the angle t of the ray from the antenna by way of the plane to the body's origin,

    M = r_TE s s^T - r_TM (I - s s^T),    r_TE = (c - q)/(c + q),    r_TM = (eps c - q)/(eps c + q),
    c = cos t,    q = sqrt(eps - sin^2 t),    Im q >= 0 under e^{-jwt},

s being the unit vector across the plane of incidence. With w = n x d, d the ray's direction, it is written as

    M = -r_TM I + b w w^T,    b = (r_TE + r_TM)/sin^2 t = 2 (1 - eps)/((c + q)(q + eps c)),

smooth at normal incidence, where there is no s. Coefficients of a plane wave at one angle an antenna hold where antenna
and body are some wavelengths from the plane and the body is small against its distance; the surface wave is left out.

The body answers the whole field, and by reciprocity is heard along the same paths: with A the weights of the images,

    H = sum over paths there i and paths back j of A_j^T H(i -> j) A_i,

each H(i -> j) the free-space channel between arrays (:func:`august_jax.physics.body_channel`), and free space where all
coefficients are zero. What is left out: waves that go between body and plane and back to the body, more than one
reflection but for a corner's two, edges, roughness, and the planes' own echo of the station, which does not move and is
taken for removed. The first are at most about |k^2 alpha/(8 pi h)| of the echo, alpha being the body's polarisability,
no more than chi times its material's volume, and h its height: 3 % at 1 m for 100 cm^3 of permittivity 3 at 3 GHz.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int, Real

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.array import AntennaArray, PlanarArray
from august_jax.physics.body import Body, body_channel
from august_jax.physics.body.body import _body_channel
from august_jax.physics.body.table import Table, table_channel
from august_jax.physics.cells import Cells
from august_jax.physics.channel import Solver, sensing_channel
from august_jax.physics.checks import check_finite, is_concrete, settled
from august_jax.physics.green import inner

_SQUARE = 1e-3  # largest cosine between the normals of two planes that make a corner
_PASSIVE = 1e-6  # what rounding may put beyond a modulus of one


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Plane:
    """An infinite plane that reflects; a pytree, so that channels have gradients in all of it.

    Either ``permittivity`` or ``coefficient`` says how.

    Attributes:
        point: a place on it (3,) [m].
        normal: its direction (3,), of any length, towards the side of station and body.
        permittivity: complex relative permittivity of the half-space behind it, eps_r + j sigma/(2 pi f eps0), one more
            than :func:`august_jax.physics.contrast`; a scalar, or one a tone (F,).
        coefficient: constant Gamma in the mirrored wave, at all angles and for both polarisations; a scalar, or one a
            tone (F,). -1 is a perfect conductor, 0 no plane.

    Raises:
        ValueError: mismatched shapes, numbers that are not finite, a normal of length zero, both or neither of
            permittivity and coefficient, a permittivity of negative imaginary part (a medium that amplifies, under
            e^{-jwt}), or a coefficient above one in modulus.
    """

    point: Real[Array, "*points 3"] | Sequence[float]
    normal: Real[Array, "*normals 3"] | Sequence[float]
    permittivity: ArrayLike | Sequence | None = None
    coefficient: ArrayLike | Sequence | None = None

    def __post_init__(self):
        for name in ("point", "normal", "permittivity", "coefficient"):
            part = getattr(self, name)
            if isinstance(part, (list, tuple)):
                part = np.asarray(part)
            if isinstance(part, (jax.Array, np.ndarray)):
                object.__setattr__(self, name, settled(name, part))
        if not all(hasattr(part, "shape") for part in (self.point, self.normal)):
            return  # JAX rebuilds pytrees with placeholders
        for name in ("point", "normal"):
            part = getattr(self, name)
            if part.shape[-1:] != (3,):
                raise ValueError(f"{name}: got shape {part.shape}; give (3,)")
            check_finite(name, part, "give three numbers")
        if is_concrete(self.normal) and not np.all(np.linalg.norm(np.asarray(self.normal, np.float64), axis=-1) > 0.0):
            raise ValueError("normal: is zero; give the direction from the plane towards station and body")
        if (self.permittivity is None) == (self.coefficient is None):
            both = "neither" if self.permittivity is None else "both"
            raise ValueError(f"permittivity, coefficient: got {both}; give one of them")
        for name in ("permittivity", "coefficient"):
            if getattr(self, name) is not None:
                check_finite(name, getattr(self, name), "give a number")
        if self.permittivity is not None and is_concrete(self.permittivity):
            least = np.min(np.imag(self.permittivity))
            if least < 0.0:
                raise ValueError(
                    f"permittivity: got an imaginary part of {least:g}, a medium that amplifies; under e^(-jwt) losses "
                    "are positive: give eps_r + 1j * sigma / (2 * pi * f * eps0)"
                )
        if self.coefficient is not None and is_concrete(self.coefficient):
            most = np.max(np.abs(self.coefficient))
            if most > 1.0 + _PASSIVE:
                raise ValueError(f"coefficient: got a modulus of {most:g}; a plane reflects no more than it gets, 1")

    @property
    def unit(self) -> Float[jax.Array, "3"]:
        """The normal at a length of one (3,)."""
        normal = jnp.asarray(self.normal) * 1.0
        return normal / jnp.sqrt(inner(normal, normal))

    def height(self, places: Real[Array, "*n 3"]) -> Float[jax.Array, "*n"]:
        """How far places (..., 3) [m] are from the plane, positive on the normal's side (...,) [m]."""
        return (jnp.asarray(places) - jnp.asarray(self.point)) @ self.unit


def fresnel(permittivity: ArrayLike, cosine: ArrayLike) -> tuple[Complex[jax.Array, "..."], Complex[jax.Array, "..."]]:
    """Fresnel's coefficients of a half-space, (r_TE, r_TM); arguments broadcast.

    Both are -1 at grazing incidence; of a perfect conductor r_TE = -1 and r_TM = 1, the ratio of magnetic fields.

    Args:
        permittivity: complex relative permittivity eps, Im eps >= 0 under e^{-jwt}.
        cosine: of the angle between ray and normal, in [0, 1].
    """
    across, along, _ = _fresnel(jnp.asarray(permittivity), jnp.asarray(cosine))
    return across, along


def _fresnel(permittivity, c):
    """r_TE, r_TM and b, as products in which nothing cancels: all are exactly 0 at a permittivity of 1."""
    eps = permittivity.astype(jnp.result_type(permittivity, c, jnp.complex64))
    q = jnp.sqrt(eps - (1.0 - c * c))
    less, sum_across, sum_along = 1.0 - eps, c + q, eps * c + q
    across = less / (sum_across * sum_across)
    along = less * (1.0 - (eps + 1.0) * (c * c)) / (sum_along * sum_along)
    return across, along, 2.0 * less / (sum_across * sum_along)


def mirrored(array: PlanarArray | AntennaArray, plane: Plane) -> AntennaArray:
    """An array's image behind a plane: places and dipoles as a mirror shows them.

    A table for channels beside planes is made for the array and its images: ``tabulate`` of
    ``AntennaArray.joined(array, mirrored(array, plane))``.
    """
    places, moments = _dipoles(array)
    return AntennaArray(_places_behind(plane, places), _vectors_behind(plane, moments), array.frequency_hz)


def _places_behind(plane, places):
    return places - 2.0 * plane.height(places)[..., None] * plane.unit


def _vectors_behind(plane, vectors):
    return vectors - 2.0 * (vectors @ plane.unit)[..., None] * plane.unit


class _Path(NamedTuple):
    """An array, or an image of it, and what its dipoles weigh in the fields of the antennas.

    Attributes:
        array: of c N dipoles, N together.
        weights: (F or 1, c, N) complex; None of the array itself.
    """

    array: PlanarArray | AntennaArray
    weights: jax.Array | None


def environment_channel(
    scatterer: Body | Table,
    array: PlanarArray | AntennaArray,
    rotation: Real[Array, "3 3"],
    translation: Real[Array, "3"],
    contrast: ArrayLike | Sequence,
    planes: Sequence[Plane],
    *,
    receiver: PlanarArray | AntennaArray | None = None,
    corners: bool = False,
    craft: int | Int[Array, ""] | None = None,
) -> Complex[jax.Array, "*tones receive transmit"]:
    """Sensing channel of a factored or tabulated body beside reflecting planes.

    Args:
        scatterer: from :func:`august_jax.physics.factor_body`, or from :func:`august_jax.physics.tabulate` for the
            array joined with its images (:func:`mirrored`): a table knows a body within one patch of directions.
        array, rotation, translation, contrast, receiver: as of :func:`august_jax.physics.body_channel`.
        planes: each reflects once; none is free space.
        corners: whether waves that two planes reflect in turn are heard, too; the planes then stand at right angles.
        craft: which table of a stack.

    Returns:
        H [1/m] (N_b, N_b), or (F, N_b, N_b) for a body of several tones; complex64, symmetric without ``receiver``;
        rows receive, columns transmit. Differentiable in all but the scatterer, ``jax.vmap`` makes batches. Of a body,
        coefficients that are zero leave :func:`august_jax.physics.body_channel` to the bit; planes whose coefficient is
        the number 0 are left out. Images at 20 m are placed to 1e-6 m in single precision, 1e-4 rad.

    Raises:
        ValueError: as :func:`august_jax.physics.body_channel` or :func:`august_jax.physics.table_channel`; a body (its
            whole radius) or an antenna that is not before a plane, planes of other tones, corners that are not right.
    """
    planes = _checked(planes, corners, len(scatterer.frequencies_hz))
    check_before(planes, (array, receiver), translation, scatterer.radius_m)
    planes = _reflecting(planes)
    if isinstance(scatterer, Table):
        return _by_table(
            scatterer, array, rotation, translation, contrast, planes, receiver=receiver, corners=corners, craft=craft
        )
    if craft is not None:
        raise ValueError(f"craft: got {craft!r}, but a factored body is of one craft alone; leave it out")
    free = body_channel(scatterer, array, rotation, translation, contrast, receiver=receiver)
    if not planes:
        return free
    turn, place = settled("rotation", rotation), settled("translation", translation)
    chi = settled("contrast", contrast)
    sent = _paths(array, planes, place, corners)
    heard = sent if receiver is None else _paths(receiver, planes, place, corners)

    def block(back: int, there: int) -> jax.Array:
        if back == there == 0:
            return free
        same = receiver is None and back == there
        return _body_channel(scatterer, sent[there].array, None if same else heard[back].array, turn, place, chi)

    return _summed(block, heard, sent, receiver is None)


def environment_sensing_channel(
    array: PlanarArray | AntennaArray,
    cells: Cells,
    contrast: ArrayLike | Sequence,
    planes: Sequence[Plane],
    *,
    place: Real[Array, "3"] | None = None,
    solver: Solver = "mom",
    frequencies_hz: Sequence[ArrayLike] | Array | None = None,
    receiver: PlanarArray | AntennaArray | None = None,
    corners: bool = False,
) -> Complex[jax.Array, "*tones receive transmit"]:
    """Sensing channel of cells in the world frame beside reflecting planes: solved once, for antennas and images.

    Args:
        array, cells, contrast, solver, frequencies_hz, receiver: as of :func:`august_jax.physics.sensing_channel`.
        planes, corners: as of :func:`environment_channel`.
        place: where the rays go whose angles Fresnel's coefficients are taken at (3,) [m]; None is the cells' mean, a
            factored body's is its origin.

    Returns:
        H [1/m] (N_b, N_b), or (F, N_b, N_b), of the precision of ``cells``; as of :func:`environment_channel`.

    Raises:
        ValueError: as :func:`august_jax.physics.sensing_channel` and :func:`environment_channel`.
    """
    tones = None if frequencies_hz is None else len(frequencies_hz)
    planes = _checked(planes, corners, 1 if tones is None else tones)
    sites = settled("cells.positions", cells.sites())
    check_before(planes, (array, receiver), sites, 0.0, "cells.positions")
    planes = _reflecting(planes)
    options = {"solver": solver, "frequencies_hz": frequencies_hz}
    if not planes:
        return sensing_channel(array, cells, contrast, receiver=receiver, **options)
    middle = jnp.mean(jnp.asarray(sites), axis=0) if place is None else jnp.asarray(settled("place", place))
    sent = _paths(array, planes, middle, corners)
    heard = sent if receiver is None else _paths(receiver, planes, middle, corners)
    ends = [AntennaArray.joined(*(path.array for path in paths)) for paths in (sent, heard)]
    whole = sensing_channel(ends[0], cells, contrast, receiver=None if receiver is None else ends[1], **options)
    columns, rows = (np.cumsum([0, *(path.array.count for path in paths)]) for paths in (sent, heard))

    def block(back: int, there: int) -> jax.Array:
        return whole[..., rows[back] : rows[back + 1], columns[there] : columns[there + 1]]

    return _summed(block, heard, sent, receiver is None)


def _by_table(table, array, rotation, translation, contrast, planes, *, receiver, corners, craft):
    """One channel of array and images, weighed by ``combine``; each image has as many dipoles as the array then."""
    channel = partial(table_channel, table, rotation=rotation, translation=translation, contrast=contrast, craft=craft)
    if not planes:
        return channel(array=array, receiver=receiver)
    tones, place = len(table.frequencies_hz), settled("translation", translation)
    ends, weights = [], []
    for end in (array,) if receiver is None else (array, receiver):
        paths = _paths(end, planes, place, corners)
        most = max(path.array.count for path in paths) // end.count
        own = _Path(end, jnp.ones((1, 1, end.count)))
        # The middle of the antennas, which the table's patch is about, is that of array and images alike.
        parts = [_padded(path, most) for path in (own, *paths[1:])]
        ends.append(AntennaArray.joined(*(path.array for path in parts)))
        every = jnp.concatenate([jnp.broadcast_to(part.weights, (tones, most, end.count)) for part in parts], axis=1)
        chosen = every[..., None] * jnp.eye(end.count)  # (F, dipoles, N, antennas)
        weights.append(chosen.reshape(tones, -1, end.count).swapaxes(1, 2).astype(jnp.complex64))
    if receiver is None:
        return channel(array=ends[0], combine=weights[0])
    return channel(array=ends[0], receiver=ends[1], combine=(weights[1], weights[0]))


def _padded(path, most):
    """A path with as many dipoles a place as the others: an image of constant coefficient by its components."""
    if path.array.count == most * path.weights.shape[-1]:
        return path
    places, moments = _dipoles(path.array)
    places, crossed = _crossed(places)
    return _Path(AntennaArray(places, crossed, path.array.frequency_hz), path.weights * moments.T[None])


def _checked(planes: Sequence[Plane], corners: bool, tones: int) -> tuple[Plane, ...]:
    """Planes as a tuple; each must be one, of as many tones, and those of corners at right angles."""
    planes = (planes,) if isinstance(planes, Plane) else tuple(planes)
    for row, plane in enumerate(planes):
        if np.shape(plane.point) != (3,) or np.shape(plane.normal) != (3,):
            raise ValueError(
                f"planes: number {row} has a point of shape {np.shape(plane.point)} and a normal of shape "
                f"{np.shape(plane.normal)}; give (3,), and vmap for batches"
            )
        for name in ("permittivity", "coefficient"):
            value = getattr(plane, name)
            if value is not None and np.shape(value) not in ((), (tones,)):
                raise ValueError(
                    f"planes: number {row} has a {name} of shape {np.shape(value)}; give a scalar or ({tones},), one a "
                    "tone"
                )
    if corners and is_concrete(planes):
        units = [np.asarray(plane.unit, np.float64) for plane in planes]
        for (one, first), (two, second) in combinations(enumerate(units), 2):
            if abs(first @ second) > _SQUARE:
                angle = np.degrees(np.arccos(np.clip(first @ second, -1.0, 1.0)))
                raise ValueError(
                    f"planes: the normals of numbers {one} and {two} are {angle:.4g} degrees apart; corners reflect "
                    "twice at right angles: leave corners out"
                )
    return planes


def check_before(
    planes: Sequence[Plane],
    arrays: Sequence[PlanarArray | AntennaArray | None],
    places: Real[Array, "*n 3"] | Sequence,
    radius_m: float,
    name: str = "translation",
) -> None:
    """Raise ValueError for antennas or a body that are not before every plane, where all are known numbers.

    Args:
        planes: the planes.
        arrays: ends, of which some may be None.
        places: of the body, or of its cells (..., 3) [m].
        radius_m: of the body about each place [m].
        name: of the argument that holds the places.
    """
    if planes:
        check_finite(name, places, "give places in m")
    for row, plane in enumerate(planes):
        for what, where, radius in (
            *(("array" if end == 0 else "receiver", array, 0.0) for end, array in enumerate(arrays)),
            (name, places, radius_m),
        ):
            if where is None or not is_concrete((plane, where)):
                continue
            where = getattr(where, "positions", where)
            unit = np.asarray(plane.normal, np.float64)
            offset = np.asarray(where, np.float64) - np.asarray(plane.point, np.float64)
            least = float(np.min(offset @ unit / np.linalg.norm(unit))) - radius
            if not least > 0.0:
                part = f"the body, {radius:.3g} m in radius, reaches" if radius else "a place is"
                raise ValueError(
                    f"{what}: {part} {-least:.3g} m behind number {row} of planes; keep antennas and body on the side "
                    "that its normal points to, or move the plane"
                )


def _reflecting(planes):
    """Without those whose coefficient is known to be zero."""
    return tuple(
        plane
        for plane in planes
        if plane.coefficient is None or not is_concrete(plane.coefficient) or np.any(plane.coefficient)
    )


def _dipoles(array):
    """Places and moments (N, 3) of an array, of the precision that is there."""
    parts = (array.positions, array.moments)
    return tuple(jnp.asarray(part, jax.dtypes.canonicalize_dtype(part.dtype)) for part in parts)


def _paths(array, planes, place, corners) -> list[_Path]:
    """The array itself and its images."""
    chains = [(plane,) for plane in planes]
    if corners:
        chains += list(combinations(planes, 2))
    paths = [_Path(array, None)]
    for chain in chains:
        places, moments, weights = _image(*_dipoles(array), jnp.asarray(place), chain)
        paths.append(_Path(AntennaArray(places, moments, array.frequency_hz), weights))
    return paths


@jax.jit
def _image(places, moments, place, chain):
    """The image of an array by one plane, or by two at right angles: its dipoles, and their weights (F or 1, c, N).

    Of constant coefficients it is one dipole an antenna with one weight, else three crossed ones, weighed by the
    components of the image's moment, which is complex.
    """
    behind = places
    for plane in chain:
        behind = _places_behind(plane, behind)
    if all(plane.permittivity is None for plane in chain):
        weights = jnp.ones((1, 1, len(places)), places.dtype)
        for plane in chain:
            moments = _vectors_behind(plane, moments)
            weights = weights * jnp.reshape(jnp.asarray(plane.coefficient), (-1, 1, 1))
        return behind, moments, weights
    way = place.astype(behind.dtype) - behind
    reflected = _reflected(chain, way, moments)
    if len(chain) == 2:
        # The plane that the straight line from the image crosses last is the one that reflects last.
        crossed = [-plane.height(behind) / (way @ plane.unit) for plane in chain]
        other = _reflected(chain[::-1], way, moments)
        reflected = jnp.where((crossed[1] >= crossed[0])[:, None], reflected, other)
    return *_crossed(behind), jnp.swapaxes(reflected, -1, -2)


def _crossed(places):
    """Dipoles along x, y and z at each of (N, 3) places: places and moments (3N, 3)."""
    return jnp.tile(places, (3, 1)), jnp.repeat(jnp.eye(3, dtype=places.dtype), len(places), axis=0)


def _reflected(chain, way, moments):
    """Moments (F or 1, N, 3) of images, complex, from their ways (N, 3) to the body, by a chain of planes in order."""
    directions = [way / jnp.sqrt(inner(way, way))[:, None]]
    for plane in chain[:0:-1]:
        directions.insert(0, _vectors_behind(plane, directions[0]))
    vectors = moments[None]
    for plane, direction in zip(chain, directions):
        vectors = vectors - 2.0 * jnp.einsum("fna,a->fn", vectors, plane.unit)[..., None] * plane.unit
        if plane.permittivity is None:
            vectors = jnp.reshape(jnp.asarray(plane.coefficient), (-1, 1, 1)) * vectors
            continue
        eps = jnp.reshape(jnp.asarray(plane.permittivity), (-1, 1))
        _, along, b = _fresnel(eps, jnp.abs(direction @ plane.unit))
        across = jnp.cross(plane.unit, direction)
        vectors = -along[..., None] * vectors + (b * inner(across, vectors))[..., None] * across
    return vectors


def _summed(block: Callable[[int, int], jax.Array], heard, sent, symmetric: bool) -> jax.Array:
    """The sum over paths back and there; of one array each pair of different paths is computed once."""
    total = block(0, 0)
    for back in range(len(heard)):
        for there in range(back + 1 if symmetric else len(sent)):
            if back == there == 0:
                continue
            part = _weighed(heard[back].weights, block(back, there), sent[there].weights)
            if symmetric:
                share = 0.5 if back == there else 1.0
                part = share * (part + jnp.swapaxes(part, -1, -2))
            total = total + part
    return total


@jax.jit
def _weighed(left, channel, right):
    """A_j^T H A_i of a channel ([F,] c N, c' N')."""
    single = channel.ndim == 2
    channel = channel[None] if single else channel
    for weights in (right, left):
        if weights is not None:
            whole = weights.reshape(weights.shape[0], 1, *weights.shape[1:])
            parts = channel.reshape(*channel.shape[:2], *weights.shape[1:])
            channel = jnp.sum(parts * whole, axis=2)
        channel = jnp.swapaxes(channel, 1, 2)
    return channel[0] if single else channel
