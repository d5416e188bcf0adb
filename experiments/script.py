"""What the experiments' command lines share: `compute` writes numbers, `draw` reads them and makes the picture."""

from __future__ import annotations

import argparse
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from august_jax.files import replacing

Numbers = dict[str, np.ndarray]


def run(
    about: str | None, name: str, compute: Callable[[bool], Numbers], draw: Callable[[Numbers, Path], None]
) -> None:
    """Parse the command line of the experiment ``name`` and do what it says.

    Args:
        about: the script's docstring, shown as its help.
        name: file name without ending; numbers go to results/name.npz, the picture to results/name.png.
        compute: from --small to named arrays.
        draw: from the arrays and the picture's path to a file.
    """
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("compute", "draw"))
    parser.add_argument("--small", action="store_true", help="coarser and fewer: under two minutes on two cores")
    parser.add_argument("--results", type=Path, default=Path(__file__).parent / "results" / f"{name}.npz",
                        help="the .npz that is written or read (%(default)s)")
    arguments = parser.parse_args()
    arguments.results = arguments.results.with_suffix(".npz")
    if arguments.action == "compute":
        arguments.results.parent.mkdir(parents=True, exist_ok=True)  # before the work, which may take long
        numbers = compute(arguments.small)
        with replacing(arguments.results) as aside:
            np.savez(aside, **numbers)
        print(f"wrote {arguments.results}\nnext:  python experiments/{name}.py draw --results {arguments.results}")
        return
    if not arguments.results.exists():
        parser.error(f"--results: {arguments.results} does not exist; run `experiments/{name}.py compute` first")
    picture = arguments.results.with_suffix(".png")
    try:
        with arguments.results.open("rb") as file, np.load(file) as stored:
            numbers = dict(stored)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        parser.error(f"--results: {arguments.results} cannot be read ({type(error).__name__}); compute it again")
    draw(numbers, picture)
    print(f"wrote {picture}")
