"""Weighted distance over SNR by the size of the region (paper: s of 0.85, 1.5 and 2.5 m).

    python experiments/paper/region_size.py compute|draw [--preset laptop]

A larger region is what a worse prediction asks for: networks of each are trained and asked under predictions that miss
by as much. So the baseline, answering the prediction, is another in each.
"""

from __future__ import annotations

import numpy as np
from campaign import SCALES, Campaign, Numbers, Run, run_of
from figure import INK, PAGE_IN, Figure, columns, legend_below, main, over_snr, plain, stacked

from august_jax.app.plotting import new_figure


def runs(preset: str) -> list[tuple[Run, bool]]:
    """AUGUST in every region, with our encoder."""
    scale = SCALES[preset]
    return [(run_of(preset, "august", "roi", threshold_m=threshold), True) for threshold in scale.thresholds_m]


def compute(campaign: Campaign) -> Numbers:
    """Accuracy, region by region."""
    return stacked(
        "scale_m",
        {
            campaign.config(run).region.scale_m: columns([("august", campaign.rows(run))])
            for run, _ in runs(campaign.preset)
        },
    )


def draw(numbers: Numbers):
    """The weighted distance, and how much of the prediction's error is left; answers without an echo are dashed."""
    drawn = new_figure(PAGE_IN, 3.0)
    first, second = drawn.subplots(1, 2)
    for number, scale in enumerate(np.unique(numbers["scale_m"])):
        mine = {name: values[numbers["scale_m"] == scale] for name, values in numbers.items()}
        line = {"august": (f"region of {scale:.2f} m", INK[number], "-")}
        over_snr(first, {name: values[mine["line"] == "august"] for name, values in mine.items()}, "wd_db", line,
                 error="wd_se_db", logarithmic=False)  # fmt: skip
        own, deaf, mean = (mine["line"] == name for name in ("august", "prediction", "mean_shape"))
        first.plot(mine["snr_db"][mean], mine["wd_db"][mean], color=INK[number], ls="--", lw=0.8)
        missed = mine["mpe_m"][deaf]
        second.plot(mine["snr_db"][own], mine["mpe_m"][own] / missed, color=INK[number], marker="o", ms=3, lw=1.1)
        second.plot(mine["snr_db"][own], mine["bound_m"][own] / missed, color=INK[number], ls="-.", lw=0.8)
    floor = numbers["line"] == "resampling"
    order = np.argsort(numbers["snr_db"][floor])
    first.plot(numbers["snr_db"][floor][order], numbers["wd_db"][floor][order], color="#999999", ls=":", lw=1.0,
               label="the true surface anew: the floor")  # fmt: skip
    first.plot([], [], color="#555555", ls="--", lw=0.8, label="the mean craft at the prediction")
    first.set_ylabel("weighted distance [dB]")
    second.axhline(1.0, color="#555555", ls="--", lw=1.0, label="answering the prediction")
    second.plot([], [], color="#555555", ls="-.", lw=0.8, label="bound, craft known")
    second.set(xlabel="SNR [dB]", ylabel="position error over that of the prediction", yscale="log", ylim=(None, 1.15))
    second.yaxis.set_major_formatter("{x:g}")
    plain(second)
    legend_below(drawn, 4)
    return drawn


FIGURE = Figure("region_size", "weighted distance over SNR by region", "WD versus SNR by region", runs, compute, draw)


if __name__ == "__main__":
    main(FIGURE, __doc__)
