"""What ``august demo``, ``reconstruct`` and ``track`` leave of a flight: report, picture, clouds, numbers, lines."""

from __future__ import annotations

import argparse
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from august_jax import __version__
from august_jax import config as configuration
from august_jax.app.cli.messages import command_line, say, scheme_table
from august_jax.config import Config

if TYPE_CHECKING:
    from august_jax.scene import WorldCloud
    from august_jax.tracking import Track


def array_told(config: Config) -> str:
    """The antennas in words."""
    tones = ", ".join(f"{tone / 1e9:g}" for tone in config.array.frequencies_hz)
    return f"{config.array.nx} x {config.array.nz} at {tones} GHz"


def needed(craft: Mapping[str, Any] | None = None) -> str:
    """What makes a command give the same again; ``craft`` is :func:`common.mesh_record` of a mesh."""
    file = f"; the mesh's SHA-256 begins {craft['mesh_sha256'][:12]}" if craft else ""
    return f"august_jax {__version__} with jax {version('jax')} on Python {platform.python_version()}{file}"


def kept(args: argparse.Namespace, config: Config, craft: Mapping[str, Any] | None = None) -> dict[str, str]:
    """What a record that stands alone says of how it was made, as texts; those of several things are JSON."""
    return {
        "command_line": command_line(*args.words),
        "made_with": needed(craft),
        "configuration": json.dumps(configuration.to_dict(config)),
        **({"craft": json.dumps(craft)} if craft else {}),
    }


def look(args: argparse.Namespace, out: Path, following: Sequence[tuple[str, str]]) -> None:
    """Say where the report is and what to run next, pairs of a command line and what it does."""
    say(args, f"look:  {(out / 'report.html').resolve().as_uri()}")
    for line, why in following:
        say(args, f"next:  {line}   # {why}")


def leave(
    args: argparse.Namespace,
    out: Path,
    config: Config,
    track: Track,
    scores: Mapping[str, Any],
    *,
    made: Mapping[str, Any],
    seconds: float,
    title: str,
    lead: str,
    setup: Sequence[tuple[str, str]],
    following: Sequence[tuple[str, str]],
    draw: Callable[[Path], None],
    hypotheses: Mapping[int, Sequence[WorldCloud]],
    scheme: tuple[str, str] = ("august", "AUGUST"),
    first: str = "",
) -> dict[str, Any]:
    """Write a flight's results, say what they are and what to run next, and return the numbers.

    Args:
        args: of the command.
        out: where to write.
        config: that the flight was sensed with.
        track: what was true and what was found.
        scores: of the track.
        made: how it was made, kept with the numbers.
        seconds: that it took [s].
        title, lead: heading of report and picture, and the sentence below it.
        setup: pairs of name and value for the report; the seed and the time are added.
        following: pairs of a command line to try next and what it does.
        draw: draws the picture into a file.
        hypotheses: slot -> surfaces of its hypotheses, for the report.
        scheme: name of the one that made the clouds, and what it is called in charts.
        first: a table to be said before that of the schemes.
    """
    from august_jax import evaluation
    from august_jax.app import report
    from august_jax.app.export import write_ply, write_record
    from august_jax.app.page import About
    from august_jax.files import replacing_together

    metrics = {
        "command": args.command,
        "command_line": command_line(*args.words),
        "snr_db": args.snr,
        "seed": args.seed,
        "seconds": round(seconds, 1),
        **made,
        **scores,
    }
    names = ("metrics.json", "config.yaml", "cloud.ply", "clouds.npz", f"{args.command}.png", "report.html")
    with replacing_together(out, names) as aside:
        write_record(aside["clouds.npz"], track.record())
        write_ply(aside["cloud.ply"], track.points[-1], track.point_permittivity[-1], track.point_conductivity[-1])
        aside["metrics.json"].write_text(json.dumps(metrics, indent=1, allow_nan=False), encoding="utf-8")
        aside["config.yaml"].write_text(configuration.to_summed_yaml(config), encoding="utf-8")
        draw(aside[f"{args.command}.png"])
        report.write_report(
            aside["report.html"],
            track,
            scores,
            About(
                title=title,
                lead=lead,
                note=evaluation.NOTE,
                setup=[*setup, ("seed", str(args.seed)), ("computed in", f"{seconds:.0f} s")],
                following=following,
                repeat=[(command_line(*args.words), needed(made.get("craft")))],
                configuration=configuration.to_yaml(config),
            ),
            scheme=scheme,
            hypotheses=hypotheses,
            permittivity=config.target.permittivity,
            conductivity=config.target.conductivity_s_m,
        )
    files = ["report.html", f"{args.command}.png", "cloud.ply", "metrics.json", "config.yaml", "clouds.npz"]
    say(args, f"\n{title}\n{lead}\n")
    if first:
        say(args, f"{first}\n")
    say(args, scheme_table(scores["schemes"], snr=False))
    say(args, f"\nwritten in {seconds:.0f} s to {out}/: {', '.join(files)}")
    look(args, out, following[:2])
    return {"out": str(out), "files": files, **metrics}
