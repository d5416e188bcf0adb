"""``august rcs``: the radar cross-section of a craft over azimuth, elevation and frequency."""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple, get_args

from august_jax.app.cli.common import (
    chosen_config,
    folder,
    material,
    material_arguments,
    mesh_again,
    mesh_airframe,
    mesh_arguments,
    mesh_record,
)
from august_jax.app.cli.messages import UsageError, command_line, note, options, say, table
from august_jax.app.cli.parser import Command, numbers
from august_jax.app.cli.results import kept
from august_jax.config import Bounds, ConfigError, Family

_STEP = Bounds(1e-3, 360.0, "degrees")
_AZIMUTH, _ELEVATION = Bounds(-360.0, 360.0, "degrees"), Bounds(-90.0, 90.0, "degrees")
_GHZ = Bounds(0.1, 100.0, "GHz")
_MOST = 200_000
_MOST_ENTRIES = 40_000_000  # of T-matrices, 320 MB
_POINTS = 500  # of the craft, in the middle of the lobe
_CHANNELS = ("hh", "hv", "vh", "vv")


class _Steps(NamedTuple):
    """From ``low`` to ``high`` in steps of ``step``; in words as it is typed."""

    low: float
    high: float
    step: float

    def __str__(self) -> str:
        return ":".join(f"{each:.12g}" for each in self) if self.low < self.high else f"{self.low:.12g}"


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(places=1)
    parser.usage = f"{parser.prog} [AIRFRAME] [options] [section.field=value ...]"
    parser.epilog = (
        f"AIRFRAME is a procedural one: {', '.join(get_args(Family))}; in its place --mesh FILE gives another."
    )
    mesh_arguments(parser, required=False)
    parser.add_argument(
        "--azimuth", type=steps(_AZIMUTH), default=_Steps(-180.0, 180.0, 2.0), metavar="A:B:STEP",
        help="from A to B in steps, or one angle [deg], 0 ahead, 90 to the left",
    )  # fmt: skip
    parser.add_argument(
        "--elevation", type=steps(_ELEVATION), default=_Steps(-90.0, 90.0, 5.0), metavar="A:B:STEP",
        help="likewise, 90 above",
    )  # fmt: skip
    parser.add_argument(
        "--frequency", type=frequencies, metavar="GHZ,...", help="[GHz] (default: the configuration's tones)"
    )
    parser.add_argument(
        "--transmit", type=direction, metavar="AZ,EL",
        help="where the transmitter is, seen from the craft [deg] (default: where the receiver is)",
    )  # fmt: skip
    parser.add_argument(
        "--t-matrix", action="store_true", help="also write the craft as T-matrices, tmatrix.npz and tmatrix.mat"
    )
    material_arguments(parser)


def steps(within: Bounds) -> Callable[[str], _Steps]:
    """An argparse type: ``A:B:STEP``, or one number."""
    inside = numbers(1, within)

    def read(text: str) -> _Steps:
        parts = text.split(":")
        if len(parts) == 1:
            (alone,) = inside(text)
            return _Steps(alone, alone, 1.0)
        if len(parts) != 3:
            raise argparse.ArgumentTypeError(f"{text!r} is neither A:B:STEP nor a number, e.g. -180:180:5")
        low, high = (inside(part)[0] for part in parts[:2])
        (step,) = numbers(1, _STEP)(parts[2])
        if not low < high:
            raise argparse.ArgumentTypeError(f"{text!r}: the end is not above the beginning, e.g. -180:180:5")
        return _Steps(low, high, step)

    read.takes = f"each end {within}, the step {_STEP}"  # type: ignore[attr-defined]
    return read


def direction(text: str) -> tuple[float, ...]:
    """An argparse type: an azimuth and an elevation."""
    azimuth, elevation = numbers(2, _AZIMUTH)(text)
    if complaint := _ELEVATION((elevation,)):
        raise argparse.ArgumentTypeError(f"{elevation:g} {complaint}")
    return azimuth, elevation


