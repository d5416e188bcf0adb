"""Flights followed in closed loop: true, predicted and estimated (paper: a smooth flight in a region of 0.85 m and a
dynamic one in a region of 2.5 m), and the errors of many.

    python experiments/paper/tracks.py compute|draw [--preset laptop]

Networks find the craft in every slot; a Kalman filter over what they found, corrected by the shipped LSTM as the paper
has it, says where to listen next. Three slots of a flight are begun with detections, which miss by up to the region's
threshold; errors are counted from the fourth on.
"""

from __future__ import annotations

import jax
import numpy as np
from campaign import SCALES, SEED, Campaign, Numbers, Run, run_of
from figure import INK, PAGE_IN, Clock, Figure, main, plain

from august_jax.app.plotting import new_figure
from august_jax.config import override
from august_jax.pipeline import draw_scenario, sense
from august_jax.tracking import PREDICTORS

SNR_DB = 20.0
SLOTS = 20
FIRST = 3
"""Slots that detections begin."""
PREDICTOR = "lstm"


def flights(preset: str) -> list[tuple[str, Run]]:
    """A smooth flight in the smallest region, and a dynamic one in the largest."""
    thresholds = SCALES[preset].thresholds_m
    return [
        (style, run_of(preset, "august", "roi", threshold_m=threshold))
        for style, threshold in (("smooth", thresholds[0]), ("dynamic", thresholds[-1]))
    ]


def runs(preset: str) -> list[tuple[Run, bool]]:
    """AUGUST with our encoder in both regions."""
    return [(run, False) for _, run in flights(preset)]


def compute(campaign: Campaign) -> Numbers:
    """The first flight of each kind, and errors (K, flights, slots) of all."""
    told, shown, errors = [], [], []
    count = campaign.scale.flights
    clock = Clock(count * len(flights(campaign.preset)))
    for style, run in flights(campaign.preset):
        networks = campaign.networks(run)
        config = override(campaign.config(run), (f"flight.style={style}",))
        predictor = PREDICTORS[PREDICTOR].for_flight(config.flight)
        told.append(f"{style}, region of {config.region.scale_m:.2f} m")
        errors.append([])
        for number in range(count):
            scenario = draw_scenario(config, SEED + number, SLOTS)
            track = sense(networks, config, scenario, seed=SEED + number, snr_db=SNR_DB, predictor=predictor)
            places = np.stack([track.position, track.predicted, track.estimated_position])
            if number == 0:
                shown.append(places)
            errors[-1].append(np.linalg.norm(places[1:] - places[0], axis=-1))
            left = clock.left()
            if (number + 1) % 10 == 0 or number + 1 == count:
                campaign.progress(f"{style}: {number + 1} of {count} flights  {left}")
        jax.clear_caches()
    values = np.array(errors)
    return {
        "label": np.array(told),
        "places_m": np.array(shown),
        "predicted_m": values[:, :, 0],
        "estimated_m": values[:, :, 1],
        "first": np.array(FIRST),
    }


def draw(numbers: Numbers):
    """The first flight of each kind from above and by height, and the distributions."""
    kinds, first = len(numbers["label"]), int(numbers["first"])
    drawn = new_figure(PAGE_IN, 2.5 * kinds)
    grid = drawn.subplots(kinds, 3, squeeze=False)
    for (above, height, share), label, places, predicted, estimated in zip(
        grid, numbers["label"], numbers["places_m"], numbers["predicted_m"], numbers["estimated_m"]
    ):
        names = ("true", "predicted", "estimated")
        for place, name, color, style in zip(places, names, ("#000000", INK[1], INK[0]), ("-", ":", "-")):
            mark = {"marker": "o", "ms": 2.5} if name != "true" else {}
            above.plot(*place.T[:2], color=color, ls=style, lw=1.0, label=name, **mark)
            height.plot(np.arange(1, len(place) + 1), place[:, 2], color=color, ls=style, lw=1.0, **mark)
        above.set(xlabel="x [m]", ylabel="y [m]", title=str(label), aspect="equal")
        height.set(xlabel="slot", ylabel="z [m]")
        for values, color, name in ((predicted, INK[1], "predicted"), (estimated, INK[0], "estimated")):
            flat = np.sort(values[:, first:].ravel())
            share.plot(flat, np.linspace(0.0, 1.0, len(flat)), color=color, lw=1.1)
            share.plot([], [], color=color, label=f"{name}: mean {flat.mean():.2f} m")
        share.set(xlabel="error [m]", ylabel="share of slots below", xscale="log", ylim=(0.0, 1.0))
        share.legend(fontsize=6, frameon=False, loc="upper left")
        share.set_title(f"{len(predicted)} flights")
        for axes in (above, height, share):
            plain(axes)
    named = dict(zip(*reversed(grid[0][0].get_legend_handles_labels())))
    drawn.legend(named.values(), named.keys(), loc="outside lower center", ncols=3, frameon=False, fontsize=6.5)
    return drawn


FIGURE = Figure("tracks", "flights followed in closed loop", "tracks, smooth and dynamic", runs, compute, draw, 8.0)


if __name__ == "__main__":
    main(FIGURE, __doc__)
