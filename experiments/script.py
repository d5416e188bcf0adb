"""What the experiments' command lines share: `compute` writes numbers, `draw` reads them and makes the picture."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from august_jax.files import DamagedFile, read_npz, replacing

Numbers = dict[str, np.ndarray]


def run(
    description: str | None,
    name: str,
    compute: Callable[..., Numbers],
    draw: Callable[[Numbers, Path], None],
    options: Callable[[argparse.ArgumentParser], None] = lambda parser: None,
) -> None:
    """Parse the command line of the experiment ``name`` and do what it says.

    Args:
        description: the script's docstring, shown as its help.
        name: file name without ending; numbers go to results/name.npz, the picture to results/name.png.
        compute: from --small to named arrays; takes what ``options`` adds by name.
        draw: from the arrays and the picture's path to a file.
        options: adds arguments that this experiment alone has.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("compute", "draw"))
    parser.add_argument("--small", action="store_true", help="coarser and fewer: minutes on two cores")
    parser.add_argument(
        "--results",
        type=Path,
        default=Path(__file__).parent / "results" / f"{name}.npz",
        help="the .npz that is written or read (%(default)s)",
    )
    common = {action.dest for action in parser._actions}
    options(parser)
    arguments = parser.parse_args()
    own = {name: value for name, value in vars(arguments).items() if name not in common}
    arguments.results = arguments.results.with_suffix(".npz")
    if arguments.action == "compute":
        arguments.results.parent.mkdir(parents=True, exist_ok=True)  # before the work, which may take long
        numbers = compute(arguments.small, **own)
        with replacing(arguments.results) as aside:
            np.savez(aside, **numbers)
        print(f"wrote {arguments.results}\nnext:  python experiments/{name}.py draw --results {arguments.results}")
        return
    try:
        numbers = read_npz(arguments.results)
    except FileNotFoundError:
        parser.error(f"--results: {arguments.results} does not exist; run `experiments/{name}.py compute` first")
    except DamagedFile as error:
        parser.error(f"--results: {error}; compute it again")
    picture = arguments.results.with_suffix(".png")
    try:
        draw(numbers, picture)
    except KeyError as missing:
        parser.error(f"--results: {arguments.results} has no {missing}: not what {name} computes now; compute it again")
    print(f"wrote {picture}")
