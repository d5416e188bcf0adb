"""Craft taken apart: every face once, rotors that turn freely about their axes, hands and blades as they were drawn."""

from dataclasses import replace

import numpy as np
import pytest

from august_jax.scene import AIRFRAMES, procedural_airframe, rotorcraft
from august_jax.scene.families import FAMILIES


@pytest.mark.parametrize("name", AIRFRAMES)
def test_a_craft_and_its_parts_are_one_surface(name):
    whole, family = procedural_airframe(name, 0.3), FAMILIES[name]
    parts = rotorcraft(whole)
    assert len(parts.rotors) == len(parts.centres_m) == len(family.arms_deg) * (2 if family.coaxial else 1)
    pieces = [parts.hull.mesh, *(each.mesh for each in parts.rotors)]
    assert sum(len(each.faces) for each in pieces) == len(whole.mesh.faces)
    assert sum(each.area for each in pieces) == pytest.approx(whole.mesh.area, rel=1e-9)
    np.testing.assert_allclose(parts.radii_m, family.rotor_radius * 0.3 / 0.25, rtol=0.02)
    assert np.all(parts.blades == 2)
    # as they are drawn: neighbours turn against each other, and so do the two of an axis
    sides = (1.0, -1.0) if family.coaxial else (1.0,)
    drawn = [side * (1.0 if arm % 2 == 0 else -1.0) for arm in range(len(family.arms_deg)) for side in sides]
    np.testing.assert_array_equal(parts.hands, drawn)
    for each, radius in zip(parts.rotors, parts.radii_m):
        assert each.radius_m == pytest.approx(radius, rel=0.02)  # about its own centre


def test_without_axes_and_without_rotors_the_way_out_is_named():
    craft = procedural_airframe("quad_x", 0.25)
    with pytest.raises(ValueError, match="names no rotor axes; give the centres"):
        rotorcraft(replace(craft, rotor_axes_m=None))
    with pytest.raises(ValueError, match=r"airframe: no piece of quad_x turns about the axis at \[0.0, 0.0, 1.0\]"):
        rotorcraft(replace(craft, rotor_axes_m=np.array([[0.0, 0.0, 1.0]])))
