"""``august doctor``: whether this installation can work."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from august_jax.app.cli.messages import say
from august_jax.app.cli.parser import Command


def _arguments(parser: argparse.ArgumentParser) -> None:
    pass


def _run(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax.app import doctor

    checks = []
    for check in doctor.examine(Path(args.out or ".")):
        checks.append(check)
        say(args, f"{ {True: 'pass', False: 'FAIL', None: 'note'}[check.passed] }  {check.name:12s} {check.detail}")
    failed = [check.name for check in checks if check.passed is False]
    if not failed:
        say(args, "all is well; next: august demo")
    return {
        "checks": [check._asdict() for check in checks],
        "failed": f"failed: {', '.join(failed)}; the lines above say why" if failed else None,
    }


COMMAND = Command(
    "check this installation",
    _arguments,
    _run,
    configured=False,
    out_help="whose disk is looked at, which nothing is written to",
)
