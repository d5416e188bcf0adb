"""``august doppler``: what a craft's motion and its turning rotors do to its echo, pulse by pulse."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import Any, get_args

from august_jax.app.cli.common import chosen_config, folder, material, material_arguments
from august_jax.app.cli.messages import UsageError, command_line, note, options, say
from august_jax.app.cli.parser import Command, number, numbers
from august_jax.app.cli.results import kept
from august_jax.config import Bounds, ConfigError, Family

_RATE, _SPEED = Bounds(-1000.0, 1000.0, "turns/s"), Bounds(-300.0, 300.0, "m/s")
_METRES, _GHZ = Bounds(-1000.0, 1000.0, "m"), Bounds(0.1, 100.0, "GHz")
_SECONDS, _PULSES = Bounds(1e-3, 10.0, "s"), Bounds(100.0, 1e6, "pulses/s")
_MOST = 50_000
_BLADE_M = 0.012  # cells of a rotor, at most
_GOLDEN = 2.399963  # rad; rotors stand at no angle twice


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(places=1)
    parser.usage = f"{parser.prog} AIRFRAME [options] [section.field=value ...]"
    parser.epilog = f"AIRFRAME is a procedural one: {', '.join(get_args(Family))}."
    parser.add_argument(
        "--half-wheelbase", type=number("target.half_wheelbase_m"), metavar="M",
        help="scale to this half-wheelbase [m] (default: the configuration's)",
    )  # fmt: skip
    parser.add_argument(
        "--rate", type=_rates, default=(90.0, 97.0, 83.0, 93.0), metavar="HZ,...",
        help="turns a second, one number a rotor, repeated as needed; each rotor turns its own way",
    )  # fmt: skip
    parser.add_argument(
        "--velocity", type=numbers(3, _SPEED), default=(0.0, 0.0, 0.0), metavar="VX,VY,VZ", help="of the craft [m/s]"
    )
    parser.add_argument(
        "--position", type=numbers(3, _METRES), default=(0.0, 11.0, 5.0), metavar="X,Y,Z",
        help="of the craft at first, seen from the antennas [m]",
    )  # fmt: skip
    parser.add_argument("--seconds", type=number(_SECONDS), default=0.1, metavar="S", help="how long to listen [s]")
    parser.add_argument("--pulses", type=number(_PULSES), default=10_000.0, metavar="HZ", help="pulses a second [Hz]")
    parser.add_argument(
        "--frequency", type=number(_GHZ), metavar="GHZ", help="[GHz] (default: the configuration's carrier)"
    )
    material_arguments(parser)


def _several(within: Bounds) -> Callable[[str], tuple[float, ...]]:
    def read(text: str) -> tuple[float, ...]:
        return numbers(text.count(",") + 1, within)(text)

    read.takes = f"each {within}"  # type: ignore[attr-defined]
    return read


_rates = _several(_RATE)


def _run(args: argparse.Namespace) -> dict[str, Any]:
    import numpy as np

    from august_jax.app.export import DESCRIBED_DOPPLER, write_record
    from august_jax.files import replacing_together
    from august_jax.physics import (
        AntennaArray,
        Spinning,
        alike,
        blade_flash_rate,
        contrast,
        doppler_shift,
        doppler_spectrum,
        factor_bodies,
        slow_time_channels,
    )
    from august_jax.scene import procedural_airframe, rotorcraft
    from august_jax.scene.airframes import AIRFRAMES

    started = time.monotonic()
    if len(args.rest) != 1 or args.rest[0] not in AIRFRAMES:
        given = f"got {' '.join(args.rest)}; " if args.rest else ""
        raise UsageError(
            f"AIRFRAME: {given}give a procedural one ({', '.join(AIRFRAMES)}): a mesh names no rotors\n"
            "see: august doppler --help"
        )
    out = folder(args, COMMAND.out)
    config = chosen_config(args)
    target = config.target
    count = round(args.seconds * args.pulses)
    if not 16 <= count <= _MOST:
        raise ConfigError(
            f"--seconds, --pulses: {args.seconds:g} s at {args.pulses:g} pulses/s are {count} pulses; give 16 to "
            f"{_MOST}"
        )
    place, velocity = np.array(args.position), np.array(args.velocity)
    airframe = procedural_airframe(args.rest[0], args.half_wheelbase or target.half_wheelbase_m)
    closest_s = np.clip(-place @ velocity / max(float(velocity @ velocity), 1e-12), 0.0, args.seconds)
    nearest, least = float(np.linalg.norm(place + closest_s * velocity)), 2.0 * airframe.radius_m + 0.5
    if nearest < least:
        raise ConfigError(f"--position: {nearest:.2g} m from the antennas at the nearest; keep {least:.2g} m")
    hertz = config.array.frequency_hz if args.frequency is None else 1e9 * args.frequency
    permittivity, conductivity = material(args, target)
    chi = complex(contrast(permittivity, conductivity, hertz))
    parts = rotorcraft(airframe)
    cell_m = parts.hull.cell_size_for(target.max_cells, target.cell_m, target.skin_m)
    cells = parts.hull.cells(cell_m, target.skin_m)
    note(
        f"{airframe.name}: half-wheelbase {airframe.half_wheelbase_m:.3f} m, {cells.count} cells of {1e3 * cell_m:.3g} "
        f"mm and {len(parts.rotors)} rotors, {count} pulses; factoring takes up to a minute, once"
    )
    far = 1.5 * airframe.radius_m + 0.5
    # rotors of one hand are one another's copies; the phases they stand at are drawn apart anyway
    hands = sorted(set(parts.hands.tolist()))
    first = [parts.rotors[parts.hands.tolist().index(hand)] for hand in hands]
    blade_m = max(min(_BLADE_M, cell_m), target.skin_m)
    blades = [each.cells(blade_m, target.skin_m) for each in first]
    hull, *factored = factor_bodies([cells, *blades], hertz, nearest_m=far)
    bodies = dict(zip(hands, alike(factored)))
    rates = [args.rate[row % len(args.rate)] for row in range(len(parts.rotors))]
    spinning = [
        Spinning(bodies[hand], centre, hand * rate, _GOLDEN * row)
        for row, (hand, centre, rate) in enumerate(zip(parts.hands.tolist(), parts.centres_m, rates))
    ]
    towards = -place / np.linalg.norm(place)
    across = np.cross([0.0, 0.0, 1.0], towards)
    if np.linalg.norm(across) < 1e-6:  # straight above: x is as level as any
        across = np.cross([0.0, 1.0, 0.0], towards)
    across = across / np.linalg.norm(across)
    antennas = AntennaArray(np.zeros((2, 3)), np.stack([across, np.cross(towards, across)]), hertz)
    times = np.arange(count) / args.pulses
    channels = np.asarray(
        slow_time_channels(hull, spinning, antennas, np.eye(3), place, times, chi, velocity_m_s=velocity)
    )
    series = {"hh": channels[:, 0, 0], "vv": channels[:, 1, 1], "hv": channels[:, 0, 1]}
    shifts, spectrum = doppler_spectrum(np.stack(list(series.values()), axis=1), 1.0 / args.pulses)
    level = float(np.hypot(towards[0], towards[1]))
    speeds = 2.0 * np.pi * np.abs(rates) * parts.radii_m * level
    tips = [float(each) for each in np.asarray(doppler_shift(speeds, hertz))]
    expected = float(np.asarray(doppler_shift(velocity @ towards, hertz)))
    flashes = [blade_flash_rate(int(blades), rate) for blades, rate in zip(parts.blades, rates)]
    strongest = float(shifts[np.argmax(np.abs(spectrum).max(axis=1))])
    record = {
        "time_s": times,
        **{f"channel_{name}_1_m": values for name, values in series.items()},
        "doppler_hz": shifts,
        **{f"spectrum_{name}_1_m": spectrum[:, row] for row, name in enumerate(series)},
        "frequency_hz": hertz,
        "rate_hz": parts.hands * rates,
        "hull_shift_hz": expected,
        "tip_shift_hz": np.array(tips),
        "flash_hz": np.array(flashes),
        "position_m": place,
        "velocity_m_s": velocity,
        "permittivity": permittivity,
        "conductivity_s_m": conductivity,
        "half_wheelbase_m": airframe.half_wheelbase_m,
        "airframe_name": airframe.name,
        **kept(args, config),
    }
    with replacing_together(out, ("doppler.npz", "doppler.mat", "doppler.png")) as aside:
        for suffix in ("npz", "mat"):
            write_record(aside[f"doppler.{suffix}"], record, described=DESCRIBED_DOPPLER)
        _draw(series, args.pulses, expected, max(tips), min(flashes), aside["doppler.png"], title=airframe.name)
    again = options(
        args,
        *("half_wheelbase", "rate", "position", "seconds", "pulses", "frequency"),
        *("permittivity", "conductivity", "preset"),
    )
    radial, what = _along(place, least, args.seconds)
    again += ["--velocity", radial, "--out", f"{out}_moving"]
    folded = " (folded: more --pulses)" if abs(expected) + max(tips) > args.pulses / 2.0 else ""
    say(
        args,
        f"{airframe.name}, {hertz / 1e9:.4g} GHz, rotors at {', '.join(f'{each:g}' for each in rates)} turns/s\n"
        f"hull     {expected:+.1f} Hz by 2 v/lambda, strongest line at {strongest:+.1f} Hz (approaching is positive)\n"
        f"tips     up to {max(tips):.0f} Hz either way{folded}\n"
        f"flashes  {', '.join(f'{each:g}' for each in sorted(set(flashes)))} a second\n"
        f"written: {out}/doppler.png, doppler.npz, doppler.mat in {time.monotonic() - started:.0f} s\n"
        f"next:  {command_line('doppler', *args.rest, *again, *args.overrides)}   # {what}",
    )
    return {
        "out": str(out),
        "airframe": airframe.name,
        "command_line": command_line(*args.words),
        "pulses": count,
        "hull_shift_hz": expected,
        "strongest_hz": strongest,
        "tip_shift_hz": max(tips),
        "flash_hz": flashes,
    }


def _along(place, least_m: float, seconds: float) -> tuple[str, str]:
    """A velocity of up to 10 m/s along the line of sight, in words, and what it does: nearer where there is room."""
    import numpy as np

    distance = float(np.linalg.norm(place))
    room = 0.8 * (distance - least_m) / seconds
    speed, what = (min(10.0, room), "coming nearer") if room > 1.0 else (-10.0, "going away")
    return ",".join(f"{each:.3g}" for each in -speed * np.asarray(place) / distance + 0.0), what


def _draw(series, pulses: float, hull_hz: float, tip_hz: float, flash_hz: float, png, *, title: str) -> None:
    """Short windows, which show flashes, and one long one, which shows lines; horizontal polarisation."""
    import numpy as np

    from august_jax.app import plotting
    from august_jax.physics import doppler_spectrum, spectrogram

    values = series["hh"]
    figure = plotting.new_figure(11.0, 4.8)
    short, lines = figure.subplots(1, 2)
    window = float(np.clip(0.6 / max(flash_hz, 1.0), 8.0 / pulses, 0.25 * len(values) / pulses))
    picture = spectrogram(values, 1.0 / pulses, window_s=window, hop_s=max(window / 10.0, 1.0 / pulses))
    power = 20.0 * np.log10(np.maximum(np.abs(picture.values), 1e-15))
    drawn = short.pcolormesh(
        1e3 * picture.across,
        picture.doppler_hz,
        power - power.max(),
        vmin=-60,
        vmax=0,
        cmap="viridis",
        shading="nearest",
    )
    figure.colorbar(drawn, ax=short, label="dB of the strongest")
    short.set(
        xlabel="time [ms]", ylabel="Doppler shift [Hz], approaching above", title=f"windows of {1e3 * window:.2g} ms"
    )
    shifts, spectrum = doppler_spectrum(values, 1.0 / pulses)
    level = 20.0 * np.log10(np.maximum(np.abs(spectrum), 1e-15))
    lines.plot(shifts, level - level.max(), color=plotting.MODEL, lw=0.9)
    for edge in (hull_hz - tip_hz, hull_hz + tip_hz):
        for axis in (short.axhline, lines.axvline):
            axis(edge, color=plotting.BASE, lw=0.9, ls="--")
    reach = min(0.5 * pulses, abs(hull_hz) + 1.7 * tip_hz)
    short.set_ylim(-reach, reach)
    lines.set(xlabel="Doppler shift [Hz], dashed: the tips", ylabel="dB of the strongest", xlim=(-reach, reach),
              ylim=(-80, 3), title="all pulses")  # fmt: skip
    lines.grid(True, alpha=0.3)
    figure.suptitle(f"{title}, HH", x=0.01, ha="left", fontsize=12, fontweight="bold")
    plotting.save(figure, png)


COMMAND = Command(
    "Doppler of a craft whose rotors turn",
    _arguments,
    _run,
    out="august_doppler",
    first="a minute or two on two quiet CPU cores",
)
