"""Tables of a configuration: they hold all that its craft may be, and give mom's channels within their error."""

from itertools import product

import jax.numpy as jnp
import numpy as np
import pytest

from august_jax import data
from august_jax.config import override, preset
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
    nearest = data.nearest_distance(CONFIG, tabulated=True)
    return data.tabulate_targets(CONFIG, factor_bodies(lattices, CONFIG.array.frequency_hz, nearest_m=nearest))


def test_tables_hold_every_place_tilt_and_material_of_a_configuration_and_a_margin(tables):
    """A concrete request outside a table's range is refused: none of these is."""
    beyond = CONFIG.region.threshold_m + 0.2
    walls = [(low - beyond, high + beyond) for low, high in CONFIG.flight.box_m]
    tilt = np.radians(CONFIG.flight.tilt_deg + 2.5)
    array = PlanarArray.from_config(CONFIG.array)
    for place in product(*walls):
        for yaw in (0.0, 2.0):
            aside = np.arctan2(place[1], place[0])  # towards the array and away from it
            for lean in (tilt, -tilt):
                axis = np.array([np.sin(lean) * np.cos(aside), np.sin(lean) * np.sin(aside), np.cos(lean)])
                turn = rotation_from_axis_yaw(jnp.asarray(axis, jnp.float32), jnp.float32(yaw))
                for permittivity, conductivity in product((1.4, 5.1), (0.0, 1.04e-2)):
                    chi = data.contrast_of(CONFIG, permittivity, conductivity)[0]
                    table_channel(tables[0], array, turn, jnp.asarray(place, jnp.float32), chi)


def test_tables_of_a_configuration_stack(tables):
    assert stack_tables(tables).directions.shape[0] == len(CONFIG.target.airframes)


def test_a_body_that_was_factored_for_the_box_alone_is_refused():
    target = CONFIG.target
    cells, _ = data.lattice_of(resolve_airframe("quad_x", target.half_wheelbase_m), target)
    body = factor_body(cells, CONFIG.array.frequency_hz, nearest_m=data.nearest_distance(CONFIG))
    with pytest.raises(ValueError, match=r"bodies: body 0 was factored for 4\.5 m .* nearest_m=nearest_distance"):
        data.tabulate_targets(CONFIG, [body])


def test_a_box_near_the_array_has_tables_that_end_a_metre_before_it():
    near = override(CONFIG, ["flight.box_m=[[-1,1],[1.3,3],[-1,1]]"])
    assert (data.nearest_distance(near), data.nearest_distance(near, tabulated=True)) == (1.0, 0.5)
