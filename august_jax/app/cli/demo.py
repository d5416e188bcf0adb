"""``august demo``: a short flight, sensed with the shipped weights."""

from __future__ import annotations

import argparse
import time
from typing import Any, get_args

from august_jax.app.cli.common import chosen_weights, counted
from august_jax.app.cli.messages import command_line, note, options
from august_jax.app.cli.parser import Command, name, seed_and_snr, whole
from august_jax.app.cli.sensing import search_arguments, sensed
from august_jax.config import Family, bounds


def _arguments(parser: argparse.ArgumentParser) -> None:
    seed_and_snr(parser, "flight, material, noise")
    most = int(bounds("flight.slots").high)
    parser.add_argument(
        "--slots", type=whole(1, most), default=12, metavar="N", help="length of the flight (default 12)"
    )
    parser.add_argument(
        "--airframe", type=name(*get_args(Family)), metavar="NAME", help="a procedural airframe (default: drawn)"
    )
    parser.add_argument("--run", metavar="RUN", help="weights of your own training run (default: the shipped ones)")
    search_arguments(parser, search=1, known=2)


def _run(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax import pipeline

    started = time.monotonic()
    networks, config = chosen_weights(args, args.run)
    shot = pipeline.draw_scenario(config, args.seed, args.slots, args.airframe)
    note(
        f"{shot.airframe.name} flies {counted(args.slots, 'slot')}, permittivity {shot.permittivity:.2f}, "
        f"conductivity {1e3 * shot.conductivity:.1f} mS/m"
    )
    again = [*options(args, "airframe", "run"), *args.overrides]
    return sensed(
        args,
        networks,
        config,
        shot,
        started,
        following=[
            (
                command_line(
                    "reconstruct",
                    "--mesh",
                    "FILE",
                    "--half-wheelbase",
                    f"{config.target.half_wheelbase_m:g}",
                    *options(args, "run"),
                    *args.overrides,
                ),
                "your own drone, in any pose",
            ),
            (
                command_line("demo", "--seed", str(args.seed + 1), "--snr", "30", "--slots", str(args.slots), *again),
                "another flight, at a better SNR",
            ),
        ],
    )


COMMAND = Command(
    "fly a short track and reconstruct it with the shipped weights",
    _arguments,
    _run,
    out="august_demo",
    first="some two minutes on two quiet CPU cores",
)
