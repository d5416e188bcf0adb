"""A tabulated craft about its own place: coefficients, and their derivatives in pose and contrast, in one go.

Where the field subspace U is taken about the craft's own place q (:mod:`august_jax.signal.roi` calls it a centre), the
spherical waves of :mod:`august_jax.physics.body.table` and the phases of U are the same, and

    A = U^H H conj(U) e^{-2jk|q|} = X M X^T,    X = P^T diag(1/r) S X_S    (K, R) real.

A displacement turns phases, by k times the components of the unit vectors n_i from the elements to the body,

    dA = j (D_i A + A D_i) + dX M X^T + X M dX^T,    D_i = k P^T diag(n_i - their mean) P,

the means, phases common to all, being left to the gain. What the craft sees of the array then turns by the
displacement over the distance, as it does in a turn: dX of a displacement is taken from that of a turn, but for the
part of a moment that turns along. That is good to a few per cent, enough for steps towards a minimum.

Tones share one gain, which takes one phase alone: that of the mean wavenumber k' of the tones. What remains of each,
e^{2j(k - k')|q|}, is left in A, because it tells the range.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int

from august_jax.arrays import Array
from august_jax.constants import VACUUM_PERMITTIVITY
from august_jax.physics.array import PlanarArray, wavenumber
from august_jax.physics.body.table import Table, aperture_of, interpolation, nearest
from august_jax.physics.green import inner
from august_jax.physics.materials import contrast

__all__ = ["LocalCoefficients", "local_coefficients"]


class LocalCoefficients(NamedTuple):
    """Coefficients of one craft about its own place and their derivatives; the phase e^{2jk'|q|} is taken out, k' being
    the mean wavenumber of the tones.

    Attributes:
        values: A of each tone (F, K, K) complex64, symmetric [1/m].
        derivatives: in displacement [m] (3), rotation vector in world axes [rad] (3), permittivity and conductivity
            [S/m], each as ``values`` (8, F, K, K); None where they were not asked for.
    """

    values: Complex[Array, "tones orders orders"]
    derivatives: Complex[Array, "8 tones orders orders"] | None


def local_coefficients(
    table: Table,
    array: PlanarArray,
    basis: Float[np.ndarray, "antennas orders"],
    craft: Int[Array, ""],
    rotation: Float[Array, "3 3"],
    position: Float[Array, "3"],
    permittivity: Float[Array, ""],
    conductivity: Float[Array, ""],
    *,
    derivatives: bool = True,
) -> LocalCoefficients:
    """A of a tabulated craft in a pose, about its own place; pure, for one pose (``jax.vmap`` makes batches).

    Nothing is checked: a search keeps its candidates within the table's range.

    Args:
        table: a stack, of :func:`august_jax.physics.stack_tables`.
        array: the antennas.
        basis: P (N_b, K) of the subspace.
        craft: which table.
        rotation: body to world (3, 3).
        position: q (3,) [m].
        permittivity, conductivity: of the craft, [1] and [S/m].
        derivatives: whether they are wanted.
    """
    places = jnp.asarray(array.positions, jnp.float32)
    toward = jnp.mean(places, axis=0) - position
    ahead = -toward / jnp.sqrt(inner(toward, toward))
    which = nearest(table.directions[craft], jax.lax.stop_gradient(toward @ rotation))
    axes = table.axes[craft, which]
    away = position - places
    distances = jnp.sqrt(inner(away, away))
    values, slopes = [], []
    for tone, frequency in enumerate(table.frequencies_hz):
        chosen, spread = aperture_of(array, frequency, table.radius_m, table.reach_m[0])
        narrowed = jnp.asarray(basis).T @ (jnp.asarray(spread, jnp.float32) / distances[:, None])
        functions = table.functions[craft, tone, which]
        elements = jnp.asarray(array.positions[chosen], jnp.float32)
        moments = jnp.asarray(array.moments[chosen], jnp.float32)

        def seen(change, elements=elements, moments=moments):
            # the elements and their moments in the patch's axes; a turn of the body turns them the other way
            turn, shifted = change[:3], elements - position - change[3] * ahead

            def turned(vectors):
                return (vectors - jnp.cross(turn, vectors)) @ (axes @ rotation.T).T

            return table.patch.functions(turned(shifted), jnp.sqrt(inner(shifted, shifted)), turned(moments))

        chi = contrast(permittivity, conductivity, frequency).astype(jnp.complex64)
        nodes = table.responses[craft, tone, which]
        size = nodes.shape[-1]
        if derivatives:
            weights, slope = jax.jvp(lambda x: interpolation(table.nodes, x), (chi,), (jnp.ones_like(chi),))
            mixed = jnp.stack([weights.real, weights.imag, slope.real, slope.imag]) @ nodes.reshape(len(nodes), -1)
            mixed = mixed.reshape(4, 2, size, size)
            response = (mixed[0, 0] - mixed[1, 1], mixed[0, 1] + mixed[1, 0])
            sloped = (mixed[2, 0] - mixed[3, 1], mixed[2, 1] + mixed[3, 0])
            phi, linear = jax.linearize(seen, jnp.zeros(4, jnp.float32))
            every = jnp.concatenate([phi[None], jax.vmap(linear)(jnp.eye(4, dtype=jnp.float32))])
            fields = (every.reshape(-1, every.shape[-1]) @ functions).reshape(5, len(chosen), size)
            fields = jnp.einsum("kn,anr->akr", narrowed, fields).reshape(5 * len(narrowed), size)
            own = fields[: len(narrowed)]
            through = own @ jnp.concatenate([*response, *sloped], axis=1)  # K, 4R
            real, imag, slope_real, slope_imag = jnp.split(through, 4, axis=1)
            sides = fields @ jnp.concatenate([real, imag]).T  # 5K, 2K
            k = len(narrowed)
            sides = jax.lax.complex(sides[:, :k], sides[:, k:]).reshape(5, k, k)
            value = sides[0]
            changed = sides[1:] + jnp.swapaxes(sides[1:], 1, 2)
            turns, farther = changed[:3], changed[3]
            unit = away / distances[:, None]
            steer = wavenumber(frequency) * jnp.einsum(
                "nk,ni,nl->ikl", jnp.asarray(basis), unit - jnp.mean(unit, axis=0), jnp.asarray(basis)
            )
            phase = steer.reshape(3 * k, k) @ jnp.concatenate([value.real, value.imag], axis=1)
            phase = jax.lax.complex(-phase[:, k:], phase[:, :k]).reshape(3, k, k)
            # the craft's view of the array turns as well, about toward x displacement
            sight = jnp.cross(toward, jnp.eye(3, dtype=jnp.float32)) / inner(toward, toward)
            weaker = 2.0 * toward / inner(toward, toward)
            shifts = phase + jnp.swapaxes(phase, 1, 2) + jnp.tensordot(sight, turns, 1) + weaker[:, None, None] * value
            shifts += ahead[:, None, None] * farther  # and narrows as it goes away
            poses = jnp.concatenate([shifts, turns])
            material = jax.lax.complex(slope_real @ own.T, slope_imag @ own.T)
            losses = 1j / (2.0 * np.pi * VACUUM_PERMITTIVITY * frequency)  # of chi in the conductivity
            slopes.append(jnp.concatenate([poses, material[None], losses * material[None]]))
        else:
            weights = interpolation(table.nodes, chi)
            mixed = (jnp.stack([weights.real, weights.imag]) @ nodes.reshape(len(nodes), -1)).reshape(2, 2, size, size)
            response = (mixed[0, 0] - mixed[1, 1], mixed[0, 1] + mixed[1, 0])
            own = narrowed @ (seen(jnp.zeros(4, jnp.float32)) @ functions)
            real, imag = (own @ part for part in response)
            value = jax.lax.complex(real @ own.T, imag @ own.T)
        values.append(value)
    found = LocalCoefficients(jnp.stack(values), jnp.stack(slopes, axis=1) if derivatives else None)
    return found if len(values) == 1 else _with_range(found, table.frequencies_hz, position)


def _with_range(found: LocalCoefficients, frequencies_hz, position) -> LocalCoefficients:
    """With the phases e^{2j(k - k')|q|} that tell tones apart by the range."""
    wavenumbers = np.asarray([wavenumber(frequency) for frequency in frequencies_hz])
    apart = jnp.asarray(wavenumbers - wavenumbers.mean(), jnp.float32)[:, None, None]
    distance = jnp.sqrt(inner(position, position))
    waves = jnp.exp(2j * apart * distance)
    if found.derivatives is None:
        return LocalCoefficients(waves * found.values, None)
    moved = 2j * apart * found.values * (position / distance)[:, None, None, None]
    return LocalCoefficients(waves * found.values, waves * found.derivatives.at[:3].add(moved))
