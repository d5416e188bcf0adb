"""Truth and reconstruction at a good and a bad SNR, coloured by conductivity (paper: at 20 and -3 dB).

python experiments/paper/region_view.py compute|draw [--preset laptop]
"""

from __future__ import annotations

from campaign import Campaign, Numbers, Run, run_of
from clouds import clouds_drawn, clouds_of
from figure import Figure, main

SNRS_DB = (20.0, -3.0)


def runs(preset: str) -> list[tuple[Run, bool]]:
    """AUGUST with our encoder."""
    return [(run_of(preset, "august", "roi"), False)]


def compute(campaign: Campaign) -> Numbers:
    """Clouds and their errors."""
    mine = [run for run, _ in runs(campaign.preset)]
    return clouds_of(campaign, mine, ["AUGUST"], SNRS_DB)


def draw(numbers: Numbers):
    """Truth and reconstructions, a row a slot."""
    return clouds_drawn(numbers, "conductivity")


FIGURE = Figure("region_view", "truth and reconstruction, good and bad SNR", "region view", runs, compute, draw)


if __name__ == "__main__":
    main(FIGURE, __doc__)
