"""Tables of a configuration: they hold all that its craft may be, and give mom's channels within their error."""

import json
from dataclasses import replace
from itertools import product

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax import config as configuration
from august_jax import data
from august_jax.config import override, preset
from august_jax.evaluation import Bound
from august_jax.physics import PlanarArray, factor_bodies, factor_body, stack_tables, table_channel
from august_jax.scene import resolve_airframe
from august_jax.scene.pose import rotation_from_axis_yaw

CONFIG = preset("smoke")
pytestmark = pytest.mark.filterwarnings("ignore:cells.volumes")


@pytest.fixture(scope="module")
def tables():
    target = CONFIG.target
    crafts = [resolve_airframe(name, target.half_wheelbase_m) for name in target.airframes]
    lattices = [cells for cells, _ in data.lattices_of(crafts, target)]
    nearest = data.nearest_distance(CONFIG)
    return data.tabulate_targets(CONFIG, factor_bodies(lattices, CONFIG.array.frequency_hz, nearest_m=nearest))


def test_tables_hold_every_place_tilt_and_material_of_a_configuration_and_a_margin(tables):
    """A concrete request outside a table's range is refused: none of these is."""
    array = PlanarArray.from_config(CONFIG.array)
    beyond = CONFIG.region.threshold_m + 0.2
    tilt = np.radians(CONFIG.flight.tilt_deg + 2.5)
    for place in product(*((low - beyond, high + beyond) for low, high in CONFIG.flight.box_m)):
        place = np.asarray(place) * max(1.0, 4.7 / np.linalg.norm(place))  # but for the corner nearest to the array
        for yaw, lean in product((0.0, 2.0), (tilt, -tilt)):
            aside = np.arctan2(place[1], place[0])  # towards the array and away from it
            axis = np.array([np.sin(lean) * np.cos(aside), np.sin(lean) * np.sin(aside), np.cos(lean)])
            turn = rotation_from_axis_yaw(jnp.asarray(axis, jnp.float32), jnp.float32(yaw))
            for permittivity, conductivity in product((1.4, 5.1), (0.0, 1.04e-2)):
                chi = data.contrast_of(CONFIG, permittivity, conductivity)[0]
                table_channel(tables[0], array, turn, jnp.asarray(place, jnp.float32), chi)


def test_tables_of_a_configuration_stack(tables):
    assert stack_tables(tables).directions.shape[0] == len(CONFIG.target.airframes)


def test_a_body_that_was_factored_for_greater_distances_is_refused():
    target = CONFIG.target
    cells, _ = data.lattice_of(resolve_airframe("quad_x", target.half_wheelbase_m), target)
    body = factor_body(cells, CONFIG.array.frequency_hz, nearest_m=5.0)
    with pytest.raises(ValueError, match=r"bodies: body 0 was factored for 5 m .* nearest_m=nearest_distance"):
        data.tabulate_targets(CONFIG, [body])


def test_a_box_too_near_for_a_table_is_told_by_its_field(tables):
    near = override(CONFIG, ["array.nx=120", "flight.box_m=[[-1,1],[4.1,6],[-1,1]]"])
    target = CONFIG.target
    cells, _ = data.lattice_of(resolve_airframe("quad_x", target.half_wheelbase_m), target)
    body = factor_body(cells, CONFIG.array.frequency_hz, nearest_m=data.nearest_distance(near))
    with pytest.raises(ValueError, match=r"^flight.box_m: .* is too near for a table: .* keep them within 45"):
        data.tabulate_targets(near, [body])


TABLE = override(CONFIG, ["data.solver=table", "data.count=48", "data.shard_rows=24"])


@pytest.fixture(scope="module")
def targets():
    return data.prepare_targets(TABLE)


def test_rows_by_table_are_mom_s_but_for_the_table_s_error(targets):
    rows = np.arange(96)
    fast = data.generate(TABLE, rows, targets)
    exact = data.generate(CONFIG, rows, [replace(target, table=None) for target in targets])
    for name, value in exact.columns().items():
        if name != "true_channel":
            np.testing.assert_array_equal(fast.columns()[name], value, err_msg=name)
    fast, exact, craft = (np.asarray(each) for each in (fast.true_channel, exact.true_channel, exact.airframe))
    off = np.linalg.norm(fast - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))
    for kind, target in enumerate(targets):
        median, most = np.asarray(target.table.errors)[0]
        assert 0.0 < np.median(off[craft == kind]) < 1.5 * median  # of 48, beside 192 all about the array
        assert np.quantile(off[craft == kind], 0.9) < 1.5 * most


