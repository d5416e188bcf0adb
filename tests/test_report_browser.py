"""The report in a browser: on a desk, on a telephone, in the dark, by key and by finger."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from browser import BROWSER, DARK, PHONE, WIDE, assert_drawn, assert_fits, assert_legible, found_in
from made_up_track import made_up_track
from test_report import write

from august_jax.config import preset
from august_jax.evaluation import score_track
from august_jax.scene import WorldCloud

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no browser here")

HYPOTHESIS = {"craft": "hexa_of_long_name", "probability": 0.9, "position": [4.0, 6.0, 3.0], "normal": [0.0, 0.0, 1.0],
              "heading_deg": 30.0, "permittivity": 3.0, "conductivity": 4e-3}  # fmt: skip


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """A report with all that reports have: several slots, a search of one, a bound, long words."""
    track = made_up_track(4)
    scores = score_track(track, preset("smoke"), 0.25)
    search = {"craft": "hexa", "craft_probability": {"hexa": 1.0}, "explained": True, "probability": 0.4,
              "position": [4.0, 6.0, 3.0], "normal": [0.0, 0.0, 1.0], "hypotheses": [HYPOTHESIS] * 2}  # fmt: skip
    scores["slots"] = [slot | {"search": search if slot["slot"] == 3 else None} for slot in scores["slots"]]
    scores["schemes"] = [{**scores["schemes"][0], "scheme": "matched_field", "count": 1}, *scores["schemes"]]
    scores["bound"] = {"bound_m": 0.02, "bound_mde": 1e-3}
    cloud = WorldCloud(track.truth[3], np.ones(400), np.ones(400))
    path = tmp_path_factory.mktemp("page") / "report.html"
    command = "august reconstruct --mesh '/a/folder/whose/name/is/longer/than/a/telephone/is/wide/drone.stl' --unit mm"
    write(path, track, scores, hypotheses={3: [cloud, cloud]}, repeat=[(command, "again")], configuration="a: 1\n" * 9)
    return path


@pytest.mark.parametrize("size", [WIDE, PHONE, {"width": 320, "height": 568}], ids=["desk", "telephone", "small"])
def test_nothing_is_wider_than_the_window(page, size):
    assert_fits(page, **size)


SEEN = """
const seen = (id) => {
  const canvas = document.getElementById(id);
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return data.reduce((sum, value, k) => (sum * 31 + value * (k % 7 + 1)) % 4294967291, 7);
};
const ids = ["left", "right", "third", "flight"];
// a canvas that is read is drawn by other means from then on
for (let k = 0; k < 3; k++) { ids.forEach(seen); refresh(); }
"""


def test_times_are_told_as_finely_as_slots_are_long(page):
    told = found_in(page, "return [0, 0.2, 1, 0.02, 0.0625].map((time_s) => seconds({ time_s }));")
    assert told == ["0.0", "0.2", "1.0", "0.02", "0.0625"]


def test_every_view_turns_by_key_and_says_what_it_shows(page):
    found = found_in(
        page,
        SEEN
        + """
return ids.map((id) => {
  const canvas = document.getElementById(id), first = seen(id), after = {};
  canvas.focus();
  const focused = document.activeElement === canvas;
  for (const key of ["ArrowLeft", "ArrowUp", "+"]) {
    const event = new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true });
    canvas.dispatchEvent(event);
    after[key] = [seen(id), event.defaultPrevented];
  }
  canvas.dispatchEvent(new KeyboardEvent("keydown", { key: "0", bubbles: true }));
  const tab = new KeyboardEvent("keydown", { key: "Tab", bubbles: true, cancelable: true });
  canvas.dispatchEvent(tab);
  const label = canvas.getAttribute("aria-label");
  return { focused, first, after, back: seen(id), label, trapped: tab.defaultPrevented };
});""",
        **WIDE,
    )
    assert len(found) == 4
    for view in found:
        assert view["focused"] and not view["trapped"] and view["back"] == view["first"] and view["label"]
        seen = [view["first"], *(pixels for pixels, _ in view["after"].values())]
        assert len(set(seen)) == 4 and all(kept for _, kept in view["after"].values())


def test_whatever_can_be_pressed_has_a_name_and_can_be_reached(page):
    found = found_in(
        page,
        """const all = [...document.querySelectorAll("button, input, select, summary, canvas[tabindex]")];
const name = (each) => (each.getAttribute("aria-label") || each.textContent).trim();
return all.map((each) => [each.tagName, name(each), each.tabIndex]);""",
    )
    assert len(found) > 30 and all(name and place >= 0 for _, name, place in found)


FINGER = """
const at = (canvas, type, id, x, y) => {
  const box = canvas.getBoundingClientRect(), place = { clientX: box.left + x, clientY: box.top + y };
  const finger = { pointerId: id, pointerType: "touch", isPrimary: id === 1, bubbles: true, cancelable: true };
  canvas.dispatchEvent(new PointerEvent(type, { ...finger, ...place }));
};
const swipe = (canvas, dx, dy) => {
  at(canvas, "pointerdown", 1, 100, 100);
  at(canvas, "pointermove", 1, 100 + dx, 100 + dy);
  at(canvas, "pointerup", 1, 100 + dx, 100 + dy);
};
"""


def test_a_swipe_scrolls_the_page_until_a_view_is_held(page):
    found = found_in(
        page,
        SEEN
        + FINGER
        + """
