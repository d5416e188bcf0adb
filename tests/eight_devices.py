"""What holds on a mesh of eight devices; run by tests/test_scale.py in a process that sees so many.

By hand: XLA_FLAGS=--xla_force_host_platform_device_count=8 python -m pytest -n 0 tests/eight_devices.py
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_training import CONFIG, next_batch

from august_jax.mesh import (
    ROWS,
    SPLIT,
    WHOLE,
    brought_home,
    check_divides,
    data_mesh,
    mean_over_devices,
    own_rows,
    placed,
    spread,
)
from august_jax.training import compiled_step, initial_state

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


@pytest.mark.parametrize("frame", ["craft", "region"])
def test_a_step_on_eight_devices_is_the_step_on_one(frame):
    config = replace(RUN, model=replace(RUN.model, frame=frame))
    mesh, told = data_mesh(), []
    for split in (False, True):
        layout, state = initial_state(config)
        state = placed(state, mesh, WHOLE) if split else state
        for step in range(3):
            batch = placed(batch_of(step), mesh, SPLIT) if split else batch_of(step)
            state, numbers = compiled_step(layout.loss, config.train, state, batch, mesh=mesh if split else None)
        told.append({name: float(value) for name, value in numbers.items()})
    # rounding alone: a wrong draw, or a sum in the place of a mean, is off by a tenth at least
    assert told[1] == pytest.approx(told[0], rel=1e-5)
