"""All figures of the paper and some beyond it, in order: trains what is missing, evaluates it, computes and draws.

    python experiments/reproduce.py NAME ...|all --preset laptop [--plan] [--budget MINUTES]

First comes the plan: which networks and evaluations each figure needs, what of them is there, and the minutes and the
disk that the rest takes. Figures share networks and evaluations. A run that is stopped goes on where it was: trainings
from their last checkpoint, all else from the last whole piece. With a budget it ends by itself, and says what is left.
"""

from __future__ import annotations

import argparse
import difflib
import importlib
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "paper"))

from campaign import SCALES, Campaign, OtherConfiguration, OutOfTime, Run
from figure import Figure, add_places, make, picture
from schemes_over_snr import asked

from august_jax.config import ConfigError

PAPER = (
    "position_error",
    "shape_error",
    "attitude_error",
    "array_size",
    "region_size",
    "denoising",
    "region_view",
    "clouds_by_scheme",
    "clouds_by_array",
    "clouds_by_region",
    "tracks",
    "craft_size",
    "craft_material",
)
"""The paper's figures, those first that most others share networks with."""
NAMES = (*PAPER, "bandwidth", "soft_boundary", "left_out")
"""All figures; of the last ones the paper says nothing."""
_COMPILE_S = {"smoke": 15.0, "laptop": 40.0, "paper": 60.0}
_BODIES_S = {"smoke": 10.0, "laptop": 180.0, "paper": 240.0}
_EVALUATE_S_PER_SLOT = {"smoke": 0.3, "laptop": 0.05, "paper": 0.6}
_PER_TONE = 0.2
"""Of a training's time, for each tone beside the first."""
_RUN_MIB = {"smoke": 3.0, "laptop": 160.0, "paper": 420.0}
_LEAST_S = 20.0


@dataclass(frozen=True)
class Piece:
    """Something that is made in one go, or gone on with.

    Attributes:
        what: for people.
        done: whether it is on disk.
        minutes: that are left of it.
        mib: of disk that it takes.
    """

    what: str
    done: bool
    minutes: float
    mib: float = 0.0


def figures(names: Sequence[str]) -> list[Figure]:
    """The figures of these names; ``all`` of them.

    Raises:
        ValueError: there is none of a name; names the nearest.
    """
    chosen = NAMES if "all" in names else tuple(dict.fromkeys(names))
    for name in chosen:
        if name not in NAMES:
            near = difflib.get_close_matches(name, NAMES, 1)
            raise ValueError(
                f"NAME: no figure {name!r}; {f'did you mean {near[0]!r}? ' if near else ''}there are all, "
                f"{', '.join(NAMES)}"
            )
    return [importlib.import_module(name).FIGURE for name in chosen]


def missing(chosen: Sequence[Figure], campaign: Campaign) -> tuple[list[Run], list[Run]]:
    """The networks and the evaluations that the figures still need: not those whose numbers are on disk."""
    preset = campaign.preset
    wanted = [pair for figure in chosen if not campaign.computed(figure.name) for pair in figure.runs(preset)]
    judged = dict.fromkeys(
        run for run, rows in wanted if rows and not campaign.evaluated(run, asked(preset, run, chosen))
    )
    networks = dict.fromkeys(run for run, rows in wanted if not rows or run in judged)
    return list(networks), list(judged)


