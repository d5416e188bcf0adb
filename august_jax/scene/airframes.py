"""What flies: airframes from five procedural families or from mesh files, their cells and their surface samples.

Body frame: x forward, y to the left, z up, metres, origin at the area centroid of the surface. Faces given twice, in
either winding, count once: they are dropped on the way in. The half-wheelbase is half of the largest horizontal
distance between two rotor axes, for every number of arms (on a three-arm craft: 0.866 of the arms' length).

The body that scatters is the fixed lattice of :meth:`Airframe.cells`; the label is sampled apart from it with
:meth:`Airframe.sample_surface`.
"""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.physics.cells import Cells
from august_jax.scene import families
from august_jax.scene.lattice import shell_cells, touched_cells
from august_jax.scene.rotors import estimate_half_wheelbase

if TYPE_CHECKING:
    import trimesh

AIRFRAMES = tuple(families.FAMILIES)
"""Names of the procedural families."""

UNITS_M = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254, "ft": 0.3048}
"""Length units of mesh files [m]."""

FORMATS = (".obj", ".stl", ".ply", ".glb", ".gltf", ".dae")
"""Mesh files that :func:`load_airframe` reads."""

_AXES = {sign + axis: factor * np.eye(3)[column]
         for column, axis in enumerate("xyz") for sign, factor in (("", 1.0), ("-", -1.0))}
_COARSER = 1.05


