"""``august track``: a flight followed slot by slot, by what explains its echoes or by any scheme in closed loop."""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from august_jax import config as configuration
from august_jax.app.cli.common import chosen_config, chosen_weights, counted, folder
from august_jax.app.cli.messages import UsageError, cell, command_line, note, options, table
from august_jax.app.cli.parser import Command, name, seed_and_snr, whole
from august_jax.app.cli.results import array_told, leave
from august_jax.config import Config, ConfigError, Family, Style, bounds

if TYPE_CHECKING:
    from august_jax.pipeline import Networks, Scenario, Track

SEARCHED = "matched_field"
"""The scheme that carries hypotheses among known drones; all others answer slot by slot, in a predictor's loop."""
PREDICTOR = "lstm"
"""The default: it errs least, or as little as the others, on all flights that were measured
(experiments/prediction.py)."""


def _arguments(parser: argparse.ArgumentParser) -> None:
    seed_and_snr(parser, "flight, material, noise")
    most = int(bounds("flight.slots").high)
    parser.add_argument(
        "--slots", type=whole(4, most), default=20, metavar="N", help="length of the flight (default 20)"
    )
    parser.add_argument(
        "--style", choices=get_args(Style), help="of the flight (default: the configuration's flight.style)"
    )
    parser.add_argument(
        "--scheme",
        type=name(SEARCHED, "august", "polar", "polar_angles", "prediction"),
        default=SEARCHED,
        metavar="NAME",
        help=f"what finds the drone: {SEARCHED} knows what may fly, august are the networks, polar and polar_angles a "
        "single point, prediction hears nothing",
    )
    parser.add_argument(
        "--predictor",
        type=name("finite_difference", "kalman", "lstm"),
        metavar="NAME",
        help=f"what says where to listen (default {PREDICTOR}, which errs least); not with {SEARCHED}",
    )
    parser.add_argument(
        "--run",
        metavar="RUN",
        action="append",
        help="weights of your own training run, for august (default: the shipped ones); given several times, the one "
        "with the smallest region that is large enough for the predictor is taken, for the whole flight",
    )
    parser.add_argument(
        "--airframe",
        type=name(*get_args(Family), other="a mesh file"),
        metavar="NAME",
        help="what flies (default: drawn from target.airframes, the drones that are known); any other is unknown",
    )


def _run(args: argparse.Namespace) -> dict[str, Any]:
    started = time.monotonic()
    out = folder(args, "august_track", configured=True)
    if args.scheme != SEARCHED:
        from august_jax.schemes.looped import check_scheme

        check_scheme(args.scheme)
    own = {
        "predictor": (args.scheme != SEARCHED, f"{SEARCHED} carries hypotheses of its own from slot to slot"),
        "run": (args.scheme == "august", f"{args.scheme} asks no networks"),
    }
    for option, (used, why) in own.items():
        if getattr(args, option) is not None and not used:
            raise UsageError(f"--{option}: {why}; leave it out, or choose --scheme august")
    return (_searched if args.scheme == SEARCHED else _looped)(args, out, started)


def _flying(args: argparse.Namespace, config: Config) -> tuple[Config, Scenario]:
    """The configuration in the style that is asked for, and what flies."""
    from august_jax import pipeline
    from august_jax.schemes.followed import check_slots

    if args.style:
        config = configuration.override(config, [f"flight.style={args.style}"])
    shot = pipeline.draw_scenario(config, args.seed, args.slots, args.airframe)
    note(
        f"{shot.airframe.name} flies {args.slots} slots ({config.flight.style}), permittivity {shot.permittivity:.2f}, "
        f"conductivity {1e3 * shot.conductivity:.1f} mS/m"
    )
    check_slots(args.slots)
    return config, shot


def _following(args: argparse.Namespace, out: Path) -> list[tuple[str, str]]:
    again = options(args, "scheme", "predictor", "style", "airframe")
    again += [word for run in args.run or () for word in ("--run", run)]
    again += [*(["--preset", args.preset] if args.preset else []), *args.overrides]
    return [
        (command_line("track", "--seed", str(args.seed + 1), "--snr", f"{args.snr:g}", *again), "another flight"),
        (command_line("demo", "--seed", str(args.seed)), "a flight seen by the networks"),
        (command_line("export", str(out), "--format", "mat"), "the clouds for MATLAB"),
    ]


