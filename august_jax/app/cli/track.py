"""``august track``: a flight followed slot by slot by what explains its echoes."""

from __future__ import annotations

import argparse
import json
import time
from typing import Any

from august_jax import config as configuration
from august_jax.app.cli.common import chosen_config, folder
from august_jax.app.cli.messages import command_line, note, options, say, scheme_table, table
from august_jax.app.cli.parser import Command, number, whole
from august_jax.config import bounds

STYLES = ("smooth", "dynamic", "jump")


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=whole(), default=0, metavar="N", help="of flight, material, noise (default 0)")
    parser.add_argument(
        "--snr", type=number("signal.snr_db"), default=20.0, metavar="DB", help="SNR of the echo [dB] (default 20)"
    )
    most = int(bounds("flight.slots").high)
    parser.add_argument(
        "--slots", type=whole(1, most), default=20, metavar="N", help="length of the flight, 4 or more (default 20)"
    )
    parser.add_argument("--style", choices=STYLES, help="of the flight (default: the configuration's flight.style)")
    parser.add_argument(
        "--airframe",
        metavar="NAME",
        help="what flies (default: drawn from target.airframes, the drones that are known); any other is unknown",
    )


def _run(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax import evaluation, pipeline
    from august_jax.app import plotting, report
    from august_jax.app.export import write_ply, write_record
    from august_jax.data import prepare_targets
    from august_jax.evaluation.followed import FOLLOWED
    from august_jax.files import write_text
    from august_jax.inference import known_craft
    from august_jax.schemes import follow_flight

    started = time.monotonic()
    out = folder(args, "august_track", configured=True)
    config = chosen_config(args)
    if args.style:
        config = configuration.override(config, [f"flight.style={args.style}"])
    shot = pipeline.draw_scenario(config, args.seed, args.slots, args.airframe)
    note(
        f"{shot.airframe.name} flies {args.slots} slots ({config.flight.style}), permittivity {shot.permittivity:.2f}, "
        f"conductivity {1e3 * shot.conductivity:.1f} mS/m"
    )
    check_slots(args.slots)
    note("preparing the known drones: for the first time that takes minutes")
    targets = prepare_targets(config, note)
    library = known_craft(config, targets, progress=note)
    channels = _channels(config, shot, targets)
    note("following the flight; what it needs is compiled in the first slots")
    flown = follow_flight(library, config, shot, channels, seed=args.seed, snr_db=args.snr, progress=note)
    track = flown.track
    scores = evaluation.score_flown(flown, config, shot.airframe.half_wheelbase_m)
    seconds = time.monotonic() - started
    settled = scores["summary"][-1]
    title = f"{shot.airframe.name} at {args.snr:g} dB, followed by {config.array.count} antennas"
    lead = _lead(settled, flown)
    setup = [
        ("known drones", ", ".join(flown.names)),
        (
            "array",
            f"{config.array.nx} x {config.array.nz} at "
            f"{', '.join(f'{tone / 1e9:g}' for tone in config.array.frequencies_hz)} GHz",
        ),
        ("flight", f"{config.flight.style}, {args.slots} slots of {config.flight.slot_s:g} s"),
        ("drone", f"{shot.airframe.name}{'' if flown.craft is not None else ', which is none of the known ones'}"),
        ("material", f"permittivity {track.permittivity:.2f}, conductivity {1e3 * track.conductivity:.2f} mS/m"),
        ("channel", f"full-wave ({config.data.dense_solver}), echoes in the region's subspace"),
        ("first predictions", f"uniform within {config.region.threshold_m:g} m along each axis, as of a detection"),
        ("seed", str(args.seed)),
        ("command", command_line(*args.words)),
        ("computed in", f"{seconds:.0f} s, a slot in {settled['seconds']:.2f} s"),
    ]
    again = [*options(args, "style", "airframe"), *(["--preset", args.preset] if args.preset else []), *args.overrides]
    following = [
        (command_line("track", "--seed", str(args.seed + 1), "--snr", f"{args.snr:g}", *again), "another flight"),
        (command_line("demo", "--seed", str(args.seed)), "a flight seen by the networks"),
        (command_line("export", str(out), "--format", "mat"), "the clouds for MATLAB"),
    ]
    metrics = {
        "command": args.command,
        "command_line": command_line(*args.words),
        "snr_db": args.snr,
        "seed": args.seed,
        "seconds": round(seconds, 1),
        "style": config.flight.style,
        "airframe": shot.airframe.name,
        "known": list(flown.names),
        **scores,
    }
    write_record(out / "clouds.npz", track.record())
    write_ply(out / "cloud.ply", track.points[-1], track.point_permittivity[-1], track.point_conductivity[-1])
    write_text(out / "metrics.json", json.dumps(metrics, indent=1, allow_nan=False))
    write_text(out / "config.yaml", configuration.to_yaml(config))
    plotting.flight(track, scores["slots"], out / "track.png", title=title)
    report.write_report(
        out / "report.html",
        track,
        scores,
        title=title,
        lead=lead,
        note=evaluation.NOTE,
        setup=setup,
        following=following,
        scheme=(FOLLOWED, "followed"),
        hypotheses=dict(enumerate(flown.clouds)),
        permittivity=config.target.permittivity,
        conductivity=config.target.conductivity_s_m,
    )
    files = ["report.html", "track.png", "cloud.ply", "metrics.json", "config.yaml", "clouds.npz"]
    say(args, f"\n{title}\n{lead}\n")
    say(args, _summary_table(scores["summary"]))
    say(args, f"\n{scheme_table(scores['schemes'], snr=False)}")
    say(args, f"\nwritten in {seconds:.0f} s to {out}/: {', '.join(files)}")
    say(args, f"look:  {(out / 'report.html').resolve().as_uri()}")
    for line, why in following[:2]:
        say(args, f"next:  {line}   # {why}")
    return {"out": str(out), "files": files, **metrics}


def _channels(config, shot, targets):
    """True channels of the flight: by the factored body, where the craft has one, else by a dense solve a slot."""
    import jax
    import jax.numpy as jnp

    from august_jax.data import channels_along, simulated_channel

    note("computing the full-wave channels")
    own = [each.body for each in targets if each.airframe.digest == shot.airframe.digest]
    if not own or own[0] is None:
        return channels_along(
            config, shot.airframe, shot.rotations, shot.positions, shot.permittivity, shot.conductivity
        )
    body = own[0]

    def one(rotation, position):
        return simulated_channel(config, body, rotation, position, shot.permittivity, shot.conductivity)

    one = jax.jit(one)
    poses = zip(jnp.asarray(shot.rotations, jnp.float32), jnp.asarray(shot.positions, jnp.float32))
    return jnp.stack([one(*pose) for pose in poses])


def _lead(settled: dict[str, Any], flown: Any) -> str:
    first, last = settled["slots"]
    lead = (
        f"From slot {first + 1} to {last + 1} the drone is found {100 * settled['mpe_m']:.1f} cm from where it is on "
        f"average, and expected to be within {100 * settled['expected_m']:.1f} cm; the prediction is "
        f"{100 * settled['predicted_m']:.1f} cm off."
    )
    if flown.craft is None:
        named = sum(step.explained for step in flown.steps)
        lead += (
            f" What flies is none of the {len(flown.names)} known drones: a known one was said to explain its echo in "
            f"{named} of {len(flown.steps)} slots."
        )
    else:
        lead += f" It is named rightly in {100 * settled['craft_accuracy']:.0f} % of them."
    if settled["lost"]:
        lead += f" It was lost in {settled['lost']} slot{'s' * (settled['lost'] > 1)}, and searched for again."
    return lead


def _summary_table(rows: list[dict[str, Any]]) -> str:
    def cell(value: float | None, digits: int) -> str:
        return "-" if value is None else f"{value:.{digits}f}"

    names = "slots|MPE [m]|expected|prediction|MDE|expected|craft|explained|in 50 %|in 90 %|lost|searched|s/slot"
    return table(
        [
            names.split("|"),
            *(
                [
                    f"{row['slots'][0] + 1}-{row['slots'][1] + 1}",
                    *(cell(row[name], 3) for name in ("mpe_m", "expected_m", "predicted_m")),
                    *(cell(row[name], 5) for name in ("mde", "expected_mde")),
                    *(cell(row[name], 2) for name in ("craft_accuracy", "explained", "inside_50", "inside_90")),
                    str(row["lost"]),
                    str(row["whole"]),
                    cell(row["seconds"], 2),
                ]
                for row in rows
            ),
        ]
    )


def check_slots(slots: int) -> None:
    """Refuse a flight that is too short before anything is prepared.

    Raises:
        ValueError: fewer slots than a flight that can be followed has.
    """
    from august_jax.schemes.followed import SHORTEST

    if slots < SHORTEST:
        raise ValueError(
            f"slots: {slots} is too short a flight to follow; a detection says where to listen in the first "
            f"{SHORTEST - 1}, so give {SHORTEST} or more"
        )


COMMAND = Command("follow a flight slot by slot, by what explains its echoes", _arguments, _run)
