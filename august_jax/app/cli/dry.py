"""``--dry-run``: what a command would do and take, in lines, with nothing written."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from typing import Any

from august_jax.app.cli.clock import told_s
from august_jax.app.cli.messages import command_line, say, table
from august_jax.progress import told_bytes


def dry_run_argument(parser: argparse.ArgumentParser) -> None:
    """``--dry-run``."""
    parser.add_argument(
        "--dry-run",
        action="store_true",
        help="say what would be done, the time, the disk and the memory that it takes, and write nothing",
    )


def told_plan(args: argparse.Namespace, plan: Mapping[str, Any], lines: Sequence[tuple[str, str]]) -> dict[str, Any]:
    """Say a plan, and the command that carries it out; what the command returns."""
    say(args, table([["nothing is written; the plan:", ""], *map(list, lines)], right=False))
    short = short_of(plan)
    if short:
        say(args, f"it would fail: {short}")
    again = command_line(*(word for word in args.words if word not in ("--dry-run", "--json")))
    say(args, f"next:  {again}")
    return {"dry_run": True, "short_of": short, **plan}


def short_of(plan: Mapping[str, Any]) -> str | None:
    """What there is too little of, and the way out; None where all is enough."""
    wanted, free = plan.get("disk_bytes"), plan.get("free_bytes")
    if wanted is not None and free is not None and wanted > free:
        return f"the disk has {size(free)} free; make room, choose another --out, or ask for less"
    wanted, free = plan.get("memory_bytes"), plan.get("free_memory_bytes")
    if wanted is not None and free is not None and wanted > free:
        return (
            f"it takes about {size(wanted)} of memory, and {size(free)} are free; end other programs, name fewer "
            "drones (target.airframes), or leave searches out (evaluate.searched=0)"
        )
    if plan.get("batch_fits") is not None:
        return (
            f"train.batch: {plan['batch']} asks for {size(plan['memory_bytes'])} of memory, and "
            f"{size(plan['available_bytes'])} are free; "
            + (
                f"train.batch={plan['batch_fits']} fits"
                if plan["batch_fits"]
                else "no batch fits; take smaller networks"
            )
        )
    return None


def size(count: int | None) -> str:
    """Bytes as a person reads them."""
    return "not known" if count is None else told_bytes(count)


def about(seconds: float | None) -> str:
    """A time that is known to one digit."""
    return "not known" if seconds is None else f"about {long(seconds)}"


def long(seconds: float) -> str:
    """A time, in hours where it is hours."""
    return f"{seconds / 3600.0:.1f} h" if seconds > 5400.0 else told_s(seconds)
