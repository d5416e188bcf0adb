"""A gradient step compiled before the run begins, and refused where the devices have no room for it.

What a compiled step holds on each device is counted by XLA: what goes in and comes out, less what shares a place, and
all that lies between. It grows with the batch, M = F + s B, not quite in proportion: parameters, their averages and
gradients are there whatever the batch. The batch that is advised was compiled, too, and fits.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

from august_jax import memory
from august_jax.arrays import Array
from august_jax.config import TrainConfig
from august_jax.progress import told_bytes
from august_jax.training.step import Loss, TrainState, compiled_step

Step = Callable[[TrainState, Any], tuple[TrainState, dict[str, Array]]]
"""(state, batch) -> the next state, and the step's numbers; the state that goes in is donated."""

_SHARE = 0.9
"""Of what is free: beside the program, batches are made."""
_TRIES, _NEAR = 5, 0.85
"""Of a search for a batch that fits: how many programs are compiled, and how near to one that does not is enough."""


def fitted_step(loss: Loss, train: TrainConfig, state: TrainState, batch: Any, mesh: Mesh) -> Step:
    """The step compiled for such a state and batch, which lie on the mesh.

    Raises:
        ValueError: it needs more memory than a device has; names a batch that fits.
    """
    program = compiled(loss, train, state, batch, mesh)
    needed, available = bytes_needed(program), bytes_available(state, mesh)
    if fits(needed, available):
        return program
    assert needed is not None and available is not None
    advised = largest_batch(loss, train, state, batch, mesh, needed, available)
    raise ValueError(
        f"train.batch: {train.batch} samples ask for {told_bytes(needed)} of memory on each device, and "
        f"{told_bytes(available)} "
        + (
            f"are free; set train.batch={advised}"
            if advised
            else "are free, where no batch fits; take smaller networks"
        )
    )


def fits(needed: int | None, available: int | None) -> bool:
    """Whether so many bytes are left with room for what else is done; true where nobody tells."""
    return needed is None or available is None or needed <= _SHARE * available


def compiled(loss: Loss, train: TrainConfig, state: TrainState, batch: Any, mesh: Mesh) -> jax.stages.Compiled:
    """The step compiled for arrays, or their shapes, of a state and a batch."""
    return compiled_step.lower(loss, train, state, batch, mesh=mesh).compile()


def bytes_needed(program: jax.stages.Compiled) -> int | None:
    """What a program holds on each device at its most; None where the compiler does not tell."""
    sizes = program.memory_analysis()
    if sizes is None:
        return None
    held = sizes.argument_size_in_bytes + sizes.output_size_in_bytes + sizes.temp_size_in_bytes
    return int(held - sizes.alias_size_in_bytes)


def bytes_available(state: TrainState, mesh: Mesh) -> int | None:
    """What a step may hold on each device: what is free, and what its state holds already."""
    free = memory.for_a_program(mesh)
    return None if free is None else free + sum(leaf.nbytes for leaf in jax.tree.leaves(state))


def largest_batch(
    loss: Loss, train: TrainConfig, state: TrainState, batch: Any, mesh: Mesh, needed: int, available: int
) -> int | None:
    """A batch near the largest whose step fits, compiled to be sure; None where none does.

    Args:
        batch: that does not fit.
        needed, available: its bytes, and those that there are, on each device.
    """
    limit, size = _SHARE * available, mesh.size
    few, smaller, more, larger = 0, 0, train.batch, needed  # the one fits, the other does not
    for left in reversed(range(_TRIES)):
        if few:
            guess = few + (more - few) * (limit - smaller) / (larger - smaller)
        else:  # half of it at most: sizes go in steps, so that two near batches tell nothing of a third
            guess = min(more / 2, more * limit / larger) if left else size
        rows = max(min(int(guess) // size * size, more - size), few + size)
        if rows >= more:
            break
        asked = bytes_needed(compiled(loss, train, state, _of_rows(batch, rows), mesh))
        assert asked is not None
        if asked <= limit:
            few, smaller = rows, asked
        else:
            more, larger = rows, asked
        if few >= _NEAR * (more - size):
            break
    return few or None


def _of_rows(batch: Any, rows: int) -> Any:
    """The shapes of such a batch with another number of rows, where its arrays lie."""

    def leaf(array: Any) -> jax.ShapeDtypeStruct:
        lies = array.sharding if isinstance(array, jax.Array) and len(array.sharding.device_set) > 1 else None
        return jax.ShapeDtypeStruct((rows, *np.shape(array)[1:]), array.dtype, sharding=lies)

    return jax.tree.map(leaf, batch)
