"""Position error over SNR, scheme by scheme, beside answering the prediction and the bound (paper: MPE versus SNR).

python experiments/paper/position_error.py compute|draw [--preset laptop]
"""

from __future__ import annotations

from campaign import Numbers
from figure import COLUMN_IN, Figure, legend_below, main, over_snr
from schemes_over_snr import compared, compared_lines, compared_numbers

from august_jax.app.plotting import new_figure


def draw(numbers: Numbers):
    """One panel."""
    drawn = new_figure(COLUMN_IN, 3.9)
    axes = drawn.add_subplot()
    over_snr(axes, numbers, "mpe_m", compared_lines(numbers), error="mpe_se_m", bound="bound_m")
    axes.set_ylabel("mean position error [m]")
    legend_below(drawn, 2)
    return drawn


FIGURE = Figure(
    "position_error", "position error over SNR by scheme", "MPE versus SNR", compared, compared_numbers, draw
)


if __name__ == "__main__":
    main(FIGURE, __doc__)