def test_a_table_answers_in_one_place_and_many_alike(targets):
    sample = data.generate(TABLE, [3], targets).each(lambda value: value[0])
    alone = data.simulated_channel(
        TABLE,
        targets[sample.airframe].table,
        sample.rotation,
        sample.position,
        float(sample.permittivity),
        float(sample.conductivity),
    )
    kept = data.unpack(jnp.asarray(sample.true_channel))
    np.testing.assert_allclose(alone, kept, atol=1e-5 * np.abs(kept).max())


def test_where_poses_are_solved_one_by_one_table_means_mom():
    airframe = resolve_airframe("quad_x", CONFIG.target.half_wheelbase_m)
    poses = (np.eye(3, dtype=np.float32)[None], np.array([[5.0, 6.0, 3.0]], np.float32), 3.0, 5e-3)
    np.testing.assert_array_equal(
        data.channels_along(TABLE, airframe, *poses), data.channels_along(CONFIG, airframe, *poses)
    )


def test_the_bound_knows_the_body_behind_a_table(targets):
    samples = data.generate(TABLE, np.arange(4) * TABLE.flight.slots, targets)
    batch = data.observed_anew(jax.random.key(0), samples, TABLE, 20.0)
    assert Bound(samples, np.asarray(batch.predicted), targets, TABLE).at(20.0)["bound_m"] > 0.0


def test_a_simulated_set_says_what_its_tables_err_by(tmp_path, targets):
    said = []
    data.simulate(TABLE, tmp_path, progress=said.append)
    told = json.loads((tmp_path / "manifest.json").read_text())["table_errors"]
    assert list(told) == list(TABLE.target.airframes)
    for target, error in zip(targets, told.values(), strict=True):
        np.testing.assert_allclose([error["median"][0], error["most"][0]], target.table.errors[0], rtol=1e-2)
    assert any("relative error" in line for line in said)
    before = (tmp_path / "manifest.json").read_text()
    data.simulate(TABLE, tmp_path)  # nothing is missing
    assert (tmp_path / "manifest.json").read_text() == before
    # By table, the same seed makes other numbers than by mom; so does a table for another threshold.
    assert (
        len({configuration.data_digest(c) for c in (CONFIG, TABLE, override(TABLE, ["region.threshold_m=0.4"]))}) == 3
    )


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("array.nx", "9"),
        ("array.tones_hz", "[3e9,3.1e9]"),
        ("flight.box_m", "[[3,7],[4,12],[2,5]]"),
        ("flight.tilt_deg", "40"),
        ("target.permittivity", "[1.5,6]"),
        ("target.conductivity_s_m", "[0.001,0.1]"),
    ],
)
def test_rows_that_a_table_does_not_hold_are_refused_by_the_configuration_s_field(targets, field, value):
    wide = override(TABLE, ["region.permittivity_max=6", "region.conductivity_max_s_m=0.1", f"{field}={value}"])
    with pytest.raises(
        ValueError, match=f"^{field}: .* beyond the table, which holds .*make it for this configuration"
    ):
        data.generate(wide, [0], targets)


@pytest.mark.parametrize(
    ("field", "position", "axis", "permittivity"),
    [
        ("flight.box_m", (9.0, 14.0, 6.0), (0.0, 0.0, 1.0), 3.0),
        ("flight.tilt_deg", (3.0, 4.0, 3.0), (-0.6, -0.8, 0.0), 3.0),
        ("target.permittivity", (5.0, 6.0, 3.0), (0.0, 0.0, 1.0), 7.0),
    ],
)
def test_a_pose_that_a_table_does_not_hold_is_refused_by_the_configuration_s_field(
    targets, field, position, axis, permittivity
):
    turn = rotation_from_axis_yaw(jnp.asarray(axis, jnp.float32), jnp.float32(0.0))
    with pytest.raises(ValueError, match=f"^{field}.*: asked beyond what tables are made for: .*the table holds"):
        data.simulated_channel(TABLE, targets[0].table, turn, jnp.asarray(position, jnp.float32), permittivity, 5e-3)
