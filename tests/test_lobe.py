"""The lobe: one offline file whose payload holds the cross-sections to the hundredth of a decibel."""

import base64

import numpy as np
import pytest
from pages import assert_alone, payload

from august_jax.app import lobe

AZIMUTH, ELEVATION, HERTZ = np.arange(-180.0, 181.0, 30.0), np.arange(-90.0, 91.0, 45.0), (2.9e9, 3e9)


def entries(azimuth=AZIMUTH, elevation=ELEVATION):
    values = np.random.default_rng(0).uniform(-70.0, 10.0, (2, len(elevation), len(azimuth), len(HERTZ)))
    return dict(zip(("hh", "vv"), values))


def written(path, title="a craft", azimuth=AZIMUTH, elevation=ELEVATION, **given):
    craft = np.random.default_rng(1).normal(0.0, 0.1, (20, 3))
    values = given or entries(azimuth, elevation)
    lobe.write_lobe(path, azimuth, elevation, HERTZ, values, craft, title=title, lead="x", repeat="august rcs x <y>")
    page = path.read_text(encoding="utf-8")
    return page, payload(page), craft


def integers(text):
    return np.frombuffer(base64.b64decode(text), "<i2")


def test_cross_sections_and_craft_come_back_from_the_page(tmp_path):
    page, told, craft = written(tmp_path / "rcs.html")
    for name, values in entries().items():
        for tone, text in enumerate(told["entries"][name]):
            found = integers(text).reshape(len(ELEVATION), len(AZIMUTH)) * lobe.STEP_DB
            np.testing.assert_allclose(found, values[..., tone], atol=0.51 * lobe.STEP_DB)
    assert told["frequency_hz"] == list(HERTZ) and told["repeat"] == "august rcs x <y>"
    reach = np.linalg.norm(craft, axis=1).max()
    np.testing.assert_allclose(integers(told["craft"]).reshape(-1, 3) / 32767, craft / reach, atol=1e-4)
    assert_alone(page)


def test_nothing_is_nothing_and_text_cannot_break_out(tmp_path):
    silent = {"vv": np.full((len(ELEVATION), len(AZIMUTH), 2), -np.inf)}
    page, told, _ = written(tmp_path / "rcs.html", title="<img> </script> of mine", **silent)
    assert told["title"] == "<img> </script> of mine" and page.count("</script>") == 2
    assert np.all(integers(told["entries"]["vv"][0]) * lobe.STEP_DB == -300.0)


@pytest.mark.parametrize("azimuth, elevation", [(AZIMUTH, np.zeros(1)), (np.zeros(1), ELEVATION)])
def test_a_cut_is_a_page_too(tmp_path, azimuth, elevation):
    _, told, _ = written(tmp_path / "rcs.html", azimuth=azimuth, elevation=elevation)
    assert len(integers(told["entries"]["hh"][1])) == len(azimuth) * len(elevation)
