"""``august evaluate``: accuracy over SNR beside the baselines."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from august_jax import config as configuration
from august_jax.app.cli.common import chosen_weights, counted, folder
from august_jax.app.cli.dry import about, dry_run_argument, long, size, told_plan
from august_jax.app.cli.messages import UsageError, command_line, expected_table, note, say, scheme_table, search_table
from august_jax.app.cli.parser import Command, name, whole
from august_jax.app.cli.results import array_told, look, needed
from august_jax.config import Config

_MOST_RUNS = 64
_SCHEMES = ("august", "matched_field", "polar", "polar_angles", "prediction", "up", "mean_shape", "resampling")
"""Names of august_jax.schemes.SCHEMES, which the help is too quick to load."""


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(places=_MOST_RUNS)
    parser.usage = f"{parser.prog} [RUN ...] [options] [section.field=value ...]"
    parser.epilog = "RUN is a folder that august train wrote (default: the shipped weights)."
    parser.add_argument(
        "--run",
        metavar="RUN",
        help="the same as RUN: weights of your own training run (default: the shipped ones); several RUNs are compared "
        "on the same samples, a line each",
    )
    parser.add_argument(
        "--schemes",
        type=name(*_SCHEMES, other="several of them separated by commas"),
        metavar="NAMES",
        help="which schemes to ask; august is the networks (default: all)",
    )
    dry_run_argument(parser)
    parser.add_argument("--seed", type=whole(), default=1, metavar="N", help="of the fresh samples (default 1)")


def _run(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax import evaluation, pipeline
    from august_jax.app import plotting
    from august_jax.app.accuracy import write_accuracy
    from august_jax.app.page import About
    from august_jax.files import replacing_together
    from august_jax.schemes import lines_of

    started = time.monotonic()
    out = folder(args, "august_evaluate", configured=True)
    if args.run and args.rest:
        raise UsageError(f"{args.rest[0]!r}: the run is already given as --run {args.run}; name one")
    runs = args.rest or [args.run]
    first, config = chosen_weights(args, runs[0])
    several = lines_of([first, *map(pipeline.load_networks, runs[1:])])
    chosen = None if args.schemes is None else [name.strip() for name in args.schemes.split(",")]
    if args.dry_run:
        return _plan(args, config, out, len(several), chosen)
    rows = evaluation.evaluate(
        first if len(several) == 1 else several, config, seed=args.seed, schemes=chosen, progress=note
    )
    weights: Any = first.name if len(several) == 1 else {line: each.name for line, each in several.items()}
    made = {"command_line": command_line(*args.words), "configuration": configuration.to_dict(config)}
    found = {"rows": rows, "thresholds": evaluation.thresholds(rows)}
    result = {"weights": weights, "seed": args.seed, **made, **found}
    title = (
        f"{first.name if len(several) == 1 else f'{len(several)} networks'}, seed {args.seed}, "
        f"{counted(config.evaluate.count, 'sample')} at each SNR"
    )
    following = _following(args, runs[0])
    with replacing_together(out, ("report.html", "evaluation.json", "evaluation.png")) as aside:
        aside["evaluation.json"].write_text(json.dumps(result, indent=1, allow_nan=False), encoding="utf-8")
        plotting.evaluation_curves(rows, aside["evaluation.png"], title=title)
        write_accuracy(
            aside["report.html"],
            rows,
            found["thresholds"],
            About(
                title=title,
                lead=f"Each sample is of its own flight, style {config.flight.style}, heard by an array of "
                f"{array_told(config)} within {config.region.threshold_m:g} m of its prediction along each axis. "
                "All SNRs and schemes share samples.",
                note=evaluation.NOTE,
                setup=[
                    ("craft", ", ".join(config.target.airframes)),
                    *([("weights", weights)] if len(several) == 1 else weights.items()),
                    ("seed", str(args.seed)),
                    ("computed in", f"{time.monotonic() - started:.0f} s"),
                ],
                following=following,
                repeat=[(result["command_line"], needed())],
                configuration=configuration.to_yaml(config),
            ),
        )
    if len(several) > 1:
        say(args, "\n".join(f"{line} is of {folder_of}" for line, folder_of in weights.items()) + "\n")
    say(args, scheme_table(rows, snr=True))
    searched = search_table(rows)
    if searched:
        say(args, f"\n{searched}")
    expected = expected_table(rows, found["thresholds"])
    if expected:
        say(args, f"\n{expected}")
    say(args, f"\n{evaluation.NOTE}\nwritten to {out}/: report.html, evaluation.png, evaluation.json")
    look(args, out, following[:1])
    return {"out": str(out), **result}


def _following(args: argparse.Namespace, run: str | None) -> list[tuple[str, str]]:
    again = ["--run", run] if run else []
    again += [text for text in args.overrides if not text.startswith("evaluate.")]
    return [
        (command_line("demo", "--seed", str(args.seed), *again), "a flight, its clouds and a search, turnable"),
        (command_line("track", "--scheme", "august", "--seed", str(args.seed), *again), "a flight, followed"),
    ]


def _plan(
    args: argparse.Namespace, config: Config, out: Path, networks: int, chosen: list[str] | None
) -> dict[str, Any]:
    from august_jax.app.plan import evaluation

    plan = evaluation(config, networks, chosen)
    levels = ", ".join(f"{level:g}" for level in plan["snr_db"])
    lines = [
        ("samples", f"{plan['samples']}, each at {levels} dB, into {out}/"),
        ("asked", ", ".join(plan["asked"]) + (f"; {networks} networks" if networks > 1 else "")),
        ("time", f"{about(plan['seconds'])} to simulate on two CPU cores, a minute or two to compile, and up to "
                 f"{long(plan['factoring_seconds'])} before where the drones are not factored yet"),
        ("search", f"{counted(plan['searched'], 'slot')}, {about(plan['search_seconds'])}"
                   + ("; evaluate.searched=0 leaves it out" if plan["searched"] else "")),
        ("memory", f"about {size(plan['memory_bytes'])}"),
    ]  # fmt: skip
    return told_plan(args, plan, lines)


COMMAND = Command(
    "accuracy over SNR beside the baselines",
    _arguments,
    _run,
    out="august_evaluate",
    first="some minutes on two quiet CPU cores, most of them for searches",
)
