"""Clouds of two slots, region by region, beside the truth (paper: at 30 dB with s of 0.85, 1.5 and 2.5 m).

python experiments/paper/clouds_by_region.py compute|draw [--preset laptop]
"""

from __future__ import annotations

from campaign import SCALES, Campaign, Numbers, Run, run_of
from clouds import clouds_drawn, clouds_of
from figure import Figure, main

SNRS_DB = (30.0,)


def runs(preset: str) -> list[tuple[Run, bool]]:
    """AUGUST in every region, with our encoder."""
    scale = SCALES[preset]
    return [(run_of(preset, "august", "roi", threshold_m=threshold), False) for threshold in scale.thresholds_m]


def compute(campaign: Campaign) -> Numbers:
    """Clouds and their errors."""
    mine = [run for run, _ in runs(campaign.preset)]
    return clouds_of(
        campaign, mine, [f"region of {campaign.config(run).region.scale_m:.2f} m" for run in mine], SNRS_DB
    )


def draw(numbers: Numbers):
    """Truth and reconstructions, a row a slot."""
    return clouds_drawn(numbers, "permittivity")


FIGURE = Figure("clouds_by_region", "clouds by region", "clouds by region size", runs, compute, draw)


if __name__ == "__main__":
    main(FIGURE, __doc__)
