"""What is refused before any tracing: each message names the argument, the value and the way out."""

from __future__ import annotations

import warnings

import jax
import numpy as np

from august_jax.physics.cells import Cells


def is_concrete(value) -> bool:
    """False for the abstract values inside jit, grad and vmap, whose numbers cannot be looked at."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(value))


def check_cells(cells: Cells) -> None:
    """Raise ValueError for cells whose shapes disagree or whose numbers make no body."""
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
    if not is_concrete(cells):
        return
    cells = jax.tree.map(np.asarray, cells)  # under jit, jnp would trace even what is done to constants
    for name in ("positions", "volumes", "fill", "normals", "centroids"):
        value = getattr(cells, name)
        if value is not None and not np.all(np.isfinite(value)):
            raise ValueError(f"cells.{name}: holds NaN or infinity; remove those cells")
    if np.min(cells.volumes) <= 0.0:
        raise ValueError(f"cells.volumes: smallest is {np.min(cells.volumes):g} m^3; every volume must be positive")
    if np.min(cells.fill) <= 0.0 or np.max(cells.fill) > 1.0 + 1e-6:
        raise ValueError(
            f"cells.fill: ranges over [{np.min(cells.fill):g}, {np.max(cells.fill):g}]; fractions lie in (0, 1]: "
            "drop empty cells"
        )
    unique = np.unique(np.asarray(cells.positions), axis=0)
    if len(unique) < count:
        raise ValueError(f"cells.positions: {count - len(unique)} of {count} cells coincide with others; merge them")


_CELLS_A_WAVELENGTH = 4.0
"""Fewer cells a wavelength in the material are warned of: |m| k d beyond about 1.5, past what is usual for dipoles."""


def warn_of_coarse_cells(cells: Cells, contrast, wavenumber) -> None:
    """Warn where the wavelength in the material, thinned by the cells' fill, is under-resolved; numbers only."""
    if not is_concrete((cells, contrast, wavenumber)):
        return
    fill = np.broadcast_to(np.asarray(cells.fill), np.shape(cells.volumes))
    index = np.sqrt(np.abs(1.0 + fill * np.asarray(contrast)))
    resolved = 2.0 * np.pi / (index * wavenumber * np.cbrt(np.asarray(cells.volumes)))
    worst = int(np.argmin(resolved))
    if resolved[worst] < _CELLS_A_WAVELENGTH:
        edge = float(np.cbrt(np.asarray(cells.volumes)[worst]))
        warnings.warn(
            f"cells.volumes: cells of {1e3 * edge:.3g} mm make {resolved[worst]:.2g} a wavelength in their material; "
            f"use {1e3 * edge * resolved[worst] / _CELLS_A_WAVELENGTH:.2g} mm or less",
            stacklevel=3,
        )


def check_contrast(contrast, count: int) -> None:
    """Raise ValueError for a contrast that is neither a scalar nor (N,), or not finite."""
    if np.shape(contrast) not in ((), (count,)):
        raise ValueError(f"contrast: got shape {np.shape(contrast)}; give a scalar or ({count},), one value a cell")
    if is_concrete(contrast) and not np.all(np.isfinite(contrast)):
        raise ValueError("contrast: holds NaN or infinity; see august_jax.physics.contrast for the material's value")
