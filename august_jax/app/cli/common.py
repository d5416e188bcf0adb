"""What several commands share: where they write, and from which configuration or weights they start."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from august_jax import config as configuration
from august_jax.app.cli.messages import note, options
from august_jax.app.cli.parser import name, number, part, whole
from august_jax.config import Config, ConfigError, TargetConfig

if TYPE_CHECKING:
    from jax.sharding import Mesh

    from august_jax.pipeline import Networks
    from august_jax.scene import Airframe

_MARKS = {
    "manifest.json": "august simulate",
    "checkpoints": "august train",
    "weights.npz": "august train",
    "clouds.npz": "august demo, august reconstruct or august track",
    "evaluation.json": "august evaluate",
}
"""What is in a folder -> which command keeps its config.yaml, or its report.html, there."""
_AXES = ("auto", "x", "y", "z", "-x", "-y", "-z")


def folder(args: argparse.Namespace, default: str, *, configured: bool = False) -> Path:
    """Where the command writes; refused before the work where nothing can be written there.

    With ``configured``, also refused where the ``config.yaml`` or the ``report.html`` is another command's.
    """
    out = Path(args.out or default)
    for mark, owner in _MARKS.items():
        if configured and (out / mark).exists() and f"august {args.command}" not in owner:
            raise ConfigError(
                f"--out: {out} holds what {owner} wrote ({mark}), which august {args.command} would "
                "damage; choose another folder"
            )
    parent = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise ConfigError(
            f"--out: nothing can be written to {out}, because {parent} is "
            f"{'read-only' if parent.is_dir() else 'a file'}; choose another folder"
        )
    return out


def devices_argument(parser: argparse.ArgumentParser, shared: str) -> None:
    """``--devices``, which share what is ``shared``."""
    parser.add_argument(
        "--devices", type=whole(1), metavar="N", help=f"share {shared} among so many devices (default: all of them)"
    )


def hosts_arguments(parser: argparse.ArgumentParser) -> None:
    """``--host`` and ``--coordinator``."""
    parser.add_argument(
        "--host", type=part, metavar="I/N", help="this is the i-th of n hosts that train as one (default: alone)"
    )
    parser.add_argument(
        "--coordinator",
        metavar="ADDRESS:PORT",
        help="of the first host, as the others reach it; a port from 1 to 65535 (default: none)",
    )


def check_hosts(args: argparse.Namespace) -> None:
    """Both of :func:`hosts_arguments` or neither."""
    if (args.host is None) != (args.coordinator is None):
        raise ConfigError(
            f"--{'host' if args.host is None else 'coordinator'}: is missing; several hosts need --host I/N, with the "
            "place of each, and --coordinator ADDRESS:PORT, the same on all"
        )


def devices(args: argparse.Namespace) -> Mesh:
    """What :func:`devices_argument` and :func:`hosts_arguments` ask for, the other hosts met; before JAX computes."""
    check_hosts(args)
    from august_jax import hosts
    from august_jax.mesh import data_mesh

    if args.host is not None:
        note(f"host {args.host[0]} of {args.host[1]}: waiting for the others at {args.coordinator}")
        hosts.join(args.coordinator, args.host)
    return data_mesh(args.devices)


def mesh_arguments(parser: argparse.ArgumentParser, *, required: bool) -> None:
    """``--mesh`` and how its file is read, and the craft's size."""
    parser.add_argument(
        "--mesh",
        required=required,
        metavar="FILE",
        help="OBJ, STL, PLY, GLB, glTF or DAE" + ("" if required else " (default: none)"),
    )
    parser.add_argument(
        "--unit",
        type=name("auto", "m", "cm", "mm", "in", "ft", other="a number of metres above 0"),
        default="auto",
        help="of the file (default: what the file or its format says, else m)",
    )
    parser.add_argument(
        "--up",
        type=name(*_AXES),
        default="auto",
        metavar="AXIS",
        help="the file's upward axis (default: the format's, else z)",
    )
    parser.add_argument(
        "--forward",
        type=name(*_AXES),
        default="auto",
        metavar="AXIS",
        help="the file's forward axis (default: the format's, else x)",
    )
    parser.add_argument(
        "--half-wheelbase",
        type=number("target.half_wheelbase_m"),
        metavar="M",
        help="scale to this half-wheelbase [m] (default: the file's own; of a procedural craft the configuration's)",
    )


