"""Weighted distance over SNR by the size of the array (paper: WD for 16x4, 16x2 and 16x1 antennas).

python experiments/paper/array_size.py compute|draw [--preset laptop]
"""

from __future__ import annotations

from campaign import SCALES, Campaign, Numbers, Run, run_of
from figure import INK, PAGE_IN, Figure, columns, legend_below, main, over_snr

from august_jax.app.plotting import new_figure


def runs(preset: str) -> list[tuple[Run, bool]]:
    """AUGUST at every array, with our encoder."""
    return [(run_of(preset, "august", "roi", array), True) for array in SCALES[preset].arrays]


def compute(campaign: Campaign) -> Numbers:
    """Accuracy; the baselines hear nothing and are the same at every array."""
    return columns((run.name, campaign.rows(run)) for run, _ in runs(campaign.preset))


def draw(numbers: Numbers):
    """The weighted distance, and the position error in it."""
    own = [name for name in dict.fromkeys(map(str, numbers["line"])) if name.startswith("august-")]
    lines = {name: (f"{name.split('-')[2]} antennas", INK[number], "-") for number, name in enumerate(own)}
    drawn = new_figure(PAGE_IN, 3.0)
    first, second = drawn.subplots(1, 2)
    over_snr(first, numbers, "wd_db", lines, error="wd_se_db", logarithmic=False)
    over_snr(second, numbers, "mpe_m", lines, error="mpe_se_m", bound="bound_m")
    first.set_ylabel("weighted distance [dB]")
    second.set_ylabel("mean position error [m]")
    legend_below(drawn, 3)
    return drawn


FIGURE = Figure("array_size", "weighted distance over SNR by array", "WD versus SNR by array", runs, compute, draw)


if __name__ == "__main__":
    main(FIGURE, __doc__)
