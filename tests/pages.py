"""Pages of reports: what is made up about them, what they hold, and that they need nothing else."""

from __future__ import annotations

import json
import re
from typing import Any

from august_jax.app.page import About


def made_up_about(**given: Any) -> About:
    """What a report says of itself, with a command longer than a telephone is wide; ``given`` in the place of some."""
    words = {
        "title": "made up, seed 1",
        "lead": "lead",
        "note": "note",
        "setup": [("seed", "1")],
        "following": [("august demo --seed 1", "a flight")],
        "repeat": [("august evaluate '/a/folder/whose/name/is/longer/than/a/telephone/is/wide/run' --seed 1", "again")],
        "configuration": "array:\n  nx: 4\n" * 9,
    }
    return About(**{**words, **given})


def payload(page: str) -> Any:
    """What was put into a page."""
    return json.loads(re.search(r'<script type="application/json" id="payload">(.*?)</script>', page, re.S)[1])


def assert_alone(page: str) -> None:
    """Nothing is loaded from elsewhere, and no text of the payload has closed a script."""
    assert not re.search(r"(src|href)\s*=|https?://|@import|url\(|fetch\(|XMLHttpRequest", page)
    assert page.count("</script>") == 2