def _left(
    args: argparse.Namespace,
    out: Path,
    config: Config,
    shot: Scenario,
    track: Track,
    scores: dict[str, Any],
    started: float,
    *,
    made: dict[str, Any],
    setup: list[tuple[str, str]],
    threshold_m: float | None = None,
    **told: Any,
) -> dict[str, Any]:
    """What both ways of following leave: beside what each has of its own, the flight, its picture and the next
    commands."""
    from august_jax.app import plotting

    seconds = time.monotonic() - started
    title = f"{shot.airframe.name} at {args.snr:g} dB, followed by {counted(config.array.count, 'antenna')}"
    setup = [
        *setup,
        ("array", array_told(config)),
        ("flight", f"{config.flight.style}, {args.slots} slots of {config.flight.slot_s:g} s"),
        ("material", f"permittivity {shot.permittivity:.2f}, conductivity {1e3 * shot.conductivity:.2f} mS/m"),
        ("detections", f"uniform within {config.region.threshold_m:g} m along each axis: the first three slots, and "
                       "after a loss"),
    ]  # fmt: skip
    return leave(
        args,
        out,
        config,
        track,
        scores,
        made={"scheme": args.scheme, "style": config.flight.style, "airframe": shot.airframe.name, **made},
        seconds=seconds,
        title=title,
        setup=setup,
        following=_following(args, out),
        draw=partial(plotting.flight, track, scores["slots"], title=title, threshold_m=threshold_m),
        **told,
    )


def _looped(args: argparse.Namespace, out: Path, started: float) -> dict[str, Any]:
    """A flight in the closed loop of a predictor and a scheme that answers each slot by itself."""
    from august_jax import evaluation, pipeline
    from august_jax.schemes import SCHEMES, title_of
    from august_jax.tracking import predictor_for, settled_threshold, smallest_region

    several: list[tuple[Networks | None, Config]]
    if args.scheme == "august":
        several = [chosen_weights(args, run) for run in args.run or [None]]
    else:
        several = [(None, chosen_config(args))]
    flights = {(config.flight.slot_s, args.style or config.flight.style) for _, config in several}
    if len(flights) > 1:
        told = "; ".join(f"slots of {slot_s:g} s, {style}" for slot_s, style in sorted(flights))
        raise ConfigError(
            f"--run: were trained for different flights ({told}), of which a predictor knows one; name runs of one "
            "flight.slot_s, and of one flight.style or with --style"
        )
    flight = several[0][1].flight
    name = args.predictor or PREDICTOR
    predictor = predictor_for(name, replace(flight, style=args.style or flight.style))
    needed = settled_threshold(predictor)
    row = smallest_region([config.region.threshold_m for _, config in several], needed)
    networks, config = several[row]
    config, shot = _flying(args, config)
    region = config.region
    enough = region.threshold_m >= needed
    fits = (
        f"{name} asks for +-{needed:.2f} m on {config.flight.style} flights, the region allows {region.threshold_m:g} m"
    )
    if not enough:
        wide = f"region.threshold_m={needed:.2f} region.scale_m={config.target.half_wheelbase_m + needed:.2f}"
        note(
            f"{fits}: no region at hand is large enough, so that losses are to be expected; "
            + (f"train networks with {wide}, and name them, too" if networks else f"set {wide}")
        )
    track = pipeline.sense(
        networks, config, shot, seed=args.seed, snr_db=args.snr, predictor=predictor, scheme=args.scheme, progress=note
    )
    scores = evaluation.score_followed(track, config, shot.airframe.half_wheelbase_m, scheme=args.scheme)
    told = title_of(networks) if networks else SCHEMES[args.scheme].label
    return _left(
        args,
        out,
        config,
        shot,
        track,
        scores,
        started,
        made={
            "predictor": name,
            "weights": networks.name if networks else None,
            "region": {"threshold_m": region.threshold_m, "scale_m": region.scale_m, "needed_m": needed,
                       "enough": enough, "compared": len(several)},
        },
        lead=_lead_looped(scores, region.threshold_m),
        setup=[
            ("scheme", f"{args.scheme}: {told}"),
            *([("weights", networks.name)] if networks else []),
            ("predictor", name),
            ("region", fits + ("" if enough else ": too small")),
        ],
        hypotheses={},
        scheme=(args.scheme, told.partition(",")[0]),
        first=_loop_table(scores["summary"]),
        threshold_m=region.threshold_m,
    )  # fmt: skip


