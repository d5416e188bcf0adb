"""Samples that never repeat: every step's batch is made on the device as training goes, of all craft at once.

Sample i of a step is one slot of a flight of its own, of the craft whose turn it is, of a material of its own: drawn
as :func:`august_jax.data.generate.generate` draws a data set's rows, from streams of its own by the step's number. Its
channel comes from the craft's table (:func:`august_jax.data.simulator.tabulate_targets`); where the base station works
in the region's subspace, its coefficients U^H H conj(U) do, and H is never formed. The echo is observed at once
(:mod:`august_jax.data.observe`). The scheme ``refchannel`` gets its channels at the reference place the same way
(:mod:`august_jax.data.reference`).

A batch is a function of the configuration and the step alone, so that a continued run sees what it would have seen.
Flights are flown step by step in time, which an accelerator does for 65,536 of them as quickly as for one: there those
of many batches are flown together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float, Int

from august_jax import streams
from august_jax.arrays import Array
from august_jax.config import Config
from august_jax.data.fields import Batch, Sample
from august_jax.data.generate import fresh_samples
from august_jax.data.observe import draw_level, draw_prediction
from august_jax.data.reference import TOGETHER, heard_by_table, reference_channels
from august_jax.data.simulator import Target, prepare_targets, tables_of
from august_jax.mesh import check_divides, data_mesh, joined, rows_here
from august_jax.physics import Table
from august_jax.progress import Progress, silent
from august_jax.scene.airframes import sample_triangles
from august_jax.scene.cloud import to_cloud
from august_jax.scene.trajectory import Flight, fly_many
from august_jax.signal.roi import Coefficients
from august_jax.signal.station import observe_for

_TOGETHER = 65_536
"""Flights that an accelerator flies at once; a processor flies those of one batch."""
_VALIDATED = 256
"""Samples that a streamed training is validated on."""


class StreamedBatches:
    """Step number -> batch for the networks; a function of the step and the configuration alone.

    Args:
        config: everything; of ``train`` the batch's size and the seed.
        targets: with tables, from :func:`~august_jax.data.simulator.prepare_targets` with ``data.solver=table``.
        mesh: of the training; of several hosts each makes the rows of its own devices. None takes all that JAX sees.

    Raises:
        ValueError: targets without tables, or tables that do not hold all that this configuration's craft may be; or
            hosts that cannot share the batch equally.
    """

    def __init__(self, config: Config, targets: Sequence[Target], mesh: Mesh | None = None):
        self._config, self._mesh = config, data_mesh() if mesh is None else mesh
        self._rows = 0, config.train.batch
        if jax.process_count() > 1:
            check_divides(config.train.batch, self._mesh)
            self._rows = rows_here(config.train.batch, self._mesh)
        self._tables = tables_of(config, targets)
        self._surfaces = tuple(jnp.asarray(np.stack(part)) for part in zip(*(target.surface for target in targets)))
        self._block = 1 if jax.default_backend() == "cpu" else max(1, _TOGETHER // config.train.batch)
        self._flown: tuple[int, Flight] | None = None

    @streams.pin  # whoever calls, from whatever thread
    def __call__(self, step: int) -> Batch:
        config, count = self._config, self._config.train.batch
        samples = streams.key(config.train.seed, "stream.sample", step)
        tracks = self._flights(step)
        turn = jnp.asarray(count * step % len(config.target.airframes), jnp.int32)
        made = _streamed(samples, tracks, turn, self._tables, *self._surfaces, config, self._rows)
        return joined(made, self._mesh)

    def _flights(self, step: int) -> Flight:
        """Those of a step's samples; of a whole block of steps where these are flown together."""
        block, place = divmod(step, self._block)
        kept = self._flown  # one read: another thread may put another block there
        if kept is None or kept[0] != block:
            steps = range(block * self._block, (block + 1) * self._block)
            kept = block, fly_batches(self._config, steps, self._rows)
            self._flown = kept
        return jax.tree.map(lambda leaf: leaf[place], kept[1])


