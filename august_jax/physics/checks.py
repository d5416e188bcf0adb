"""What is refused before any tracing: each message names the argument, the value and the way out.

Every door of the package passes here. Shapes are looked at always; numbers only where they are there, not inside jit,
grad or vmap (:func:`is_concrete`). What is accepted comes back as single or double precision.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial import cKDTree

from august_jax.arrays import ArrayLike
from august_jax.constants import SPEED_OF_LIGHT, VACUUM_PERMITTIVITY
from august_jax.physics.cells import Cells

_GAP = 0.25
"""Centres nearer than this many edges are refused: the dipoles' fields no longer stand for those of cells."""
_CARRIERS = 1e-6  # relative difference of carriers that are the same one
_BAND = 0.1  # how far beyond the tones, relative, the carrier that an array is made for may lie
_VACUUM_OHM = 1.0 / (SPEED_OF_LIGHT * VACUUM_PERMITTIVITY)  # Z0
_OHM_A_SQUARE = 17.0  # of the skins that stand for metal best
_ROTATION = 1e-3  # largest entry of R^T R - I that rounding may leave


def is_concrete(value: object) -> bool:
    """False for the abstract values inside jit, grad and vmap, whose numbers cannot be looked at."""
    if isinstance(value, (float, complex, np.ndarray)):
        return True
    if isinstance(value, jax.Array):
        return not isinstance(value, jax.core.Tracer)
    return not any(isinstance(leaf, (jax.core.Tracer, jax.ShapeDtypeStruct)) for leaf in jax.tree.leaves(value))


def settled(name: str, value: ArrayLike | Sequence) -> ArrayLike:
    """Arrays and nested lists as arrays of single or double precision; plain numbers as they are.

    Whole, boolean and half-precision numbers become float32: their own type would round places and phases away.

    Raises:
        ValueError: what is no array of numbers.
    """
    if isinstance(value, (bool, int, float, complex)):
        return value
    if not hasattr(value, "dtype"):
        try:
            value = np.asarray(value)
        except ValueError as error:
            raise ValueError(f"{name}: got rows of different lengths ({error}); give one array") from None
    dtype = value.dtype
    if jnp.issubdtype(dtype, jnp.inexact) and dtype.itemsize >= 4:
        return value
    if not (jnp.issubdtype(dtype, jnp.number) or jnp.issubdtype(dtype, jnp.bool_)):
        raise ValueError(f"{name}: got entries of type {dtype}; give numbers")
    return value.astype(np.float32)


def settled_cells(cells: Cells) -> Cells:
    """:func:`settled` of every part."""
    return Cells(
        *(
            None if part is None else settled(f"cells.{name}", part)
            for name, part in zip(Cells._fields, cells, strict=True)
        )
    )


def check_frequency(name: str, hertz: object) -> float:
    """A positive, finite number of Hz, as a float."""
    try:
        value = float(hertz)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: got {hertz!r}; give a frequency in Hz, e.g. 3e9") from None
    if isinstance(hertz, str) or not 0.0 < value < math.inf:
        raise ValueError(f"{name}: got {hertz!r}; give a positive frequency in Hz, e.g. 3e9")
    return value


def check_finite(name: str, value: object, way_out: str) -> None:
    """Raise ValueError where concrete numbers, or those of a tree, are NaN or infinite."""
    for leaf in jax.tree.leaves(value):
        if is_concrete(leaf) and not np.all(np.isfinite(leaf)):
            raise ValueError(f"{name}: holds NaN or infinity; {way_out}")


def check_rotation(rotation: object) -> None:
    """Raise ValueError for matrices (..., 3, 3) that turn nothing: stretched, sheared, or mirrors."""
    if np.shape(rotation)[-2:] != (3, 3):
        raise ValueError(f"rotation: got shape {np.shape(rotation)}; give (3, 3), body axes to world axes")
    if not is_concrete(rotation):
        return
    turn = np.asarray(rotation, np.float64)
    off = np.abs(np.swapaxes(turn, -1, -2) @ turn - np.eye(3)).max(initial=0.0)
    if not off < _ROTATION:
        raise ValueError(
            f"rotation: R^T R differs from the identity by {off:.2g}; give a rotation matrix, e.g. of "
            "august_jax.scene.rotation_from_euler"
        )
    if np.any(np.linalg.det(turn) < 0.0):
        raise ValueError("rotation: is a mirror (determinant -1); give a proper rotation, and mirror the body's cells")


