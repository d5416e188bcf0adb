"""What flies: airframes from five procedural families or from mesh files, their cells and their surface samples.

How mesh files are read, with their units, axes and damage, is in :mod:`august_jax.scene.mesh_files`.

Body frame: x forward, y to the left, z up, metres, origin at the area centroid of the surface. Faces given twice, in
either winding, count once: they are dropped on the way in. The half-wheelbase is half of the largest horizontal
distance between two rotor axes, for every number of arms (on a three-arm craft: 0.866 of the arms' length).

The body that scatters is the fixed lattice of :meth:`Airframe.cells`; the label is sampled apart from it with
:meth:`Airframe.sample_surface`.
"""

from __future__ import annotations

import hashlib
import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from august_jax.arrays import Array
from august_jax.physics.cells import Cells
from august_jax.scene import families
from august_jax.scene.lattice import check_sizes, shell_cells, touched_cells
from august_jax.scene.mesh_files import AUTO, FORMATS, MeshSource, read_mesh
from august_jax.scene.rotors import estimate_half_wheelbase

if TYPE_CHECKING:
    import trimesh

AIRFRAMES = tuple(families.FAMILIES)
"""Names of the procedural families."""

SIZES_M = (0.001, 100.0)
"""Smallest and largest half-wheelbase that is asked for [m]."""
FEWEST_CELLS = 8
"""Cells of the coarsest body: one an octant. With fewer, front and rear or left and right are one cell."""

_IN_NAMES = ("unit", "up", "forward")
"""What may stand after a mesh file's name in a configuration."""
_COARSER = 1.05
_MANY_FLAT = 0.05
"""Share of faces without area that is warned of: exporters leave slivers, 1.3 % in one of 17 published files and less
in the others; a file whose places were lost has many."""


