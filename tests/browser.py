"""A page in a headless browser, as a reader has it: what a script finds there, and a picture."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any
from urllib.parse import unquote

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome"))), None)
DARK = "--blink-settings=preferredColorScheme=0"
TOUCH = "--blink-settings=availablePointerTypes=2,primaryPointerType=2"


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
