"""Direction error over SNR, schemes by arrays, beside a level craft and the bound (paper: MDE versus SNR).

python experiments/paper/attitude_error.py compute|draw [--preset laptop]
"""

from __future__ import annotations

import numpy as np
from campaign import SCALES, Campaign, Numbers, Run, run_of
from figure import INK, PAGE_IN, Figure, columns, legend_below, main, over_snr, stacked
from schemes_over_snr import OTHERS

from august_jax.app.plotting import new_figure
from august_jax.schemes.networks import TITLES


def runs(preset: str) -> list[tuple[Run, bool]]:
    """Every scheme at every array, with our encoder: the paper's tells nothing of the attitude."""
    return [(run_of(preset, scheme, "roi", array), True) for array in SCALES[preset].arrays for scheme in TITLES]


def compute(campaign: Campaign) -> Numbers:
    """Accuracy; baselines and bound of each array are its own."""

    def accuracy(array: tuple[int, int]) -> Numbers:
        return columns((scheme, campaign.rows(run_of(campaign.preset, scheme, "roi", array))) for scheme in TITLES)

    return stacked("array", {f"{nx}x{nz}": accuracy((nx, nz)) for nx, nz in campaign.scale.arrays})


def draw(numbers: Numbers):
    """A panel an array."""
    arrays = list(dict.fromkeys(map(str, numbers["array"])))
    drawn = new_figure(PAGE_IN, 3.0)
    for axes, array in zip(np.ravel(drawn.subplots(1, len(arrays), sharey=True)), arrays):
        mine = {name: values[numbers["array"] == array] for name, values in numbers.items()}
        lines = {scheme: (label, INK[number], "-") for number, (scheme, label) in enumerate(TITLES.items())}
        over_snr(axes, mine, "mde", lines | OTHERS, error="mde_se", bound="bound_mde")
        axes.set_title(f"{array} antennas")
    drawn.axes[0].set_ylabel("mean of 1 - cos of the normal's error")
    legend_below(drawn, 4)
    return drawn


FIGURE = Figure("attitude_error", "direction error over SNR, schemes by arrays", "MDE versus SNR", runs, compute, draw)


if __name__ == "__main__":
    main(FIGURE, __doc__)