@dataclass(frozen=True, eq=False)
class Airframe:
    """A rigid body in its own frame (x forward, z up, origin at the surface's area centroid).

    Attributes:
        name: family, or stem of the mesh file.
        mesh: the surface [m], vertices merged, no faces of zero area, none given twice.
        half_wheelbase_m: half of the largest horizontal distance between two rotor axes [m]; of a loaded mesh, an
            estimate.
        rotor_axes_m: centres of the rotors (R, 3) [m], or None where they are not known.
        source: of a loaded mesh, its file and the unit and axes that it was read in.
    """

    name: str
    mesh: trimesh.Trimesh
    half_wheelbase_m: float
    rotor_axes_m: Float[np.ndarray, "R 3"] | None = None
    source: MeshSource | None = None
    _last: dict[tuple[float, float], Cells] = field(default_factory=dict, init=False, repr=False)
    """The lattice made last: :meth:`cell_size_for` makes what :meth:`cells` is asked for next, seconds each."""

    @cached_property
    def surface(self) -> tuple[Float[np.ndarray, "T 3 3"], Float[np.ndarray, " T"]]:
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

        Raises:
            ValueError: a size is not positive, the skin is thicker than a cell, or the cells are so coarse that fewer
                than :data:`FEWEST_CELLS` make the body, or so fine that they do not fit in memory.
        """
        cells = self._lattice(cell_m, skin_m)
        if cells.count < FEWEST_CELLS:
            raise ValueError(
                f"cell_m={cell_m!r}: {self.name}, which reaches {self.radius_m:.3g} m out, would be {cells.count} "
                f"cells, without a shape; wanted at least {FEWEST_CELLS}: give {0.5 * self.radius_m:.2g} m or less"
            )
        return cells

    def cell_size_for(self, max_cells: int, cell_m: float, skin_m: float) -> float:
        """The finest of the sizes cell_m * 1.05^k, k = 0, 1, ... [m] that needs at most ``max_cells`` cells.

        Raises:
            ValueError: ``max_cells`` is less than :data:`FEWEST_CELLS`, or a size is wrong as in :meth:`cells`.
        """
        if max_cells < FEWEST_CELLS:
            raise ValueError(f"max_cells={max_cells!r}: so few cells have no shape; wanted at least {FEWEST_CELLS}")
        check_sizes(cell_m, skin_m)
        size = cell_m
        # counting the cells of the bare surface is cheap and seldom too high
        while touched_cells(self.mesh.triangles, size) > max_cells:
            size *= _COARSER
        while self._lattice(size, skin_m).count > max_cells:
            size *= _COARSER
        left = self._lattice(size, skin_m).count
        if left < FEWEST_CELLS and size > cell_m:
            raise ValueError(
                f"max_cells={max_cells!r}: the finest cells that fit are {left}, and a shape takes at "
                f"least {FEWEST_CELLS}; give more"
            )
        self.cells(size, skin_m)  # names cell_m where that alone is too coarse
        return size

    def _lattice(self, cell_m: float, skin_m: float) -> Cells:
        wanted = (float(cell_m), float(skin_m))
        if wanted not in self._last:
            cells = shell_cells(self.mesh.triangles, cell_m, skin_m)
            self._last.clear()
            self._last[wanted] = cells
        return self._last[wanted]

    def sample_surface(self, key: jax.Array, count: int) -> Float[jax.Array, "count 3"]:
        """``count`` area-uniform points of the surface (count, 3) float32 [m]."""
        return _sample_triangles(key, *self.surface, count)

    def scaled(self, half_wheelbase_m: float) -> Airframe:
        """A copy of another size, all lengths in proportion, with the given half-wheelbase [m]."""
        _require_size("half_wheelbase_m", half_wheelbase_m)
        factor = half_wheelbase_m / self.half_wheelbase_m
        mesh = self.mesh.copy()
        mesh.apply_scale(factor)
        axes = None if self.rotor_axes_m is None else self.rotor_axes_m * factor
        return Airframe(self.name, mesh, float(half_wheelbase_m), axes, self.source)


def sample_triangles(
    key: jax.Array, triangles: Float[Array, "T 3 3"], cumulative_area: Float[Array, " T"], count: int
) -> Float[jax.Array, "count 3"]:
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
    _require_size("half_wheelbase_m", half_wheelbase_m)
    parts, rotors = families.build(name)
    offsets = np.cumsum([0] + [len(vertices) for vertices, _ in parts])
    vertices = np.concatenate([vertices for vertices, _ in parts])
    faces = np.concatenate([faces + offset for (_, faces), offset in zip(parts, offsets)])
    return _airframe(name, vertices, faces, families.REFERENCE_HALF_WHEELBASE_M, rotors).scaled(half_wheelbase_m)


def load_airframe(
    path: str | Path,
    *,
    unit: str | float = AUTO,
    up: str = AUTO,
    forward: str = AUTO,
    half_wheelbase_m: float | None = None,
) -> Airframe:
    """An airframe from a mesh file: OBJ, STL, PLY, GLB, glTF or COLLADA (.dae).

    The transforms of the file's scene are applied; its materials and textures are not read. Where an argument is
    "auto", unit and axes are those that the file or its format fixes (glTF: metres, y up, z forward; COLLADA: its own
    unit and upward axis), else metres, z up, x forward. An argument that is given wins, with a warning where the file
    says otherwise. What was taken, and why, is in the airframe's ``source``.

    Args:
        path: the file.
        unit: length of the file's unit: "m", "cm", "mm", "in", "ft", a number of metres, or "auto".
        up: the file's axis that points up: "x", "y", "z", "-x", "-y", "-z", or "auto".
        forward: the file's axis that points forward, perpendicular to ``up``, or "auto".
        half_wheelbase_m: scale the craft so that its half-wheelbase, estimated from the geometry, equals this [m];
            None keeps its size.

    Warns:
        UserWarning: the file contradicts an argument, or more than 5 % of its faces have no area.

    Raises:
        ValueError: the file is missing, unreadable, damaged, of another format or without faces, or an argument is
            wrong.
    """
    if half_wheelbase_m is not None:
        _require_size("half_wheelbase_m", half_wheelbase_m)
    surface, source = read_mesh(path, unit=unit, up=up, forward=forward)
    try:
        airframe = _airframe(Path(path).stem, surface.vertices, surface.faces, None, source=source)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    airframe = replace(airframe, source=source.doubted(np.asarray(airframe.mesh.extents)))
    return airframe if half_wheelbase_m is None else airframe.scaled(half_wheelbase_m)


def resolve_airframe(text: str, half_wheelbase_m: float) -> Airframe:
    """The airframe that a configuration names: a procedural family, or a mesh file.

    After a mesh file's name may stand its unit and axes, as :func:`load_airframe` takes them, such as
    ``drone.stl?unit=mm&up=y&forward=-z``; a file whose own name looks so is taken as it is.

    Args:
        text: the name.
        half_wheelbase_m: size to scale the craft to [m].

    Raises:
        ValueError: there is no such family or file, or its unit or axes are wrong.
    """
    if text in AIRFRAMES:
        return procedural_airframe(text, half_wheelbase_m)
    path, arguments = _mesh_and_arguments(text)
    if path.suffix.lower() in FORMATS or path.exists():
        try:
            return load_airframe(path, half_wheelbase_m=half_wheelbase_m, **arguments)
        except ValueError as error:
            raise ValueError(f"airframe {text!r}: {error}" if arguments else str(error)) from None
    raise ValueError(
        f"airframe {text!r}: neither a family ({', '.join(AIRFRAMES)}) nor a mesh file ({', '.join(FORMATS)})"
    )


def mesh_path(text: str) -> Path | None:
    """The mesh file behind a name that :func:`resolve_airframe` takes; None for a family, or where no file is."""
    if text in AIRFRAMES:
        return None
    path, _ = _mesh_and_arguments(text)
    return path if path.is_file() else None


def _mesh_and_arguments(text: str) -> tuple[Path, dict[str, str]]:
    """File and arguments of "file?key=value&key=value"."""
    name, mark, query = text.rpartition("?")
    if not mark or Path(text).is_file():
        return Path(text), {}
    arguments: dict[str, str] = {}
    for item in query.split("&"):
        key, equals, value = item.partition("=")
        if key not in _IN_NAMES or not equals or not value or key in arguments:
            raise ValueError(
                f"airframe {text!r}: {item!r} is not one of {', '.join(_IN_NAMES)}, each once and with a "
                f"value, such as {name}?unit=mm&up=y&forward=-z"
            )
        arguments[key] = value
    return Path(name), arguments


def _airframe(
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    half_wheelbase_m: float | None,
    rotor_axes_m: np.ndarray | None = None,
    source: MeshSource | None = None,
) -> Airframe:
    import trimesh

    vertices, faces = _clean(vertices, faces, name if source is None else source.path)
    triangles = vertices[faces]
    centroid = np.average(triangles.mean(axis=1), axis=0, weights=_areas(triangles))
    vertices = vertices - centroid
    if rotor_axes_m is not None:
        rotor_axes_m = rotor_axes_m - centroid
    if half_wheelbase_m is None:
        half_wheelbase_m = estimate_half_wheelbase(vertices, faces)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return Airframe(name, mesh, half_wheelbase_m, rotor_axes_m, source)


def _clean(vertices: np.ndarray, faces: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices that coincide; drop faces that have no area, with a warning if many, or are given twice."""
    given = len(faces)
    extent = np.ptp(vertices[faces].reshape(-1, 3), axis=0).max()
    if extent == 0.0:
        raise ValueError("all faces have zero area; wanted a surface: export the mesh again")
    used, faces = np.unique(faces, return_inverse=True)
    grid = np.round(vertices[used] / (1e-6 * extent)).astype(np.int64)
    _, first, merged = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    vertices, faces = vertices[used][first], merged.reshape(-1)[faces].reshape(-1, 3)
    faces = faces[_areas(vertices[faces]) > 1e-12 * extent**2]
    if not len(faces):
        raise ValueError("all faces have zero area; wanted a surface: export the mesh again")
    if given - len(faces) > _MANY_FLAT * given:
        warnings.warn(
            f"{name}: {given - len(faces)} of {given} faces have no area and were left out; if the craft has holes, "
            "export the mesh again",
            stacklevel=4,
        )
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    faces = faces[np.sort(once)]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3)


def _areas(triangles: np.ndarray) -> np.ndarray:
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return 0.5 * np.linalg.norm(cross, axis=-1)


def _require_size(argument: str, value: float) -> None:
    low, high = SIZES_M
    if not low <= value <= high:  # NaN too
        raise ValueError(f"{argument}={value!r}: wanted a number of metres from {low:g} to {high:g}")