@streams.pin
def fly_batches(config: Config, steps: Sequence[int], rows: tuple[int, int] | None = None) -> Flight:
    """The flights of the samples of several steps, (steps, train.batch, slots, ...); with ``rows`` of these alone, from
    the first to the one before the last."""
    low, high = rows or (0, config.train.batch)
    parents = jnp.stack([streams.key(config.train.seed, "stream.flight", step) for step in steps])
    keys = jax.vmap(lambda key: jax.random.split(key, config.train.batch)[low:high])(parents)
    flown = fly_many(keys.reshape(-1), config.flight)
    return jax.tree.map(lambda leaf: leaf.reshape(len(steps), high - low, *leaf.shape[1:]), flown)


@streams.pin
def open_stream(
    config: Config, progress: Progress = silent, *, mesh: Mesh | None = None
) -> tuple[StreamedBatches, Sample]:
    """The batches of a streamed training, and what it is validated on: a few hundred samples, each from its own flight.

    The samples for validation come from streams of their own, by ``data.solver``.

    Args:
        config: of the training.
        progress: told how far factoring and tabulating are, which take minutes for the first time.
        mesh: of the training; None takes all that JAX sees.
    """
    targets = prepare_targets(replace(config, data=replace(config.data, solver="table")), progress)
    progress(f"simulating {_VALIDATED} samples for validation ({config.data.solver})")
    asked = targets if config.data.solver == "table" else [replace(target, table=None) for target in targets]
    samples = fresh_samples(config, np.arange(_VALIDATED), asked, seed=config.train.seed, domain="validation")
    return StreamedBatches(config, targets, mesh), samples


@partial(jax.jit, static_argnames=("config", "rows"))
def _streamed(
    key: jax.Array,
    tracks: Flight,
    turn: Int[Array, ""],
    tables: Table,
    triangles: Float[Array, "craft triangles 3 3"],
    areas: Float[Array, "craft triangles"],
    config: Config,
    rows: tuple[int, int],
) -> Batch:
    low, high = rows
    craft = (turn + jnp.arange(low, high)) % len(triangles)
    in_subspace = config.model.encoder == "roi" and config.signal.estimator == "lmmse_roi"

    def drawn(key: jax.Array, track: Flight, craft: jax.Array):
        slot_key, material_key, points_key, predicted_key, level_key, echo_key = jax.random.split(key, 6)
        slot = jax.random.randint(slot_key, (), 0, config.flight.slots)
        position, rotation = track.positions[slot], track.rotations[slot]
        spans = jnp.asarray([config.target.permittivity, config.target.conductivity_s_m], jnp.float32)
        material = jax.random.uniform(material_key, (2,), minval=spans[:, 0], maxval=spans[:, 1])
        points = sample_triangles(points_key, triangles[craft], areas[craft], config.target.points) @ rotation.T
        predicted = draw_prediction(predicted_key, position, config)
        return points, position, rotation, material, predicted, draw_level(level_key, config), echo_key

    keys = jax.random.split(key, config.train.batch)[low:high]
    points, position, rotation, material, predicted, level, echo_keys = jax.vmap(drawn)(keys, tracks, craft)

    def channel(place):
        craft, rotation, position, material, predicted = place
        return heard_by_table(config, tables, craft, rotation, position, material, predicted if in_subspace else None)

    channels = jax.lax.map(channel, (craft, rotation, position, material, predicted), batch_size=TOGETHER)

    def seen(key: jax.Array, channel: jax.Array, predicted: jax.Array, level: dict[str, jax.Array]):
        whole = Coefficients(channel, predicted) if in_subspace else channel
        observed = observe_for(config, key, whole, predicted, **level)
        return observed.snr_estimate_db, observed.heard

    snr_db, heard = jax.vmap(seen)(echo_keys, channels, predicted, level)
    cloud = to_cloud(points, position, predicted, material[:, 0], material[:, 1], config.region)
    batch = Batch.of(predicted, snr_db, cloud, heard)
    if config.model.scheme != "refchannel":
        return batch
    reference = reference_channels(config, tables, craft, rotation, position, material, predicted)
    return batch._replace(reference_channel=reference)
