"""Accuracy over transmit power: what the figures of the craft's size and material share.

A larger craft, or one of a stronger material, sends back more at the same power, which an SNR that is set to a value
would hide. The powers are those at which the median echo of the preset's own craft has the SNRs of an evaluation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import jax
import numpy as np
from answered import Asked, row, slots_of, truth_of
from campaign import SEED, Campaign, Numbers, Run
from figure import INK, MARKS, PAGE_IN, legend_below, plain

from august_jax import streams
from august_jax.app.plotting import new_figure
from august_jax.config import Config, override
from august_jax.data import Sample, fresh_samples, observed_anew, prepare_targets
from august_jax.evaluation.bound import Bound
from august_jax.progress import TimeLeft

_LOUD_DBM = 60.0
SCORED = ("wd_db", "wd_se_db", "mcd_db", "mpe_m", "mpe_se_m")
"""Of :func:`august_jax.evaluation.score`."""


class Case(NamedTuple):
    """Craft that fly, and networks that were trained for them.

    Attributes:
        label: of the line.
        run: whose networks are asked.
        flown: what differs from the run in what flies.
    """

    label: str
    run: Run
    flown: tuple[str, ...] = ()


def over_power(campaign: Campaign, cases: Sequence[Case], count: int) -> Numbers:
    """Errors of each case at each power, on ``count`` slots that all cases share but for the craft.

    Returns:
        ``label`` (L,); ``power_dbm`` (P,); (L, P) each: ``snr_db`` (median), ``wd_db`` with ``wd_se_db``, ``mcd_db``,
        ``mpe_m`` with ``mpe_se_m`` and its ``bound_m``, not a number where none is known; (L,) each: ``prediction_m``
        and ``floor_db``, answering the prediction, and the WD of the true surface drawn anew.
    """
    powers = np.zeros(0)
    found: list[list[list[float]]] = []
    deaf: list[tuple[float, float]] = []
    clock = TimeLeft(len(cases))
    for case in cases:
        networks = campaign.networks(case.run)
        config = override(campaign.config(case.run), case.flown)
        targets = prepare_targets(config)
        samples = fresh_samples(config, np.arange(count), targets, seed=SEED, domain="evaluate")
        if not len(powers):
            unit = float(np.median(_echoes(samples, config, 0.0).snr_db))
            powers = np.asarray(campaign.scale.snr_db) - unit
        found.append([])
        truth, size_m = truth_of(samples, targets), config.target.half_wheelbase_m
        asked = Asked(case.label, "august", config, networks)
        loud = _echoes(samples, config, _LOUD_DBM)  # so that no estimate's error is in its SNR
        bound = Bound(samples, np.asarray(loud.predicted), targets, config)
        for power in powers:
            least = bound.each(np.asarray(loud.snr_db, float) - _LOUD_DBM + power)
            batch = _echoes(samples, config, float(power))
            slots = slots_of(batch, truth)
            scored = row(asked, slots, size_m)
            found[-1].append(
                [
                    float(np.median(batch.snr_db)),
                    *(scored[name] or 0.0 for name in SCORED),
                    np.nan if least is None else float(np.mean(least["bound_m"])),
                ]
            )
        prediction, floor = (row(Asked(name, name, config), slots, size_m) for name in ("prediction", "resampling"))
        deaf.append((prediction["mpe_m"], floor["wd_db"]))
        campaign.progress(f"{case.label}: {count} slots at {len(powers)} powers  {clock.after_one()}")
        jax.clear_caches()
    names = ("snr_db", *SCORED, "bound_m")
    values = np.array(found)
    return {
        "label": np.array([case.label for case in cases]),
        "power_dbm": powers,
        **{name: values[..., column] for column, name in enumerate(names)},
        "prediction_m": np.array([each[0] for each in deaf]),
        "floor_db": np.array([each[1] for each in deaf]),
    }


@streams.pin
def _echoes(samples: Sample, config: Config, power_dbm: float):
    """Echoes at a transmit power [dBm]; predictions and noise are drawn alike at all."""
    signal = replace(config.signal, draw="power", power_dbm=(power_dbm, power_dbm))
    return observed_anew(streams.key(SEED, "evaluate.observation"), samples, replace(config, signal=signal))


def drawn_over_power(numbers: Numbers):
    """The weighted distance and the position error, a line a case."""
    drawn = new_figure(PAGE_IN, 3.1)
    first, second = drawn.subplots(1, 2)
    power = numbers["power_dbm"]
    for at, label in enumerate(numbers["label"]):
        style = {"color": INK[at % len(INK)], "marker": MARKS[at % len(MARKS)], "ms": 3, "lw": 1.1, "capsize": 1.5}
        first.errorbar(power, numbers["wd_db"][at], numbers["wd_se_db"][at], label=str(label), **style)
        second.errorbar(power, numbers["mpe_m"][at], numbers["mpe_se_m"][at], **style)
        first.axhline(numbers["floor_db"][at], color=style["color"], ls=":", lw=0.8)
        second.plot(power, numbers["bound_m"][at], color=style["color"], ls="-.", lw=0.8)
    first.plot([], [], color="#999999", ls=":", lw=0.8, label="the true surface anew: the floor")
    second.plot([], [], color="#555555", ls="-.", lw=0.8, label="bound, craft known")
    second.axhline(numbers["prediction_m"][0], color="#555555", ls="--", lw=1.0, label="answering the prediction")
    first.set_ylabel("weighted distance [dB]")
    second.set(ylabel="mean position error [m]", ylim=(0.0, None))
    for axes in (first, second):
        axes.set_xlabel("transmit power [dBm]")
        plain(axes)
    legend_below(drawn, 4)
    return drawn
