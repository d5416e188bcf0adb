"""Channels at the reference place: those that the same body has there, for the prediction at hand, wherever from."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from august_jax import data
from august_jax.config import ConfigError, check_data, override, preset
from august_jax.data import stream
from august_jax.models.refchannel import RefChannel
from august_jax.physics import PlanarArray, body_channel
from august_jax.scene.cloud import position_estimate
from august_jax.signal import Coefficients, Subspace, project

CONFIG = override(
    preset("smoke"),
    ["model.scheme=refchannel", "data.count=24", "flight.slots=3", "train.batch=24", "data.shard_rows=24"],
)
PLACE = np.array([5.0, 6.0, 3.5])
"""The middle of the box."""
pytestmark = pytest.mark.filterwarnings("ignore:cells.volumes")


@pytest.fixture(scope="module")
def targets():
    return data.prepare_targets(override(CONFIG, ["data.solver=table"]))


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    data.simulate(CONFIG, folder)
    return data.Dataset(folder)


def check(found, config, targets, craft, rotation, position, material, predicted):
    """Against the factored body, slot by slot; a table errs by 2e-3 (median) and 1.3e-2 (95 %)."""
    array, subspace = PlanarArray.from_config(config.array), Subspace.from_config(config.array)
    places, errors = jnp.asarray(PLACE + (position - predicted), jnp.float32), []
    for kind, target in enumerate(targets):
        mine = np.flatnonzero(np.asarray(craft) == kind)
        chi = jax.vmap(lambda each: data.contrast_of(config, each[0], each[1])[0])(jnp.asarray(material)[mine])
        poses = jnp.asarray(rotation)[mine], places[mine], chi
        true = jax.jit(jax.vmap(partial(body_channel, target.body, array)))(*poses)[:, None]
        value = jax.tree.map(lambda leaf, rows=mine: leaf[rows], found)
        if config.model.encoder == "roi":
            np.testing.assert_allclose(value.centre, np.tile(PLACE, (len(mine), 1)))
            value = value.values
            true = jax.vmap(lambda h: project(h, jnp.asarray(PLACE, jnp.float32), subspace).values)(true)
        errors.extend(
            np.linalg.norm((value - true).reshape(len(mine), -1), axis=1)
            / np.linalg.norm(true.reshape(len(mine), -1), axis=1)
        )
    assert np.median(errors) < 8e-3 and np.max(errors) < 0.08, errors


@pytest.mark.parametrize("encoder", ["roi", "paper"])
def test_a_streamed_sample_s_is_its_own_body_s(targets, encoder, monkeypatch):
    config = override(CONFIG, ["train.source=stream", f"model.encoder={encoder}", "train.batch=12"])
    told = []

    def watched(config, tables, *slots):
        jax.debug.callback(lambda *each: told.append([np.asarray(part) for part in each]), *slots)
        return data.reference.reference_channels(config, tables, *slots)

    monkeypatch.setattr(stream, "reference_channels", watched)
    batch = jax.block_until_ready(data.StreamedBatches(config, targets)(0))
    jax.effects_barrier()
    (slots,) = told
    check(batch.reference_channel, config, targets, *slots)
    np.testing.assert_array_equal(slots[-1], batch.predicted)
    # a label of 64 points has its mean within 7 cm of the centroid
    np.testing.assert_allclose(position_estimate(batch.cloud, batch.predicted, config.region), slots[2], atol=0.07)


@pytest.mark.parametrize("encoder, solver", [("roi", "mom"), ("paper", "table")])
def test_a_stored_sample_s_follows_the_prediction_of_the_step(stored, targets, encoder, solver, monkeypatch):
    """The solver of the stored channels makes no difference: these are made by table."""
    config = override(CONFIG, [f"model.encoder={encoder}", f"data.solver={solver}"])
    batches = data.TrainingBatches(stored, config, targets)
    rows = stored.read(np.sort(stored.rows("train")))
    assert rows.rows == config.train.batch  # all of them, in their order
    material = np.stack([rows.permittivity, rows.conductivity], axis=-1)
    first, second = batches(0), batches(1)
    for batch in (first, second):
        found = batch.reference_channel
        assert isinstance(found, Coefficients) == isinstance(batch.heard, Coefficients)
        check(found, config, targets, rows.airframe, rows.rotation, rows.position, material, batch.predicted)
    one, two = (jax.tree.leaves(batch.reference_channel)[0] for batch in (first, second))
    assert np.abs(one - two).max() > 0.1 * np.abs(one).max()  # other predictions, other offsets
    others = data.TrainingBatches(stored, override(config, ["model.scheme=august"]))(0)
    assert others.reference_channel is None


def test_the_reference_channel_has_no_phase_of_its_own():
    """A range that repeats every half wavelength tells nothing; what one tone's turns more than another's tells it."""
    config = override(CONFIG, ["array.nx=8", "array.tones_hz=[3e9,3.05e9]"])
    model = RefChannel(config, rngs=nnx.Rngs(0))
    array, subspace = PlanarArray.from_config(config.array), Subspace.from_config(config.array)

    def heard(place, centre):
        far = np.linalg.norm(place - array.positions, axis=1)
        waves = np.exp(1j * subspace.wavenumbers[:, None] * far)
        channel = (waves[:, :, None] * waves[:, None, :]).astype(np.complex64)
        return jax.tree.map(lambda leaf: leaf[None], project(channel, jnp.asarray(centre, jnp.float32), subspace))

    def vector(coefficients, factor=1.0):
        told = Coefficients(factor * coefficients.values, coefficients.centre)
        return model.vector(told, coefficients.centre)[0]

    sight = PLACE / np.linalg.norm(PLACE)
    here = heard(PLACE + 0.2 * sight, PLACE)
    np.testing.assert_allclose(vector(here), vector(here, 5.0 * np.exp(2j)), atol=1e-6)
    # A_00 of the second tone keeps the phase 2 (k_2 - k_1) 0.2 m by which the point is farther than the centre
    values = vector(here).reshape(2, 2, -1)[:, :, 0]
    turn = 2.0 * (subspace.wavenumbers[1] - subspace.wavenumbers[0]) * 0.2
    np.testing.assert_allclose(np.arctan2(values[1], values[0]), [0.0, turn], atol=2e-3)
    # at the same offset elsewhere, along the line of sight, it is the same but for the aperture's bend
    there = heard(0.8 * PLACE + 0.2 * sight, 0.8 * PLACE)
    np.testing.assert_allclose(vector(there).reshape(2, 2, -1)[:, :, 0], values, atol=2e-3)


def test_what_makes_no_reference_channels_is_refused(stored, targets):
    with pytest.raises(ValueError, match="targets: they have no tables; prepare them with data.solver=table"):
        data.TrainingBatches(stored, CONFIG)
    with pytest.raises(ValueError, match="targets: they have no tables"):
        data.TrainingBatches(stored, CONFIG, [replace(target, table=None) for target in targets])
    with pytest.raises(ValueError, match=r"targets: got 1 for the 2 of target.airframes"):
        data.TrainingBatches(stored, CONFIG, targets[:1])
    born = override(CONFIG, ["data.solver=born"])
    with pytest.raises(ConfigError, match="data.solver: born, but model.scheme=refchannel learns from channels"):
        check_data(born, born)
