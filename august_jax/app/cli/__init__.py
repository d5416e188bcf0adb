"""The command line: ``august doctor | demo | simulate | train | evaluate | reconstruct | track | rcs |
doppler | export``.

Here arguments become a configuration and a call, and results become lines and files; what is computed lives elsewhere.
Results go to stdout (as JSON with ``--json``), progress to stderr. The exit status is 0; or 2 with at most six lines on
stderr that name the field, the value and the way out; or 130 after Ctrl-C. Nothing is left half-written.

A command is a file here that holds a :class:`~august_jax.app.cli.parser.Command`, and a line in :data:`COMMANDS`. Only
the standard library and the configuration are imported at the top of these files, so that ``--help`` answers at once.
"""

from __future__ import annotations

import json
import os
import sys
import warnings
from collections.abc import Sequence

from august_jax.app.cli import demo, doctor, doppler, evaluate, export, rcs, reconstruct, simulate, track, train
from august_jax.app.cli.clock import watched
from august_jax.app.cli.interrupt import STATUS, TOLD, end_at_once
from august_jax.app.cli.messages import hush, note, told
from august_jax.app.cli.parser import errand, parse

COMMANDS = {
    "doctor": doctor.COMMAND,
    "demo": demo.COMMAND,
    "simulate": simulate.COMMAND,
    "train": train.COMMAND,
    "evaluate": evaluate.COMMAND,
    "reconstruct": reconstruct.COMMAND,
    "track": track.COMMAND,
    "rcs": rcs.COMMAND,
    "doppler": doppler.COMMAND,
    "export": export.COMMAND,
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status.

    Args:
        argv: the words after ``august``; those of the process when None.
    """
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    if not debug:
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA's remarks on its own compile times
    args = None
    try:
        args = parse(words, COMMANDS)
        if args is None:
            return 0
        if argv is None:
            end_at_once()
            if not debug:
                hush()
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: note(f"august: note: {message}")
            from august_jax.app.compiled import keep_compiled  # with NumPy, which --help does without

            keep_compiled()
            with watched(errand(args), COMMANDS[args.command].first):
                result = COMMANDS[args.command].run(args)
        if args.json:
            print(json.dumps(result, allow_nan=False))
        if result.get("failed"):
            note(f"august: {result['failed']}")
            return 2
        return 0
    except BrokenPipeError:  # the reader, `head` for example, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        note(TOLD)
        return STATUS
    except Exception as error:
        if debug:
            raise
        note(told(error, args.options if args else ()))
        return 2
