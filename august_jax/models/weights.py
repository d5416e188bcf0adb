"""Parameters by dotted name, such as ``denoiser.layers.0.gate.kernel``: what a file of weights holds, and whether it
fits, leaf by leaf.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from august_jax.arrays import Array
from august_jax.files import DamagedFile, read_npz

FORMAT = 1
"""What a file of weights says of itself beside the arrays: raised where the same names and shapes come to mean another
network. A file that says nothing is of format 1."""


def read_weights(path: str | Path) -> dict[str, Float[np.ndarray, "..."]]:
    """The arrays that ``training.save_weights`` wrote, by dotted name, as float32.

    Raises:
        FileNotFoundError: no such file.
        ValueError: the file is damaged (a ``files.DamagedFile``), of another format, or an array holds what is no
            finite number.
    """
    try:
        arrays = read_npz(path)
    except DamagedFile as error:
        raise DamagedFile(
            f"{error}; train once more into its folder, which writes it again from the last checkpoint"
        ) from None
    made = arrays.pop("format", np.asarray(FORMAT))
    if made.shape or made.dtype.kind not in "iu" or made != FORMAT:
        raise ValueError(
            f"{path}: holds weights of another version of august_jax (format {made}, wanted {FORMAT}); "
            "train them again with `august train`, in another folder, or use the version that wrote them"
        )
    for name, leaf in arrays.items():
        if leaf.dtype.kind != "f":
            raise ValueError(f"{path}: {name} holds {leaf.dtype} and no real numbers; it is no file of weights")
        with np.errstate(over="ignore"):
            arrays[name] = leaf.astype(np.float32)
        if not np.isfinite(arrays[name]).all():
            raise ValueError(f"{path}: {name} holds NaN or infinity; take the weights of another save or run")
    return arrays


def flatten(tree: Any) -> dict[str, Array]:
    """The leaves of a pytree by dotted name, in the pytree's own order."""
    return {
        ".".join(
            str(getattr(part, "key", getattr(part, "name", getattr(part, "idx", part))))
            for part in path
            if getattr(part, "name", None) != "value"
        ): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
    }


def compare(found: Mapping[str, tuple[int, ...]], wanted: Mapping[str, Array], source: Any) -> None:
    """Check stored shapes against the arrays that are wanted.

    Raises:
        ValueError: it names the first leaf that is missing, left over or of another shape.
    """
    for name, leaf in wanted.items():
        if name not in found:
            raise ValueError(f"{source}: {name} is missing; the file belongs to another model.* configuration")
        if tuple(found[name]) != leaf.shape:
            raise ValueError(
                f"{source}: {name} has shape {tuple(found[name])}, the configuration wants {leaf.shape}; "
                "use the configuration that it was trained with"
            )
    for name in found:
        if name not in wanted:
            raise ValueError(
                f"{source}: {name} is not part of this configuration's networks; "
                "use the configuration that it was trained with"
            )
