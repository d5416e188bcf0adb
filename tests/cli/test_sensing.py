"""Which known craft a search among them compares with."""

from dataclasses import replace

import pytest

from august_jax.app.cli.sensing import _known
from august_jax.config import preset
from august_jax.scene import load_airframe, procedural_airframe, resolve_airframe

CONFIG = preset("smoke")
CONFIG = replace(CONFIG, target=replace(CONFIG.target, airframes=("quad_x", "hexa", "octo")))


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A craft that the configuration does not name, of a file."""
    path = tmp_path_factory.mktemp("mesh") / "mine.stl"
    procedural_airframe("coaxial_y6", 0.25).mesh.export(path)
    return load_airframe(path, unit="m")


@pytest.mark.parametrize(
    "flies, most, wanted",
    [
        ("mine", None, ("quad_x", "hexa", "octo")),
        ("mine", 1, ()),
        ("mine", 3, ("quad_x", "hexa")),
        ("hexa", None, ("quad_x", "hexa", "octo")),
        ("hexa", 1, ("hexa",)),
        ("octo", 2, ("quad_x", "octo")),
        ("octo", 9, ("quad_x", "hexa", "octo")),
    ],
)
def test_all_are_compared_or_the_one_that_flies_and_others(own, flies, most, wanted):
    craft = own if flies == "mine" else resolve_airframe(flies, CONFIG.target.half_wheelbase_m)
    assert _known(CONFIG, craft, most) == wanted


def test_a_file_called_as_a_known_craft_is_refused(tmp_path):
    procedural_airframe("octo", 0.25).mesh.export(tmp_path / "hexa.stl")
    with pytest.raises(ValueError, match="two of the known craft are called 'hexa'.*another name"):
        _known(CONFIG, load_airframe(tmp_path / "hexa.stl", unit="m"), None)