def check_ends(array, other, name: str = "receiver") -> None:
    """Raise ValueError where another array, if there is one, has another carrier."""
    if other is not None and not math.isclose(array.frequency_hz, other.frequency_hz, rel_tol=_CARRIERS):
        raise ValueError(
            f"{name}: got carriers of {array.frequency_hz:g} and {other.frequency_hz:g} Hz; make all for one carrier"
        )


def check_band(array, tones: Sequence[float]) -> None:
    """Raise ValueError for an array made for a carrier outside the band of a body's tones, give or take a tenth."""
    low, high = min(tones), max(tones)
    if not (1.0 - _BAND) * low <= array.frequency_hz <= (1.0 + _BAND) * high:
        band = f"{low:g} Hz" if low == high else f"{low:g} to {high:g} Hz"
        raise ValueError(
            f"array: its carrier is {array.frequency_hz:g} Hz, but the body was factored for {band}; "
            "factor the body for the array's tones, or make the array for the body's"
        )


def check_pose(tones: Sequence[float], array, receiver, rotation: object, translation: object) -> None:
    """Raise ValueError for antennas of another carrier than a body's tones, or a pose that is none."""
    for name, value, shape in (("rotation", rotation, (3, 3)), ("translation", translation, (3,))):
        if np.shape(value) != shape:
            raise ValueError(f"{name}: got shape {np.shape(value)}; give {shape}, and vmap for batches")
    check_rotation(rotation)
    check_finite("translation", translation, "give the place of the body's origin (3,) in m")
    check_ends(array, receiver)
    check_band(array, tones)


def check_cells(cells: Cells) -> Cells:
    """Cells of single or double precision.

    Raises:
        ValueError: shapes that disagree, numbers that make no body, or centres nearer than a quarter of a cell.
    """
    cells = settled_cells(cells)
    shape = np.shape(cells.positions)
    if len(shape) != 2 or shape[1] != 3 or shape[0] == 0:
        raise ValueError(f"cells.positions: got shape {shape}; give (N, 3) with N at least 1, and vmap for batches")
    count = shape[0]
    if np.shape(cells.volumes) != (count,):
        raise ValueError(f"cells.volumes: got shape {np.shape(cells.volumes)}; give ({count},), one volume a cell")
    if np.shape(cells.fill) not in ((), (count,)):
        raise ValueError(f"cells.fill: got shape {np.shape(cells.fill)}; give one number or ({count},)")
    if cells.normals is not None and np.shape(cells.normals) not in ((count, 3), (count, 3, 3)):
        raise ValueError(f"cells.normals: got shape {np.shape(cells.normals)}; give ({count}, 3) or ({count}, 3, 3)")
    if cells.centroids is not None and np.shape(cells.centroids) != (count, 3):
        raise ValueError(f"cells.centroids: got shape {np.shape(cells.centroids)}; give ({count}, 3), or None")
    for name, part in zip(Cells._fields, cells, strict=True):
        if part is not None and jnp.issubdtype(jnp.result_type(part), jnp.complexfloating):
            raise ValueError(f"cells.{name}: got complex numbers; give real ones")
    if is_concrete(cells):
        _check_numbers(jax.tree.map(np.asarray, cells))  # under jit, jnp would trace even what is done to constants
    return cells


def _check_numbers(cells: Cells) -> None:
    for name in Cells._fields:
        value = getattr(cells, name)
        if value is not None:
            check_finite(f"cells.{name}", value, "remove those cells")
    if np.min(cells.volumes) <= 0.0:
        raise ValueError(f"cells.volumes: smallest is {np.min(cells.volumes):g} m^3; every volume must be positive")
    if np.min(cells.fill) <= 0.0 or np.max(cells.fill) > 1.0 + 1e-6:
        raise ValueError(
            f"cells.fill: ranges over [{np.min(cells.fill):g}, {np.max(cells.fill):g}]; fractions lie in (0, 1]: "
            "drop empty cells"
        )
    if len(cells.positions) == 1:
        return
    gaps, nearest = cKDTree(cells.positions).query(cells.positions, k=2)
    # Of points that coincide, either may come first.
    itself = nearest[:, 0] == np.arange(len(gaps))
    gap, other = gaps[:, 1], np.where(itself, nearest[:, 1], nearest[:, 0])
    short = gap < _GAP * np.cbrt(cells.volumes)
    if np.any(short):
        first = int(np.argmin(np.where(short, gap, np.inf)))
        one, two = sorted((first, int(other[first])))
        at = ", ".join(f"{value:.6g}" for value in cells.positions[one])
        raise ValueError(
            f"cells.positions: cells {one} and {two} at ({at}) m are {gap[first]:.2g} m apart, less than a quarter of "
            f"their edge, {np.cbrt(cells.volumes[first]):.2g} m ({int(short.sum())} of {len(gap)} cells are so near "
            "to another); merge them, or move the bodies apart"
        )


