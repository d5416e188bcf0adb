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
from august_jax.models.layers import PRECISION

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
    """What the figures are measured on, with its rate of matrix products in the networks' precision [Gflop/s]; printed
    too."""
    size = 3000 if jax.default_backend() == "cpu" else 12_000  # large enough that a call's own time does not show
    square = jnp.asarray(np.random.default_rng(0).standard_normal((size, size), np.float32))
    product = jax.jit(lambda a: jnp.matmul(a, a, precision=PRECISION))
    product(square).block_until_ready()
    best = min(seconds(lambda: product(square)) for _ in range(5))
    described = {
        "processor": processor(),
        "cores": len(os.sched_getaffinity(0)),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "python": platform.python_version(),
        "gflop_s": 2.0 * size**3 / best / 1e9,
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
