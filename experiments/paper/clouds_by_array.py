"""Clouds of two slots, array by array, beside the truth (paper: at 20 dB with 16x4, 16x2 and 16x1 antennas).

python experiments/paper/clouds_by_array.py compute|draw [--preset laptop]
"""

from __future__ import annotations

from campaign import SCALES, Campaign, Numbers, Run, run_of
from clouds import clouds_drawn, clouds_of
from figure import Figure, main

SNRS_DB = (20.0,)


def runs(preset: str) -> list[tuple[Run, bool]]:
    """AUGUST at every array, with our encoder."""
    return [(run_of(preset, "august", "roi", array), False) for array in SCALES[preset].arrays]


def compute(campaign: Campaign) -> Numbers:
    """Clouds and their errors."""
    mine = [run for run, _ in runs(campaign.preset)]
    return clouds_of(campaign, mine, [f"{nx}x{nz} antennas" for nx, nz in campaign.scale.arrays], SNRS_DB)


def draw(numbers: Numbers):
    """Truth and reconstructions, a row a slot."""
    return clouds_drawn(numbers, "permittivity")


FIGURE = Figure("clouds_by_array", "clouds by array", "clouds by array", runs, compute, draw)


if __name__ == "__main__":
    main(FIGURE, __doc__)
