"""What the command line says: lines for the reader, lines of progress, tables, and errors in at most six lines."""

from __future__ import annotations

import argparse
import errno
import re
import shlex
import sys
import textwrap
from collections.abc import Collection, Sequence
from typing import Any

from august_jax.app.cli.clock import heard, wipe
from august_jax.app.devices import describe_backend_error

_MOST_LINES = 6
FLAGS = {
    "airframe": "--airframe",
    "conductivity": "--conductivity",
    "coordinator": "--coordinator",
    "data": "--data",
    "devices": "--devices",
    "folder": "--out",
    "forward": "--forward",
    "half_wheelbase": "--half-wheelbase",
    "half_wheelbase_m": "--half-wheelbase",
    "host": "--host",
    "index": "--index",
    "mesh": "--mesh",
    "out_dir": "--out",
    "part": "--shard",
    "permittivity": "--permittivity",
    "pitch": "--pitch",
    "pitch_deg": "--pitch",
    "position": "--position",
    "position_m": "--position",
    "predictor": "--predictor",
    "preset": "--preset",
    "roll": "--roll",
    "roll_deg": "--roll",
    "run": "--run",
    "scheme": "--scheme",
    "schemes": "--schemes",
    "seed": "--seed",
    "shard": "--shard",
    "slots": "--slots",
    "style": "--style",
    "snr": "--snr",
    "snr_db": "--snr",
    "unit": "--unit",
    "up": "--up",
    "weights": "--init",
    "yaw": "--yaw",
    "yaw_deg": "--yaw",
}
"""Argument of the library -> option that gives it. The library's messages name arguments; here alone are they
translated."""
_WAYS_OUT = {
    errno.ENOSPC: "make room there, or choose another --out",
    errno.EDQUOT: "make room in your quota, or choose another --out",
    errno.EROFS: "nothing can be written there; choose another --out",
    errno.EACCES: "ask for the right to it, or choose another folder",
    errno.EPERM: "ask for the right to it, or choose another folder",
}
"""Of what the system refuses."""
_NAMES = "|".join(sorted(FLAGS, key=len, reverse=True))
_LEADING = re.compile(rf"((?:{_NAMES})(?:, (?:{_NAMES}))*)(?=:)")
_GIVEN = re.compile(rf"(?<![\w./-])({_NAMES})=(\([^)]*\)|[^\s,;:)]+)")


class UsageError(Exception):
    """The arguments do not fit the command."""


def say(args: argparse.Namespace, text: str) -> None:
    """A line for the reader: on stdout, or on stderr where stdout is for JSON."""
    wipe()
    print(text, file=sys.stderr if args.json else sys.stdout, flush=True)


def note(text: str) -> None:
    """A line of progress, on stderr."""
    wipe()
    print(text, file=sys.stderr, flush=True)
    heard(text)


def hush() -> None:
    """Leave out what libraries print of errors in callbacks of theirs: the command tells the error that counts."""
    sys.excepthook = lambda *_: None
    sys.unraisablehook = lambda *_: None


def command_line(*words: str) -> str:
    """A line that a shell takes back as it is: ``august`` with these words, quoted where they need it."""
    return shlex.join(["august", *words])


def options(args: argparse.Namespace, *names: str) -> list[str]:
    """The words that give these options again, such as ``--unit mm``; none for those that were not given."""
    words = []
    for name in names:
        value = getattr(args, name)
        if value is not None:
            words += [f"--{name.replace('_', '-')}", worded(value)]
    return words


def worded(value: Any) -> str:
    """The value of an option as it is typed: numbers of one option stand between commas."""
    if type(value) is tuple:
        return ",".join(map(worded, value))
    return f"{value:.12g}" if isinstance(value, float) else str(value)


def in_flags(text: str, options: Collection[str]) -> str:
    """A message of the library in the words of the command line.

    ``snr_db: 300 ...`` becomes ``--snr: 300 ...``, and ``try position=(5, 6, 3.5)`` ``try --position 5,6,3.5``.

    Args:
        text: the message.
        options: those that the command takes; arguments that it gets otherwise keep their names.
    """

    def named(found: re.Match[str]) -> str:
        flags = [FLAGS[name] for name in found[1].split(", ")]
        return ", ".join(flags) if set(flags) <= set(options) else found[0]

    def given(found: re.Match[str]) -> str:
        flag = FLAGS[found[1]]
        return f"{flag} {found[2].strip('()').replace(', ', ',')}" if flag in options else found[0]

    lead = _LEADING.match(text)
    return (named(lead) if lead else "") + _GIVEN.sub(given, text[lead.end() if lead else 0 :])


