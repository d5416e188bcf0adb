"""The report of an evaluation: one offline file that holds the rows, and what a reader finds in a browser."""

from __future__ import annotations

import numpy as np
import pytest
from browser import BROWSER, DARK, PHONE, WIDE, assert_drawn, assert_fits, assert_legible, found_in
from pages import assert_alone, made_up_about, payload

from august_jax.app.accuracy import write_accuracy
from august_jax.evaluation import thresholds
from august_jax.schemes import SCHEMES

IN_A_BROWSER = pytest.mark.skipif(BROWSER is None, reason="no browser here")
METRICS = ("mpe_m", "mde", "wd_db", "mcd_db")
ERRORS = {"august": 0.11, "other_network": 0.14, "matched_field": 0.07, "prediction": 0.48}


def made_up_rows(snrs=(0.0, 10.0, 20.0), schemes=tuple(ERRORS)):
    """Rows as an evaluation gives them: a scheme that answers a place alone, a search, two networks."""
    rows = []
    for snr in snrs:
        for name in schemes:
            error = ERRORS[name] * (1.0 if name == "prediction" else 1.0 + (30.0 - snr) / 30.0)
            searched = name == "matched_field"
            row = {"scheme": name, "label": SCHEMES[name].label if name in SCHEMES else "another network",
                   "snr_db": snr, "count": 10 if searched else 100, "mpe_m": error, "mpe_se_m": 0.01,
                   "along_m": 0.8 * error, "across_m": 0.6 * error, "bound_m": 0.02 * (30.0 - snr),
                   "bound_mde": 1e-3 * (30.0 - snr), "own_bound_m": 0.6, "own_bound_mde": 0.03}  # fmt: skip
            alone = name == "prediction"
            row |= {metric: None if alone else value for metric, value in
                    (("mde", 0.1 * error), ("wd_db", -17.0), ("mcd_db", -25.5), ("mde_se", 1e-3), ("wd_se_db", 0.4),
                     ("mcd_se_db", 0.3))}  # fmt: skip
            names = ("explained", "craft_accuracy", "craft_chance", "inside_50", "inside_90", "seconds",
                     "expected_mpe_m", "mpe_over_expected", "expected_mde", "mde_over_expected")  # fmt: skip
            told = (0.9, 0.75, 0.2, 0.5, 0.88, 2.3, 0.06, 1.12, 0.012, 1.3)
            rows.append(row | dict(zip(names, told if searched else [None] * len(told))))
    return rows


def written(path, rows, **given):
    write_accuracy(path, rows, thresholds(rows), made_up_about(**given))
    return path


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return written(tmp_path_factory.mktemp("page") / "report.html", made_up_rows())


def test_the_rows_come_back_from_the_page_which_needs_nothing_else(page, tmp_path):
    text = page.read_text(encoding="utf-8")
    told = payload(text)
    assert told["rows"] == made_up_rows() and told["thresholds"] == thresholds(made_up_rows())
    assert [each["name"] for each in told["schemes"] if each["strong"]] == ["august", "other_network"]
    assert len({each["colour"] for each in told["schemes"]}) == 4
    broken = written(tmp_path / "report.html", made_up_rows(), title="<img> </script>").read_text(encoding="utf-8")
    for each in (text, broken):
        assert_alone(each)


@IN_A_BROWSER
@pytest.mark.parametrize("size", [WIDE, PHONE, {"width": 320, "height": 568}], ids=["desk", "telephone", "small"])
def test_nothing_is_wider_than_the_window(page, size):
    assert_fits(page, **size)


@IN_A_BROWSER
@pytest.mark.parametrize("flags, dark", [((), False), ((DARK,), True)], ids=["light", "dark"])
def test_text_can_be_read_in_light_and_in_the_dark(page, flags, dark):
    assert_legible(page, flags, dark)


TOLD = """
const told = (id) => [...document.querySelectorAll(`#${id} tr`)]
  .map((line) => [...line.children].map((box) => box.innerText));
const press = (text) => [...document.querySelectorAll("button")].find((each) => each.textContent === text).click();
"""


