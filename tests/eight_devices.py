"""What holds on a mesh of eight devices; run by tests/test_scale.py in a process that sees so many.

By hand: XLA_FLAGS=--xla_force_host_platform_device_count=8 python -m pytest -n 0 tests/eight_devices.py
"""

import json
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_training import CONFIG, next_batch

from august_jax import data
from august_jax.app import cli
from august_jax.config import override, preset
from august_jax.mesh import (
    ROWS,
    SPLIT,
    WHOLE,
    brought_home,
    check_divides,
    data_mesh,
    mean_over_devices,
    own_accelerators,
    own_rows,
    placed,
    spread,
)
from august_jax.training import compiled_step, initial_state, train

pytestmark = pytest.mark.filterwarnings("ignore:cells.volumes")
RUN = replace(CONFIG, train=replace(CONFIG.train, steps=12, batch=16, save_every=6))


def batch_of(step):
    return next_batch(step, RUN.train.batch)


def test_a_mesh_is_a_row_of_devices():
    assert data_mesh().size == 8 and data_mesh().axis_names == (ROWS,)
    assert list(data_mesh(3).devices.flat) == jax.devices()[:3]
    with pytest.raises(ValueError, match=r"devices: 9, but JAX sees 8 here \(of a CPU, XLA_FLAGS=.*; give 1 to 8"):
        data_mesh(9)


@pytest.mark.parametrize(
    "batch, advice",
    [(12, "train.batch=8 or train.batch=16, or take devices=6"), (7, "train.batch=8, or take devices=7")],
)
def test_a_batch_that_cannot_be_shared_is_answered_with_the_nearest_that_can(batch, advice):
    with pytest.raises(
        ValueError, match=f"train.batch: {batch} samples cannot be shared equally by 8 devices; set {advice}$"
    ):
        check_divides(batch, data_mesh())
    check_divides(16, data_mesh())


@pytest.mark.parametrize("implementation", ["threefry2x32", "rbg"])
def test_what_is_drawn_for_a_batch_is_the_same_on_any_number_of_devices(implementation):
    key = jax.random.key(3, impl=implementation)

    def drawn(key, rows):
        return own_rows(lambda count: jax.random.normal(key, (count, 5)), len(rows))

    rows = jnp.zeros(24)
    alone = jax.jit(drawn)(key, rows)
    for devices in (2, 8):
        mesh = data_mesh(devices)
        found = jax.jit(spread(drawn, mesh, (WHOLE, SPLIT), SPLIT))(placed(key, mesh, WHOLE), placed(rows, mesh, SPLIT))
        np.testing.assert_array_equal(found, alone)


def test_means_over_devices_are_means_over_rows():
    mesh, values = data_mesh(), np.arange(16.0, dtype=np.float32)
    mean = spread(lambda rows: mean_over_devices({"mean": rows.mean()}), mesh, SPLIT, WHOLE)
    found = jax.jit(mean)(placed(values, mesh, SPLIT))
    assert float(brought_home(found)["mean"]) == values.mean()


@pytest.mark.parametrize("frame", [pytest.param("craft", marks=pytest.mark.slow), "region"])
def test_steps_on_eight_devices_are_steps_on_one(frame):
    config = replace(RUN, model=replace(RUN.model, frame=frame))
    mesh, losses, terms = data_mesh(), [], []
    for split in (False, True):
        layout, state = initial_state(config)
        state, each = placed(state, mesh, WHOLE) if split else state, []
        for step in range(config.train.steps):
            batch = placed(batch_of(step), mesh, SPLIT) if split else batch_of(step)
            state, numbers = compiled_step(layout.loss, config.train, state, batch, mesh=mesh if split else None)
            each.append({name: float(value) for name, value in numbers.items()})
        losses.append([numbers["loss"] for numbers in each])
        terms.append(each[2])
    # rounding alone, 1e-6 where it was measured: a wrong draw, or a sum in the place of a mean, is off by a tenth
    assert losses[1] == pytest.approx(losses[0], rel=1e-5)
    assert terms[1] == pytest.approx(terms[0], rel=1e-4)


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A run on one device, and what it logged."""
    folder = tmp_path_factory.mktemp("alone")
    return train(RUN, batch_of, folder, mesh=data_mesh(1)), logged(folder)


def logged(folder):
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return {line["step"]: line["loss"] for line in lines}


@pytest.mark.parametrize("first, then", [(8, 1), (1, 8), pytest.param(8, 2, marks=pytest.mark.slow)])
def test_a_checkpoint_goes_on_on_any_number_of_devices(alone, tmp_path, first, then):
    def interrupted(step):
        if step == 8:
            raise ConnectionError("power cut")
        return batch_of(step)

    with pytest.raises(ConnectionError):
        train(RUN, interrupted, tmp_path, mesh=data_mesh(first))
    said = []
    state = train(RUN, batch_of, tmp_path, mesh=data_mesh(then), progress=said.append)
    assert said[0] == "continuing from step 6 of 12"
    assert any("devices share each batch" in line for line in said) == (then > 1)
    whole, losses = alone
    assert logged(tmp_path) == pytest.approx(losses, rel=1e-5)
    # a weight moves by 1e-3 at most in a step; where its gradient is all rounding, Adam may turn it either way
    np.testing.assert_allclose(np.median(np.abs(np.asarray(state.params) - np.asarray(whole.params))), 0.0, atol=1e-6)


def test_a_run_takes_all_devices_and_refuses_what_they_cannot_share(tmp_path):
    odd = replace(RUN, train=replace(RUN.train, batch=12))
    with pytest.raises(ValueError, match="12 samples cannot be shared equally by 8 devices"):
        train(odd, batch_of, tmp_path / "run")
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("solver", ["mom", pytest.param("born", marks=pytest.mark.slow)])
def test_rows_made_on_eight_devices_are_those_made_on_one(solver):
    config = override(preset("smoke"), [f"data.solver={solver}", "target.points=20"])
    targets = data.prepare_targets(config)
    alone, shared = (
        data.generate(config, np.arange(150), targets, mesh=data_mesh(devices)).columns() for devices in (1, 8)
    )
    for name, value in alone.items():
        assert shared[name].dtype == value.dtype and shared[name].shape == value.shape
        # each device runs the program of one: no difference was seen
        np.testing.assert_allclose(shared[name], value, rtol=1e-5, atol=1e-6 * np.abs(value).max(), err_msg=name)


def test_what_shares_nothing_takes_one_device_of_a_processor(capsys, tmp_path):
    assert own_accelerators().size == 1
    assert cli.main(["simulate", "--preset", "smoke", "--devices", "2", "--out", str(tmp_path / "data")]) == 2
    assert "--devices: 2 devices of one processor share its cores; make parts side by side, --shard I/N" in (
        capsys.readouterr().err
    )
    assert not (tmp_path / "data").exists()
