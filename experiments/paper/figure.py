"""A figure of the paper: which networks it needs, the numbers it shows, and the picture.

A script holds one :class:`Figure` and hands it to :func:`main`, which computes or draws it alone;
``reproduce.py`` does all of them. Pictures have IEEE's column widths and colours that the colour-blind tell apart.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from campaign import RESULTS, SCALES, Campaign, Numbers, OtherConfiguration, Rows, Run, digest_of

from august_jax.files import replacing
from august_jax.progress import Progress

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Picture

COLUMN_IN, PAGE_IN = 3.5, 7.16
"""Widths of one and of two columns [inch]."""
INK = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#999999")
"""Okabe and Ito's colours."""
SEARCHED = "#7a3fb5"
"""Of the search by physics."""
MARKS = "osD^vP*X"
_NONE = {
    "prediction": ("answering the prediction", "#555555", "--"),
    "up": ("a level craft", "#555555", "--"),
    "mean_shape": ("the mean craft at the prediction", "#555555", "--"),
    "resampling": ("the true surface anew: the floor", "#999999", ":"),
}
BASELINES = {
    "mpe_m": ("prediction",),
    "mde": ("up",),
    "wd_db": ("mean_shape", "resampling"),
    "mcd_db": ("mean_shape", "resampling"),
}
"""Metric -> schemes that take no information, or the whole truth."""
COLUMNS = (
    "mpe_m",
    "mpe_se_m",
    "mde",
    "mde_se",
    "wd_db",
    "wd_se_db",
    "mcd_db",
    "mcd_se_db",
    "craft_accuracy",
    "bound_m",
    "bound_mde",
    "expected_mpe_m",
    "expected_mde",
)
EXPECTED = {"mpe_m": "expected_mpe_m", "mde": "expected_mde"}
"""Metric -> what the search's posterior expects of it: the bound that knows of every explanation of an echo."""


@dataclass(frozen=True)
class Figure:
    """One figure.

    Attributes:
        name: of its script, numbers and pictures.
        subject: what it shows, in a line.
        paper: which of the paper's it stands for.
        runs: preset -> the networks that it needs, and whether their accuracy is.
        compute: a campaign -> the numbers.
        draw: the numbers -> the picture.
        minutes: that computing takes on two cores at the preset ``laptop``, trainings and evaluations aside.
    """

    name: str
    subject: str
    paper: str
    runs: Callable[[str], Sequence[tuple[Run, bool]]]
    compute: Callable[[Campaign], Numbers]
    draw: Callable[[Numbers], Picture]
    minutes: float = 1.0

    def digest(self, campaign: Campaign) -> str:
        """Of all configurations that its numbers come from."""
        return digest_of(*(campaign.config(run) for run, _ in self.runs(campaign.preset)))


def make(figure: Figure, campaign: Campaign) -> Numbers:
    """A figure's numbers: from the disk, or computed and kept."""
    digest = figure.digest(campaign)
    if campaign.computed(figure.name):
        return campaign.numbers(figure.name, digest)
    numbers, seconds = campaign.timed(lambda: figure.compute(campaign))
    path = campaign.keep(figure.name, numbers, digest, seconds)
    campaign.progress(f"wrote {path}")
    return numbers


def picture(figure: Figure, campaign: Campaign, numbers: Numbers) -> list[Path]:
    """Draw it as PDF and PNG; the files."""
    drawn, base = figure.draw(numbers), campaign.picture(figure.name)
    base.parent.mkdir(parents=True, exist_ok=True)
    paths = [base.with_name(f"{base.name}.{kind}") for kind in ("pdf", "png")]
    for path in paths:
        with replacing(path) as aside:
            # no date in the file: the same numbers give the same picture
            drawn.savefig(
                aside, format=path.suffix[1:], dpi=300, metadata={"CreationDate": None} if path.suffix == ".pdf" else {}
            )
    return paths