def mesh_airframe(args: argparse.Namespace) -> Airframe:
    """The craft of the file that :func:`mesh_arguments` name; how the file was read is told."""
    from august_jax.scene import load_airframe

    airframe = load_airframe(
        args.mesh, unit=args.unit, up=args.up, forward=args.forward, half_wheelbase_m=args.half_wheelbase
    )
    note(f"{args.mesh}: {airframe.source}")
    return airframe


def mesh_record(args: argparse.Namespace, airframe: Airframe) -> dict[str, Any]:
    """Where the craft of :func:`mesh_airframe` came from, as plain strings and numbers, to be kept with results."""
    from august_jax.files import sha256_of

    assert airframe.source is not None  # of a loaded mesh
    return {
        "mesh": airframe.source.record(),
        "mesh_sha256": sha256_of(Path(args.mesh)),
        "surface_digest": airframe.digest,
        "half_wheelbase_m": airframe.half_wheelbase_m,
    }


def mesh_again(args: argparse.Namespace, airframe: Airframe) -> list[str]:
    """The words that give the craft of :func:`mesh_airframe` again: what was read of the file stands for ``auto``."""
    source = airframe.source
    assert source is not None  # of a loaded mesh
    taken = {"unit": f"{source.unit_m:.12g}", "up": source.up, "forward": source.forward}
    read = {name: text for name, text in taken.items() if vars(args)[name] == "auto"}
    return options(argparse.Namespace(**vars(args) | read), "mesh", "unit", "up", "forward", "half_wheelbase")


def material_arguments(parser: argparse.ArgumentParser) -> None:
    """``--permittivity`` and ``--conductivity`` of the craft."""
    parser.add_argument(
        "--permittivity", type=number("target.permittivity"), metavar="EPS", help="relative (default: mid-range)"
    )
    parser.add_argument(
        "--conductivity", type=number("target.conductivity_s_m"), metavar="S", help="[S/m] (default: mid-range)"
    )


def material(args: argparse.Namespace, target: TargetConfig) -> tuple[float, float]:
    """Permittivity and conductivity [S/m] that :func:`material_arguments` ask for, or the middles of the ranges."""
    asked = (args.permittivity, target.permittivity), (args.conductivity, target.conductivity_s_m)
    permittivity, conductivity = (sum(span) / 2.0 if value is None else value for value, span in asked)
    return permittivity, conductivity


def chosen_config(args: argparse.Namespace) -> Config:
    """The preset (``laptop`` unless named) with its overrides."""
    return configuration.override(configuration.preset(args.preset or "laptop"), args.overrides)


def chosen_weights(args: argparse.Namespace, run: str | None) -> tuple[Networks, Config]:
    """Networks, and their configuration with the overrides that they allow."""
    from august_jax import pipeline

    networks = pipeline.load_networks(run)
    if args.preset is not None and configuration.preset(args.preset).preset != networks.config.preset:
        raise ConfigError(
            f"preset: {args.preset!r}, but these weights were trained with preset {networks.config.preset!r}\n"
            f"train your own: august simulate --preset {args.preset}, then august train --preset {args.preset}"
        )
    config = configuration.override(networks.config, args.overrides)
    configuration.check_weights(config, networks.config)
    return networks, config


def counted(number: int, thing: str) -> str:
    """``1 slot``, ``12 slots``."""
    return f"{number} {thing}{'' if number == 1 else 's'}"
