"""Clouds and samples as files that other programs read: PLY, CSV, NPZ, MATLAB and JSON; every write is atomic.

PLY and CSV hold one cloud, a point a row: its place, permittivity and conductivity. In PLY, binary little-endian, the
material stands as one float per property, which viewers show as scalar fields, and as a colour for those that read no
scalars. The other formats hold a record: a flat mapping of names to arrays, with the unit of each and what its axes
are.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from august_jax.app.page import RAMP
from august_jax.arrays import Array, ArrayLike
from august_jax.files import replacing

FORMATS = ("ply", "csv", "npz", "mat", "json")
"""What ``august export`` writes."""
COLUMNS = ("x", "y", "z", "permittivity", "conductivity")
"""Of a cloud: [m], [1] and [S/m]."""
DESCRIBED: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "time_s": ("s", ()),
    "position": ("m", ("xyz",)),
    "rotation": ("1", ("world xyz", "body xyz")),
    "predicted": ("m", ("xyz",)),
    "snr_db": ("dB", ()),
    "snr_estimate_db": ("dB", ()),
    "power_dbm": ("dBm", ()),
    "permittivity": ("1", ()),
    "conductivity": ("S/m", ()),
    "airframe": ("place in target.airframes", ()),
    "flight": ("number of the flight", ()),
    "slot": ("number of the slot in its flight", ()),
    "truth": ("m", ("point", "xyz")),
    "resampled": ("m", ("point", "xyz")),
    "points": ("m", ("point", "xyz")),
    "point_permittivity": ("1", ("point",)),
    "point_conductivity": ("S/m", ("point",)),
    "normal_estimate": ("1", ("xyz",)),
    "received": ("1, in units of the noise", ("tone", "function of the region", "function of the region")),
    "pilots": ("m, in units of the noise", ("tone", "function of the region", "function of the region")),
    "detected": ("true or false", ()),
    "lost": ("true or false", ()),
    "threshold_m": ("m", ()),
    "true_channel": ("1/m, of time e^{-jwt}", ("tone", "receiving antenna", "sending antenna")),
    "estimated_channel": ("1/m, of time e^{-jwt}", ("tone", "receiving antenna", "sending antenna")),
    "azimuth_deg": ("deg", ("azimuth",)),
    "elevation_deg": ("deg", ("elevation",)),
    "frequency_hz": ("Hz", ("frequency",)),
    "rcs_hh_dbsm": ("dB re 1 m^2", ("elevation", "azimuth", "frequency")),
    "rcs_hv_dbsm": ("dB re 1 m^2", ("elevation", "azimuth", "frequency")),
    "rcs_vh_dbsm": ("dB re 1 m^2", ("elevation", "azimuth", "frequency")),
    "rcs_vv_dbsm": ("dB re 1 m^2", ("elevation", "azimuth", "frequency")),
    "scattering_m": ("m, of time e^{-jwt}", ("elevation", "azimuth", "frequency", "received H V", "sent H V")),
    "conductivity_s_m": ("S/m", ()),
    "half_wheelbase_m": ("m", ()),
    "transmit_deg": ("deg", ("azimuth, elevation",)),
    "tmatrix": ("1, of time e^{-jwt}", ("frequency", "scattered wave", "incident wave")),
    "l": ("degree", ("wave",)),
    "m": ("order", ("wave",)),
    "electric": ("true or false", ("wave",)),
    "k0_rad_m": ("rad/m", ("frequency",)),
}
"""Name of an array of a slot, a sample or a cross-section -> its unit, and its axes, the first one first."""
DESCRIBED_DOPPLER: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "time_s": ("s", ("pulse",)),
    **{f"channel_{name}_1_m": ("1/m, of time e^{-jwt}", ("pulse",)) for name in ("hh", "vv", "hv")},
    "doppler_hz": ("Hz, approaching is positive", ("shift",)),
    **{f"spectrum_{name}_1_m": ("1/m", ("shift",)) for name in ("hh", "vv", "hv")},
    "frequency_hz": ("Hz", ()),
    "rate_hz": ("turns/s, positive anticlockwise seen from above", ("rotor",)),
    "hull_shift_hz": ("Hz, approaching is positive", ()),
    "tip_shift_hz": ("Hz, at most, either way", ("rotor",)),
    "flash_hz": ("1/s", ("rotor",)),
    "position_m": ("m", ("xyz",)),
    "velocity_m_s": ("m/s", ("xyz",)),
    "permittivity": ("1", ()),
    "conductivity_s_m": ("S/m", ()),
    "half_wheelbase_m": ("m", ()),
}
"""The same of what ``august doppler`` writes."""
_GREY = 150


def write_ply(
    path: str | Path,
    points: Array,
    permittivity: ArrayLike,
    conductivity: ArrayLike,
    *,
    span: tuple[float, float] = (1.0, 6.0),
) -> None:
    """Write a cloud as binary PLY with the properties x, y, z, permittivity, conductivity, red, green and blue.

    Args:
        path: the file.
        points: positions (M, 3) [m].
        permittivity: relative permittivities (M,) or one number.
        conductivity: conductivities (M,) or one number [S/m].
        span: permittivities between which colours run from dark to light; points of an unknown one are grey.

    Raises:
        ValueError: the points are no list of places.
    """
    values = _columns(points, permittivity, conductivity)
    kinds = [*((name, "<f4") for name in COLUMNS), *((name, "u1") for name in ("red", "green", "blue"))]
    table = np.empty(len(values), kinds)
    for name, column in zip(COLUMNS, values.T):
        table[name] = column
    colours = _coloured(values[:, 3], span)
    for name, column in zip(("red", "green", "blue"), colours.T):
        table[name] = column
    words = {"<f4": "float", "u1": "uchar"}
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment positions in metres, conductivity in S/m, colours by permittivity from "
        f"{span[0]:g} (dark) to {span[1]:g} (light)",
        f"element vertex {len(table)}",
        *(f"property {words[kind]} {name}" for name, kind in kinds),
        "end_header\n",
    ]
    with replacing(path) as aside:
        aside.write_bytes("\n".join(header).encode("ascii") + table.tobytes())


def write_csv(path: str | Path, points: Array, permittivity: ArrayLike, conductivity: ArrayLike) -> None:
    """Write a cloud as CSV: a line of headings with units, then a point a line. Arguments as of :func:`write_ply`.

    Raises:
        ValueError: the points are no list of places.
    """
    values = _columns(points, permittivity, conductivity)
    with replacing(path) as aside:
        np.savetxt(aside, values, fmt="%.9g", delimiter=",", comments="",
                   header="x_m,y_m,z_m,permittivity,conductivity_s_m")  # fmt: skip


def _columns(points: Array, permittivity: ArrayLike, conductivity: ArrayLike) -> np.ndarray:
    points = np.asarray(points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: shape {points.shape} where (M, 3) is wanted; write one cloud a file")
    values = np.empty((len(points), len(COLUMNS)), np.float32)
    values[:, :3] = points
    values[:, 3] = permittivity
    values[:, 4] = conductivity
    return values


def _coloured(values: np.ndarray, span: tuple[float, float]) -> np.ndarray:
    """Colours (M, 3) of numbers (M,), grey where they are none."""
    level = np.clip((values - span[0]) / max(span[1] - span[0], 1e-30), 0.0, 1.0) * (len(RAMP) - 1)
    known = np.isfinite(level)
    at = np.arange(len(RAMP))
    colours = np.stack([np.interp(np.where(known, level, 0.0), at, each) for each in np.transpose(RAMP)], axis=-1)
    return np.where(known[:, None], np.round(colours), _GREY).astype(np.uint8)


def write_record(
    path: str | Path, record: Mapping[str, Any], *, described: Mapping[str, tuple[str, tuple[str, ...]]] | None = None
) -> None:
    """Write a flat mapping of arrays; the suffix of ``path`` says how: ``.npz``, ``.mat`` or ``.json``.

    JSON turns a complex array into ``{"real": ..., "imag": ...}`` and numbers that are not finite into null.

    Args:
        path: the file.
        record: arrays by name.
        described: name -> unit and axes, as :data:`DESCRIBED`; what it says of the names in the record is also written,
            as ``units`` and ``axes``: in MATLAB structures, in JSON objects, in NPZ arrays of pairs of a name and a
            text.

    Raises:
        ValueError: another suffix.
    """
    path = Path(path)
    arrays = {name: np.asarray(value) for name, value in record.items()}
    about: dict[str, dict[str, str]] = {}
    if described is not None:
        known = {name: described[name] for name in arrays if name in described}
        about = {
            "units": {name: unit for name, (unit, _) in known.items()},
            "axes": {name: " x ".join(axes) or "one number" for name, (_, axes) in known.items()},
        }
    with replacing(path) as aside:
        if path.suffix == ".npz":
            pairs = {name: np.array(list(texts.items())) for name, texts in about.items()}
            np.savez_compressed(aside, **arrays, **pairs)  # type: ignore[arg-type]
        elif path.suffix == ".mat":
            from scipy.io import savemat

            savemat(aside, {**arrays, **about}, do_compression=True, oned_as="row")
        elif path.suffix == ".json":
            plain = {name: _plain(array) for name, array in arrays.items()} | about
            aside.write_text(json.dumps(plain, allow_nan=False), encoding="utf-8")
        else:
            raise ValueError(f"path: unknown suffix {path.suffix!r}; a record is written as .npz, .mat or .json")


def _plain(array: np.ndarray) -> Any:
    if np.iscomplexobj(array):
        return {"real": _plain(array.real), "imag": _plain(array.imag)}
    if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
        return np.where(np.isfinite(array), array.astype(object), np.array(None)).tolist()
    return array.tolist()
