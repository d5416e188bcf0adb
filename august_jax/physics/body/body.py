"""A rigid body's response: its coupled system is reduced once, then serves every pose and every scalar contrast.

A rotation turns G into R G R^T, so that K' of :mod:`august_jax.physics.mom` is fixed in the body frame, and a
material enters only through chi in (I/chi - K') P = E', H = k^2 E'^T P. :mod:`august_jax.physics.body.factor` leaves
of it

    H = k^2 F^T diag(chi / (1 - chi lambda)) F,    F = W E'_S,

with E'_S the field at a few of the cells. Here a pose's channel is made of that: the antennas' fields at those places,
three real matrix products for W in single precision (Gauss's scheme for complex numbers: XLA multiplies real matrices
three times faster than complex ones), and the antennas that were left out
(:mod:`august_jax.physics.body.aperture`).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int, Real

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.array import AntennaArray, PlanarArray, wavenumber
from august_jax.physics.body.aperture import Aperture, aperture_skeleton
from august_jax.physics.checks import (
    check_contrast,
    check_nearest,
    check_pose,
    coarseness,
    is_concrete,
    settled,
    warn_of_coarse_cells,
)
from august_jax.physics.green import dipole_fields_about, path_difference

CHECKS = (3.5 + 0.05j, 0.2, 7.0, 9.0, 14.0, 24.0, 40.0, 4.0 + 4.0j, 2.0 + 12.0j, 14.0 + 12.0j, 2.0 + 40.0j)
"""Contrasts at which a body's error is measured, between its nodes first; at 3 GHz 12j is a conductivity of 2 S/m."""
_FARTHEST = 40.0
_WITHIN = 5.0  # the last of the nodes: up to here the error is that between them
_WARN = 3e-3  # a tenth of what the lattice itself errs by


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Body:
    """A factored body; a pytree, with F tones padded to a common size.

    Attributes:
        weights: Re W, Im W - Re W and Re W + Im W, the square roots of the cells' material volumes in them
            (F, 3, n, m), float32.
        eigenvalues: lambda (F, n), complex64.
        points: where the incident field is needed, in the body frame (F, p, 3) [m].
        rows: which (point, component) of the field each column of W takes, 3 point + component (F, m), int32.
        frequencies_hz: the tones [Hz].
        single: True where the body was made for one plain frequency, so that channels carry no tone axis.
        radius_m: largest distance of the material's places in the cells from the body's origin [m].
        nearest_m: sources must be at least this far from the body's origin [m].
        errors: relative error of the reduced response at each of ``CHECKS``, as measured when it was made.
        cells: number of cells N.
        edge_m, fill: edge [m] and fill of the cell that is the coarsest at ``ASSUMED_CONTRAST``.
    """

    weights: Float[Array, "f 3 n m"]
    eigenvalues: Complex[Array, "f n"]
    points: Float[Array, "f p 3"]
    rows: Int[Array, "f m"]
    frequencies_hz: tuple[float, ...] = field(metadata={"static": True})
    single: bool = field(metadata={"static": True})
    radius_m: float = field(metadata={"static": True})
    nearest_m: float = field(metadata={"static": True})
    errors: tuple[float, ...] = field(metadata={"static": True})
    cells: int = field(metadata={"static": True})
    edge_m: float = field(metadata={"static": True})
    fill: float = field(metadata={"static": True})

    @property
    def error(self) -> float:
        """Relative error of the reduced response between the nodes, at a contrast of 3.5 + 0.05j."""
        return self.errors[0]

    def error_at(self, contrast: complex) -> float:
        """Relative error of the reduced response at a contrast, interpolated between ``CHECKS``; NaN far from them.

        In log error over the logarithm of the contrast, weighted by the inverse fourth power of the distance: good to
        a factor of two or three.
        """
        contrast = complex(contrast)
        if not 0.0 < abs(contrast) < 2.0 * _FARTHEST or contrast.real < -0.1 * abs(contrast):
            return math.nan
        place = np.log(contrast)
        weight = 1.0 / (np.abs(np.log(np.asarray(CHECKS)) - place) + 1e-3) ** 4
        return float(np.exp(weight @ np.log(np.maximum(self.errors, 1e-9)) / weight.sum()))


