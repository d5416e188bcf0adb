"""``august rcs``: the radar cross-section of a craft over azimuth, elevation and frequency."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from typing import Any

from august_jax.app.cli.common import chosen_config, folder, material, material_arguments, mesh_airframe, mesh_arguments
from august_jax.app.cli.messages import UsageError, command_line, note, options, say, table
from august_jax.app.cli.parser import Command, numbers
from august_jax.config import Bounds, ConfigError

_AZIMUTH, _ELEVATION = Bounds(-360.0, 360.0, "degrees"), Bounds(-90.0, 90.0, "degrees")
_GHZ = Bounds(0.1, 100.0, "GHz")
_MOST = 200_000
_MOST_ENTRIES = 40_000_000  # of T-matrices, 320 MB
_POINTS = 500  # of the craft, in the middle of the lobe
_CHANNELS = ("hh", "hv", "vh", "vv")


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(places=1)
    parser.usage = f"{parser.prog} [AIRFRAME] [options] [section.field=value ...]"
    mesh_arguments(parser, required=False)
    parser.add_argument(
        "--azimuth", type=steps(_AZIMUTH), default=(-180.0, 180.0, 2.0), metavar="A:B:STEP",
        help="from A to B in steps [deg], 0 ahead, 90 to the left (default -180:180:2)",
    )  # fmt: skip
    parser.add_argument(
        "--elevation", type=steps(_ELEVATION), default=(-90.0, 90.0, 5.0), metavar="A:B:STEP",
        help="likewise, 90 above (default -90:90:5)",
    )  # fmt: skip
    parser.add_argument(
        "--frequency", type=frequencies, metavar="GHZ,...", help="[GHz] (default: the configuration's tones)"
    )
    parser.add_argument(
        "--transmit", type=numbers(2, _AZIMUTH), metavar="AZ,EL",
        help="where the transmitter is, seen from the craft [deg] (default: where the receiver is)",
    )  # fmt: skip
    parser.add_argument(
        "--t-matrix", action="store_true", help="also write the craft as T-matrices, tmatrix.npz and tmatrix.mat"
    )
    material_arguments(parser)


def steps(within: Bounds) -> Callable[[str], tuple[float, float, float]]:
    """An argparse type: ``A:B:STEP``, or one number."""
    inside = numbers(1, within)

    def read(text: str) -> tuple[float, float, float]:
        parts = text.split(":")
        if len(parts) == 1:
            (alone,) = inside(text)
            return alone, alone, 1.0
        if len(parts) != 3:
            raise argparse.ArgumentTypeError(f"{text!r} is neither A:B:STEP nor a number, e.g. -180:180:5")
        low, high = (inside(part)[0] for part in parts[:2])
        (step,) = numbers(1, Bounds(1e-3, 360.0, "degrees"))(parts[2])
        if not low < high:
            raise argparse.ArgumentTypeError(f"{text!r}: the end is not above the beginning, e.g. -180:180:5")
        return low, high, step

    read.takes = f"each end {within}"  # type: ignore[attr-defined]
    return read


def frequencies(text: str) -> tuple[float, ...]:
    """An argparse type: growing numbers of GHz."""
    found = numbers(text.count(",") + 1, _GHZ)(text)
    if list(found) != sorted(set(found)):
        raise argparse.ArgumentTypeError(f"{text!r}: give each frequency once, the lowest first, e.g. 2.9,3,3.1")
    return found


frequencies.takes = f"each {_GHZ}"  # type: ignore[attr-defined]


def _run(args: argparse.Namespace) -> dict[str, Any]:
    import numpy as np

    from august_jax.app import plotting
    from august_jax.app.export import write_record
    from august_jax.app.lobe import write_lobe
    from august_jax.data.simulator import lattice_of
    from august_jax.files import replacing
    from august_jax.physics import (
        contrast,
        dbsm,
        degree_for,
        factor_body,
        looking,
        scattering_matrix,
        spherical_basis,
        t_matrix,
        wavenumber,
    )
    from august_jax.scene import resolve_airframe
    from august_jax.scene.airframes import AIRFRAMES

    started = time.monotonic()
    if len(args.rest) + (args.mesh is not None) != 1:
        raise UsageError(
            f"AIRFRAME: give a procedural one ({', '.join(AIRFRAMES)}) or --mesh FILE, and not both\n"
            "see: august rcs --help"
        )
    out = folder(args, "august_rcs")
    config = chosen_config(args)
    target = config.target
    if args.mesh is not None:
        airframe = mesh_airframe(args)
    else:
        airframe = resolve_airframe(args.rest[0], args.half_wheelbase or target.half_wheelbase_m)
    azimuth, elevation = (_places(each) for each in (args.azimuth, args.elevation))
    hertz = config.array.frequencies_hz if args.frequency is None else tuple(1e9 * each for each in args.frequency)
    looks = len(azimuth) * len(elevation)
    if looks * len(hertz) > _MOST:
        raise ConfigError(
            f"--azimuth, --elevation: {looks} directions at {len(hertz)} frequencies are more than {_MOST}; take "
            "larger steps"
        )
    degree = degree_for(airframe.radius_m, max(hertz))
    if args.t_matrix and len(hertz) * (2 * degree * (degree + 2)) ** 2 > _MOST_ENTRIES:
        raise ConfigError(
            f"--t-matrix: {len(hertz)} matrices of degree {degree} are more than {_MOST_ENTRIES:.0e} entries; "
            "give fewer or lower frequencies"
        )
    permittivity, conductivity = material(args, target)
    cells, cell_m = lattice_of(airframe, target)
    note(
        f"{airframe.name}: half-wheelbase {airframe.half_wheelbase_m:.3f} m, {cells.count} cells of "
        f"{1e3 * cell_m:.3g} mm; factoring takes up to a minute a frequency, once"
    )
    body = factor_body(cells, list(hertz), nearest_m=_far(airframe.radius_m))
    chi = [complex(contrast(permittivity, conductivity, each)) for each in hertz]
    directions = looking(azimuth[None, :], elevation[:, None]).reshape(-1, 3)
    transmit = None if args.transmit is None else looking(*args.transmit)
    matrix = np.asarray(scattering_matrix(body, directions, np.asarray(chi), transmit=transmit))
    # elevation x azimuth x frequency, as radar toolboxes hold patterns
    matrix = matrix.reshape(len(hertz), len(elevation), len(azimuth), 2, 2).transpose(1, 2, 0, 3, 4)
    power = np.asarray(dbsm(matrix), np.float64)
    entries = {name: power[..., row, column] for name, (row, column) in zip(_CHANNELS, np.ndindex(2, 2))}
    record = {
        "azimuth_deg": azimuth,
        "elevation_deg": elevation,
        "frequency_hz": np.asarray(hertz),
        **{f"rcs_{name}_dbsm": values for name, values in entries.items()},
        "scattering_m": matrix,
        "permittivity": permittivity,
        "conductivity_s_m": conductivity,
        "half_wheelbase_m": airframe.half_wheelbase_m,
    } | ({} if args.transmit is None else {"transmit_deg": np.asarray(args.transmit)})
    summary: list[dict[str, Any]] = [
        {"frequency_hz": each, "polarisation": name, **_summary(entries[name][..., row], elevation)}
        for row, each in enumerate(hertz)
        for name in _CHANNELS
    ]
    out.mkdir(parents=True, exist_ok=True)
    for suffix in ("npz", "mat"):
        write_record(out / f"rcs.{suffix}", record)
    if args.t_matrix:
        basis = spherical_basis(degree)
        matrices = {
            "tmatrix": t_matrix(body, np.asarray(chi), degree).astype(np.complex64),
            "l": basis.degree,
            "m": basis.order,
            "electric": basis.electric,
            "k0_rad_m": np.array([wavenumber(each) for each in hertz]),
            "frequency_hz": np.asarray(hertz),
        }
        for suffix in ("npz", "mat"):
            write_record(out / f"tmatrix.{suffix}", matrices)
    rows = np.stack(
        [
            *(part.ravel() for part in np.meshgrid(elevation, azimuth, hertz, indexing="ij")),
            *(values.ravel() for values in entries.values()),
        ],
        axis=1,
    )
    with replacing(out / "rcs.csv") as aside:
        np.savetxt(aside, rows, fmt=("%.6g", "%.6g", "%.10g", *["%.4f"] * 4), delimiter=",", comments="",
                   header="elevation_deg,azimuth_deg,frequency_hz,hh_dbsm,hv_dbsm,vh_dbsm,vv_dbsm")  # fmt: skip
    title = f"{airframe.name}, {'monostatic' if transmit is None else 'bistatic'}"
    plotting.cross_sections(azimuth, elevation, hertz, entries, out / "rcs.png", title=title)
    made_of = f"permittivity {permittivity:.3g}, conductivity {1e3 * conductivity:.3g} mS/m"
    sites = np.asarray(cells.sites())
    write_lobe(
        out / "rcs.html",
        azimuth,
        elevation,
        hertz,
        entries,
        sites[:: max(1, len(sites) // _POINTS)],
        title=f"{title}: radar cross-section",
        lead=f"Half-wheelbase {airframe.half_wheelbase_m:.3g} m, {made_of}. Distance from the middle is the "
        "cross-section in dB above what the slider leaves out"
        + ("." if args.transmit is None else ", towards the receiver, while the transmitter stands at azimuth "
           f"{args.transmit[0]:g} and elevation {args.transmit[1]:g} degrees."),
    )  # fmt: skip
    say(
        args,
        f"{title}, half-wheelbase {airframe.half_wheelbase_m:.3g} m, {made_of}; error of the reduced body "
        f"{body.error_at(chi[0]):.1e}\n"
        + table(
            [
                ["dBsm", "GHz", "mean", "median", "least", "most"],
                *(
                    [
                        row["polarisation"].upper(),
                        f"{row['frequency_hz'] / 1e9:.4g}",
                        *(f"{row[name]:.1f}" for name in ("mean_dbsm", "median_dbsm", "least_dbsm", "most_dbsm")),
                    ]
                    for row in summary
                ),
            ]
        ),
    )
    again = options(args, "half_wheelbase", "permittivity", "conductivity")
    craft = [*args.rest, *options(args, "mesh")]
    more = ", tmatrix.npz, tmatrix.mat" if args.t_matrix else ""
    say(
        args,
        f"written: {out}/rcs.html, rcs.png, rcs.npz, rcs.mat, rcs.csv{more} in {time.monotonic() - started:.0f} s\n"
        f"next:  {command_line('rcs', *craft, *again, '--transmit', '0,0', '--elevation', '0')}"
        "      seen from all sides while a transmitter stands ahead",
    )
    return {"out": str(out), "airframe": airframe.name, "cells": cells.count, "summary": summary}


def _places(span: tuple[float, float, float]):
    import numpy as np

    low, high, step = span
    return low + step * np.arange(math.floor((high - low) / step * (1.0 + 1e-9)) + 1)


def _far(radius_m: float) -> float:
    """From where a body is factored so that plane waves are among the fields it knows [m]."""
    return max(2.0, math.ceil(5.0 * radius_m))


def _summary(values, elevation_deg) -> dict[str, float]:
    """Mean of the cross-section over the directions, by solid angle, and median, least and most of them [dBsm]."""
    import numpy as np

    weight = np.cos(np.radians(elevation_deg)) + 1e-3  # poles count a little, alone they count
    mean = np.average(10.0 ** (values / 10.0), axis=0, weights=weight).mean()
    return {
        "mean_dbsm": float(10.0 * np.log10(mean)),
        "median_dbsm": float(np.median(values)),
        "least_dbsm": float(values.min()),
        "most_dbsm": float(values.max()),
    }


COMMAND = Command("the radar cross-section of a craft", _arguments, _run, out="august_rcs")
