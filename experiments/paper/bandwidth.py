"""Weighted distance and position error over bandwidth: 1, 2, 4 and 8 tones over 100 MHz (not in the paper).

    python experiments/paper/bandwidth.py compute|draw [--preset laptop]

The tones lie evenly over 100 MHz about the carrier, one alone on it. The energy of the echo is held, and with it, but
for what 100 MHz change, the transmit power: F tones share what one would hear at 20 dB, so that each hears 1/F of it,
and the SNR over all tones, which counts the noise of each, is 20 dB - 10 log10 F. Tones df apart tell ranges modulo
c/(2 df): 1.5 m for two, as wide as the region, 4.5 m for four and 10.5 m for eight.

The craft are the smallest ones, whose bodies and tables of eight tones are made in minutes. A search takes as many
times as long as there are tones, so that it answers as many times fewer slots.
"""

from __future__ import annotations

import jax
import numpy as np
from answered import table
from campaign import BAND_HZ, SCALES, SEED, Campaign, Numbers, Run, run_of
from figure import INK, PAGE_IN, SEARCHED, Figure, legend_below, main, over_snr, prefixed

from august_jax.app.plotting import new_figure
from august_jax.config import override
from august_jax.evaluation import evaluate

SNR_DB = 20.0
"""Of one tone."""
FEWEST = 5
"""Slots that a search answers at least."""
ASKED = ("august", "matched_field", "prediction", "mean_shape", "resampling")
LINES = {"august": ("AUGUST", INK[0], "-"), "matched_field": ("search by physics", SEARCHED, "-")}


def runs(preset: str) -> list[tuple[Run, bool]]:
    """AUGUST with every number of tones, with our encoder, for the smallest craft."""
    scale = SCALES[preset]
    return [(run_of(preset, "august", "roi", size_m=min(scale.sizes_m), tones=tones), False) for tones in scale.tones]


def compute(campaign: Campaign) -> Numbers:
    """Rows of an evaluation at one SNR for each number of tones."""
    scale, rows = campaign.scale, []
    for tones, (run, _) in zip(scale.tones, runs(campaign.preset), strict=True):
        searched = min(scale.searched, max(scale.searched // tones, FEWEST))
        level = (f"evaluate.snr_db=[{SNR_DB - 10.0 * np.log10(tones):.4f}]", f"evaluate.searched={searched}")
        config = override(campaign.config(run), level)
        told = prefixed(f"{tones} tone{'s' * (tones > 1)}: ", campaign.progress)
        found = evaluate(campaign.networks(run), config, seed=SEED, schemes=ASKED, progress=told)
        rows += [{"line": each["scheme"], "tones": tones, **each} for each in found]
        jax.clear_caches()
    return table(rows)


def draw(numbers: Numbers):
    """The weighted distance, and the position error in it."""
    drawn = new_figure(PAGE_IN, 3.0)
    first, second = drawn.subplots(1, 2)
    over_snr(first, numbers, "wd_db", LINES, error="wd_se_db", logarithmic=False, over="tones")
    over_snr(second, numbers, "mpe_m", LINES, error="mpe_se_m", bound="bound_m", over="tones")
    first.set_ylabel("weighted distance [dB]")
    second.set_ylabel("mean position error [m]")
    counts = np.unique(numbers["tones"])
    for axes in (first, second):
        axes.set_xscale("log", base=2)
        axes.set_xticks(counts, [f"{count:g}" for count in counts])
        axes.set_xlabel(f"tones over {BAND_HZ / 1e6:g} MHz, the same energy")
    legend_below(drawn, 3)
    return drawn


FIGURE = Figure(
    "bandwidth", "weighted distance and position error over bandwidth", "none: beyond it", runs, compute, draw, 18.0
)


if __name__ == "__main__":
    main(FIGURE, __doc__)
