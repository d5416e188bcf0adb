"""``august evaluate``: accuracy over SNR beside the baselines."""

from __future__ import annotations

import argparse
import json
from typing import Any

from august_jax import config as configuration
from august_jax.app.cli.common import chosen_weights, folder
from august_jax.app.cli.messages import UsageError, command_line, expected_table, note, say, scheme_table, search_table
from august_jax.app.cli.parser import Command, whole


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(places=1)
    parser.usage = f"{parser.prog} [RUN] [options] [section.field=value ...]"
    parser.add_argument(
        "--run", metavar="RUN", help="the same as RUN: weights of your own training run (default: the shipped ones)"
    )
    parser.add_argument("--seed", type=whole(), default=1, metavar="N", help="of the fresh samples (default 1)")


def _run(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax import evaluation
    from august_jax.app import plotting
    from august_jax.files import write_text

    out = folder(args, "august_evaluate")
    if args.run and args.rest:
        raise UsageError(f"{args.rest[0]!r}: the run is already given as --run {args.run}; name one")
    networks, config = chosen_weights(args, args.run or (args.rest[0] if args.rest else None))
    rows = evaluation.evaluate(networks, config, seed=args.seed, progress=note)
    made = {"command_line": command_line(*args.words), "configuration": configuration.to_dict(config)}
    found = {"rows": rows, "thresholds": evaluation.thresholds(rows)}
    result = {"weights": networks.name, "seed": args.seed, **made, **found}
    write_text(out / "evaluation.json", json.dumps(result, indent=1, allow_nan=False))
    plotting.evaluation_curves(
        rows,
        out / "evaluation.png",
        title=f"{networks.name}, seed {args.seed}, {config.evaluate.count} samples at each SNR",
    )
    say(args, scheme_table(rows, snr=True))
    searched = search_table(rows)
    if searched:
        say(args, f"\n{searched}")
    expected = expected_table(rows, found["thresholds"])
    if expected:
        say(args, f"\n{expected}")
    say(args, f"\n{evaluation.NOTE}\nwritten: {out / 'evaluation.json'}, {out / 'evaluation.png'}")
    return {"out": str(out), **result}


COMMAND = Command("accuracy over SNR beside the baselines", _arguments, _run)
