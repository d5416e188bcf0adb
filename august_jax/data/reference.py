"""Channels by table, in the form in which they are heard; and those at the reference place (paper, Section VI-A).

RefChannel-Diff learns the channel that the same craft, turned alike and of the same material, would have if its
prediction were the centre of the flight box, q_ref: the craft then flies at

    q_ref + (q - q_pre).

That depends on the prediction, which is drawn anew for every batch: so these channels are no part of a sample. They are
the simulator's own, without noise, made by table for the batch at hand.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Complex, Float, Int

from august_jax.arrays import Array
from august_jax.config import Config
from august_jax.data.simulator import contrast_of
from august_jax.physics import PlanarArray, Table, table_channel
from august_jax.signal.roi import Coefficients, Subspace

TOGETHER = 128
"""Channels of more samples at once no longer fit a processor's caches."""


def heard_by_table(
    config: Config,
    tables: Table,
    craft: Int[Array, ""],
    rotation: Float[Array, "3 3"],
    position: Float[Array, "3"],
    material: Float[Array, "2"],
    centre: Float[Array, "3"] | None,
) -> Complex[jax.Array, "tones rows columns"]:
    """A channel (F, N_b, N_b), or with ``centre`` its coefficients about it (F, K, K); H itself is then never formed.

    Args:
        config: static; of array, tones and material.
        tables: a stack of all craft.
        craft: which of them.
        rotation: body to world (3, 3).
        position: of the surface's centroid (3,) [m].
        material: permittivity and conductivity (2,), [1] and [S/m].
        centre: (3,) [m].
    """
    array, tones = PlanarArray.from_config(config.array), len(config.array.frequencies_hz)
    chi = contrast_of(config, material[0], material[1])
    combine = None
    if centre is not None:
        combine = jnp.swapaxes(Subspace.from_config(config.array).waves(centre).conj(), -1, -2)
    answer = table_channel(
        tables, array, rotation, position, chi[0] if tables.single else chi, combine=combine, craft=craft
    )
    return answer.reshape(tones, *answer.shape[-2:])


@partial(jax.jit, static_argnames="config")
def reference_channels(
    config: Config,
    tables: Table,
    craft: Int[Array, " batch"],
    rotation: Float[Array, "batch 3 3"],
    position: Float[Array, "batch 3"],
    material: Float[Array, "batch 2"],
    predicted: Float[Array, "batch 3"],
) -> Complex[jax.Array, "batch tones antennas antennas"] | Coefficients:
    """Channels of B slots at the reference place; for the encoder ``roi`` their coefficients about q_ref.

    Args:
        config: static.
        tables: a stack of all craft, from :func:`~august_jax.data.simulator.tabulate_targets`, which reach as far.
        craft, rotation, position, material: of each slot, as of :func:`heard_by_table`.
        predicted: q_pre (B, 3) [m].
    """
    middle = jnp.asarray(config.flight.centre_m, jnp.float32)
    in_subspace = config.model.encoder == "roi"

    def one(slot: tuple[jax.Array, ...]) -> jax.Array:
        craft, rotation, position, material, predicted = slot
        place = middle + (position - predicted)
        return heard_by_table(config, tables, craft, rotation, place, material, middle if in_subspace else None)

    slots = tuple(map(jnp.asarray, (craft, rotation, position, material, predicted)))
    values = jax.lax.map(one, slots, batch_size=TOGETHER)
    return Coefficients(values, jnp.broadcast_to(middle, (len(values), 3))) if in_subspace else values
