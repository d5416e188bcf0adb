"""Weighted distance over transmit power by the craft's size (paper: half-wheelbases of 0.25, 0.35 and 0.5 m).

python experiments/paper/craft_size.py compute|draw [--preset laptop]
"""

from __future__ import annotations

from campaign import SCALES, Campaign, Numbers, Run, run_of
from figure import Figure, main
from over_power import Case, drawn_over_power, over_power


def runs(preset: str) -> list[tuple[Run, bool]]:
    """AUGUST for every size, with our encoder."""
    return [(run_of(preset, "august", "roi", size_m=size), False) for size in SCALES[preset].sizes_m]


def compute(campaign: Campaign) -> Numbers:
    """Each size by its own networks."""
    labels = [f"half-wheelbase {size:g} m" for size in campaign.scale.sizes_m]
    cases = [Case(label, run) for label, (run, _) in zip(labels, runs(campaign.preset), strict=True)]
    return over_power(campaign, cases, campaign.scale.count)


FIGURE = Figure(
    "craft_size",
    "weighted distance over power by size",
    "UAV size: WD versus P_s",
    runs,
    compute,
    drawn_over_power,
    3.0,
)


if __name__ == "__main__":
    main(FIGURE, __doc__)
