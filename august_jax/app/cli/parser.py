"""From words to arguments: what a command is, the options that all share, and the types of their values."""

from __future__ import annotations

import argparse
import difflib
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from august_jax import __version__
from august_jax import config as configuration
from august_jax.app.cli.completion import SHELLS, completion
from august_jax.app.cli.messages import UsageError, worded
from august_jax.config import Bounds

_ASSIGNMENT = re.compile(r"[a-z_]\w*(\.\w+)*=")
_SIGNED = ("--azimuth", "--elevation", "--forward", "--index", "--pitch", "--position", "--roll", "--snr", "--transmit",
           "--rate", "--up", "--velocity", "--yaw")  # fmt: skip
"""Options whose value may begin with a minus sign."""


def presets_help() -> str:
    """The presets with what they take and what to expect, for the end of a command's help."""
    lines = [
        line
        for name, each in configuration.PRESETS.items()
        for line in textwrap.wrap(
            f"{name}: {each.summary}. Takes: {each.time}. Expect: {each.expected}.",
            100,
            initial_indent="  ",
            subsequent_indent="    ",
        )
    ]
    return "\n".join(["presets:", *lines])


ANGLE = Bounds(-360.0, 360.0, "degrees")


class Command(NamedTuple):
    """One command.

    Attributes:
        summary: what it does, in a line of the help.
        arguments: adds its own options to the parser.
        run: does it, with what :func:`parse` returned; its result is what ``--json`` prints.
        configured: whether it takes ``--preset`` and overrides.
        out: where it writes unless told otherwise, for the help.
        out_help: what ``--out`` is.
        first: how long it takes for the first time, in words.
    """

    summary: str
    arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], dict[str, Any]]
    configured: bool = True
    out: str = "."
    out_help: str = "where to write"
    first: str = ""


class _Formatter(argparse.RawDescriptionHelpFormatter):
    """Help that says of every option what it takes and what it is where it is left out."""

    def _get_help_string(self, action: argparse.Action) -> str:
        text = action.help or ""
        if not action.option_strings or action.nargs == 0 or text == argparse.SUPPRESS:
            return text
        notes = [str(takes)] if (takes := getattr(action.type, "takes", None)) else []
        if action.choices is None and "default" not in text:
            notes.append("required" if action.required else f"default {_shown(action.default)}")
        elif action.choices is not None and "default" not in text:
            notes.append(f"one of {', '.join(map(str, action.choices))}; default {_shown(action.default)}")
        return f"{text} [{'; '.join(notes)}]" if notes else text


def _shown(value: Any) -> str:
    """A default as it would be typed."""
    return "none" if value is None else worded(value)


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        unknown = re.match(r"unrecognized arguments: (\S+)", message)
        if unknown:
            known = [option.strip("-") for option in _options(self)]
            near = difflib.get_close_matches(unknown[1].strip("-").partition("=")[0], known, n=1, cutoff=0.65)
            hint = f"; did you mean --{near[0]}?" if near else "; overrides are of the form section.field=value"
            message = f"unknown argument {unknown[1]!r}{hint}"
        raise UsageError(f"{message}\nsee: {self.prog} --help")


def _options(parser: argparse.ArgumentParser) -> list[str]:
    return [option for action in parser._actions for option in action.option_strings]


def parse(words: Sequence[str], commands: Mapping[str, Command]) -> argparse.Namespace | None:
    """The arguments of one command, with ``command``, ``options`` (that it takes), ``words`` (as they were given),
    ``overrides`` and ``rest``; None where help was all.

    Raises:
        UsageError: the words do not fit.
    """
    top = _Parser(
        prog="august",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        add_help=True,
        allow_abbrev=False,
        usage="august COMMAND [options] [section.field=value ...]",
        description="Sense a drone with one antenna array: simulate its echo, reconstruct its 5-D point cloud.",
        epilog="commands:\n"
        + "\n".join(f"  {name:12s} {each.summary}" for name, each in commands.items())
        + "\n\nstart here: august demo\neach command explains itself: august COMMAND --help",
    )
    top.add_argument("--version", action="version", version=f"august_jax {__version__}")
    top.add_argument(
        "--completion", choices=SHELLS, help=f"print what completes commands and options in {' or '.join(SHELLS)}"
    )
    top.add_argument("command", nargs="?", help=argparse.SUPPRESS)
    if not words or words[0].startswith("-"):
        try:
            asked = top.parse_args(words)
        except SystemExit:  # --help and --version have printed
            return None
        if asked.completion:
            print(completion({name: parser_of(name, each) for name, each in commands.items()}, asked.completion))
        else:
            top.print_help()
        return None
    name = words[0]
    if name not in commands:
        near = difflib.get_close_matches(name, commands, n=1)
        raise UsageError(
            f"unknown command {name!r}; "
            + (f"did you mean {near[0]!r}? " if near else "")
            + f"choose one of {', '.join(commands)}"
        )
    command = commands[name]
    parser = parser_of(name, command)
    try:
        args = parser.parse_intermixed_args(_join_signed(words[1:]))
    except SystemExit:
        return None
    for each, value in vars(args).items():
        if value == "":
            raise UsageError(
                f"--{each.replace('_', '-')}: '' is empty; leave it out, or give a value\nsee: august {name} --help"
            )
    if "" in args.rest:
        raise UsageError(f"'': an empty argument; leave it out, or give a value\nsee: august {name} --help")
    args.command, args.options, args.words = name, tuple(_options(parser)), tuple(words)
    args.overrides = [text for text in args.rest if _is_override(text)]
    args.rest = [text for text in args.rest if not _is_override(text)]
    if args.overrides and not command.configured:
        raise UsageError(
            f"{args.overrides[0]!r}: august {name} has no configuration to override\nsee: august {name} --help"
        )
    wanted = getattr(args, "places", 0)
    if len(args.rest) > wanted:
        raise UsageError(
            f"{args.rest[wanted]!r}: unexpected argument; overrides are of the form section.field=value\n"
            f"see: august {name} --help"
        )
    return args