def check_apart(array, cells: Cells) -> None:
    """Raise ValueError for an antenna within a cell's edge of a cell, or of where it hears the antennas."""
    if not is_concrete((cells, array)):
        return
    antennas = np.asarray(array.positions, np.float64)
    edge = float(np.cbrt(np.max(np.asarray(cells.volumes))))
    for name, places in (("positions", cells.positions), ("centroids", cells.centroids)):
        if places is None:
            continue
        gap = float(cKDTree(antennas).query(np.asarray(places, np.float64))[0].min())
        if gap < edge:
            raise ValueError(f"cells.{name}: a cell is {gap:.3g} m from an antenna; keep the array outside the body")


def check_nearest(nearest_m: float, array, place, name: str) -> None:
    """Raise ValueError for a concrete place (3,) nearer to an antenna than a body was factored for."""
    away = np.asarray(array.positions, np.float64) - np.asarray(place, np.float64)
    gap = math.sqrt(np.einsum("...a,...a->...", away, away).min())
    if not gap >= nearest_m * (1.0 - 1e-6):
        raise ValueError(
            f"{name}: the body is {gap:.3g} m from an antenna, but was factored for {nearest_m:g} m and "
            "beyond; pass a smaller nearest_m to factor_body"
        )


def check_contrast(contrast: ArrayLike, shapes: Sequence[tuple[int, ...]], wanted: str) -> None:
    """Raise ValueError for a contrast of another shape than wanted, or not finite; warn of a body of air."""
    if np.shape(contrast) not in shapes:
        raise ValueError(f"contrast: got shape {np.shape(contrast)}; give {wanted}")
    if not is_concrete(contrast):
        return
    values = np.asarray(contrast)
    if not np.all(np.isfinite(values)):
        raise ValueError("contrast: holds NaN or infinity; see august_jax.physics.contrast for the material's value")
    if not np.any(values):
        warnings.warn("contrast: is 0, a body of air: its echo is zero", stacklevel=3)


ASSUMED_CONTRAST = 2.0
"""Where the material is not known yet, cells are judged at permittivity 3, the middle of plastics and composites."""


def cells_a_wavelength(edge_m: ArrayLike, fill: ArrayLike, contrast: ArrayLike, wavenumber: ArrayLike):
    """How many cells there are to a wavelength in the material thinned by the fill, and how many are wanted.

    With m^2 = 1 + f chi: 2 pi/(|m| k d); and 4 up to |m|^2 = 4, |m|^2 up to 9, 3|m| beyond. Solid spheres of lattice
    cells, 5, 7 and 9 across, were compared with the Mie series at 3 to 32 cells a wavelength. With as many as wanted
    they err by at most 4, 6, 9, 6 and 11 % at permittivity 2, 7, 15, 30 and 80 below their first resonance
    (|m| k a < 2.3), and by 4 and 28 % at 2 and 7 on it; with four, 5 across, by 9, 36, 61, 311 and 110 %.
    """
    index = np.sqrt(np.abs(1.0 + np.asarray(fill) * np.asarray(contrast)))
    return 2.0 * np.pi / (index * wavenumber * edge_m), np.maximum(4.0, np.minimum(index**2, 3.0 * index))


