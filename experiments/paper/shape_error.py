"""Weighted distance over SNR, scheme by scheme, beside the mean craft and the floor (paper: WD versus SNR).

    python experiments/paper/shape_error.py compute|draw [--preset laptop]

The weighted distance adds the squared position error to the Chamfer distance of clouds about their own means: beside it
stands the latter alone, which says what is left of the shape.
"""

from __future__ import annotations

from campaign import Numbers
from figure import PAGE_IN, Figure, legend_below, main, over_snr
from schemes_over_snr import compared, compared_lines, compared_numbers

from august_jax.app.plotting import new_figure


def draw(numbers: Numbers):
    """The weighted distance, and shapes about their own means."""
    drawn = new_figure(PAGE_IN, 3.4)
    for axes, metric, label, error in zip(
        drawn.subplots(1, 2),
        ("wd_db", "mcd_db"),
        ("weighted distance [dB]", "Chamfer distance [dB]"),
        ("wd_se_db", "mcd_se_db"),
    ):
        over_snr(axes, numbers, metric, compared_lines(numbers), error=error, logarithmic=False)
        axes.set_ylabel(label)
    legend_below(drawn, 4)
    return drawn


FIGURE = Figure(
    "shape_error", "weighted distance over SNR by scheme", "WD versus SNR", compared, compared_numbers, draw
)


if __name__ == "__main__":
    main(FIGURE, __doc__)
