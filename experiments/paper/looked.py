"""Clouds of a few slots for the figures that show them: true ones, and what networks make of the echo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from campaign import SEED, Campaign, Run
from figure import plain

from august_jax import streams
from august_jax.config import Config
from august_jax.data import Sample, fresh_samples, observed_anew, prepare_targets
from august_jax.scene.cloud import from_cloud


class Looked(NamedTuple):
    """Slots that were looked at.

    Attributes:
        truth: true surface points about the true position (B, M, 3) [m], and their materials (B, M), [1] and [S/m].
        clouds: reconstructed points (..., B, M, 3), likewise about the true position, and their materials (..., B, M).
    """

    truth: tuple[np.ndarray, np.ndarray, np.ndarray]
    clouds: tuple[np.ndarray, np.ndarray, np.ndarray]


def fresh(config: Config, rows: Sequence[int]) -> Sample:
    """Slots that no training has seen; the same for the same seed."""
    return fresh_samples(config, np.asarray(rows), prepare_targets(config), seed=SEED, domain="evaluate")


@streams.pin
def look(campaign: Campaign, run: Run, rows: Sequence[int], snr_db: float, instants: tuple[int, ...] = ()) -> Looked:
    """What a run's networks make of slots.

    Args:
        campaign: that has the networks.
        run: whose they are.
        rows: numbers of the slots.
        snr_db: of the echoes [dB].
        instants: steps of the reverse diffusion at which the clouds are taken; none takes the end alone, by the
            configuration's sampler.
    """
    networks, config = campaign.networks(run), campaign.config(run)
    samples = fresh(config, rows)
    batch = observed_anew(streams.key(SEED, "evaluate.observation"), samples, config, snr_db)
    key = streams.key(SEED, "evaluate.answer")
    if instants:
        from flax import nnx

        model = nnx.merge(networks.graphdef, networks.state)
        cloud = model.reconstruct(
            key, batch.heard, batch.predicted, batch.snr_db, config.target.points, sampler="ancestral",
            instants=instants,
        )  # fmt: skip
    else:
        cloud = networks.reconstruct(key, batch.heard, batch.predicted, batch.snr_db, config)
    predicted = jnp.broadcast_to(jnp.asarray(batch.predicted), (*cloud.shape[:-2], 3))  # that of all instants
    world = from_cloud(cloud, predicted, config.region)
    place = np.asarray(samples.position)[:, None]
    count = samples.points.shape[1]
    truth = (
        np.asarray(samples.points),
        np.repeat(np.asarray(samples.permittivity)[:, None], count, axis=1),
        np.repeat(np.asarray(samples.conductivity)[:, None], count, axis=1),
    )
    return Looked(truth, (np.asarray(world.points) - place, *(np.asarray(part) for part in world[1:])))


def scattered(figure, where, points, values, limits, reach_m: float, title: str, cmap: str = "viridis"):
    """One cloud in a box about the true position, coloured by a material; the drawn points.

    Args:
        figure, where: axes are added at ``where`` = (rows, columns, index).
        points: (M, 3) [m].
        values: (M,), by which points are coloured.
        limits: of the colours.
        reach_m: half the box's edge [m].
        title: of the axes.
        cmap: colours.
    """
    axes = figure.add_subplot(*where, projection="3d")
    colours = {"c": values, "vmin": limits[0], "vmax": limits[1], "cmap": cmap}
    # as pixels: a thousand points as shapes would make megabytes of a PDF
    shown = axes.scatter(*points.T, **colours, s=max(0.6, 300.0 / len(points)), lw=0, rasterized=True)
    axes.set(xlim=(-reach_m, reach_m), ylim=(-reach_m, reach_m), zlim=(-reach_m, reach_m), box_aspect=(1, 1, 1))
    plain(axes)
    axes.tick_params(labelsize=5, pad=-3)
    tick = max(np.floor(10.0 * reach_m / 1.5) / 10.0, 0.1)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_ticks([-tick, 0.0, tick])
    for name in "xyz":
        getattr(axes, f"set_{name}label")(f"{name} [m]", fontsize=5, labelpad=-10)
    axes.set_title(title, fontsize=7)
    return shown