_UNEVEN = 1.4
"""So many times the mean size the largest body may be for padding to pay."""


def evened(bodies: Sequence[Body]) -> list[Body]:
    """:func:`alike` where the bodies are of about one size; left as they are where padding would cost more than the
    compilations that it spares."""
    sizes = [body.weights.size for body in bodies]
    return alike(bodies) if bodies and max(sizes) < _UNEVEN * sum(sizes) / len(sizes) else list(bodies)


def alike(bodies: Sequence[Body]) -> list[Body]:
    """The same bodies padded to one shape, so that what is compiled for one serves all.

    Modes that are added have no weight. ``radius_m``, ``nearest_m``, ``errors`` and the coarsest cell become the worst
    of all, ``cells`` the largest; ``nearest_m`` bounds every body's use from then on.

    Raises:
        ValueError: the bodies were made for different tones.
    """
    if len({(body.frequencies_hz, body.single) for body in bodies}) > 1:
        raise ValueError("bodies: they were factored for different frequencies; factor all for the same tones")
    leaves = [[np.asarray(leaf) for leaf in jax.tree.leaves(body)] for body in bodies]
    shapes = [np.max([leaf.shape for leaf in each], axis=0) for each in zip(*leaves)]
    if not bodies:
        return []
    coarsest = max(bodies, key=lambda body: coarseness(body.edge_m, body.fill))
    worst = {name: max(getattr(body, name) for body in bodies) for name in ("radius_m", "nearest_m", "cells")}
    worst |= {
        "errors": tuple(max(each) for each in zip(*(body.errors for body in bodies), strict=True)),
        "edge_m": coarsest.edge_m,
        "fill": coarsest.fill,
    }
    return [
        replace(
            body,
            **worst,
            **{
                name: jnp.asarray(np.pad(leaf, [(0, n - m) for m, n in zip(leaf.shape, shape)]))
                for name, leaf, shape in zip(("weights", "eigenvalues", "points", "rows"), own, shapes, strict=True)
            },
        )
        for body, own in zip(bodies, leaves)
    ]


def body_channel(
    body: Body,
    array: PlanarArray | AntennaArray,
    rotation: Real[Array, "3 3"],
    translation: Real[Array, "3"],
    contrast: ArrayLike | Sequence,
    *,
    receiver: PlanarArray | AntennaArray | None = None,
) -> Complex[jax.Array, "*tones receive transmit"]:
    """Sensing channel of a factored body in a pose: equal to the coupled solve of the moved cells.

    Args:
        body: from :func:`factor_body`.
        array: the antennas, transmitting and, without ``receiver``, receiving.
        rotation: body axes to world axes (3, 3).
        translation: origin of the body's frame in the world (3,) [m].
        contrast: chi, scalar; with several tones also (F,).
        receiver: the antennas that receive, where they are not those that transmit; of the same carrier.

    Returns:
        H [1/m] (N_b, N_b), or (F, N_b, N_b) for a body of several tones; complex64, symmetric without ``receiver``;
        rows receive, columns transmit. Differentiable in rotation, translation, contrast and an
        :class:`AntennaArray`; ``jax.vmap`` over them makes batches. Planar arrays are the fastest: few of their
        elements are computed, and determine the others.

    Raises:
        ValueError: mismatched shapes, numbers that are not finite, a matrix that is no rotation, a body nearer than
            ``body.nearest_m`` to an antenna, ends of different carriers, or an array whose carrier lies outside the
            band of the body's tones by more than a tenth.

    Warns where the body's cells are too coarse for the contrast, where the contrast lies so far outside the nodes of
    the reduction that its error shows (with the figure), and of a contrast that is zero.
    """
    check_pose(body.frequencies_hz, array, receiver, rotation, translation)
    for end in (array, receiver):
        if end is not None and is_concrete((translation, end)):
            check_nearest(body.nearest_m, end, translation, "translation")
    tones = len(body.frequencies_hz)
    check_contrast(contrast, ((), (tones,)), f"a scalar or ({tones},), one value a tone")
    if is_concrete(contrast):
        judge_contrast(body, contrast)
    return _body_channel(
        body,
        array,
        receiver,
        settled("rotation", rotation),
        settled("translation", translation),
        settled("contrast", contrast),
    )


