"""From words to arguments: what a command is, the options that all share, and the types of their values."""

from __future__ import annotations

import argparse
import difflib
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, NoReturn

from august_jax import __version__
from august_jax import config as configuration
from august_jax.app.cli.messages import UsageError
from august_jax.config import Bounds

_ASSIGNMENT = re.compile(r"[a-z_]\w*(\.\w+)*=")
_SIGNED = ("--azimuth", "--elevation", "--forward", "--index", "--pitch", "--position", "--roll", "--snr", "--transmit",
           "--up", "--yaw")  # fmt: skip
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
    """

    summary: str
    arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], dict[str, Any]]
    configured: bool = True


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        unknown = re.match(r"unrecognized arguments: (\S+)", message)
        if unknown:
            known = [option.strip("-") for option in _options(self)]
            near = difflib.get_close_matches(unknown[1].strip("-").partition("=")[0], known, n=1)
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
    top.add_argument("command", nargs="?", help=argparse.SUPPRESS)
    if not words or words[0].startswith("-"):
        try:
            top.parse_args(words)
        except SystemExit:  # --help and --version have printed
            return None
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
    parser = _Parser(
        prog=f"august {name}",
        description=command.summary,
        allow_abbrev=False,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    command.arguments(parser)
    if command.configured:
        parser.add_argument("--preset", metavar="NAME", help=f"one of {', '.join(configuration.PRESETS)}")
    parser.add_argument("--out", metavar="DIR", help="where to write")
    parser.add_argument("--json", action="store_true", help="the result as JSON on stdout")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.add_argument(
        "rest",
        nargs="*",
        metavar="section.field=value",
        help="overrides of the configuration" if command.configured else argparse.SUPPRESS,
    )
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
    args.overrides = [text for text in args.rest if _ASSIGNMENT.match(text)]
    args.rest = [text for text in args.rest if not _ASSIGNMENT.match(text)]
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

    return read


def number(bounds: Bounds | str) -> Callable[[str], float]:
    """An argparse type: a finite number within bounds, or those of the field that is named."""
    read = numbers(1, bounds)
    return lambda text: read(text)[0]


def whole(low: int = 0, high: int = 2**31 - 1) -> Callable[[str], int]:
    """An argparse type: a whole number from ``low`` to ``high``."""

    def read(text: str) -> int:
        if not re.fullmatch("-?[0-9]{1,20}", text) or not low <= int(text) <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {low} to {high}")
        return int(text)

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