direction.takes = f"azimuth {_AZIMUTH}, elevation {_ELEVATION}"  # type: ignore[attr-defined]


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
    from august_jax.app.export import DESCRIBED, write_record
    from august_jax.app.lobe import write_lobe
    from august_jax.data.simulator import lattice_of
    from august_jax.files import replacing_together
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
    read = [name for name in ("unit", "up", "forward") if getattr(args, name) != "auto"]
    if args.mesh is None and read:
        raise UsageError(f"--{read[0]}: says how a mesh file is read; leave it out, or give --mesh FILE")
    out = folder(args, "august_rcs")
    config = chosen_config(args)
    target = config.target
    made: dict[str, Any] = {"command_line": command_line(*args.words)}
    if args.mesh is not None:
        airframe = mesh_airframe(args)
        made["craft"] = mesh_record(args, airframe)
        craft = mesh_again(args, airframe)
    else:
        craft = [*args.rest, *options(args, "half_wheelbase")]
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
        **({} if args.transmit is None else {"transmit_deg": np.asarray(args.transmit)}),
        "airframe_name": airframe.name,
        **kept(args, config, made.get("craft")),
    }
    summary: list[dict[str, Any]] = [
        {"frequency_hz": each, "polarisation": name, **_summary(entries[name][..., row], elevation, azimuth)}
        for row, each in enumerate(hertz)
        for name in _CHANNELS
    ]
    matrices: dict[str, Any] | None = None
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
    rows = np.stack(
        [
            *(part.ravel() for part in np.meshgrid(elevation, azimuth, hertz, indexing="ij")),
            *(values.ravel() for values in entries.values()),
        ],
        axis=1,
    )
    title = f"{airframe.name}, {'monostatic' if transmit is None else 'bistatic'}"
    made_of = f"permittivity {permittivity:.3g}, conductivity {1e3 * conductivity:.3g} mS/m"
    sites = np.asarray(cells.sites())
    names = ["rcs.npz", "rcs.html", "rcs.png", "rcs.mat", "rcs.csv"]
    names += ["tmatrix.npz", "tmatrix.mat"] if matrices is not None else []
    with replacing_together(out, names) as aside:
        for suffix in ("npz", "mat"):
            write_record(aside[f"rcs.{suffix}"], record, described=DESCRIBED)
            if matrices is not None:
                write_record(aside[f"tmatrix.{suffix}"], matrices, described=DESCRIBED)
        np.savetxt(aside["rcs.csv"], rows, fmt=("%.6g", "%.6g", "%.10g", *["%.4f"] * 4), delimiter=",", comments="",
                   header="elevation_deg,azimuth_deg,frequency_hz,hh_dbsm,hv_dbsm,vh_dbsm,vv_dbsm")  # fmt: skip
        plotting.cross_sections(azimuth, elevation, hertz, entries, aside["rcs.png"], title=title)
        write_lobe(
            aside["rcs.html"],
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
            repeat=made["command_line"],
        )  # fmt: skip
        if matrices is None:  # those of another craft, maybe
            for suffix in ("npz", "mat"):
                (out / f"tmatrix.{suffix}").unlink(missing_ok=True)
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
    again = options(args, "azimuth", "frequency", "permittivity", "conductivity", "preset")
    again += ["--transmit", "0,0", "--elevation", "0", "--out", f"{out}_bistatic"]
    say(
        args,
        f"written: {out}/: {', '.join(names)} in {time.monotonic() - started:.0f} s\n"
        f"look:  {(out / 'rcs.html').resolve().as_uri()}\n"
        f"next:  {command_line('rcs', *craft, *again, *args.overrides)}"
        "   # seen from all sides while a transmitter stands ahead",
    )
    return {"out": str(out), "airframe": airframe.name, "cells": cells.count, **made, "summary": summary}


def _places(span: _Steps):
    import numpy as np

    low, high, step = span
    return low + step * np.arange(math.floor((high - low) / step * (1.0 + 1e-9)) + 1)


def _far(radius_m: float) -> float:
    """From where a body is factored so that plane waves are among the fields it knows [m]."""
    return max(2.0, math.ceil(5.0 * radius_m))


def _summary(values, elevation_deg, azimuth_deg) -> dict[str, float]:
    """Mean and median of the cross-section over the directions, by solid angle, and least and most of them [dBsm]."""
    import numpy as np

    weight = np.repeat(np.cos(np.radians(elevation_deg))[:, None] + 1e-3, len(azimuth_deg), axis=1)  # poles alone count
    if azimuth_deg[-1] - azimuth_deg[0] > 360.0 - 1e-6:  # both ends are one direction
        weight[:, [0, -1]] *= 0.5
    mean = np.average(10.0 ** (values / 10.0), weights=weight)
    order = np.argsort(values, axis=None)
    below = np.cumsum(weight.ravel()[order])
    return {
        "mean_dbsm": float(10.0 * np.log10(mean)),
        "median_dbsm": float(values.ravel()[order][np.searchsorted(below, 0.5 * below[-1])]),
        "least_dbsm": float(values.min()),
        "most_dbsm": float(values.max()),
    }


COMMAND = Command(
    "the radar cross-section of a craft",
    _arguments,
    _run,
    out="august_rcs",
    first="up to a minute a frequency on two quiet CPU cores",
)