def plan(chosen: Sequence[Figure], campaign: Campaign) -> list[Piece]:
    """What the figures need, in the order in which it is made."""
    preset, scale = campaign.preset, campaign.scale
    pieces: list[Piece] = []
    runs, to_judge = missing(chosen, campaign)
    judged = dict.fromkeys(run for figure in chosen for run, rows in figure.runs(preset) if rows)
    bodies = set()
    for run in runs:
        config = campaign.config(run)
        done = campaign.trained(run)
        left = max(config.train.steps - done, 0)
        tones = len(config.array.frequencies_hz)
        slower = 1.0 + _PER_TONE * (tones - 1)
        seconds = slower * left * config.train.batch / scale.samples_s + (_COMPILE_S[preset] if left else 0.0)
        shape = (config.target, config.array, config.flight.box_m)
        if left and shape not in bodies:
            area = (config.target.half_wheelbase_m / campaign.base.target.half_wheelbase_m) ** 2
            seconds += area * tones * _BODIES_S[preset]  # at most: bodies are cached
        bodies.add(shape)
        pieces.append(Piece(f"train {run.name}: {done} of {config.train.steps} steps", not left, seconds / 60.0,
                            0.0 if done else _RUN_MIB[preset]))  # fmt: skip
    for run in judged:
        searched = asked(preset, run, chosen)
        slots = scale.count * len(scale.snr_db)
        seconds = slots * _EVALUATE_S_PER_SLOT[preset] + _COMPILE_S[preset]
        seconds += 7.0 * scale.searched * len(scale.snr_db) if searched else 0.0
        what = f"evaluate {run.name}{', with the search' if searched else ''}"
        pieces.append(Piece(what, run not in to_judge, seconds / 60.0, 0.1))
    for figure in chosen:
        share = min(scale.steps / SCALES["laptop"].steps, 1.0)
        pieces.append(Piece(f"figure {figure.name}", campaign.computed(figure.name),
                            max(figure.minutes * share, 0.1), 2.0))  # fmt: skip
    return pieces


def told(pieces: Sequence[Piece]) -> str:
    """The plan as lines, and what is left in all."""
    lines = [
        f"  {'there' if piece.done else f'{piece.minutes:5.1f} min':>9}  {piece.what}" for piece in pieces
    ]  # fmt: skip
    left = [piece for piece in pieces if not piece.done]
    minutes, mib = sum(piece.minutes for piece in left), sum(piece.mib for piece in left)
    return "\n".join(
        [*lines, f"{len(left)} of {len(pieces)} pieces to do, about {minutes:.0f} min, {mib:.0f} MiB of disk"]
    )


def reproduce(chosen: Sequence[Figure], campaign: Campaign) -> None:
    """Make what is missing and draw, network by network and figure by figure.

    Raises:
        OutOfTime: the campaign's deadline has passed.
        OtherConfiguration: something on disk is of another configuration.
    """
    networks, judged = missing(chosen, campaign)
    for run in networks:
        campaign.networks(run)
    for run in judged:
        campaign.rows(run, asked(campaign.preset, run, chosen))
    for figure in chosen:
        paths = picture(figure, campaign, make(figure, campaign))
        campaign.progress(f"wrote {', '.join(map(str, paths))}")


def main(argv: Sequence[str] | None = None) -> int:
    """The command line; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", metavar="NAME", help=f"all, or of {', '.join(NAMES)}")
    add_places(parser)
    parser.add_argument("--plan", action="store_true", help="say what would be done, and do nothing")
    parser.add_argument("--budget", type=float, metavar="MINUTES", help="begin nothing new after so long")
    args = parser.parse_args(argv)
    began = time.monotonic()
    deadline = None if args.budget is None else began + 60.0 * args.budget
    try:
        chosen = figures(args.names)
        campaign = Campaign(args.preset, args.runs, args.results, _Stamped(began), deadline, args.rehearse)
        pieces = plan(chosen, campaign)
        print(told(pieces), flush=True)
        again = [*args.names, "--preset", args.preset, *(["--rehearse"] if args.rehearse else [])]
        if args.plan:
            return 0
        if args.budget is not None and not 60.0 * args.budget >= _LEAST_S:
            raise ValueError(
                f"--budget: {args.budget:g} minutes are too few for the next piece; give {_LEAST_S / 60:.1f} or more, "
                "or leave the budget out"
            )
        reproduce(chosen, campaign)
    except OutOfTime:
        left = [piece for piece in plan(chosen, campaign) if not piece.done]
        print(f"the budget of {args.budget:g} min is used up; {len(left)} pieces are left, the next: {left[0].what}\n"
              f"next:  python experiments/reproduce.py {' '.join(again)}")  # fmt: skip
        return 0
    except (ConfigError, OtherConfiguration, ValueError) as error:
        print(f"reproduce.py: {error}", file=sys.stderr)
        return 2
    print(f"done in {(time.monotonic() - began) / 60.0:.1f} min; results in {campaign.picture('').parent}")
    return 0


class _Stamped:
    """Lines of progress with the minutes since the beginning."""

    def __init__(self, began: float):
        self._began = began

    def __call__(self, line: str) -> None:
        print(f"{(time.monotonic() - self._began) / 60.0:6.1f} min  {line}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
