"""Clouds of two slots, scheme by scheme, beside the truth (paper: at 20 dB with 16x2 antennas).

python experiments/paper/clouds_by_scheme.py compute|draw [--preset laptop]
"""

from __future__ import annotations

from campaign import SCALES, Campaign, Numbers, Run, run_of
from clouds import clouds_drawn, clouds_of
from figure import Figure, main

from august_jax.schemes.networks import TITLES

SNRS_DB = (20.0,)


def runs(preset: str) -> list[tuple[Run, bool]]:
    """Every scheme at the second array, with our encoder."""
    array = SCALES[preset].arrays[1]
    return [(run_of(preset, scheme, "roi", array), False) for scheme in TITLES]


def compute(campaign: Campaign) -> Numbers:
    """Clouds and their errors."""
    mine = [run for run, _ in runs(campaign.preset)]
    return clouds_of(campaign, mine, [TITLES[run.name.partition("-")[0]] for run in mine], SNRS_DB)


def draw(numbers: Numbers):
    """Truth and reconstructions, a row a slot."""
    return clouds_drawn(numbers, "permittivity")


FIGURE = Figure("clouds_by_scheme", "clouds by scheme", "clouds by scheme", runs, compute, draw)


if __name__ == "__main__":
    main(FIGURE, __doc__)