const told = {};
for (const id of ids) {
  const canvas = document.getElementById(id), style = getComputedStyle(canvas), seq = [seen(id)];
  told[id] = { free: style.touchAction };
  swipe(canvas, 0, 60); seq.push(seen(id));     // the page's own
  swipe(canvas, 60, 0); seq.push(seen(id));     // turns
  at(canvas, "pointerdown", 1, 50, 50); at(canvas, "pointerdown", 2, 90, 90);
  at(canvas, "pointermove", 1, 50, 20); at(canvas, "pointermove", 2, 90, 150);
  at(canvas, "pointerup", 1, 50, 20); at(canvas, "pointerup", 2, 90, 150); seq.push(seen(id));   // two fingers
  swipe(canvas, 0, 0); told[id].held = style.touchAction;
  swipe(canvas, 0, -60); seq.push(seen(id));    // held: lowers
  swipe(canvas, 0, 0); told[id].again = style.touchAction;
  told[id].seq = seq;
}
const left = document.getElementById("left");
swipe(left, 0, 0);
document.getElementById("title").dispatchEvent(new PointerEvent("pointerdown", { bubbles: true }));
told.elsewhere = getComputedStyle(left).touchAction;
return told;""",
        **PHONE,
    )
    assert found.pop("elsewhere") == "pan-y"
    assert set(found) == {"left", "right", "third", "flight"}
    for view in found.values():
        assert (view["free"], view["held"], view["again"]) == ("pan-y", "none", "pan-y")
        still, swiped, turned, pinched, lowered = view["seq"]
        assert still == swiped and len({swiped, turned, pinched, lowered}) == 4


def test_the_wheel_scrolls_the_page_until_a_view_was_clicked(page):
    found = found_in(
        page,
        """const canvas = document.getElementById("left");
const wheel = () => { const event = new WheelEvent("wheel", { deltaY: 100, bubbles: true, cancelable: true });
  canvas.dispatchEvent(event); return event.defaultPrevented; };
const before = wheel(); canvas.focus(); return [before, wheel()];""",
    )
    assert found == [False, True]


@pytest.mark.parametrize("flags, dark", [((), False), ((DARK,), True)], ids=["light", "dark"])
def test_text_can_be_read_in_light_and_in_the_dark(page, flags, dark):
    assert_legible(page, flags, dark)


def test_the_overlay_says_what_it_compares(page):
    found = found_in(
        page,
        """const press = (key, value) => document.querySelector(`[data-set=${key}][data-value=${value}]`).click();
press("layout", "over"); const where = document.getElementById("leftLabel").textContent;
press("place", "own"); return [where, document.getElementById("leftLabel").textContent,
  document.getElementById("scoreTable").textContent];""",
    )
    where, own, table = found
    assert where.endswith("cm apart") and "about its own centre" in own and "cm apart" not in own
    assert "in 1 slot" in table and "1 slots" not in table and "bound" in table


@pytest.mark.parametrize("kind", ["one slot", "a place alone"])
def test_less_than_a_flight_with_clouds_is_shown_too(tmp_path, kind):
    track = made_up_track(1 if kind == "one slot" else 3)
    if kind == "a place alone":  # as schemes without a cloud answer
        unknown = np.full((3, 1), np.nan)
        track = replace(track, points=track.points.mean(axis=1, keepdims=True), point_permittivity=unknown,
                        point_conductivity=unknown, normal_estimate=np.full((3, 3), np.nan))  # fmt: skip
    scores = score_track(track, preset("smoke"), 0.25)
    write(tmp_path / "report.html", track, scores)
    found = found_in(
        tmp_path / "report.html",
        "const shown = (id) => document.getElementById(id).getClientRects().length > 0;"
        "return { title: document.title, text: document.body.innerText, flight: shown('flightCard'), map: shown('map'),"
        " configuration: shown('configurationCard'), wide: document.documentElement.scrollWidth };",
        **PHONE,
    )
    assert found["title"] == "made up" and "NaN" not in found["text"] and "undefined" not in found["text"]
    assert found["flight"] == found["map"] == (kind != "one slot") and found["wide"] == PHONE["width"]
    assert not found["configuration"]  # none was given


def test_pictures_are_drawn(page, tmp_path):
    looks = {"desk": (1280, 2600), "telephone": (390, 3600), "dark": (1280, 2600)}
    assert_drawn(page, "report", tmp_path, looks, 60_000)  # a page without its clouds packs into 40 kB
