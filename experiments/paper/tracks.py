"""Flights followed in closed loop: true, predicted and estimated (paper: a smooth flight in a region of 0.85 m and a
dynamic one in a region of 2.5 m), and the errors of many.

    python experiments/paper/tracks.py compute|draw [--preset laptop]

The regions are the smallest and the largest of the preset's: 0.85 and 2.5 m at `paper`, whose craft have a
half-wheelbase of 0.35 m; 0.75 and 2.4 m at `laptop` and 0.75 and 1.05 m at `smoke`, of 0.25 m.

Networks find the craft in every slot; a Kalman filter over what they found, corrected by the shipped LSTM as the paper
has it, says where to listen next. Three slots of a flight are begun with detections, which miss by up to the region's
threshold, and three after a loss, which is noticed by the echo or by an estimate that leaps. Errors are counted from
the fourth slot on, whatever happens there. Beside them: the search among known craft, which carries hypotheses from
slot to slot, on some of the same flights; it listens in the smallest region, whose detections are good to that.
"""

from __future__ import annotations

import jax
import numpy as np
from campaign import SCALES, SEED, Campaign, Numbers, Run, run_of
from figure import INK, PAGE_IN, Figure, main, plain

from august_jax.app.plotting import new_figure
from august_jax.config import override
from august_jax.data import channels_along, prepare_targets
from august_jax.inference import known_craft
from august_jax.pipeline import draw_scenario, sense
from august_jax.progress import TimeLeft
from august_jax.schemes import follow_flight
from august_jax.tracking import predictor_for

SNR_DB = 20.0
SLOTS = 20
FIRST = 3
"""Slots that detections begin."""
PREDICTOR = "lstm"
LINES = ("predicted", "estimated", "search")
_LOOK = {"true": ("#000000", "-"), "predicted": (INK[1], ":"), "estimated": (INK[0], "-"), "search": (INK[2], "--")}


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
    """The first flight of each kind, and errors (K, flights, slots) of all; NaN where nobody searched."""
    kinds, scale = flights(campaign.preset), campaign.scale
    shape = len(kinds), scale.flights, SLOTS
    errors = {line: np.full(shape, np.nan) for line in LINES}
    lost, told, shown = {line: np.zeros(shape, bool) for line in LINES[1:]}, [], []
    targets = prepare_targets(campaign.config(kinds[0][1]), campaign.progress)
    clock = TimeLeft(scale.flights * len(kinds))
    for kind, (style, run) in enumerate(kinds):
        networks = campaign.networks(run)
        config = override(campaign.config(run), (f"flight.style={style}",))
        predictor = predictor_for(PREDICTOR, config.flight)
        told.append(f"{style}, region of {config.region.scale_m:.2f} m")
        for number in range(scale.flights):
            scenario = draw_scenario(config, SEED + number, SLOTS)
            body = next(each.body for each in targets if each.airframe.digest == scenario.airframe.digest)
            track = sense(networks, config, scenario, seed=SEED + number, snr_db=SNR_DB, predictor=predictor, body=body)
            if number == 0:
                shown.append(np.stack([track.position, track.predicted, track.estimated_position]))
            for line, places in (("predicted", track.predicted), ("estimated", track.estimated_position)):
                errors[line][kind, number] = np.linalg.norm(places - track.position, axis=-1)
            lost["estimated"][kind, number] = track.lost
            left = clock.after_one()
            if (number + 1) % 10 == 0 or number + 1 == scale.flights:
                campaign.progress(f"{style}: {number + 1} of {scale.flights} flights  {left}")
        jax.clear_caches()
    if scale.tracked:
        base = campaign.config(kinds[0][1])
        library = known_craft(base, targets, progress=campaign.progress)
        clock = TimeLeft(scale.tracked * len(kinds))
        for kind, (style, _) in enumerate(kinds):
            config = override(base, (f"flight.style={style}",))
            for number in range(scale.tracked):
                scenario = draw_scenario(config, SEED + number, SLOTS)
                body = next(each.body for each in targets if each.airframe.digest == scenario.airframe.digest)
                pose, material = (
                    (scenario.rotations, scenario.positions),
                    (scenario.permittivity, scenario.conductivity),
                )
                channels = channels_along(config, scenario.airframe, *pose, *material, body)
                track = follow_flight(library, config, scenario, channels, seed=SEED + number, snr_db=SNR_DB).track
                errors["search"][kind, number] = np.linalg.norm(track.estimated_position - track.position, axis=-1)
                lost["search"][kind, number] = track.lost
                campaign.progress(f"{style}: {number + 1} of {scale.tracked} flights searched  {clock.after_one()}")
    return {
        "label": np.array(told),
        "places_m": np.array(shown),
        **{f"{line}_m": values for line, values in errors.items()},
        **{f"{line}_lost": values for line, values in lost.items()},
        "first": np.array(FIRST),
    }


