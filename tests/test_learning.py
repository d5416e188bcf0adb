"""The report of a training run: one offline file that holds its numbers, and what a reader finds in a browser."""

from __future__ import annotations

import numpy as np
import pytest
from browser import BROWSER, DARK, PHONE, WIDE, assert_drawn, assert_fits, assert_legible, found_in
from pages import assert_alone, made_up_about, payload
from test_plotting import NETWORKS, PREDICTOR

from august_jax.app.learning import write_learning

IN_A_BROWSER = pytest.mark.skipif(BROWSER is None, reason="no browser here")
STEPS = 600


def made_up_lines(done=STEPS):
    """As a run logs them: terms every ten steps, validation at every hundredth."""
    lines = []
    for step in range(10, done + 1, 10):
        line = {name: value * (1.0 + 50.0 / step) for name, value in NETWORKS.items() if "validation" not in name}
        line |= {"step": float(step), "seconds_left": 0.3 * (STEPS - step)}
        if step % 100 == 0:
            line |= {"validation_mpe_m": 0.15 + 30.0 / step, "validation_prediction_m": 0.48}
        lines.append(line)
    return lines


def written(path, lines, **given):
    write_learning(path, lines, STEPS, made_up_about(**given))
    return path


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    return written(tmp_path_factory.mktemp("page") / "report.html", made_up_lines())


def test_the_lines_come_back_from_the_page_which_needs_nothing_else(page, tmp_path):
    text = page.read_text(encoding="utf-8")
    told = payload(text)
    assert told["lines"] == made_up_lines() and told["steps"] == STEPS
    assert [each["name"] for each in told["panels"]] == [
        "validation_mpe_m", "loss", "latent", "material", "position", "gradient"
    ]  # fmt: skip
    assert told["panels"][0]["held"] == "answering the prediction" and told["panels"][1]["held"] == ""
    broken = written(tmp_path / "report.html", made_up_lines(), title="<img> </script>").read_text(encoding="utf-8")
    for each in (text, broken):
        assert_alone(each)


@IN_A_BROWSER
@pytest.mark.parametrize("size", [WIDE, PHONE], ids=["desk", "telephone"])
def test_nothing_is_wider_than_the_window(page, size):
    assert_fits(page, **size)


@IN_A_BROWSER
@pytest.mark.parametrize("flags, dark", [((), False), ((DARK,), True)], ids=["light", "dark"])
def test_text_can_be_read_in_light_and_in_the_dark(page, flags, dark):
    assert_legible(page, flags, dark)


TOLD = """
const told = [...document.querySelectorAll("#numbers tr")]
  .map((line) => [...line.children].map((box) => box.innerText));
return { told, stands: document.getElementById("stands").textContent, text: document.body.innerText,
  labels: [...document.querySelectorAll("canvas")].map((each) => each.getAttribute("aria-label")) };
"""


@IN_A_BROWSER
def test_the_table_tells_first_now_and_least_beside_what_it_is_held_against(page, tmp_path):
    lines = made_up_lines()
    found = found_in(page, TOLD)
    validated, loss = found["told"][1:3]
    assert [text.split("\n")[0] for text in validated] == ["validation_mpe_m", "0.45", "0.2", "0.2", "0.48"]
    assert [float(text) for text in loss[1:4]] == [float(f"{lines[k]['loss']:.3g}") for k in (0, -1, -1)]
    assert loss[4] == "–" and found["stands"] == "All 600 steps are done"
    assert "from 0.45 at step 100 to 0.2 at step 600; answering the prediction: 0.48" in found["labels"][0]
    halfway = found_in(written(tmp_path / "half.html", made_up_lines(300)), TOLD)
    assert halfway["stands"] == "Step 300 of 600; 2 minutes were left when this was written"


@IN_A_BROWSER
@pytest.mark.parametrize("lines", [[PREDICTOR], [{"step": 1.0, "loss": 2.0, "seconds_left": 5.0}]])
def test_a_predictor_and_a_single_line_are_a_page_too(tmp_path, lines):
    found = found_in(written(tmp_path / "report.html", lines), TOLD, **PHONE)
    assert "NaN" not in found["text"] and "undefined" not in found["text"]
    assert len(found["labels"]) == len(found["told"]) - 1 == (4 if lines == [PREDICTOR] else 1)
    assert ("the Kalman filter alone" in found["text"]) == (lines == [PREDICTOR])


@IN_A_BROWSER
def test_curves_stand_where_their_numbers_are(page):
    """Read off the first canvas: at the steps of validation, the run's colour at the height of its error and the
    baseline's at its own, on one linear scale."""
    found = found_in(page, """
const canvas = document.querySelector("canvas"), pen = canvas.getContext("2d");
const dense = canvas.width / canvas.clientWidth;
const height = (colour, step) => {
  const width = canvas.clientWidth, x = 58 + (width - 48 - 14 - 20) * step / 600, rows = [];
  const { data: seen, width: wide } = pen.getImageData(
    ...[x - 2, 26, 5, canvas.clientHeight - 68].map((each) => each * dense));
  const [r, g, b] = [1, 3, 5].map((at) => parseInt(colour.slice(at, at + 2), 16));
  for (let k = 0; k < seen.length; k += 4) {
    const apart = Math.abs(seen[k] - r) + Math.abs(seen[k + 1] - g) + Math.abs(seen[k + 2] - b);
    if (seen[k + 3] > 200 && apart < 6) rows.push(Math.floor(k / 4 / wide) / dense);
  }
  return rows.length ? rows.reduce((sum, row) => sum + row, 0) / rows.length : null;
};
return { own: [100, 200, 600].map((step) => height(ink.model, step)), base: height(ink.base, 300) };""")  # fmt: skip
    heights, values = np.array([*found["own"], found["base"]]), np.array([0.45, 0.3, 0.2, 0.48])
    line = np.polyfit(values, heights, 1)
    assert line[0] < 0.0 and np.abs(np.polyval(line, values) - heights).max() < 2.0
    assert heights.max() - heights.min() > 80.0


@IN_A_BROWSER
def test_pictures_are_drawn(page, tmp_path):
    looks = {"desk": (1280, 2000), "telephone": (390, 4200), "dark": (1280, 2000)}
    assert_drawn(page, "training", tmp_path, looks, 40_000)