@dataclass(frozen=True, eq=False)
class Airframe:
    """A rigid body in its own frame (x forward, z up, origin at the surface's area centroid).

    Attributes:
        name: family, or stem of the mesh file.
        mesh: the surface [m], vertices merged, no faces of zero area, none given twice.
        half_wheelbase_m: half of the largest horizontal distance between two rotor axes [m]; of a loaded mesh, an
            estimate.
        rotor_axes_m: centres of the rotors (R, 3) [m], or None where they are not known.
    """

    name: str
    mesh: trimesh.Trimesh
    half_wheelbase_m: float
    rotor_axes_m: np.ndarray | None = None
    _last: dict[tuple[float, float], Cells] = field(default_factory=dict, init=False, repr=False)
    """The lattice made last: :meth:`cell_size_for` makes what :meth:`cells` is asked for next, seconds each."""

    @cached_property
    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Triangles (T, 3, 3) [m] and their cumulative areas (T,) [m^2], float32: the pool of surface samples."""
        triangles = np.asarray(self.mesh.triangles)
        return triangles.astype(np.float32), np.cumsum(_areas(triangles)).astype(np.float32)

    @cached_property
    def digest(self) -> str:
        """Sixteen hexadecimal digits that identify the surface by content, to the nanometre."""
        content = hashlib.sha256(np.round(np.asarray(self.mesh.vertices) * 1e9).astype("<i8").tobytes())
        content.update(np.asarray(self.mesh.faces).astype("<i8").tobytes())
        return content.hexdigest()[:16]

    @property
    def radius_m(self) -> float:
        """Largest distance of the surface from the origin [m]."""
        return float(np.linalg.norm(self.mesh.vertices, axis=-1).max())

    def cells(self, cell_m: float, skin_m: float) -> Cells:
        """The body's quadrature: lattice cells that its skin touches (:func:`~august_jax.scene.lattice.shell_cells`).

        Args:
            cell_m: edge of the cells [m].
            skin_m: thickness of the material about the surface [m], at most ``cell_m``.
        """
        wanted = (float(cell_m), float(skin_m))
        if wanted not in self._last:
            cells = shell_cells(self.mesh.triangles, cell_m, skin_m)
            self._last.clear()
            self._last[wanted] = cells
        return self._last[wanted]

    def cell_size_for(self, max_cells: int, cell_m: float, skin_m: float) -> float:
        """The finest of the sizes cell_m * 1.05^k, k = 0, 1, ... [m] that needs at most ``max_cells`` cells."""
        if max_cells < 1:
            raise ValueError(f"max_cells={max_cells!r}: wanted at least 1")
        size = cell_m
        # counting the cells of the bare surface is cheap and seldom too high
        while touched_cells(self.mesh.triangles, size) > max_cells:
            size *= _COARSER
        while self.cells(size, skin_m).count > max_cells:
            size *= _COARSER
        return size

    def sample_surface(self, key: jax.Array, count: int) -> jax.Array:
        """``count`` area-uniform points of the surface (count, 3) float32 [m]."""
        return _sample_triangles(key, *self.surface, count)

    def scaled(self, half_wheelbase_m: float) -> Airframe:
        """A copy of another size, all lengths in proportion, with the given half-wheelbase [m]."""
        _require_positive("half_wheelbase_m", half_wheelbase_m)
        factor = half_wheelbase_m / self.half_wheelbase_m
        mesh = self.mesh.copy()
        mesh.apply_scale(factor)
        axes = None if self.rotor_axes_m is None else self.rotor_axes_m * factor
        return Airframe(self.name, mesh, float(half_wheelbase_m), axes)


def sample_triangles(key: jax.Array, triangles: jax.Array, cumulative_area: jax.Array, count: int) -> jax.Array:
    """Area-uniform points on triangles; pure, so that it may be jitted and vmapped over keys.

    Args:
        key: a ``jax.random`` key.
        triangles: corners (T, 3, 3) [m].
        cumulative_area: running sum of their areas (T,) [m^2].
        count: number of points, static.

    Returns:
        points (count, 3) [m].
    """
    which, where = jax.random.split(key)
    level = jax.random.uniform(which, (count,)) * cumulative_area[-1]
    chosen = jnp.clip(jnp.searchsorted(cumulative_area, level, side="right"), 0, len(triangles) - 1)
    u, v = jax.random.uniform(where, (2, count, 1))
    root = jnp.sqrt(u)
    a, b, c = jnp.moveaxis(jnp.asarray(triangles)[chosen], 1, 0)
    return (1.0 - root) * a + root * (1.0 - v) * b + root * v * c


_sample_triangles = jax.jit(sample_triangles, static_argnums=3)


def procedural_airframe(name: str, half_wheelbase_m: float = 0.25) -> Airframe:
    """One of the five families in :data:`AIRFRAMES`, scaled to a half-wheelbase [m]."""
    if name not in AIRFRAMES:
        raise ValueError(f"name={name!r}: no such airframe; choose one of {', '.join(AIRFRAMES)}")
    _require_positive("half_wheelbase_m", half_wheelbase_m)
    parts, rotors = families.build(name)
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + offset for (_, faces), offset in zip(parts, offsets)])
    return _airframe(name, vertices, faces, families.REFERENCE_HALF_WHEELBASE_M, rotors).scaled(half_wheelbase_m)


def load_airframe(
    path: str | Path,
    *,
    unit: str | float = "m",
    up: str = "z",
    forward: str = "x",
    half_wheelbase_m: float | None = None,
) -> Airframe:
    """An airframe from a mesh file: OBJ, STL, PLY, GLB, glTF, or COLLADA (.dae, with the extra ``dae``).

    The transforms of the file's scene are applied; its materials and textures are not read. Units and axes are those
    of the arguments, whatever the file declares.

    Args:
        path: the file.
        unit: length of the file's unit: "m", "cm", "mm", "in", "ft", or a number of metres.
        up: the file's axis that points up: "x", "y", "z", "-x", "-y" or "-z".
        forward: the file's axis that points forward, perpendicular to ``up``.
        half_wheelbase_m: scale the craft so that its half-wheelbase, estimated from the geometry, equals this [m];
            None keeps its size.

    Raises:
        ValueError: the file is missing, unreadable, of another format or without faces, or an argument is wrong.
    """
    path = Path(path)
    scale = _unit(unit)
    for argument, axis in (("up", up), ("forward", forward)):
        if axis not in _AXES:
            raise ValueError(f"{argument}={axis!r}: choose one of {', '.join(_AXES)}")
    if up[-1] == forward[-1]:
        raise ValueError(f"up={up!r}, forward={forward!r}: the two must be perpendicular")
    if half_wheelbase_m is not None:
        _require_positive("half_wheelbase_m", half_wheelbase_m)
    vertices, faces = _read(path, scale)
    rotation = np.stack([_AXES[forward], np.cross(_AXES[up], _AXES[forward]), _AXES[up]])
    try:
        airframe = _airframe(path.stem, vertices @ rotation.T * scale, faces, None)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return airframe if half_wheelbase_m is None else airframe.scaled(half_wheelbase_m)


def resolve_airframe(text: str, half_wheelbase_m: float) -> Airframe:
    """The airframe that a configuration names: a procedural family, or a mesh file in metres, z up, x forward."""
    if text in AIRFRAMES:
        return procedural_airframe(text, half_wheelbase_m)
    if Path(text).suffix.lower() in FORMATS or Path(text).exists():
        return load_airframe(text, half_wheelbase_m=half_wheelbase_m)
    raise ValueError(
        f"airframe {text!r}: neither a family ({', '.join(AIRFRAMES)}) nor a mesh file ({', '.join(FORMATS)})"
    )


def _airframe(name, vertices, faces, half_wheelbase_m, rotor_axes_m=None) -> Airframe:
    import trimesh

    vertices, faces = _clean(vertices, faces)
    triangles = vertices[faces]
    centroid = np.average(triangles.mean(axis=1), axis=0, weights=_areas(triangles))
    vertices = vertices - centroid
    if rotor_axes_m is not None:
        rotor_axes_m = rotor_axes_m - centroid
    if half_wheelbase_m is None:
        half_wheelbase_m = estimate_half_wheelbase(vertices, faces)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return Airframe(name, mesh, half_wheelbase_m, rotor_axes_m)


def _clean(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices that coincide; drop faces that are not finite, have no area, or are given twice."""
    faces = faces[np.isfinite(vertices).all(axis=1)[faces].all(axis=1)]
    if not len(faces):
        raise ValueError("holds no faces with finite corners")
    corners = vertices[faces]
    extent = np.ptp(corners.reshape(-1, 3), axis=0).max()
    if extent == 0.0:
        raise ValueError("all faces have zero area")
    used, faces = np.unique(faces, return_inverse=True)
    grid = np.round(vertices[used] / (1e-6 * extent)).astype(np.int64)
    _, first, merged = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    vertices, faces = vertices[used][first], merged.reshape(-1)[faces].reshape(-1, 3)
    faces = faces[_areas(vertices[faces]) > 1e-12 * extent**2]
    if not len(faces):
        raise ValueError("all faces have zero area")
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(once)]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _read(path: Path, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) in the file's unit and faces (F, 3) of all meshes of a file, at their places in its scene."""
    kind = path.suffix.lower()
    if kind not in FORMATS:
        raise ValueError(f"{path}: unknown mesh format {kind!r}; wanted one of {', '.join(FORMATS)}")
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    if kind == ".dae":
        try:
            import collada  # noqa: F401  trimesh reads COLLADA through it
        except ImportError:
            raise ValueError(f"{path}: COLLADA needs pycollada; pip install -c constraints.txt pycollada") from None
    import trimesh

    # textures and materials are of no use here, and may be missing
    options = {"skip_materials": True} if kind in (".obj", ".glb", ".gltf") else {}
    try:
        scene = trimesh.load_scene(path, process=False, **options)
        meshes = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh) and len(part.faces)]
    except Exception as error:  # the readers raise whatever their parsers raise
        unknown = isinstance(error, ImportError)  # it guesses the encoding of what is neither binary nor text
        reason = "unknown encoding" if unknown else (str(error) or type(error).__name__).splitlines()[0]
        raise ValueError(f"{path}: not a readable {kind} file ({reason[:120]})") from None
    if not meshes:
        raise ValueError(f"{path}: holds no faces")
    declared = _declared_unit(meshes[0].units)
    if declared is not None and not np.isclose(declared, scale, rtol=1e-3):
        warnings.warn(f"{path}: declares a unit of {declared:g} m, but is read with unit={scale:g} m", stacklevel=3)
    offsets = np.cumsum([0] + [len(part.vertices) for part in meshes])
    faces = [np.asarray(part.faces) + offset for part, offset in zip(meshes, offsets)]
    return np.concatenate([np.asarray(part.vertices, dtype=np.float64) for part in meshes]), np.concatenate(faces)


def _declared_unit(text: str | None) -> float | None:
    """Metres in a unit as trimesh reports a COLLADA file's, such as "0.001 * meters"; files that declare nothing are
    reported as "meters", which therefore says nothing."""
    number, _, rest = (text or "").partition(" * ")
    return float(number) if rest == "meters" else None


def _unit(unit: str | float) -> float:
    if unit in UNITS_M:
        return UNITS_M[unit]
    try:
        scale = float(unit)
    except (TypeError, ValueError):
        scale = np.nan
    if not (np.isfinite(scale) and scale > 0.0):
        raise ValueError(f"unit={unit!r}: choose one of {', '.join(UNITS_M)}, or give a number of metres")
    return scale


def _areas(triangles: np.ndarray) -> np.ndarray:
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return 0.5 * np.linalg.norm(cross, axis=-1)


def _require_positive(argument: str, value: float) -> None:
    if not (np.isfinite(value) and value > 0.0):
        raise ValueError(f"{argument}={value!r}: wanted a positive number of metres")
