"""A page in a headless browser, as a reader has it: what a script finds there, and a picture."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any
from urllib.parse import unquote

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
DARK = "--blink-settings=preferredColorScheme=0"
TOUCH = "--blink-settings=availablePointerTypes=2,primaryPointerType=2"
WIDE, PHONE = {"width": 1280, "height": 900}, {"width": 390, "height": 844}
WIDER = """
document.querySelectorAll("details").forEach((each) => { each.open = true; });
const wide = document.documentElement.clientWidth, named = (each) => each.outerHTML.slice(0, 90);
const shown = (but) => [...document.querySelectorAll("main *")].filter((each) =>
  each.getClientRects().length && !each.closest(but));
const out = shown("pre, .unseen").filter((each) => each.getBoundingClientRect().right > wide + 0.5).map(named);
const cut = shown(".unseen, select, button").filter((each) =>
  each.scrollWidth > each.clientWidth + 1 && getComputedStyle(each).display !== "inline").map(named);
return { wide, needs: document.documentElement.scrollWidth, out, cut };
"""
"""What is wider than the window, and what of a text does not fit its box."""
COLOURS = """
const part = (text) => { const v = text / 255; return v <= 0.03928 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4; };
const light = (text) => {
  const [r, g, b] = text.match(/[\\d.]+/g).map(part);
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const ground = (each) => {
  for (; each; each = each.parentElement) {
    const colour = getComputedStyle(each).backgroundColor;
    if (!/, 0\\)$/.test(colour)) return colour;
  }
  return "rgb(255, 255, 255)";
};
const written = [...document.querySelectorAll("main *")].filter((each) =>
  each.getClientRects().length && !each.closest(".label, .hint, select")
  && [...each.childNodes].some((node) => node.nodeType === 3 && node.textContent.trim()));
const contrast = (each) => {
  const [a, b] = [light(getComputedStyle(each).color), light(ground(each))].sort((x, y) => x - y);
  return (b + 0.05) / (a + 0.05);
};
const least = written.map((each) => [contrast(each), each.outerHTML.slice(0, 80)]).sort((x, y) => x[0] - y[0])[0];
return { page: light(getComputedStyle(document.body).backgroundColor), least };
"""
"""How light the page is, and the text that stands out least from its ground, by WCAG's ratio."""


def _opened(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    assert BROWSER is not None
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader", "--hide-scrollbars",
             "--no-first-run", "--disable-extensions", f"--user-data-dir={folder / 'browser'}",
             "--virtual-time-budget=5000", "--host-resolver-rules=MAP * ~NOTFOUND"]  # fmt: skip
    return subprocess.run([BROWSER, *flags, *words], capture_output=True, text=True, timeout=240, check=True)


def found_in(page: Path, script: str, *, width: int = 1280, height: int = 900, flags: tuple[str, ...] = ()) -> Any:
    """What the body of a function ``script`` returns in the page, as JSON, once the page's own scripts have run.

    The page is copied beside itself with the script at its end. The browser's window cannot be narrower than some
    500 pixels everywhere, so the page lies in a frame of ``width`` and ``height``.
    """
    told = "<script>addEventListener('load', async () => { let found; try { found = await (async () => {" + script + (
        "})(); } catch (error) { found = { error: String(error) }; }"
        "const box = parent.document.createElement('pre');"
        "box.id = 'found'; box.textContent = encodeURIComponent(JSON.stringify(found));"
        "parent.document.body.append(box);"
        "});</script></body>"
    )  # fmt: skip
    inner = page.with_name(f"{page.stem}-told.html")
    inner.write_text(page.read_text(encoding="utf-8").replace("</body>", told), encoding="utf-8")
    outer = page.with_name(f"{page.stem}-framed.html")
    outer.write_text(
        f"<!doctype html><body style='margin:0'><iframe src='{inner.name}' width={width} height={height} "
        "style='border:0'></iframe></body>",
        encoding="utf-8",
    )
    words = ("--allow-file-access-from-files", "--dump-dom", f"--window-size={max(width, 600)},{height}", *flags)
    run = _opened(page.parent, *words, outer.as_uri())
    text = re.search(r'<pre id="found">(.*?)</pre>', run.stdout, re.DOTALL)
    assert text, f"the page said nothing\n{run.stderr[-2000:]}"
    return json.loads(unquote(text[1]))


def picture(page: Path, png: Path, *, width: int, height: int, flags: tuple[str, ...] = ()) -> None:
    """The page as a PNG of ``width`` by ``height``."""
    _opened(page.parent, f"--screenshot={png}", f"--window-size={width},{height}", *flags, page.as_uri())


def assert_fits(page: Path, *, width: int, height: int) -> None:
    """Nothing of the page is wider than the window, and no text than its box."""
    found = found_in(page, WIDER, width=width, height=height)
    assert (found["wide"], found["needs"]) == (width, width)
    assert found["out"] == [] and found["cut"] == []


def assert_drawn(page: Path, name: str, folder: Path, looks: dict[str, tuple[int, int]], least: int) -> None:
    """Pictures of the page, each larger than ``least`` bytes; to look at where ``AUGUST_SCREENSHOTS`` names a folder.

    Args:
        looks: what it is on, ``desk``, ``telephone`` or ``dark`` -> width and height.
    """
    folder = Path(os.environ.get("AUGUST_SCREENSHOTS", folder))
    folder.mkdir(parents=True, exist_ok=True)
    for look, (width, height) in looks.items():
        png = folder / f"{name}_{look}.png"
        picture(page, png, width=width, height=height, flags=(DARK,) if look == "dark" else ())
        assert png.stat().st_size > least, look


def assert_legible(page: Path, flags: tuple[str, ...], dark: bool) -> None:
    """The page is as dark as it is asked to be, and its text stands out."""
    found = found_in(page, COLOURS, flags=flags)
    assert (found["page"] < 0.05) == dark
    assert found["least"][0] >= 4.5, found["least"]  # WCAG's AA for text