def judge_contrast(body: Body, contrast: ArrayLike | Sequence) -> None:
    """Warn of cells, and of a reduction, that a contrast asks too much of, with the figure.

    Args:
        body: what it is asked of.
        contrast: chi, a scalar or one value a tone; numbers, not traced ones.
    """
    values = [complex(value) for value in np.ravel(contrast)]
    for tone, frequency in enumerate(body.frequencies_hz):
        warn_of_coarse_cells(body.edge_m, body.fill, values[tone % len(values)], wavenumber(frequency))
    for value in values:
        if abs(value) > _WITHIN or value.real < 0.0 or body.error > _WARN:
            error = body.error_at(value)
            if not error < _WARN:
                figure = f"about {error:.1g}" if error == error else "not known, and large"
                warnings.warn(
                    f"contrast: at {value:.3g} the error of the factored body is {figure} ({body.error:.1g} at 3.5); "
                    "take sensing_channel, which solves the whole system",
                    stacklevel=3,
                )
                return


@jax.jit
def _body_channel(body, array, receiver, rotation, translation, contrast):
    rotation = rotation.astype(jnp.float32)
    contrasts = jnp.broadcast_to(contrast, (len(body.frequencies_hz),)).astype(jnp.complex64)
    channels = []
    for tone, frequency in enumerate(body.frequencies_hz):
        chi = contrasts[tone]
        gain = (wavenumber(frequency) ** 2) * chi / (1.0 - chi * body.eigenvalues[tone])
        sent, sender = _modal_fields(body, tone, array, rotation, translation)
        heard, hearer = (
            (sent, sender) if receiver is None else _modal_fields(body, tone, receiver, rotation, translation)
        )
        # Fields are O(0.1/r) and the cells' volumes O(1e-6): the product stays far above the smallest float32.
        channel = _product(heard, gain[:, None] * sent)
        if hearer is not None:
            channel = hearer.over_rows(channel)
        if sender is not None:
            channel = sender.over_rows(channel.T).T
        channels.append(channel if receiver is not None else 0.5 * (channel + channel.T))
    return channels[0] if body.single else jnp.stack(channels)


def _product(left, right):
    """left^T right of (K, n) and (K, m) complex, by one real product of all parts."""
    n, m = left.shape[1], right.shape[1]
    left, right = (jnp.concatenate([each.real, each.imag], axis=1) for each in (left, right))
    parts = left.T @ right
    return jax.lax.complex(parts[:n, :m] - parts[n:, m:], parts[:n, m:] + parts[n:, :m])


def in_modes(body: Body, tone: int, fields: Complex[Array, "m k"]) -> Complex[jax.Array, "n k"]:
    """W E' (n, K) of fields at the rows (m, K) that W takes, by three real products."""
    real, difference, total = body.weights[tone]
    both = real @ (fields.real + fields.imag)
    return jax.lax.complex(both - total @ fields.imag, both + difference @ fields.real)


def _modal_fields(body, tone, array, rotation, translation):
    """F of some antennas in the body's modes (K, n), and how they determine all: None where they are all."""
    frequency = body.frequencies_hz[tone]
    k = wavenumber(frequency)
    planar = isinstance(array, PlanarArray)
    if planar:
        chosen, spread = aperture_skeleton(array, frequency, body.radius_m, body.nearest_m)
        centre = array.positions.mean(axis=0)
    else:
        chosen, centre = slice(None), jnp.mean(jnp.asarray(array.positions, jnp.float32), axis=0)
    elements = jnp.asarray(array.positions - centre, jnp.float32)
    moments = jnp.asarray(array.moments, jnp.float32)[chosen]
    base = (translation - jnp.asarray(centre, jnp.float32)).astype(jnp.float32)
    local = body.points[tone] @ rotation.T
    world = dipole_fields_about(local, base, elements[chosen], moments, k)
    fields = jnp.einsum("pna,ab->pbn", world, rotation).reshape(-1, world.shape[1])[body.rows[tone]]
    modal = in_modes(body, tone, fields)
    if not planar:
        return modal, None
    # Interpolation over the aperture, on fields whose phases to the body's centre are removed.
    return modal, Aperture(chosen, spread, jnp.exp(1j * k * path_difference(elements, base)))
