"""The compared networks: each trains by one override with either encoder, and several share an evaluation."""

from functools import cache

import numpy as np
import pytest

from august_jax import data
from august_jax.config import ConfigError, override, preset
from august_jax.evaluation import evaluate
from august_jax.models import Networks, create
from august_jax.schemes import lines_of
from august_jax.training import compiled_step, initial_state, load_weights, save_weights
from august_jax.training.checkpoint import flatten

SMOKE = override(
    preset("smoke"),
    ["train.source=stream", "train.batch=8", "train.points=8", "model.denoiser=[8,8]", "model.flow_layers=1"],
)
pytestmark = pytest.mark.filterwarnings("ignore:cells.volumes")


@cache
def batch_for(encoder):
    """A streamed batch with all that any of the schemes learns from."""
    config = override(SMOKE, ["model.scheme=refchannel", f"model.encoder={encoder}"])
    return data.StreamedBatches(config, data.prepare_targets(override(config, ["data.solver=table"])))(0)


@pytest.mark.parametrize(
    "scheme, encoder",
    [
        pytest.param(scheme, encoder, marks=() if (scheme, encoder) == ("refchannel", "roi") else pytest.mark.slow)
        for scheme in ("august", "noebd", "nolatent", "refchannel")
        for encoder in ("paper", "roi")
    ],
)
def test_each_trains_by_one_override(scheme, encoder, tmp_path):
    config = override(SMOKE, [f"model.scheme={scheme}", f"model.encoder={encoder}"])
    batch = batch_for(encoder)
    if scheme != "refchannel":
        batch = batch._replace(reference_channel=None)
    layout, state = initial_state(config)
    before = flatten(layout.arrays(np.array(state.params)))
    for _ in range(3):
        state, numbers = compiled_step(layout.loss, config.train, state, batch)
        assert all(np.isfinite(value) for value in numbers.values())
    assert ("reference" in numbers) == (scheme == "refchannel")
    assert ("latent" in numbers) == (scheme in ("august", "noebd"))
    after = layout.arrays(np.array(state.params))
    still = [name for name, leaf in flatten(after).items() if np.array_equal(leaf, before[name])]
    assert not still
    save_weights(tmp_path / "weights.npz", after)
    _, loaded = load_weights(tmp_path / "weights.npz", config)
    for name, leaf in flatten(loaded).items():
        np.testing.assert_array_equal(leaf, flatten(after)[name])
    other = override(config, ["model.scheme=nolatent" if scheme == "august" else "model.scheme=august"])
    with pytest.raises(ValueError, match="weights.npz: .*; (the file belongs to another|use the configuration)"):
        load_weights(tmp_path / "weights.npz", other)


TINY = override(
    preset("smoke"),
    [
        "evaluate.count=4",
        "evaluate.snr_db=[20]",
        "data.solver=born",
        "target.airframes=[quad_x]",
        "model.denoiser=[8,8]",
        "model.flow_layers=1",
    ],
)


def untrained(name, *assignments):
    config = override(TINY, assignments)
    return Networks(name, config, *create(config, 0))


def test_networks_beside_each_other_answer_as_each_does_alone():
    """The same samples, echoes, predictions and draws, whatever the encoder."""
    first, second = untrained("a"), untrained("b", "model.scheme=noebd", "model.encoder=paper")
    # of a point's angles alone: one tone before eight antennas leaves its range to rounding
    asked = {"seed": 3, "schemes": ["polar_angles", "august"]}
    rows = evaluate(lines_of([first, second]), TINY, **asked)
    assert [(row["scheme"], row["label"]) for row in rows] == [
        ("august_roi", "AUGUST, encoder roi"),
        ("noebd_paper", "AUGUST-NoEBD, encoder paper"),
        ("polar_angles", "a point's angles, at the predicted range"),
    ]
    for row, networks in zip(rows, (first, second)):
        alone, polar = evaluate(networks, networks.config, **asked)
        assert (alone["scheme"], alone["label"]) == ("august", "the networks")
        assert row["mpe_m"] > 0.0 and {name for name in row if row[name] is None} == {
            name for name in alone if alone[name] is None
        }
        for name, value in alone.items():
            if isinstance(value, (int, float)):
                assert row[name] == pytest.approx(value, rel=1e-5), name
        # what the filter hears is the first one's, in whichever form
        assert polar["mpe_m"] == pytest.approx(rows[-1]["mpe_m"], rel=1e-3)


def test_lines_are_named_by_scheme_and_encoder():
    networks = [
        untrained("a"),
        untrained("b", "model.encoder=paper"),
        untrained("c"),
        untrained("d", "model.scheme=refchannel"),
        untrained("e"),
    ]
    lines = lines_of(networks)
    assert list(lines) == ["august_roi", "august_paper", "august_roi_2", "refchannel_roi", "august_roi_3"]
    assert [each.name for each in lines.values()] == list("abcde")


def wider():
    return untrained("wide", "array.nx=6")


@pytest.mark.parametrize(
    "networks, options, error, message",
    [
        (dict, {}, ValueError, "networks: got none; give networks, or several by name"),
        (lambda: {"up": untrained("a")}, {}, ValueError, "networks: 'up' is the name of a scheme"),
        (wider, {}, ConfigError, "array.nx: 4, but the weights were trained with 6"),
        (
            lambda: {"near": untrained("a"), "far": wider()},
            {},
            ConfigError,
            "networks: 'far' .wide. cannot stand beside the others\narray.nx: 4, but the weights were trained with 6",
        ),
        (
            lambda: untrained("a"),
            {"schemes": ["august", "polr"]},
            ValueError,
            "schemes: unknown scheme 'polr'; did you mean 'polar'. choose of august, matched_field, polar, ",
        ),
    ],
)
def test_what_cannot_be_compared_is_named(networks, options, error, message):
    with pytest.raises(error, match=message):
        evaluate(networks(), TINY, seed=0, **options)
