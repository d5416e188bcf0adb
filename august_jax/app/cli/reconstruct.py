"""``august reconstruct``: a drone of the user's, from a mesh file, at one pose."""

from __future__ import annotations

import argparse
import time
from typing import Any

from august_jax.app.cli.common import (
    chosen_weights,
    material,
    material_arguments,
    mesh_again,
    mesh_airframe,
    mesh_arguments,
    mesh_record,
)
from august_jax.app.cli.messages import command_line, note, options
from august_jax.app.cli.parser import ANGLE, Command, number, numbers, seed_and_snr
from august_jax.app.cli.sensing import search_arguments, sensed


def _arguments(parser: argparse.ArgumentParser) -> None:
    mesh_arguments(parser, required=True)
    parser.add_argument(
        "--position", type=numbers(3, "flight.box_m"), metavar="X,Y,Z", help="[m] (default: the flight box's centre)"
    )
    for angle in ("yaw", "pitch", "roll"):
        parser.add_argument(f"--{angle}", type=number(ANGLE), default=0.0, metavar="DEG", help="[deg] (default 0)")
    material_arguments(parser)
    seed_and_snr(parser, "prediction and noise")
    parser.add_argument("--run", metavar="RUN", help="weights of your own training run (default: the shipped ones)")
    search_arguments(parser, search=0, known=None)


def _run(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax import pipeline

    started = time.monotonic()
    airframe = mesh_airframe(args)
    networks, config = chosen_weights(args, args.run)
    permittivity, conductivity = material(args, config.target)
    shot = pipeline.pose_scenario(
        networks.config,
        airframe,
        position=args.position,
        yaw_deg=args.yaw,
        pitch_deg=args.pitch,
        roll_deg=args.roll,
        permittivity=permittivity,
        conductivity=conductivity,
    )
    note(
        f"{airframe.name}: half-wheelbase {airframe.half_wheelbase_m:.3f} m, at "
        f"({', '.join(f'{value:.2f}' for value in shot.positions[0])}) m"
    )
    craft = mesh_record(args, airframe) | {"yaw_deg": args.yaw, "pitch_deg": args.pitch, "roll_deg": args.roll}
    again = [*mesh_again(args, airframe), *options(args, "position", "permittivity", "conductivity", "run")]
    another = command_line("reconstruct", *again, "--snr", "30", "--yaw", "45", "--pitch", "15", *args.overrides)
    return sensed(
        args, networks, config, shot, started, craft=craft, following=[(another, "another pose, at a better SNR")]
    )


COMMAND = Command(
    "your own drone from a mesh file, at one pose",
    _arguments,
    _run,
    out="august_reconstruct",
    first="about a minute on two quiet CPU cores, some minutes with a search",
)
