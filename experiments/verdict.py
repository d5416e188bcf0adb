"""The verdict on the paper's claims: ``claims.yaml`` held against the results, and the table of it in ``README.md``.

    python experiments/verdict.py               says what does not hold
    python experiments/verdict.py --write       and writes the table into experiments/README.md

A claim names the figure that it is about, what the paper says, and for each scale the verdict (``agrees``, ``partly``,
``not``) with the numbers that it rests on. A number says where it is read: a column of the figure's results (or of
another ``file`` below ``results``), the entries ``where`` other columns have certain values, of what is left the place
``at`` of the last axis, or the places ``since`` one, or all; then the mean of what is a number. It is told to as many
places as it is written.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import yaml

HERE = Path(__file__).parent
VERDICTS = ("agrees", "partly", "not")
SCALES = ("laptop", "paper")
MARKS = ("<!-- verdict -->", "<!-- end of the verdict -->")
_NEEDED = {"figure", "claim", "why"}

Claim = dict[str, Any]


def claims(path: Path = HERE / "claims.yaml") -> list[Claim]:
    """What the file holds; numbers as they are written, so that their places are known.

    Raises:
        ValueError: a claim with fields that are unknown or missing.
    """
    found = yaml.load(path.read_text(encoding="utf-8"), _Written)
    for claim in found:
        if not _NEEDED <= set(claim) <= _NEEDED | set(SCALES):
            raise ValueError(
                f"{path.name}: a claim has {sorted(claim)}; give {sorted(_NEEDED)} and, where it was run, of {SCALES}"
            )
    return found


class _Written(yaml.SafeLoader):
    """Numbers with a point stay what they were written as."""


_Written.add_constructor("tag:yaml.org,2002:float", lambda loader, node: Decimal(loader.construct_scalar(node)))


def table_of(path: Path) -> dict[str, np.ndarray]:
    """Columns of a result file: npz, or the ``rows`` of JSON."""
    if path.suffix == ".json":
        rows = json.loads(path.read_text(encoding="utf-8"))["rows"]
        return {name: np.array([row[name] for row in rows]) for name in rows[0]}
    with np.load(path) as stored:
        return {name: stored[name] for name in stored.files}


def read(number: dict[str, Any], path: Path) -> float:
    """What the results say.

    Raises:
        ValueError: a column or an entry is not there.
    """
    columns = table_of(path)
    for name in (number["column"], *number.get("where", {})):
        if name not in columns:
            raise ValueError(f"{path.name} has no column {name!r}; there are {', '.join(sorted(columns))}")
    values = columns[number["column"]]
    chosen = np.ones(len(values), bool)
    for name, wanted in number.get("where", {}).items():
        column = columns[name]
        chosen &= column == wanted if column.dtype.kind in "US" else np.isclose(column, float(wanted))
    if not chosen.any():
        raise ValueError(f"{path.name} has no entry where {number['where']}")
    left = values[chosen][..., number["at"] if "at" in number else slice(number.get("since", 0), None)]
    return float(np.nanmean(left))


def faults(found: Sequence[Claim], names: Sequence[str], results: Path) -> list[str]:
    """What does not hold, a line each.

    Args:
        found: of :func:`claims`.
        names: the paper's figures, each of which needs a claim.
        results: folder of the results.
    """
    wrong = [f"{name}: no claim is about this figure" for name in names if name not in {c["figure"] for c in found}]
    for claim in found:
        for scale in SCALES:
            said = claim.get(scale)
            if said is None:
                continue
            told = f"{claim['figure']}, {scale}"
            if said["verdict"] not in VERDICTS:
                wrong.append(f"{told}: verdict {said['verdict']!r}; there are {', '.join(VERDICTS)}")
            if not said.get("numbers"):
                wrong.append(f"{told}: a verdict without a number")
            for number in said.get("numbers", ()):
                path = results / number.get("file", f"{scale}/{claim['figure']}.npz")
                try:
                    value = read(number, path)
                except (OSError, ValueError, KeyError) as error:
                    wrong.append(f"{told}, {number['what']}: {error}")
                    continue
                written = Decimal(str(number["value"]))
                places = max(-int(written.as_tuple().exponent), 0)
                if f"{value * number.get('times', 1):.{places}f}" != f"{written:.{places}f}":
                    wrong.append(f"{told}, {number['what']}: written {written}, the results say {value:.6g}")
    return wrong


def lines(found: Sequence[Claim], results: Path) -> str:
    """The table in Markdown."""
    rows = ["| the paper's claim | measured | verdict | why |", "|---|---|---|---|"]
    for claim in found:
        measured, verdicts = [], []
        for scale in SCALES:
            said = claim.get(scale)
            if said is None:
                verdicts.append(f"{scale}: not run")
                continue
            numbers = "; ".join(
                f"{number['what']} {number['value']}{' ' + number['unit'] if number.get('unit') else ''}"
                for number in said["numbers"]
            )
            measured.append(f"{scale}: {numbers}")
            verdicts.append(f"{scale}: **{said['verdict']}**")
        picture = results / "laptop" / f"{claim['figure']}.png"
        name = f"[{claim['claim']}](results/laptop/{picture.name})" if picture.is_file() else claim["claim"]
        rows.append(f"| {name} | {'<br>'.join(measured)} | {'<br>'.join(verdicts)} | {claim['why'].strip()} |")
    return "\n".join(rows)


def written(text: str, table: str) -> str:
    """The README's text with this table between the marks.

    Raises:
        ValueError: the marks are not there.
    """
    first, last = MARKS
    if not 0 <= text.find(first) < text.find(last):
        raise ValueError(f"README.md: the marks {first} and {last} are not there, in this order; put them back")
    return f"{text[: text.index(first)]}{first}\n{table}\n{text[text.index(last) :]}"


def main(argv: Sequence[str] | None = None) -> int:
    """The command line; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="write the table into experiments/README.md")
    args = parser.parse_args(argv)
    from reproduce import PAPER

    found, results = claims(), HERE / "results"
    wrong = faults(found, PAPER, results)
    print("\n".join(wrong) or f"{len(found)} claims, every number as the results have it")
    if args.write:
        readme = HERE / "README.md"
        readme.write_text(written(readme.read_text(encoding="utf-8"), lines(found, results)), encoding="utf-8")
        print(f"wrote {readme}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
