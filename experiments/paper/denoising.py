"""A cloud on its way through the reverse diffusion, coloured by permittivity (paper: the denoising process).

    python experiments/paper/denoising.py compute|draw [--preset laptop]

The paper's way of drawing points, in the region about the prediction, from noise that is as wide as the region. Where
networks draw in a craft's own axes (``model.frame``), the place is known before the first step.
"""

from __future__ import annotations

import numpy as np
from campaign import Campaign, Numbers, Run, run_of
from figure import PAGE_IN, Figure, main
from looked import look, scattered

from august_jax.app.plotting import new_figure

SHARES = (0.0, 0.4, 0.75, 0.9, 1.0)
"""Of the steps at which clouds are shown; the paper's 0, 80, 150, 180 and 200 of 200."""
SNR_DB = 20.0
ROW = 1


def runs(preset: str) -> list[tuple[Run, bool]]:
    """AUGUST with our encoder."""
    return [(run_of(preset, "august", "roi"), False)]


def compute(campaign: Campaign) -> Numbers:
    """Clouds at instants, the truth, and how wide and how far off the clouds are."""
    run = runs(campaign.preset)[0][0]
    steps = campaign.config(run).model.steps
    instants = tuple(round(share * steps) for share in SHARES)
    seen = look(campaign, run, [ROW], SNR_DB, instants)
    points = seen.clouds[0][:, 0]
    return {
        "instants": np.array(instants),
        "points_m": points,
        "permittivity": seen.clouds[1][:, 0],
        "truth_m": seen.truth[0][0],
        "true_permittivity": seen.truth[1][0],
        "off_m": np.linalg.norm(points.mean(axis=1), axis=-1),
        "spread_m": np.sqrt(points.var(axis=1).sum(axis=-1)),
    }


def draw(numbers: Numbers):
    """Clouds in a row, the truth last."""
    drawn = new_figure(PAGE_IN, 1.9)
    reach = float(np.abs(numbers["truth_m"]).max()) * 2.5
    limits = (1.0, float(max(numbers["true_permittivity"].max(), 5.0)))
    count = len(numbers["instants"])
    for row, instant in enumerate(numbers["instants"]):
        title = (
            f"step {instant}: {100 * numbers['off_m'][row]:.0f} cm off,\n{100 * numbers['spread_m'][row]:.0f} cm wide"
        )
        scattered(drawn, (1, count + 1, row + 1), np.clip(numbers["points_m"][row], -reach, reach),
                  numbers["permittivity"][row], limits, reach, title)  # fmt: skip
    shown = scattered(drawn, (1, count + 1, count + 1), numbers["truth_m"], numbers["true_permittivity"], limits, reach,
                      "truth")  # fmt: skip
    bar = drawn.colorbar(shown, ax=drawn.axes, shrink=0.6, pad=0.04)
    bar.set_label("permittivity", fontsize=7)
    bar.ax.tick_params(labelsize=6)
    return drawn


FIGURE = Figure("denoising", "a cloud on its way through the reverse diffusion", "denoise process", runs, compute, draw)


if __name__ == "__main__":
    main(FIGURE, __doc__)
