"""The lobe in a browser: as wide as the window, turned by key, other polarisations and frequencies at hand."""

from __future__ import annotations

import numpy as np
import pytest
from browser import BROWSER, DARK, found_in, picture
from test_experiments import assert_ink
from test_lobe import AZIMUTH, ELEVATION, written

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no browser here")

SEEN = """
const canvas = document.getElementById("lobe");
const seen = () => {
  draw();
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return data.reduce((sum, value, k) => (sum * 31 + value * (k % 7 + 1)) % 4294967291, 7);
};
for (let k = 0; k < 3; k++) seen();  // a canvas that is read is drawn by other means from then on
const press = (key) => canvas.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("lobe") / "rcs.html"
    written(path, title="quad_x_of_a_long_name, monostatic: radar cross-section")
    return path


@pytest.mark.parametrize("width", [1280, 390, 320])
def test_nothing_is_wider_than_the_window(page, width):
    asked = 'return [document.documentElement.scrollWidth, document.getElementById("lobe").clientWidth];'
    found = found_in(page, asked, width=width, height=800)
    assert found[0] == width and 0.7 * min(width, 1000) < found[1] < width


def test_keys_turn_and_bring_back(page):
    found = found_in(page, SEEN + """
const first = seen(), after = ["ArrowLeft", "ArrowUp", "+"].map((key) => { press(key); return seen(); });
press("Home");
return { first, after, back: seen(), tab: canvas.tabIndex, label: canvas.getAttribute("aria-label") };""")  # fmt: skip
    assert len({found["first"], *found["after"]}) == 4 and found["back"] == found["first"]
    assert found["tab"] == 0 and found["label"]


def test_choices_change_the_picture_and_the_most_is_told(page):
    found = found_in(page, SEEN + """
const told = () => document.getElementById("told").textContent, pictures = [seen()], words = [told()];
for (const [id, index] of [["entry", 0], ["tone", 1]]) {
  document.getElementById(id).selectedIndex = index;
  document.getElementById(id).dispatchEvent(new Event("change"));
  pictures.push(seen()); words.push(told());
}
return { pictures, words };""")  # fmt: skip
    assert len(set(found["pictures"])) == 3
    values = np.random.default_rng(0).uniform(-70.0, 10.0, (2, len(ELEVATION), len(AZIMUTH), 2))  # as test_lobe draws
    for text, shown in zip(found["words"], (values[1, ..., 0], values[0, ..., 0], values[0, ..., 1])):
        row, column = np.unravel_index(shown.argmax(), shown.shape)
        place = f"azimuth {AZIMUTH[column]:.0f}°, elevation {ELEVATION[row]:.0f}°"
        assert text == f"most: {shown.max():.1f} dBsm at {place}"


def test_angles_are_told_as_they_were_asked(page):
    told = found_in(page, "return [0.5, -1.5, 2, 0.125, -90].map(degrees);")
    assert told == ["0.5", "-1.5", "2", "0.125", "-90"]


@pytest.mark.parametrize("flags", [(), (DARK,)], ids=["light", "dark"])
def test_it_is_drawn(page, tmp_path, flags):
    picture(page, tmp_path / "seen.png", width=1000, height=900, flags=flags)
    if not flags:
        assert_ink(tmp_path / "seen.png")
    from matplotlib.image import imread

    shade = imread(tmp_path / "seen.png")[2, 2, :3].mean()
    assert shade < 0.2 if flags else shade > 0.9
