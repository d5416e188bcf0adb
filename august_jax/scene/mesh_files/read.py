"""A mesh file as a surface in metres, x forward, y to the left, z up.

Readers return the surface in the file's own unit and axes and say what the file fixes of them; here the file is
opened, the reader is chosen by the name's ending, and unit and axes are applied.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from august_jax.scene.mesh_files.dae import read_dae
from august_jax.scene.mesh_files.frame import AUTO, MeshSource, check_frame, chosen_frame
from august_jax.scene.mesh_files.gltf import DECLARED, read_gltf
from august_jax.scene.mesh_files.obj import read_obj
from august_jax.scene.mesh_files.ply import read_ply
from august_jax.scene.mesh_files.stl import read_stl
from august_jax.scene.mesh_files.surface import DamagedMesh, Declared, Surface

FORMATS = (".obj", ".stl", ".ply", ".glb", ".gltf", ".dae")
"""Endings of the mesh files that are read."""
_LARGEST_M = 1e6
"""A craft drawn in micrometres and read as metres is smaller; what is larger is damage, and overflows."""


def read_mesh(
    path: str | Path, *, unit: str | float = AUTO, up: str = AUTO, forward: str = AUTO
) -> tuple[Surface, MeshSource]:
    """The surface of a mesh file [m], x forward, y to the left, z up, and how its unit and axes were fixed.

    Args:
        path: the file.
        unit: length of the file's unit: "m", "cm", "mm", "in", "ft", a number of metres, or "auto".
        up: the file's axis that points up: "x", "y", "z", "-x", "-y", "-z", or "auto".
        forward: the file's axis that points forward, perpendicular to ``up``, or "auto".

    Raises:
        ValueError: an argument is wrong, or the file is missing, empty, damaged, of another format or without faces.
    """
    path = Path(path)
    check_frame(unit, up, forward)
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise ValueError(f"{path}: unknown mesh format {kind!r}; wanted one of {', '.join(FORMATS)}")
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}); check its permissions") from None
    if not content:
        raise ValueError(f"{path}: is empty (0 bytes), not a {kind} file; export or copy it again")
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # places so large are refused below
            surface, declared = _read(kind, content, path.parent)
    except DamagedMesh as error:
        raise ValueError(f"{path}: not a readable {kind} file: {error}") from None
    except (LookupError, ValueError, TypeError, AttributeError, ArithmeticError, RecursionError, MemoryError) as error:
        # a document whose parts are not of the kinds that its format wants
        reason = f"{error} is missing" if isinstance(error, KeyError) else (str(error) or "no reason").splitlines()[0]
        raise ValueError(
            f"{path}: not a readable {kind} file ({type(error).__name__}: {reason[:120]}); export it again"
        ) from None
    if not len(surface.faces):
        raise ValueError(f"{path}: holds no faces; wanted a surface, not points or lines")
    source = chosen_frame(str(path), declared, unit, up, forward)
    with np.errstate(over="ignore"):
        extent = float(np.ptp(surface.vertices[surface.faces].reshape(-1, 3), axis=0).max()) * source.unit_m
    if extent > _LARGEST_M:
        raise ValueError(
            f"{path}: is {extent:.3g} m long with unit={source.unit_m:g} m, and no more than "
            f"{_LARGEST_M:g} m is read; give its unit, or export it again"
        )
    return Surface(surface.vertices @ source.rotation().T * source.unit_m, surface.faces), source


def _read(kind: str, content: bytes, folder: Path) -> tuple[Surface, Declared]:
    if kind in (".glb", ".gltf"):

        def fetch(name: str) -> bytes:
            try:
                return (folder / name).read_bytes()
            except OSError as error:
                raise DamagedMesh(
                    f"its buffer {name[:80]!r} cannot be read ({error.strerror}); keep the file's parts "
                    "together, or export it as .glb"
                ) from None

        return read_gltf(content, fetch), DECLARED
    if kind == ".dae":
        return read_dae(content)
    return {".obj": read_obj, ".stl": read_stl, ".ply": read_ply}[kind](content), Declared()
