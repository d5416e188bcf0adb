"""Errors over range at fixed transmit power, from loud echoes to none: the soft boundary (the paper's future work).

    python experiments/paper/soft_boundary.py compute|draw [--preset laptop]

Where sensing ends is no line: an echo falls by 12 dB for each doubling of the range (by less near by, where craft are
far aside of the axis), and the error rises from what networks or physics allow to what is known without an echo.
One set of networks learns at this one power in a box from the preset's nearest depth to sixteen times as far. It is
asked about the same slots at one depth after another, beside a search, the error that its posterior expects, and the
bound, which knows of one explanation alone: a mark says up to which range the two are at most 1.5 times apart (of
1 - cos 2.25 times, august_jax.evaluation.threshold).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from answered import EXPECTED, Asked, row, slots_of, table, truth_of
from campaign import SEED, Campaign, Numbers, Run, run_of
from figure import INK, PAGE_IN, SEARCHED, Figure, legend_below, main, over_snr, prefixed
from matplotlib.ticker import NullLocator

from august_jax import streams
from august_jax.app.plotting import new_figure
from august_jax.config import Config, preset
from august_jax.data import Sample, Target, fresh_samples, observed_anew, pack, prepare_targets, simulated_channel
from august_jax.evaluation import threshold_db
from august_jax.evaluation.bound import Bound
from august_jax.evaluation.threshold import METRICS
from august_jax.inference import known_craft
from august_jax.progress import TimeLeft

DEEPER = 16.0
POWER_DBM = {"smoke": 2.0, "laptop": 0.0, "paper": 35.0}
"""By which the median echo of the nearest depth has some 24 dB, and that of the farthest about none."""
LINES = {"AUGUST": ("AUGUST", INK[0], "-"), "search": ("search by physics", SEARCHED, "-")}


def runs(preset_name: str) -> list[tuple[Run, bool]]:
    """AUGUST in the deep box, with our encoder."""
    base = run_of(preset_name, "august", "roi")
    (west, east), (near, far), (low, high) = preset(preset_name).flight.box_m
    power = POWER_DBM[preset_name]
    deep = (
        f"flight.box_m=[[{west:g},{east:g}],[{near:g},{max(far, DEEPER * near):g}],[{low:g},{high:g}]]",
        "signal.draw=power",
        f"signal.power_dbm=[{power:g},{power:g}]",
    )
    return [(Run(f"{base.name}-deep", (*base.assignments, *deep)), False)]


def compute(campaign: Campaign) -> Numbers:
    """Rows of every scheme at every depth."""
    scale, (run, _) = campaign.scale, runs(campaign.preset)[0]
    networks, config = campaign.networks(run), campaign.config(run)
    targets = prepare_targets(config, campaign.progress)
    samples = fresh_samples(config, np.arange(scale.count), targets, seed=SEED, domain="evaluate")
    library = known_craft(config, targets, progress=campaign.progress) if scale.searched else None
    near, far = config.flight.box_m[1]
    depths = np.geomspace(near, far, 7 if scale.count > 100 else 3)
    clock, rows = TimeLeft(len(depths)), []
    for depth in depths:
        rows += _at(float(depth), config, samples, targets, [
            Asked("AUGUST", "august", config, networks),
            *([Asked("search", "matched_field", config, library=library)] if library else []),
            *(Asked(name, name, config, known=targets) for name in ("prediction", "up", "mean_shape", "resampling")),
        ], max(scale.searched // 2, 1), campaign.progress)  # fmt: skip
        campaign.progress(f"depth {depth:.1f} m  {clock.after_one()}")
    jax.clear_caches()
    return table(rows)


@streams.pin
def _at(depth, config: Config, samples: Sample, targets: Sequence[Target], asked, searched: int, progress):
    """The slots again, all at one depth: their places across it, attitudes and materials stay."""
    place = np.array(samples.position)
    place[:, 1] = depth
    moved = samples._replace(position=place)
    moved = moved._replace(true_channel=_channels(config, targets, moved))
    key = streams.key(SEED, "evaluate.observation")
    batch = observed_anew(key, moved, config, statistics=True)
    slots = slots_of(batch, truth_of(moved, targets))
    range_m = np.linalg.norm(place, axis=-1)
    power = config.signal.power_dbm[0] + 60.0
    loud = replace(config, signal=replace(config.signal, power_dbm=(power, power)))
    snr_db = np.asarray(observed_anew(key, moved, loud).snr_db, float) - 60.0  # without the estimate's own error
    about = {"depth_m": depth, "range_m": float(np.median(range_m)), "snr_db": float(np.median(snr_db))}
    bounds = Bound(moved, np.asarray(batch.predicted), targets, config).each(snr_db)
    assert bounds is not None
    every = {name: float(np.mean(values)) for name, values in bounds.items()}
    rows: list[dict[str, Any]] = []
    for who in asked:
        mine = slots.at(slice(0, searched)) if who.scheme == "matched_field" else slots
        own = {f"own_{name}": float(np.mean(values[: mine.slots])) for name, values in bounds.items()}
        told = prefixed(f"depth {depth:.1f} m, ", progress)
        rows.append({**about, **every, **own, **row(who, mine, config.target.half_wheelbase_m, told)})
    return rows


def _channels(config: Config, targets: Sequence[Target], samples: Sample) -> np.ndarray:
    """True channels of the samples where they are now, packed."""
    found = None
    for kind, target in enumerate(targets):
        mine = np.flatnonzero(samples.airframe == kind)
        poses = (samples.rotation, samples.position, samples.permittivity, samples.conductivity)
        part = np.asarray(_heard(target.body, config, *(jnp.asarray(each[mine]) for each in poses)))
        found = np.empty((samples.rows, *part.shape[1:]), part.dtype) if found is None else found
        found[mine] = part
    assert found is not None
    return found


@partial(jax.jit, static_argnames="config")
def _heard(body, config: Config, *poses):
    return jax.lax.map(lambda pose: pack(simulated_channel(config, body, *pose)), poses, batch_size=64)


def boundary_m(numbers: Numbers, of: str) -> float | None:
    """The largest range up to which a posterior expects no more than what it is allowed over its bound [m]; None where
    that is so nowhere, or at all ranges."""
    at = numbers["line"] == "search"
    expected, bound, within = METRICS[of]
    if not at.any() or not np.all(np.isfinite([numbers[name][at] for name in EXPECTED])):
        return None
    found = threshold_db(-numbers["range_m"][at], numbers[expected][at], numbers[bound][at], within)
    return None if found is None or not np.isfinite(found) else -found


def draw(numbers: Numbers):
    """Position, attitude and the weighted distance over range."""
    drawn = new_figure(PAGE_IN, 3.3)
    panels = drawn.subplots(1, 3)
    for axes, metric, error, bound, of, label in (
        (panels[0], "mpe_m", "mpe_se_m", "bound_m", "position", "mean position error [m]"),
        (panels[1], "mde", "mde_se", "bound_mde", "normal", "mean direction error"),
        (panels[2], "wd_db", "wd_se_db", None, None, "weighted distance [dB]"),
    ):
        over_snr(axes, numbers, metric, LINES, error=error, bound=bound, over="range_m", logarithmic=of is not None)
        axes.set(xlabel="range [m]", ylabel=label, xscale="log")
        ranges = np.unique(numbers["range_m"])
        axes.set_xticks(ranges[::2], [f"{each:.0f}" for each in ranges[::2]])
        axes.xaxis.set_minor_locator(NullLocator())
        levels = [float(numbers["snr_db"][numbers["range_m"] == each][0]) for each in ranges[::2]]
        above = axes.secondary_xaxis("top")
        above.set_xticks(ranges[::2], [f"{level:.0f}" for level in levels], fontsize=7)
        above.xaxis.set_minor_locator(NullLocator())
        above.set_xlabel("SNR [dB]", fontsize=8)
        end = boundary_m(numbers, of) if of else None
        if end is not None:
            axes.axvline(end, color=INK[3], ls="-", lw=0.8, label="there the expected error leaves the bound")
    legend_below(drawn, 4)
    return drawn


FIGURE = Figure(
    "soft_boundary", "errors over range at fixed transmit power", "none: beyond it", runs, compute, draw, 11.0
)


if __name__ == "__main__":
    main(FIGURE, __doc__)
