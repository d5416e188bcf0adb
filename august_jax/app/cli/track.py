"""``august track``: a flight followed slot by slot by what explains its echoes."""

from __future__ import annotations

import argparse
import time
from functools import partial
from typing import Any, get_args

from august_jax import config as configuration
from august_jax.app.cli.common import chosen_config, folder
from august_jax.app.cli.messages import cell, command_line, note, options, table
from august_jax.app.cli.parser import Command, seed_and_snr, whole
from august_jax.app.cli.results import array_told, leave
from august_jax.config import Style, bounds


def _arguments(parser: argparse.ArgumentParser) -> None:
    seed_and_snr(parser, "flight, material, noise")
    most = int(bounds("flight.slots").high)
    parser.add_argument(
        "--slots", type=whole(1, most), default=20, metavar="N", help="length of the flight, 4 or more (default 20)"
    )
    parser.add_argument(
        "--style", choices=get_args(Style), help="of the flight (default: the configuration's flight.style)"
    )
    parser.add_argument(
        "--airframe",
        metavar="NAME",
        help="what flies (default: drawn from target.airframes, the drones that are known); any other is unknown",
    )


def _run(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax import evaluation, pipeline
    from august_jax.app import plotting
    from august_jax.data import channels_along, prepare_targets
    from august_jax.evaluation.followed import FOLLOWED
    from august_jax.inference import known_craft
    from august_jax.schemes import follow_flight
    from august_jax.schemes.followed import check_slots

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
    note("computing the full-wave channels")
    body = next((each.body for each in targets if each.airframe.digest == shot.airframe.digest), None)
    material = shot.permittivity, shot.conductivity
    channels = channels_along(config, shot.airframe, shot.rotations, shot.positions, *material, body)
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
        ("array", array_told(config)),
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
    return leave(
        args,
        out,
        config,
        track,
        scores,
        made={"style": config.flight.style, "airframe": shot.airframe.name, "known": list(flown.names)},
        seconds=seconds,
        title=title,
        lead=lead,
        setup=setup,
        following=following,
        draw=partial(plotting.flight, track, scores["slots"], title=title),
        hypotheses=dict(enumerate(flown.clouds)),
        scheme=(FOLLOWED, "followed"),
        first=_summary_table(scores["summary"]),
    )


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


COMMAND = Command("follow a flight slot by slot, by what explains its echoes", _arguments, _run)
