"""A craft that was not trained on: one procedural family is left out (not in the paper).

    python experiments/paper/left_out.py compute|draw [--preset laptop]

Networks that never saw a hexacopter are asked about hexacopters, and about the craft that they know, beside networks
that saw all, and beside the average of the known craft at the prediction. A search whose library lacks the hexacopter
says whether a known craft explains the echo: where none does, the networks that never saw one answer in its place.

Real craft by hand: `august evaluate august_runs/reproduce/PRESET/RUN 'target.airframes=[drone.stl,...]'`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np
from answered import Asked, row, slots_of, table, truth_of
from campaign import SEED, Campaign, Numbers, Run, run_of
from figure import INK, PAGE_IN, SEARCHED, Figure, legend_below, main, over_snr, plain, prefixed

from august_jax import streams
from august_jax.app.plotting import new_figure
from august_jax.config import Config, override, preset
from august_jax.data import Sample, Target, fresh_samples, observed_anew, prepare_targets
from august_jax.evaluation import calibration
from august_jax.evaluation.bound import Bound
from august_jax.inference import known_craft
from august_jax.progress import Progress, TimeLeft
from august_jax.schemes import Truth

FAMILY = "hexa"
SEARCHED_DB = (10.0, 20.0, 30.0)
LINES = {
    "without": ("AUGUST, trained without it", INK[0], "-"),
    "all": ("AUGUST, trained on all", INK[2], "-"),
    "search": ("search, library without it", SEARCHED, "-"),
}
"""Labels where the craft that was left out flies."""
TRAINED_ON = (0, (3, 1, 1, 1))


def runs(preset_name: str) -> list[tuple[Run, bool]]:
    """AUGUST for all craft but one, and for all, with our encoder."""
    every = run_of(preset_name, "august", "roi")
    kept = [name for name in preset(preset_name).target.airframes if name != FAMILY]
    return [
        (Run(f"{every.name}-without-{FAMILY}", (*every.assignments, f"target.airframes=[{','.join(kept)}]")), False),
        (every, False),
    ]


class World(NamedTuple):
    """What flies.

    Attributes:
        name: "left out" or "known".
        config: of the slots.
        targets, samples, truth: the craft, the slots, and what was true of them.
    """

    name: str
    config: Config
    targets: Sequence[Target]
    samples: Sample
    truth: Truth


def compute(campaign: Campaign) -> Numbers:
    """Rows of every line in both worlds at every SNR."""
    scale, progress = campaign.scale, campaign.progress
    without, every = (run for run, _ in runs(campaign.preset))
    config = campaign.config(without)
    known = prepare_targets(config, progress)
    left = override(config, (f"target.airframes=[{FAMILY}]",))
    library = known_craft(config, known, progress=progress) if scale.searched else None
    networks = {"without": campaign.networks(without), "all": campaign.networks(every)}
    asked = [
        *(Asked(line, "august", config, own) for line, own in networks.items()),
        *(Asked(name, name, config, known=known) for name in ("prediction", "mean_shape", "resampling")),
    ]
    search = Asked("search", "matched_field", config, networks["without"], library)
    rows, clock = [], TimeLeft(2 * len(scale.snr_db))
    for name, own, targets in (("left out", left, prepare_targets(left, progress)), ("known", config, known)):
        count = max(scale.count // 2, 2)
        samples = fresh_samples(own, np.arange(count), targets, seed=SEED, domain="evaluate")
        world = World(name, own, targets, samples, truth_of(samples, targets))
        bound = None
        for snr_db in scale.snr_db:
            found, bound = _at(world, snr_db, asked, search if snr_db in SEARCHED_DB and library else None,
                               max(scale.searched // 3, 1), bound, progress)  # fmt: skip
            rows += found
            progress(f"{name}, {snr_db:g} dB  {clock.after_one()}")
        jax.clear_caches()
    return table(rows)


@streams.pin
def _at(world: World, snr_db: float, asked: Sequence[Asked], search: Asked | None, searched: int, bound: Bound | None,
        progress: Progress):  # fmt: skip
    """Rows at one SNR, and the bound for the next one."""
    key = streams.key(SEED, "evaluate.observation")
    batch = observed_anew(key, world.samples, world.config, snr_db, statistics=True)
    slots = slots_of(batch, world.truth)
    bound = bound or Bound(world.samples, np.asarray(batch.predicted), world.targets, world.config)
    about = {"world": world.name, "snr_db": snr_db, **bound.at(snr_db)}
    size_m, told = world.config.target.half_wheelbase_m, prefixed(f"{world.name}, {snr_db:g} dB, ", progress)
    rows = [about | row(who, slots, size_m) for who in asked]
    if search is not None:
        # the bound is that of all slots: one line
        rows.append(about | row(search, slots.at(slice(0, searched)), size_m, told) | dict.fromkeys(bound.at(snr_db)))
    return rows, bound


def draw(numbers: Numbers):
    """Position, weighted and Chamfer distance, and how often a search says that a known craft explains the echo."""
    drawn = new_figure(PAGE_IN, 5.2)
    panels = drawn.subplots(2, 2)
    mine = {name: values[numbers["world"] == "left out"] for name, values in numbers.items()}
    others = {name: values[numbers["world"] == "known"] for name, values in numbers.items()}
    for axes, metric, error, bound, label in (
        (panels[0, 0], "mpe_m", "mpe_se_m", "bound_m", "mean position error [m]"),
        (panels[0, 1], "wd_db", "wd_se_db", None, "weighted distance [dB]"),
        (panels[1, 0], "mcd_db", "mcd_se_db", None, "mean Chamfer distance [dB]"),
    ):
        over_snr(axes, mine, metric, LINES, error=error, bound=bound, logarithmic=metric == "mpe_m")
        for line, (_, color, _) in LINES.items():
            at = (others["line"] == line) & np.isfinite(others[metric])
            axes.plot(others["snr_db"][at], others[metric][at], color=color, ls=TRAINED_ON, lw=0.8, marker=".", ms=2)
        axes.set_ylabel(label)
    panels[0, 0].plot([], [], color="0.4", ls=TRAINED_ON, lw=0.8, label="the same, craft trained on")
    axes = panels[1, 1]
    for number, part in enumerate((mine, others)):
        at = part["line"] == "search"
        if not at.any():
            continue
        shares = np.array([calibration.share(np.arange(count) < round(share * count))
                           for share, count in zip(part["explained"][at], part["count"][at])])  # fmt: skip
        bars = np.minimum(shares[:, 1], shares[:, 0]), np.minimum(shares[:, 1], 1.0 - shares[:, 0])
        style = {"ls": ("-", TRAINED_ON)[number], "marker": "os"[number], "ms": 4, "capsize": 2, "lw": 1.0}
        axes.errorbar(part["snr_db"][at], shares[:, 0], bars, color=SEARCHED, **style)
    axes.set(xlabel="SNR [dB]", ylabel="told to be a known craft", ylim=(-0.04, 1.04), xlim=panels[0, 0].get_xlim())
    plain(axes)
    legend_below(drawn, 3)
    return drawn


FIGURE = Figure("left_out", "a craft that was not trained on", "none: beyond it", runs, compute, draw, 11.0)


if __name__ == "__main__":
    main(FIGURE, __doc__)