@IN_A_BROWSER
def test_the_table_tells_every_scheme_at_the_snr_that_is_chosen(page):
    found = found_in(page, TOLD + """
const first = told("here"); press("0 dB");
return { first, then: told("here"), title: document.getElementById("hereTitle").textContent,
  searched: told("searched"), expected: told("expected"),
  parted: document.getElementById("parted").textContent };""")  # fmt: skip
    for table, snr in ((found["first"], 20.0), (found["then"], 0.0)):
        rows = [row for row in made_up_rows() if row["snr_db"] == snr]
        assert [line[0].split("\n")[0] for line in table[1:]] == [*ERRORS, "bound"]
        for line, row in zip(table[1:], rows):
            assert line[1].split("\n") == [f"{100 * row['mpe_m']:.1f}", "± 1.0"]
            assert (line[4] == "–") == (row["mcd_db"] is None)
        assert table[-1][1] == f"{100 * rows[0]['bound_m']:.1f}"
    assert "in 10 samples" in found["first"][3][0] and found["title"] == "At 0 dB"
    assert found["searched"][1] == ["0 dB", "10", "75 %", "20 %", "90 %", "50 %", "88 %", "2.3"]
    assert found["expected"][3][2:4] == ["6.0", "1.12"] and "below 0 dB" in found["parted"]


@IN_A_BROWSER
def test_curves_stand_where_their_numbers_are_and_leave_when_asked(page):
    """Read off the canvas: in the column of an SNR, the colour of a scheme at the height of its error."""
    found = found_in(page, TOLD + """
const canvas = document.getElementById("curves"), pen = canvas.getContext("2d");
const height = (colour) => {
  const column = [Math.round(across(20)) - 4, 30, 9, canvas.clientHeight - 75], rows = [];
  const { data: seen } = pen.getImageData(...column);
  const [r, g, b] = colour.match(/\\d+/g).map(Number);
  for (let k = 0; k < seen.length; k += 4) {
    const apart = Math.abs(seen[k] - r) + Math.abs(seen[k + 1] - g) + Math.abs(seen[k + 2] - b);
    if (apart < 6) rows.push(Math.floor(k / 36));
  }
  return rows.length ? rows.reduce((sum, row) => sum + row, 0) / rows.length : null;
};
const colours = Object.fromEntries(data.schemes.map((scheme) => [scheme.name, tint(scheme.colour)]));
const seen = () => {
  drawCurves();
  return Object.fromEntries(data.schemes.map(({ name }) => [name, height(colours[name])]));
};
const all = seen(); press("august"); const without = seen(); press("august"); press("Shape");
return { all, without, after: seen(), label: canvas.getAttribute("aria-label") };""")  # fmt: skip
    heights = [found["all"][name] for name in ("prediction", "other_network", "august", "matched_field")]
    errors = np.log([0.48, *(ERRORS[name] * 4.0 / 3.0 for name in ("other_network", "august", "matched_field"))])
    line = np.polyfit(errors, heights, 1)  # a logarithmic scale: one pixel as far as the next
    assert line[0] < 0.0 and np.abs(np.polyval(line, errors) - heights).max() < 2.0
    assert found["without"]["august"] is None and found["without"]["prediction"] == found["all"]["prediction"]
    assert found["after"]["prediction"] is None and "Chamfer" in found["label"]


@IN_A_BROWSER
@pytest.mark.parametrize("schemes", [("august",), ("prediction",)])
def test_one_snr_and_one_scheme_are_a_page_too(tmp_path, schemes):
    rows = [{**row, "bound_m": None, "bound_mde": None} for row in made_up_rows((7.5,), schemes)]
    found = found_in(written(tmp_path / "report.html", rows), """
return { text: document.body.innerText, search: document.getElementById("searchCard").getClientRects().length,
  metrics: [...document.getElementById("metrics").children].map((each) => each.textContent),
  wide: document.documentElement.scrollWidth };""", **PHONE)  # fmt: skip
    assert "NaN" not in found["text"] and "undefined" not in found["text"] and found["search"] == 0
    assert found["metrics"] == ["Position", "Attitude", "Cloud", "Shape"][: 1 if schemes == ("prediction",) else 4]
    assert "The bound is not known here" in found["text"] and found["wide"] == PHONE["width"]


@IN_A_BROWSER
def test_whatever_can_be_pressed_has_a_name_and_can_be_reached(page):
    found = found_in(page, """const all = [...document.querySelectorAll("button, summary")];
const name = (each) => (each.getAttribute("aria-label") || each.textContent).trim();
return all.map((each) => [name(each), each.tabIndex]);""")  # fmt: skip
    assert len(found) >= 15 and all(name and place >= 0 for name, place in found)


@IN_A_BROWSER
def test_pictures_are_drawn(page, tmp_path):
    looks = {"desk": (1280, 1800), "telephone": (390, 3600), "dark": (1280, 1800)}
    assert_drawn(page, "accuracy", tmp_path, looks, 40_000)