def skin_depths(edge_m: ArrayLike, fill: ArrayLike, contrast: ArrayLike, wavenumber: ArrayLike):
    """How many skin depths of the material, thinned by the fill, a cell's edge is: k d Im m, m^2 = 1 + f chi.

    A field is one number a cell. Beyond one skin depth cells tell that a wave is kept out, and no longer how: solid
    spheres, 5 and 9 cells across, err in their far field by at most 3 % up to 0.3 of it (against Mie's series, ka 0.3
    and 0.7), by 3 to 16 % about a half, and by 4 to 205 % beyond one. Closed skins do better: of 2 mm and 17 ohm a
    square, on spheres of ka 1.3 to 2.9 in cells of 4 to 15 mm, they are off a perfectly conducting sphere by 14 to 20 %
    (37 % where the radius is 1.7 cells), -0.1 to 0.8 dB in the power scattered to all sides; of a tenth of that and
    less by 5 to 74 %, up to 3.4 dB: without loss a skin of cells rings.
    """
    return np.asarray(edge_m * wavenumber * np.sqrt(1.0 + np.asarray(fill) * np.asarray(contrast, complex)).imag)


def warn_of_coarse_cells(edge_m: ArrayLike, fill: ArrayLike, contrast: ArrayLike | None, wavenumber: ArrayLike) -> None:
    """Warn where cells are larger than the skin depth of their material, or else under-resolve the wavelength in it;
    numbers only.

    A contrast that is traced, or None where no material is known yet, is judged at ``ASSUMED_CONTRAST``.
    """
    if not is_concrete((edge_m, fill, wavenumber)):
        return
    known = contrast is not None and is_concrete(contrast)
    chi = np.asarray(contrast if known else ASSUMED_CONTRAST)
    depths = np.where(chi.imag > np.abs(chi.real), skin_depths(edge_m, fill, chi, wavenumber), 0.0)
    if np.max(depths) > 1.0:
        _warn_of_metal(edge_m, fill, chi, depths, wavenumber)
        return
    found, wanted = cells_a_wavelength(edge_m, fill, chi, wavenumber)
    share = found / wanted
    if np.min(share) >= 1.0:
        return
    worst = int(np.argmin(share))
    edge, found, wanted, share = (
        float(np.broadcast_to(part, np.shape(share)).flat[worst]) for part in (edge_m, found, wanted, share)
    )
    material = "their material" if known else f"a material of permittivity {1.0 + ASSUMED_CONTRAST:g}"
    warnings.warn(
        f"cells.volumes: cells of {1e3 * edge:.3g} mm make {found:.2g} a wavelength in {material}, of {wanted:.2g} "
        f"wanted; use {1e3 * edge * share:.2g} mm or less",
        stacklevel=4,
    )


def _warn_of_metal(edge_m, fill, contrast, depths, wavenumber) -> None:
    """Say what cells larger than a skin depth still tell."""
    worst = int(np.argmax(depths))
    edge, part, chi, deep = (
        np.broadcast_to(each, np.shape(depths)).flat[worst] for each in (edge_m, fill, contrast, depths)
    )
    a_square = _VACUUM_OHM / (complex(chi).imag * wavenumber * part * edge)  # 1/(sigma f d), sigma = chi'' k/Z0
    if part > 0.5:
        figure = "a solid part errs by 4 to 200 % of its far field: give it a skin in its place"
    elif a_square < 0.8 * _OHM_A_SQUARE:
        figure = (
            "a closed skin errs by 5 to 75 % of its far field, up to 3 dB in power, one of "
            f"{_OHM_A_SQUARE:g} ohm a square ({a_square / _OHM_A_SQUARE:.2g} of this conductivity) by 20 % and 0.8 dB"
        )
    else:
        figure = "a closed skin is within 20 % of its far field, 0.8 dB in power, of a perfectly conducting one"
    warnings.warn(
        f"contrast: cells of {1e3 * edge:.3g} mm, filled to {part:.2g}, are {deep:.3g} skin depths of their material, "
        f"and cannot tell it from a perfect conductor; {figure}",
        stacklevel=5,
    )


def coarseness(edge_m: ArrayLike, fill: ArrayLike) -> ArrayLike:
    """How coarse cells are, to compare them: edges in wavelengths of a material of ``ASSUMED_CONTRAST``, up to k."""
    found, wanted = cells_a_wavelength(edge_m, fill, ASSUMED_CONTRAST, 1.0)
    return wanted / found


def edges_and_fills(cells: Cells) -> tuple[np.ndarray, np.ndarray]:
    """Edges [m] and fills (N,) of cells whose volumes and fill are concrete."""
    volumes = np.asarray(cells.volumes)
    return np.cbrt(volumes), np.broadcast_to(np.asarray(cells.fill), volumes.shape)