def told(error: Exception, options: Collection[str] = ()) -> str:
    """At most six lines for any error: those meant for the user as they are, others with their kind.

    Args:
        error: what a command raised.
        options: those that the command takes, into which the library's arguments are translated.
    """
    text = str(error).strip()
    missing_device = describe_backend_error(error)
    if missing_device is not None:
        text = missing_device
    elif isinstance(error, OSError):
        text = f"{error.filename}: {error.strerror}" if error.filename else text
        text += f"; {_WAYS_OUT[error.errno]}" if error.errno in _WAYS_OUT else ""
    elif isinstance(error, ImportError):
        text = f"{text}; install again: pip install -c constraints.txt ."
    elif not isinstance(error, (ValueError, FloatingPointError, UsageError)):
        text = f"unexpected {type(error).__name__}: {text}\nadd --debug to see where"
    elif isinstance(error, ValueError):
        text = in_flags(text, options)
    lines = [
        part
        for line in f"august: {text or type(error).__name__}".splitlines()
        if line.strip()
        for part in _wrapped(line)
    ]
    return "\n".join(lines if len(lines) <= _MOST_LINES else [*lines[: _MOST_LINES - 1], "  ..."])


def _wrapped(line: str) -> list[str]:
    """A line in pieces of at most 160 letters; one that ends in a command to take over stays whole."""
    if re.search(r": (august|pip) ", line):
        return [line]
    return textwrap.wrap(line, 160, break_long_words=False, break_on_hyphens=False, subsequent_indent="  ")


def table(rows: Sequence[Sequence[str]], *, right: bool = True) -> str:
    """Rows of cells, aligned: the first column to the left, the others to the ``right``, or to the left as well."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if index and right else cell.ljust(width)
            for index, (cell, width) in enumerate(zip(row, widths))
        ).rstrip()
        for row in rows
    )


def scheme_table(rows: Sequence[dict[str, Any]], *, snr: bool) -> str:
    """Rows of metrics as text; with ``snr``, each with its SNR and the bound."""
    columns = [
        ("MPE [m]", "mpe_m", 3),
        ("+-", "mpe_se_m", 3),
        ("MDE", "mde", 4),
        ("triples", "mde_triples", 4),
        ("WD [dB]", "wd_db", 1),
        ("MCD [dB]", "mcd_db", 1),
    ]
    if snr:
        columns = [
            ("SNR [dB]", "snr_db", 0),
            *columns,
            ("along [m]", "along_m", 3),
            ("across", "across_m", 3),
            ("bound [m]", "bound_m", 3),
            ("of MDE", "bound_mde", 4),
        ]
    return table(
        [
            ["scheme", *(title for title, _, _ in columns)],
            *([row["scheme"], *(cell(row[name], digits) for _, name, digits in columns)] for row in rows),
        ]
    )


def search_table(rows: Sequence[dict[str, Any]]) -> str:
    """What rows say of searches among known craft, as text; empty where none does."""
    columns = [
        ("SNR [dB]", "snr_db", 0),
        ("slots", "count", 0),
        ("craft", "craft_accuracy", 2),
        ("chance", "craft_chance", 2),
        ("explained", "explained", 2),
        ("in 50 %", "inside_50", 2),
        ("in 90 %", "inside_90", 2),
        ("s/slot", "seconds", 1),
    ]
    told = [
        [row["scheme"], *(cell(row[name], digits) for _, name, digits in columns)]
        for row in rows
        if row["explained"] is not None
    ]
    return table([["scheme", *(title for title, _, _ in columns)], *told]) if told else ""


def expected_table(rows: Sequence[dict[str, Any]], thresholds: Sequence[dict[str, Any]]) -> str:
    """Errors beside those that a scheme expects of itself and the bound on the same slots, and where the two part, as
    text; empty where no scheme expects any."""
    columns = [
        ("SNR [dB]", "snr_db", 0),
        ("MPE [m]", "mpe_m", 3),
        ("expected", "expected_mpe_m", 3),
        ("off by x", "mpe_over_expected", 2),
        ("bound", "own_bound_m", 3),
        ("MDE", "mde", 4),
        ("expected", "expected_mde", 4),
        ("off by x", "mde_over_expected", 2),
        ("bound", "own_bound_mde", 4),
    ]
    told = [
        [row["scheme"], *(cell(row[name], digits) for _, name, digits in columns)]
        for row in rows
        if row["expected_mpe_m"] is not None
    ]
    parted = [
        f"{each['scheme']}: the expected error of its {each['of']} is within {each['within']:g} times the bound from: "
        f"{each['said']}"
        for each in thresholds
    ]
    return "\n".join([table([["scheme", *(title for title, _, _ in columns)], *told]), *parted]) if told else ""


def cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
