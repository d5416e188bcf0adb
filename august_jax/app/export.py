"""Clouds and samples as files that other programs read: PLY, NPZ, MATLAB and JSON; every write is atomic.

PLY is binary little-endian with one float per property, so that point-cloud viewers show the permittivity and the
conductivity as scalar fields. The other formats hold a record: a flat mapping of names to arrays.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from august_jax.arrays import Array, ArrayLike
from august_jax.files import replacing

FORMATS = ("ply", "npz", "mat", "json")
"""What ``august export`` writes."""


def write_ply(path: str | Path, points: Array, permittivity: ArrayLike, conductivity: ArrayLike) -> None:
    """Write a cloud as binary PLY with the properties x, y, z, permittivity and conductivity.

    Args:
        path: the file.
        points: positions (M, 3) [m].
        permittivity: relative permittivities (M,) or one number.
        conductivity: conductivities (M,) or one number [S/m].

    Raises:
        ValueError: the points are no list of places.
    """
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: shape {points.shape} where (M, 3) is wanted; write one cloud a file")
    names = ("x", "y", "z", "permittivity", "conductivity")
    table = np.empty((len(points), len(names)), "<f4")
    table[:, :3] = points
    table[:, 3] = permittivity
    table[:, 4] = conductivity
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment positions in metres, conductivity in S/m",
        f"element vertex {len(points)}",
        *(f"property float {name}" for name in names),
        "end_header\n",
    ]
    with replacing(path) as aside:
        aside.write_bytes("\n".join(header).encode("ascii") + table.tobytes())


def write_record(path: str | Path, record: Mapping[str, Any]) -> None:
    """Write a flat mapping of arrays; the suffix of ``path`` says how: ``.npz``, ``.mat`` or ``.json``.

    JSON turns a complex array into ``{"real": ..., "imag": ...}`` and numbers that are not finite into null.

    Raises:
        ValueError: another suffix.
    """
    path = Path(path)
    arrays = {name: np.asarray(value) for name, value in record.items()}
    with replacing(path) as aside:
        if path.suffix == ".npz":
            np.savez_compressed(aside, **arrays)  # type: ignore[arg-type]
        elif path.suffix == ".mat":
            from scipy.io import savemat

            savemat(aside, arrays, do_compression=True, oned_as="row")
        elif path.suffix == ".json":
            plain = {name: _plain(array) for name, array in arrays.items()}
            aside.write_text(json.dumps(plain, allow_nan=False), encoding="utf-8")
        else:
            raise ValueError(f"path: unknown suffix {path.suffix!r}; a record is written as .npz, .mat or .json")


def _plain(array: np.ndarray) -> Any:
    if np.iscomplexobj(array):
        return {"real": _plain(array.real), "imag": _plain(array.imag)}
    if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
        return np.where(np.isfinite(array), array.astype(object), np.array(None)).tolist()
    return array.tolist()