def main(figure: Figure, description: str | None) -> None:
    """The command line of one figure."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("compute", "draw"))
    add_places(parser)
    args = parser.parse_args()
    campaign = Campaign(
        args.preset, args.runs, args.results, lambda line: print(line, flush=True), rehearse=args.rehearse
    )
    try:
        if args.action == "compute":
            make(figure, campaign)
            print(f"next:  python experiments/paper/{figure.name}.py draw --preset {args.preset}")
        elif not campaign.computed(figure.name):
            parser.error(
                f"{figure.name}: not computed at the preset {args.preset}; run first "
                f"`python experiments/paper/{figure.name}.py compute --preset {args.preset}`"
            )
        else:
            numbers = campaign.numbers(figure.name, figure.digest(campaign))
            print("wrote", *picture(figure, campaign, numbers))
    except OtherConfiguration as error:
        parser.error(str(error))


def add_places(parser: argparse.ArgumentParser) -> None:
    """Options that every figure shares."""
    parser.add_argument("--preset", choices=tuple(SCALES), default="laptop", help="how large (%(default)s)")
    parser.add_argument("--rehearse", action="store_true", help="a twentieth of the preset, in folders of its own")
    parser.add_argument(
        "--runs", type=Path, default=Path("august_runs/reproduce"), help="folder of the trainings (%(default)s)"
    )
    parser.add_argument("--results", type=Path, default=RESULTS, help="folder of the results (%(default)s)")


def columns(labelled: Iterable[tuple[str, Rows]]) -> Numbers:
    """Rows of several evaluations as arrays, one entry a line and SNR; NaN where a scheme does not define a metric.

    Args:
        labelled: what the networks' own rows are called, and the rows. All other schemes' are taken from the first
            evaluation that has them.
    """
    lines: list[tuple[str, dict[str, Any]]] = []
    seen: set[str] = set()
    for label, rows in labelled:
        others = {row["scheme"] for row in rows} - {"august"} - seen
        lines += [(label if row["scheme"] == "august" else row["scheme"], row) for row in rows
                  if row["scheme"] == "august" or row["scheme"] in others]  # fmt: skip
        seen |= others
    numbers = {"line": np.array([line for line, _ in lines]), "snr_db": np.array([row["snr_db"] for _, row in lines])}
    for name in COLUMNS:
        numbers[name] = np.array([np.nan if row.get(name) is None else row[name] for _, row in lines], float)
    numbers["count"] = np.array([row["count"] for _, row in lines])
    return numbers


def stacked(name: str, parts: Mapping[Any, Numbers]) -> Numbers:
    """:func:`columns` of several cases one after the other, with a column ``name`` that says which case."""
    own = [part | {name: np.full(len(part["line"]), case)} for case, part in parts.items()]
    return {column: np.concatenate([part[column] for part in own]) for column in own[0]}


def over_snr(
    axes: Axes,
    numbers: Numbers,
    metric: str,
    lines: dict[str, tuple[str, str, str]],
    *,
    error: str | None = None,
    bound: str | None = None,
    logarithmic: bool = True,
    over: str = "snr_db",
) -> None:
    """A metric over SNR: the lines with error bars, what takes no information, the floor, and the bound.

    Args:
        axes: to draw in.
        numbers: of :func:`columns`.
        metric: one of COLUMNS.
        lines: name in ``numbers`` -> label, colour and style.
        error: column of its standard error.
        bound: column of what an unbiased estimator that knows the craft errs by; one for each line where they differ.
        logarithmic: the metric's axis.
        over: column that takes the SNR's place.
    """
    for number, (name, (label, color, style)) in enumerate(lines.items()):
        at = (numbers["line"] == name) & np.isfinite(numbers[metric])
        if at.any():
            bars = None if error is None else numbers[error][at]
            axes.errorbar(numbers[over][at], numbers[metric][at], bars, color=color, ls=style, lw=1.1, capsize=1.5,
                          marker=MARKS[number % len(MARKS)], ms=3, label=label)  # fmt: skip
    for name in BASELINES[metric]:
        label, color, style = _NONE[name]
        at = (numbers["line"] == name) & np.isfinite(numbers[metric])
        if at.any():
            axes.plot(numbers[over][at], numbers[metric][at], color=color, ls=style, lw=1.0, label=label)
    if bound is not None:
        limits = {
            name: tuple(sorted((x, float(f"{y:.3g}")) for x, y in zip(numbers[over][at], numbers[bound][at])))
            for name in lines
            if (at := (numbers["line"] == name) & np.isfinite(numbers[bound])).any()
        }
        for number, limit in enumerate(dict.fromkeys(limits.values())):
            # black where all hear alike, else in the colour of who hears
            alone = len(set(limits.values())) == 1
            name = next(name for name, each in limits.items() if each == limit)
            axes.plot(*np.array(limit).T, color="black" if alone else lines[name][1], ls="-.", lw=1.0,
                      label=None if number else "bound, craft known")  # fmt: skip
    expected = EXPECTED.get(metric)
    at = np.isin(numbers["line"], list(lines))  # what a line that is not drawn expects says nothing
    if expected in numbers and (at := at & np.isfinite(numbers[expected])).any():
        pairs = sorted(zip(numbers[over][at], numbers[expected][at]))
        axes.plot(*np.array(pairs).T, color=SEARCHED, ls=":", lw=1.0, label="what the search expects to err by")
    if logarithmic:
        axes.set_yscale("log")
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter("{x:g}" if np.ptp(np.log10(axes.get_ylim())) < 0.7 else _two_or_five)
    if over == "snr_db":
        axes.set_xlabel("SNR [dB]")
    plain(axes)


def _two_or_five(value: float, _: int) -> str:
    """Labels of a decade's ticks between its ends: others would touch one another."""
    return f"{value:g}" if round(value / 10.0 ** np.floor(np.log10(value))) in (2, 5) else ""


def plain(axes: Axes) -> None:
    """Small letters, thin grid."""
    axes.tick_params(labelsize=7, which="both")
    axes.xaxis.label.set_size(8)
    axes.yaxis.label.set_size(8)
    axes.title.set_size(8)
    axes.grid(True, which="major", lw=0.4, color="0.88")
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def legend_below(drawn: Picture, columns: int) -> None:
    """One legend of all axes, below them, each label once, in letters that are small enough for the picture's width."""
    named = {label: line for axes in drawn.axes for line, label in zip(*axes.get_legend_handles_labels())}
    for size in (6.5, 6.0, 5.5, 5.0):
        style = {"ncols": columns, "frameon": False, "fontsize": size}
        legend = drawn.legend(named.values(), named.keys(), loc="outside lower center", **style)
        if size == 5.0 or legend.get_window_extent().width <= drawn.bbox.width:
            return
        legend.remove()


def prefixed(words: str, progress: Progress) -> Progress:
    """Progress whose lines begin with these words."""
    return lambda line: progress(words + line)
