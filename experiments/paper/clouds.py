"""Clouds side by side: what the figures share that show reconstructions beside the truth."""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from campaign import Campaign, Numbers, Run
from figure import PAGE_IN
from looked import look, scattered

from august_jax.app.plotting import new_figure
from august_jax.evaluation import metrics

ROWS = (1, 2)
"""Slots that are shown; their numbers were fixed before anything was looked at."""


def clouds_of(campaign: Campaign, runs: Sequence[Run], labels: Sequence[str], snrs_db: Sequence[float]) -> Numbers:
    """Clouds of ROWS by each of the runs at each SNR, and how far off they are.

    Returns:
        ``label`` (L,), ``points_m`` (L, B, M, 3), ``permittivity``, ``conductivity`` (L, B, M), ``off_m`` and
        ``chamfer_m2`` (L, B); ``truth_m`` (B, M, 3), ``true_permittivity`` and ``true_conductivity`` (B, M).
    """
    told, parts = [], []
    for run, label in zip(runs, labels, strict=True):
        for snr_db in snrs_db:
            seen = look(campaign, run, ROWS, snr_db)
            told.append(f"{label}, {snr_db:g} dB")
            parts.append(seen)
        jax.clear_caches()
    points = np.stack([part.clouds[0] for part in parts])
    truth = parts[0].truth
    chamfer = [
        [float(metrics.shape_distance(jnp.asarray(cloud), jnp.asarray(true))) for cloud, true in zip(each, truth[0])]
        for each in points
    ]
    return {
        "label": np.array(told),
        "points_m": points.astype(np.float32),
        "permittivity": np.stack([part.clouds[1] for part in parts]).astype(np.float32),
        "conductivity": np.stack([part.clouds[2] for part in parts]).astype(np.float32),
        "off_m": np.linalg.norm(points.mean(axis=2), axis=-1),
        "chamfer_m2": np.array(chamfer),
        "truth_m": truth[0].astype(np.float32),
        "true_permittivity": truth[1].astype(np.float32),
        "true_conductivity": truth[2].astype(np.float32),
    }


def clouds_drawn(numbers: Numbers, material: str):
    """A row a slot: the truth, then each cloud with its position error and Chamfer distance; coloured by a material."""
    slots, across = len(numbers["truth_m"]), len(numbers["label"]) + 1
    drawn = new_figure(PAGE_IN, 1.75 * slots + 0.2)
    reach = 1.4 * float(np.abs(numbers["truth_m"]).max())
    true, found = numbers[f"true_{material}"], numbers[material]
    limits = (float(min(true.min(), np.quantile(found, 0.02))), float(max(true.max(), np.quantile(found, 0.98))))
    for slot in range(slots):
        where = (slots, across, slot * across + 1)
        shown = scattered(drawn, where, numbers["truth_m"][slot], true[slot], limits, reach, "truth")
        for column, label in enumerate(numbers["label"]):
            cloud = numbers["points_m"][column, slot]
            inside = np.all(np.abs(cloud) <= reach, axis=1)
            off, apart = numbers["off_m"][column, slot], 10.0 * np.log10(numbers["chamfer_m2"][column, slot])
            scattered(drawn, (slots, across, slot * across + column + 2), cloud[inside], found[column, slot][inside],
                      limits, reach, f"{label}\n{100 * off:.0f} cm off\nChamfer {apart:.0f} dB")  # fmt: skip
    bar = drawn.colorbar(shown, ax=drawn.axes, shrink=0.5, pad=0.04)
    bar.set_label(material + (" [S/m]" if material == "conductivity" else ""), fontsize=7)
    bar.ax.tick_params(labelsize=6)
    return drawn
