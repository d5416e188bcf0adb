"""The lines of the figures that compare schemes: their runs, labels and styles."""

from __future__ import annotations

from collections.abc import Sequence

from campaign import SCALES, Campaign, Numbers, Run, run_of
from figure import INK, SEARCHED, Figure, columns

from august_jax.schemes.networks import TITLES

ENCODERS = {"roi": ("our encoder", "-"), "paper": ("the paper's", "--")}
OTHERS = {
    "polar": ("model-based, polar domain", "#000000", "-"),
    "polar_angles": ("its angles alone", "#000000", ":"),
    "matched_field": ("search by physics", SEARCHED, "-"),
}


def compared(preset: str) -> list[tuple[Run, bool]]:
    """Every scheme with every encoder, at the largest array; the first run is asked for the search, too."""
    return [(run_of(preset, scheme, encoder), True) for scheme in TITLES for encoder in SCALES[preset].encoders]


def asked(preset: str, run: Run, figures: Sequence[Figure]) -> bool:
    """Whether one of the figures asks for the search beside a run's networks."""
    return SCALES[preset].searched > 0 and any(
        figure.runs is compared and run == figure.runs(preset)[0][0] for figure in figures
    )


def compared_numbers(campaign: Campaign) -> Numbers:
    """Their accuracy, and that of all schemes without networks."""
    runs = [run for run, _ in compared(campaign.preset)]
    first, searched = runs[0], campaign.scale.searched > 0
    return columns((run.name, campaign.rows(run, searched and run == first)) for run in runs)


def compared_lines(numbers: Numbers) -> dict[str, tuple[str, str, str]]:
    """Line -> label, colour, style, of the networks in ``numbers`` and of what needs none."""
    lines = {}
    for name in dict.fromkeys(map(str, numbers["line"])):
        scheme, _, rest = name.partition("-")
        if rest:
            told, style = ENCODERS[rest.partition("-")[0]]
            lines[name] = (f"{TITLES[scheme]}, {told}", INK[list(TITLES).index(scheme)], style)
    return lines | OTHERS
