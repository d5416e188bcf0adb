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

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.physics.array import AntennaArray, PlanarArray, wavenumber
from august_jax.physics.body.aperture import Aperture, aperture_skeleton
from august_jax.physics.checks import is_concrete
from august_jax.physics.green import dipole_fields_about, path_difference


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
        error: relative error of the reduced response at a contrast between the nodes, 3.5 + 0.05j, as measured when it
            was made.
        cells: number of cells N.
    """

    weights: jax.Array
    eigenvalues: jax.Array
    points: jax.Array
    rows: jax.Array
    frequencies_hz: tuple[float, ...] = field(metadata={"static": True})
    single: bool = field(metadata={"static": True})
    radius_m: float = field(metadata={"static": True})
    nearest_m: float = field(metadata={"static": True})
    error: float = field(metadata={"static": True})
    cells: int = field(metadata={"static": True})


def alike(bodies: Sequence[Body]) -> list[Body]:
    """The same bodies padded to one shape, so that what is compiled for one serves all.

    Modes that are added have no weight. ``radius_m``, ``nearest_m`` and ``error`` become the worst of all, ``cells``
    the largest; ``nearest_m`` bounds every body's use from then on.

    Raises:
        ValueError: the bodies were made for different tones.
    """
    if len({(body.frequencies_hz, body.single) for body in bodies}) > 1:
        raise ValueError("bodies: they were factored for different frequencies; factor all for the same tones")
    leaves = [[np.asarray(leaf) for leaf in jax.tree.leaves(body)] for body in bodies]
    shapes = [np.max([leaf.shape for leaf in each], axis=0) for each in zip(*leaves)]
    worst = {name: max(getattr(body, name) for body in bodies) if bodies else 0
             for name in ("radius_m", "nearest_m", "error", "cells")}
    return [
        replace(body, **worst, **{
            name: jnp.asarray(np.pad(leaf, [(0, n - m) for m, n in zip(leaf.shape, shape)]))
            for name, leaf, shape in zip(("weights", "eigenvalues", "points", "rows"), own, shapes, strict=True)})
        for body, own in zip(bodies, leaves)
    ]


def body_channel(
    body: Body,
    array: PlanarArray | AntennaArray,
    rotation: jax.Array,
    translation: jax.Array,
    contrast: jax.Array,
    *,
    receiver: PlanarArray | AntennaArray | None = None,
) -> jax.Array:
    """Sensing channel of a factored body in a pose: equal to the coupled solve of the moved cells.

    Args:
        body: from :func:`factor_body`.
        array: the antennas, transmitting and, without ``receiver``, receiving.
        rotation: body axes to world axes (3, 3).
        translation: origin of the body's frame in the world (3,) [m].
        contrast: chi, scalar; with several tones also (F,).
        receiver: the antennas that receive, where they are not those that transmit.

    Returns:
        H [1/m] (N_b, N_b), or (F, N_b, N_b) for a body of several tones; complex64, symmetric without ``receiver``;
        rows receive, columns transmit. Differentiable in rotation, translation, contrast and an
        :class:`AntennaArray`; ``jax.vmap`` over them makes batches. Planar arrays are the fastest: few of their
        elements are computed, and determine the others.

    Raises:
        ValueError: mismatched shapes, or a body nearer than ``body.nearest_m`` to an antenna.
    """
    for name, value, shape in (("rotation", rotation, (3, 3)), ("translation", translation, (3,))):
        if np.shape(value) != shape:
            raise ValueError(f"{name}: got shape {np.shape(value)}; give {shape}, and vmap for batches")
    tones = len(body.frequencies_hz)
    if np.shape(contrast) not in ((), (tones,)):
        raise ValueError(f"contrast: got shape {np.shape(contrast)}; give a scalar or ({tones},), one value a tone")
    for end in (array, receiver):
        if end is not None and is_concrete((translation, end)):
            gap = float(np.linalg.norm(np.asarray(translation) - np.asarray(end.positions), axis=1).min())
            if not gap >= body.nearest_m * (1.0 - 1e-6):
                raise ValueError(
                    f"translation: the body is {gap:.3g} m from an antenna, but was factored for {body.nearest_m:g} m "
                    "and beyond; pass a smaller nearest_m to factor_body"
                )
    return _body_channel(body, array, receiver, *(jnp.asarray(part) for part in (rotation, translation, contrast)))


@jax.jit
def _body_channel(body, array, receiver, rotation, translation, contrast):
    rotation = rotation.astype(jnp.float32)
    contrasts = jnp.broadcast_to(contrast, (len(body.frequencies_hz),)).astype(jnp.complex64)
    channels = []
    for tone, frequency in enumerate(body.frequencies_hz):
        chi = contrasts[tone]
        gain = (wavenumber(frequency) ** 2) * chi / (1.0 - chi * body.eigenvalues[tone])
        sent, sender = _modal_fields(body, tone, array, rotation, translation)
        heard, hearer = (sent, sender) if receiver is None else _modal_fields(
            body, tone, receiver, rotation, translation)
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
    real, difference, total = body.weights[tone]
    both = real @ (fields.real + fields.imag)
    modal = jax.lax.complex(both - total @ fields.imag, both + difference @ fields.real)
    if not planar:
        return modal, None
    # Interpolation over the aperture, on fields whose phases to the body's centre are removed.
    return modal, Aperture(chosen, spread, jnp.exp(1j * k * path_difference(elements, base)))