def draw(numbers: Numbers):
    """The first flight of each kind from above and by height, and the distributions."""
    kinds, first = len(numbers["label"]), int(numbers["first"])
    drawn = new_figure(PAGE_IN, 2.6 * kinds)
    grid = drawn.subplots(kinds, 3, squeeze=False, width_ratios=(1.0, 0.9, 1.25))
    for kind, (above, height, share) in enumerate(grid):
        places = numbers["places_m"][kind]
        for place, name in zip(places, _LOOK):
            color, style = _LOOK[name]
            mark = {"marker": "o", "ms": 2.5} if name != "true" else {}
            above.plot(*place.T[:2], color=color, ls=style, lw=1.0, label=name, **mark)
            height.plot(np.arange(1, len(place) + 1), place[:, 2], color=color, ls=style, lw=1.0, **mark)
        gone = numbers["estimated_lost"][kind, 0]
        above.plot(*places[2][gone].T[:2], ls="", marker="s", ms=6, mfc="none", mec=INK[3], label="lost")
        above.set(xlabel="x [m]", ylabel="y [m]", title=str(numbers["label"][kind]))
        above.set_aspect("equal", adjustable="datalim")
        height.set(xlabel="slot", ylabel="z [m]", title="the same flight, height")
        means = {}
        for name in LINES:
            values = numbers[f"{name}_m"][kind, :, first:]
            values = values[np.isfinite(values).all(axis=1)]
            if not len(values):
                continue
            flat, (color, style) = np.sort(values.ravel()), _LOOK[name]
            means[name] = flat.mean()
            label = f"{name}: mean {100 * means[name]:.1f} cm"
            if name != "predicted":
                gone = int(numbers[f"{name}_lost"][kind, :, first:].sum())
                label += f", {len(values)} flights, {gone} lost"
            share.plot(flat, np.linspace(0.0, 1.0, len(flat)), color=color, ls=style, lw=1.2)
            share.plot([], [], color=color, ls=style, label=label)
        closer = means["predicted"] / means["estimated"]
        share.set(xlabel="error from slot 4 on [m]", ylabel="share of slots below", xscale="log", ylim=(0.0, 1.0))
        share.xaxis.set_major_formatter("{x:g}")
        share.xaxis.set_minor_formatter("")
        share.set_title(f"estimates {closer:.1f} x closer than predictions")
        share.legend(fontsize=5.5, frameon=False, loc="upper center", bbox_to_anchor=(0.45, -0.22))
        for axes in (above, height, share):
            plain(axes)
    handles, names = grid[0][0].get_legend_handles_labels()
    drawn.legend(handles, names, loc="outside lower center", ncols=4, frameon=False, fontsize=6.5)
    return drawn


FIGURE = Figure("tracks", "flights followed in closed loop", "tracks, smooth and dynamic", runs, compute, draw, 16.0)


if __name__ == "__main__":
    main(FIGURE, __doc__)