def _is_override(text: str) -> bool:
    """Fields have a section: what has none and is there is a folder, such as ``lr=3e-4``."""
    return bool(_ASSIGNMENT.match(text)) and ("." in text.partition("=")[0] or not Path(text).exists())


def parser_of(name: str, command: Command) -> argparse.ArgumentParser:
    """What reads the words after ``august NAME``."""
    parser = _Parser(prog=f"august {name}", description=command.summary, allow_abbrev=False, formatter_class=_Formatter)
    command.arguments(parser)
    if command.configured:
        parser.add_argument(
            "--preset",
            metavar="NAME",
            help=f"one of {', '.join(configuration.PRESETS)} (default: that of the weights or the data, else laptop)",
        )
    parser.add_argument("--out", metavar="DIR", help=f"{command.out_help} (default: {command.out})")
    parser.add_argument("--json", action="store_true", help="the result as JSON on stdout")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.add_argument(
        "rest",
        nargs="*",
        metavar="section.field=value",
        help="overrides of the configuration, of docs/configuration.md" if command.configured else argparse.SUPPRESS,
    )
    return parser


_PLACES = ("out", "seed", "json", "debug", "command", "options", "words", "places", "rest")
"""Arguments that do not change how long a command takes."""


def errand(args: argparse.Namespace) -> str:
    """The command with all that it was asked that may change how long it takes."""
    asked = {name: value for name, value in sorted(vars(args).items()) if name not in _PLACES and value is not None}
    return f"{args.command} {asked}"


def _join_signed(words: Sequence[str]) -> list[str]:
    """``--up -z`` becomes ``--up=-z``, which argparse does not mistake for an option."""
    joined: list[str] = []
    for text in words:
        if joined and joined[-1] in _SIGNED and re.match(r"-[\dxyz.]", text):
            joined[-1] += f"={text}"
        else:
            joined.append(text)
    return joined


def numbers(count: int, bounds: Bounds | str) -> Callable[[str], tuple[float, ...]]:
    """An argparse type: ``count`` numbers separated by commas, within bounds or those of the field that is named."""
    within = configuration.bounds(bounds) if isinstance(bounds, str) else bounds

    def read(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count or not all(abs(value) < float("inf") for value in values):
            shape = ",".join("xyz"[:count]) if count > 1 else "a number"
            raise argparse.ArgumentTypeError(f"{text!r} is not {shape}, e.g. {'5,6,3.5' if count > 1 else '20'}")
        complaint = within(values)
        if complaint:
            raise argparse.ArgumentTypeError(f"{text} {complaint}")
        return values

    read.takes = f"{'each ' if count > 1 else ''}{within}"  # type: ignore[attr-defined]
    return read


def number(bounds: Bounds | str) -> Callable[[str], float]:
    """An argparse type: a finite number within bounds, or those of the field that is named."""
    read = numbers(1, bounds)

    def alone(text: str) -> float:
        return read(text)[0]

    alone.takes = read.takes  # type: ignore[attr-defined]
    return alone


def whole(low: int = 0, high: int = 2**31 - 1) -> Callable[[str], int]:
    """An argparse type: a whole number from ``low`` to ``high``."""

    def read(text: str) -> int:
        if not re.fullmatch("-?[0-9]{1,20}", text) or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high}")
        return int(text)

    read.takes = f"{low} to {high}"  # type: ignore[attr-defined]
    return read


def name(*known: str, other: str = "") -> Callable[[str], str]:
    """An argparse type: one of the ``known`` names, or an ``other``, as the help says; what it is given to judges it,
    whose error says more."""

    def read(text: str) -> str:
        return text

    read.takes = f"one of {', '.join(known)}" + (f", or {other}" if other else "")  # type: ignore[attr-defined]
    read.known = known  # type: ignore[attr-defined]
    return read


def seed_and_snr(parser: argparse.ArgumentParser, drawn: str) -> None:
    """``--seed``, of what is ``drawn``, and ``--snr``, of the echo."""
    parser.add_argument("--seed", type=whole(), default=0, metavar="N", help=f"of {drawn} (default 0)")
    parser.add_argument(
        "--snr", type=number("signal.snr_db"), default=20.0, metavar="DB", help="SNR of the echo [dB] (default 20)"
    )


def part(text: str) -> tuple[int, int]:
    """An argparse type: ``i/n`` with 1 <= i <= n."""
    found = re.fullmatch(r"([0-9]{1,9})/([0-9]{1,9})", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form i/n with 1 <= i <= n, e.g. 1/4")
    return int(found[1]), int(found[2])


part.takes = "I from 1 to N"  # type: ignore[attr-defined]
