"""What the benchmarks share: the machine, wall times, the command line's ``--json`` and what is written there.

A time is the median of calls after one that is not counted, and what is compared is called in turn: a machine that
slows down slows all of them.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from august_jax.app.machine import processor
from august_jax.files import write_text

Figures = dict[str, Any]


def parsed(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The command line with ``--json FILE``, whose folder must be there before minutes of measuring begin."""
    parser.add_argument("--json", type=Path, help="also write the figures here")
    args = parser.parse_args()
    if args.json and not args.json.absolute().parent.is_dir():
        parser.error(f"--json: {args.json.parent} is no folder")
    return args


def write(args: argparse.Namespace, figures: Figures) -> None:
    """Write the figures where ``--json`` says, if it was given."""
    if args.json:
        write_text(args.json, json.dumps(figures, indent=1))


def machine() -> dict[str, str | int | float]:
    """What the figures are measured on, with its rate of single-precision matrix products [Gflop/s]; printed too."""
    square = jnp.ones((3000, 3000), jnp.float32)
    product = jax.jit(lambda a: a @ a)
    product(square).block_until_ready()
    best = min(seconds(lambda: product(square)) for _ in range(5))
    described = {
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "python": platform.python_version(),
        "gflop_s": 2.0 * 3000**3 / best / 1e9,
    }
    print(described, flush=True)
    return described


def seconds(call: Callable[[], Any]) -> float:
    """Wall time of one call that returns arrays, JAX's or not."""
    start = time.perf_counter()
    jax.block_until_ready(call())
    return time.perf_counter() - start


def medians(calls: dict[Any, Callable[[], Any]], repeats: int) -> dict[Any, float]:
    """Median wall time [s] of each call, timed in turn after one call of each that is not counted."""
    for call in calls.values():
        seconds(call)
    times = [{name: seconds(call) for name, call in calls.items()} for _ in range(repeats)]
    return {name: float(np.median([each[name] for each in times])) for name in calls}