def _searched(args: argparse.Namespace, out: Path, started: float) -> dict[str, Any]:
    """A flight followed by hypotheses among known drones."""
    from august_jax import evaluation
    from august_jax.data import channels_along, prepare_targets
    from august_jax.evaluation.bound import track_bound
    from august_jax.evaluation.followed import FOLLOWED
    from august_jax.inference import known_craft
    from august_jax.schemes import follow_flight

    config, shot = _flying(args, chosen_config(args))
    note("preparing the known drones: for the first time that takes minutes")
    targets = prepare_targets(config, note)
    library = known_craft(config, targets, progress=note)
    note("computing the full-wave channels")
    flying = next((each for each in targets if each.airframe.digest == shot.airframe.digest), None)
    body = flying.body if flying else None
    material = shot.permittivity, shot.conductivity
    channels = channels_along(config, shot.airframe, shot.rotations, shot.positions, *material, body)
    note("following the flight; what it needs is compiled in the first slots")
    flown = follow_flight(library, config, shot, channels, seed=args.seed, snr_db=args.snr, progress=note)
    track = flown.track
    scores: dict[str, Any] = evaluation.score_flown(flown, config, shot.airframe.half_wheelbase_m)
    if flying is not None:
        note("working out the bound")
        bound = track_bound(track, flying, config, args.snr)
        scores |= {} if bound["bound_m"] is None else {"bound": bound}
    settled = scores["summary"][-1]
    unknown = "" if flown.craft is not None else ", which is none of the known ones"
    return _left(
        args,
        out,
        config,
        shot,
        track,
        scores,
        started,
        made={"known": list(flown.names)},
        lead=_lead(settled, flown),
        setup=[
            ("scheme", f"{SEARCHED}: hypotheses carried from slot to slot"),
            ("known drones", ", ".join(flown.names)),
            ("drone", f"{shot.airframe.name}{unknown}"),
            ("a slot takes", f"{settled['seconds']:.2f} s"),
        ],
        hypotheses=dict(enumerate(flown.clouds)),
        scheme=(FOLLOWED, "followed"),
        first=_summary_table(scores["summary"]),
    )


def _lead_looped(scores: dict[str, Any], threshold_m: float) -> str:
    settled = scores["summary"][-1]
    first, last = settled["slots"]
    lost = [str(slot["slot"] + 1) for slot in scores["slots"] if slot["lost"]]
    detected = [str(slot["slot"] + 1) for slot in scores["slots"] if slot["detected"]]
    lead = (
        f"From slot {first + 1} to {last + 1} the drone is found {100 * settled['mpe_m']:.1f} cm from where it is on "
        f"average; the prediction is {100 * settled['predicted_m']:.1f} cm off."
    )
    lead += f" It was lost in slot {', '.join(lost)}, and detected anew." if lost else " It was never lost."
    lead += f" Detections say where to listen in slot {', '.join(detected)}."
    if settled["narrow"]:
        lead += (
            f" In {settled['narrow']} of the others the prediction asks for more than the region's {threshold_m:g} m."
        )
    return lead


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
        lead += f" It was lost in {counted(settled['lost'], 'slot')}, and searched for again."
    return lead


def _loop_table(rows: list[dict[str, Any]]) -> str:
    names = "slots|MPE [m]|prediction|MDE|lost|detected|region too small"
    return table(
        [
            names.split("|"),
            *(
                [
                    f"{row['slots'][0] + 1}-{row['slots'][1] + 1}",
                    *(cell(row[name], digits) for name, digits in (("mpe_m", 3), ("predicted_m", 3), ("mde", 4))),
                    *(str(row[name]) for name in ("lost", "detected", "narrow")),
                ]
                for row in rows
            ),
        ]
    )


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


COMMAND = Command(
    "follow a flight slot by slot, by what explains its echoes or by the networks",
    _arguments,
    _run,
    out="august_track",
    first="some minutes on two quiet CPU cores",
)
