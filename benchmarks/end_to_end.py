"""Wall times of the program as a user meets it: imports, the help, samples a second.

    python benchmarks/end_to_end.py --json end_to_end.json

Prints a table and writes JSON. ``import august_jax`` is timed against ``import jax`` in fresh interpreters, in turn.
Samples a second are those that ``august simulate`` reports: coupled solves through the factored body, pilots, noise,
estimate and label, with preparing (or reading) the factored bodies and writing counted in.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time

import numpy as np
from common import Figures, machine, parsed, write

AUGUST = (sys.executable, "-m", "august_jax.app.cli")


def command_seconds(*command: str) -> float:
    """Wall time of a command that must succeed."""
    start = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    return time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="laptop")
    parser.add_argument("--count", type=int, default=20_000, help="samples to simulate; 0 leaves that out")
    parser.add_argument("--repeats", type=int, default=5)
    args = parsed(parser)
    figures: Figures = {"machine": machine()}
    timed: dict[str, list[float]] = {"import jax": [], "import august_jax": [], "august --help": []}
    for _ in range(args.repeats):
        timed["import jax"].append(command_seconds(sys.executable, "-c", "import jax"))
        timed["import august_jax"].append(command_seconds(sys.executable, "-c", "import jax, august_jax"))
        timed["august --help"].append(command_seconds(*AUGUST, "--help"))
    for name, values in timed.items():
        figures[name] = float(np.median(values))
        print(f"{name:18s} {figures[name]:8.2f} s")
    print(f"import august_jax / import jax: {figures['import august_jax'] / figures['import jax']:.2f}")
    if args.count:
        with tempfile.TemporaryDirectory() as folder:
            arguments = ["simulate", "--preset", args.preset, "--out", folder, "--json", f"data.count={args.count}"]
            output = subprocess.run([*AUGUST, *arguments], check=True, capture_output=True, text=True).stdout
        figures["simulate"] = json.loads(output)
        print(f"simulate {args.preset}: {figures['simulate']['samples_per_s']:.1f} samples/s, all counted")
    write(args, figures)


if __name__ == "__main__":
    main()
