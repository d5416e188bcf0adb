"""``august simulate``: a data set in shards, continued where it was left."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from august_jax import config as configuration
from august_jax.app.cli.common import chosen_config, devices_argument, folder
from august_jax.app.cli.dry import about, dry_run_argument, long, size, told_plan
from august_jax.app.cli.messages import command_line, note, say
from august_jax.app.cli.parser import Command, part, presets_help
from august_jax.config import Config, ConfigError


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.epilog = presets_help()
    parser.add_argument(
        "--shard",
        type=part,
        metavar="I/N",
        help="make the i-th of n parts alone, 1 <= i <= n (default: of a SLURM array its task's, else 1/1)",
    )
    parser.add_argument(
        "--verify",
        action="store_true",
        help="read what is there, compare its check sums, and make damaged pieces again",
    )

    devices_argument(parser, "the samples")
    dry_run_argument(parser)


def _run(args: argparse.Namespace) -> dict[str, Any]:
    out = folder(args, f"august_data/{args.preset or 'laptop'}", configured=True)
    config, shard = _config(args, out), _part(args)
    if args.dry_run:
        return _plan(args, config, out, shard)
    from august_jax.data import content_sum, simulate
    from august_jax.mesh import data_mesh, own_accelerators

    mesh = data_mesh(args.devices, local=True) if args.devices else own_accelerators()
    if mesh.size > own_accelerators().size:
        raise ConfigError(
            f"--devices: {args.devices} devices of one processor share its cores; make parts side by side, --shard I/N"
        )
    manifest = simulate(config, out, part=shard, verify=args.verify, mesh=mesh, progress=note)
    done = manifest["rows"] >= manifest["wanted"]
    say(
        args,
        f"{manifest['written']} samples written in {manifest['seconds']:.0f} s "
        f"({manifest['samples_per_s']:.1f} samples/s); {out}/ now holds {manifest['rows']} of "
        f"{manifest['wanted']}",
    )
    content = content_sum(out)
    say(args, f"sha256 of its arrays: {content}")
    say(
        args,
        "next:  "
        + (
            command_line("train", "--preset", config.preset, "--data", str(out))
            if done
            else "the other parts, with --shard, or the same command without it"
        ),
    )
    return {
        "out": str(out),
        "digest": manifest["digest"],
        "content": content,
        "shard": list(shard),
        **{name: manifest[name] for name in ("rows", "wanted", "written", "seconds", "samples_per_s")},
    }


def _config(args: argparse.Namespace, out: Path) -> Config:
    """What the words say; where these say nothing of it, that of the data in ``out``."""
    kept = out / "config.yaml"
    if args.preset is None and not args.overrides and kept.is_file():
        note(f"goes on with {kept}")
        return configuration.read(kept)
    return chosen_config(args)


def _part(args: argparse.Namespace) -> tuple[int, int]:
    """``--shard``, or what a SLURM array says, or all."""
    if args.shard:
        return args.shard
    from august_jax.app.slurm import array_part

    found = array_part(os.environ)
    if found is None:
        return 1, 1
    task = os.environ["SLURM_ARRAY_TASK_ID"]
    note(f"task {task} of a SLURM array of {found[1]}: --shard {found[0]}/{found[1]}")
    return found


def _plan(args: argparse.Namespace, config: Config, out: Path, shard: tuple[int, int]) -> dict[str, Any]:
    from august_jax.app.plan import simulation

    plan = simulation(config, out, shard)
    lines = [
        ("samples", f"{plan['rows_left']} of {plan['rows']} to make, {plan['rows_here']} are there"),
        ("shards", f"{plan['shards_left']} of {config.data.shard_rows} samples, in {out}/"),
        ("time", f"{about(plan['seconds'])} on two CPU cores, and up to {long(plan['factoring_seconds'])} before "
                 "it where the drones are not factored yet"),
        ("disk", f"{size(plan['disk_bytes'])}; {size(plan['free_bytes'])} are free"),
        ("memory", f"about {size(plan['memory_bytes'])}"),
    ]  # fmt: skip
    return told_plan(args, plan, lines)


COMMAND = Command(
    "make a data set: flights, channels, clouds",
    _arguments,
    _run,
    out="august_data/PRESET",
    first="up to a minute a drone to factor it, on two quiet CPU cores, before samples are made",
)
