"""The command line: ``august doctor | demo | simulate | train | evaluate | reconstruct | export``.

Here arguments become a configuration and a call, and results become lines and files; what is computed lives elsewhere.
Results go to stdout (as JSON with ``--json``), progress to stderr. The exit status is 0; or 2 with at most six lines on
stderr that name the field, the value and the way out; or 130 after Ctrl-C. Nothing is left half-written.

Only the standard library and the configuration are imported at the top, so that ``--help`` answers at once.
"""

from __future__ import annotations

import argparse
import dataclasses
import difflib
import errno
import json
import os
import re
import sys
import textwrap
import time
import warnings
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from august_jax import __version__
from august_jax import config as configuration
from august_jax.config import Config, ConfigError

_ASSIGNMENT = re.compile(r"[a-z_]\w*(\.\w+)*=")
_SIGNED = ("--position", "--up", "--forward", "--yaw", "--pitch", "--roll", "--snr", "--index")
"""Options whose value may begin with a minus sign."""
_MAX_LINES = 6


class _UsageError(Exception):
    """The arguments do not fit the command."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str):
        unknown = re.match(r"unrecognized arguments: (\S+)", message)
        if unknown:
            known = [option for action in self._actions for option in action.option_strings]
            near = difflib.get_close_matches(unknown[1], known, n=1)
            hint = f"; did you mean {near[0]}?" if near else "; overrides are of the form section.field=value"
            message = f"unknown argument {unknown[1]!r}{hint}"
        raise _UsageError(f"{message}\nsee: {self.prog} --help")


class _Command(NamedTuple):
    summary: str
    arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], dict[str, Any]]
    configured: bool = True  # takes --preset and overrides


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    argv = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in argv
    if not debug:
        os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA's remarks on its own compile times
    try:
        args = _parse(argv)
        if args is None:
            return 0
        with warnings.catch_warnings():
            warnings.showwarning = lambda message, *_: _note(f"august: note: {message}")
            result = _COMMANDS[args.command].run(args)
        if args.json:
            print(json.dumps(result, allow_nan=False))
        if result.get("failed"):
            print(f"august: {result['failed']}", file=sys.stderr)
            return 2
        return 0
    except BrokenPipeError:  # the reader, `head` for example, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        print("august: interrupted; finished files are kept, nothing is half-written", file=sys.stderr)
        return 130
    except Exception as error:
        if debug:
            raise
        print(_message(error), file=sys.stderr)
        return 2


def _message(error: Exception) -> str:
    """At most six lines for any error: those meant for the user as they are, others with their kind."""
    text = str(error).strip()
    if isinstance(error, OSError):
        text = f"{error.filename}: {error.strerror}" if error.filename else text
        text += "; make room there, or choose another --out" if error.errno == errno.ENOSPC else ""
    elif isinstance(error, ImportError):
        text = f"{text}; install again: pip install -c constraints.txt ."
    elif not isinstance(error, (ValueError, FloatingPointError, _UsageError)):
        text = f"unexpected {type(error).__name__}: {text}\nadd --debug to see where"
    lines = [part for line in f"august: {text or type(error).__name__}".splitlines() if line.strip()
             for part in textwrap.wrap(line, 160, break_long_words=False, subsequent_indent="  ")]
    return "\n".join(lines if len(lines) <= _MAX_LINES else [*lines[:_MAX_LINES - 1], "  ..."])


def _parse(argv: list[str]) -> argparse.Namespace | None:
    top = _Parser(
        prog="august", formatter_class=argparse.RawDescriptionHelpFormatter, add_help=True, allow_abbrev=False,
        usage="august COMMAND [options] [section.field=value ...]",
        description="Sense a drone with one antenna array: simulate its echo, reconstruct its 5-D point cloud.",
        epilog="commands:\n" + "\n".join(f"  {name:12s} {each.summary}" for name, each in _COMMANDS.items())
        + "\n\nstart here: august demo\neach command explains itself: august COMMAND --help",
    )
    top.add_argument("--version", action="version", version=f"august_jax {__version__}")
    top.add_argument("command", nargs="?", help=argparse.SUPPRESS)
    if not argv or argv[0].startswith("-"):
        try:
            top.parse_args(argv)
        except SystemExit:  # --help and --version have printed
            return None
        top.print_help()
        return None
    name = argv[0]
    if name not in _COMMANDS:
        near = difflib.get_close_matches(name, _COMMANDS, n=1)
        raise _UsageError(f"unknown command {name!r}; " + (f"did you mean {near[0]!r}? " if near else "")
                          + f"choose one of {', '.join(_COMMANDS)}")
    command = _COMMANDS[name]
    parser = _Parser(prog=f"august {name}", description=command.summary, allow_abbrev=False)
    command.arguments(parser)
    if command.configured:
        parser.add_argument("--preset", metavar="NAME", help=f"one of {', '.join(configuration.PRESETS)}")
    parser.add_argument("--out", metavar="DIR", help="where to write")
    parser.add_argument("--json", action="store_true", help="the result as JSON on stdout")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    parser.add_argument("rest", nargs="*", metavar="section.field=value",
                        help="overrides of the configuration" if command.configured else argparse.SUPPRESS)
    try:
        args = parser.parse_intermixed_args(_join_signed(argv[1:]))
    except SystemExit:
        return None
    args.command = name
    args.overrides = [text for text in args.rest if _ASSIGNMENT.match(text)]
    args.rest = [text for text in args.rest if not _ASSIGNMENT.match(text)]
    if args.overrides and not command.configured:
        raise _UsageError(f"{args.overrides[0]!r}: august {name} has no configuration to override\n"
                          f"see: august {name} --help")
    wanted = getattr(args, "places", 0)
    if len(args.rest) > wanted:
        raise _UsageError(f"{args.rest[wanted]!r}: unexpected argument; overrides are of the form section.field=value\n"
                          f"see: august {name} --help")
    return args


def _join_signed(argv: list[str]) -> list[str]:
    """``--up -z`` becomes ``--up=-z``, which argparse does not mistake for an option."""
    joined: list[str] = []
    for text in argv:
        if joined and joined[-1] in _SIGNED and re.match(r"-[\dxyz.]", text):
            joined[-1] += f"={text}"
        else:
            joined.append(text)
    return joined


_MARKS = {"manifest.json": "august simulate", "checkpoints": "august train", "weights.npz": "august train",
          "clouds.npz": "august demo or august reconstruct"}
"""What is in a folder -> which command keeps its config.yaml there."""


def _folder(args: argparse.Namespace, default: str, *, configured: bool = False) -> Path:
    """Where the command writes; refused before the work where nothing can be written there.

    With ``configured``, also refused where the ``config.yaml`` is another command's.
    """
    if args.out == "":
        raise ConfigError("--out: '' names no folder; leave it out, or give one")
    out = Path(args.out or default)
    for mark, owner in _MARKS.items():
        if configured and (out / mark).exists() and f"august {args.command}" not in owner:
            raise ConfigError(f"--out: {out} holds what {owner} wrote ({mark}), which august {args.command} would "
                              "damage; choose another folder")
    parent = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise ConfigError(f"--out: nothing can be written to {out}, because {parent} is "
                          f"{'read-only' if parent.is_dir() else 'a file'}; choose another folder")
    return out


def _say(args: argparse.Namespace, text: str) -> None:
    """A line for the reader: on stdout, or on stderr where stdout is for JSON."""
    print(text, file=sys.stderr if args.json else sys.stdout, flush=True)


def _note(text: str) -> None:
    """A line of progress."""
    print(text, file=sys.stderr, flush=True)


def _config(args: argparse.Namespace) -> Config:
    """The preset (``laptop`` unless named) with its overrides."""
    return configuration.override(configuration.preset(args.preset or "laptop"), args.overrides)


def _weights(args: argparse.Namespace, run: str | None):
    """Networks, and their configuration with the overrides that they allow."""
    from august_jax import pipeline

    networks = pipeline.load_networks(run)
    if args.preset:
        configuration.preset(args.preset)  # refuses unknown ones
    if args.preset and args.preset != networks.config.preset:
        raise ConfigError(
            f"preset: {args.preset!r}, but these weights were trained with preset {networks.config.preset!r}\n"
            f"train your own: august simulate --preset {args.preset}, then august train --preset {args.preset}"
        )
    config = configuration.override(networks.config, args.overrides)
    for path, has, wanted in _differences(networks.config, config, ("array", "region", "model", "flight.box_m")):
        raise ConfigError(f"{path}={wanted}: the weights were trained with {has} and only fit that\n"
                          "train weights of your own (august simulate, august train) to change it")
    return networks, config


def _differences(first: Config, second: Config, sections: Sequence[str]) -> list[tuple[str, Any, Any]]:
    """Fields below ``sections`` in which two configurations differ: (path, value in the first, in the second)."""
    left, right = _leaves(configuration.to_dict(first)), _leaves(configuration.to_dict(second))
    return [(path, left[path], right[path]) for path in left
            if any(path == each or path.startswith(each + ".") for each in sections) and left[path] != right[path]]


def _leaves(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat.update(_leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value})
    return flat


def _numbers(count: int) -> Callable[[str], tuple[float, ...]]:
    """An argparse type: ``count`` numbers separated by commas."""
    def read(text: str) -> tuple[float, ...]:
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) != count or not all(abs(value) < float("inf") for value in values):
            shape = ",".join("xyz"[:count]) if count > 1 else "a number"
            raise argparse.ArgumentTypeError(f"{text!r} is not {shape}, e.g. {'5,6,3.5' if count > 1 else '20'}")
        return values
    return read


def _number(text: str) -> float:
    return _numbers(1)(text)[0]


def _natural(text: str) -> int:
    if not re.fullmatch("[0-9]{1,20}", text) or int(text) >= 2**31:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 0 up to 2^31 - 1")
    return int(text)


def _part(text: str) -> tuple[int, int]:
    found = re.fullmatch(r"(\d+)/(\d+)", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise argparse.ArgumentTypeError(f"{text!r} is not of the form i/n with 1 <= i <= n, e.g. 1/4")
    return int(found[1]), int(found[2])


def _table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of cells, aligned: the first column to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows)]
    return "\n".join("  ".join(cell.ljust(width) if index == 0 else cell.rjust(width)
                               for index, (cell, width) in enumerate(zip(row, widths))).rstrip() for row in rows)


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _scheme_table(rows: Sequence[dict[str, Any]], snr: bool) -> str:
    """Rows of metrics as text; with ``snr``, each with its SNR and the bound."""
    columns = [("MPE [m]", "mpe_m", 3), ("+-", "mpe_se_m", 3), ("MDE", "mde", 4), ("triples", "mde_triples", 4),
               ("WD [dB]", "wd_db", 1), ("MCD [dB]", "mcd_db", 1)]
    if snr:
        columns = [("SNR [dB]", "snr_db", 0), *columns, ("along [m]", "along_m", 3), ("across", "across_m", 3),
                   ("bound [m]", "bound_m", 3), ("of MDE", "bound_mde", 4)]
    return _table([["scheme", *(title for title, _, _ in columns)],
                   *([row["scheme"], *(_cell(row[name], digits) for _, name, digits in columns)] for row in rows)])


# ---- doctor -----------------------------------------------------------------------------------------------------


def _doctor_arguments(parser: argparse.ArgumentParser) -> None:
    pass


def _doctor(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax import doctor

    checks = []
    for check in doctor.examine(Path(args.out or ".")):
        checks.append(check)
        _say(args, f"{ {True: 'pass', False: 'FAIL', None: 'none'}[check.passed] }  {check.name:12s} {check.detail}")
    failed = [check.name for check in checks if check.passed is False]
    if not failed:
        _say(args, "all is well; next: august demo")
    return {"checks": [check._asdict() for check in checks],
            "failed": f"failed: {', '.join(failed)}; the lines above say why" if failed else None}


# ---- demo and reconstruct ---------------------------------------------------------------------------------------


def _demo_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seed", type=_natural, default=0, metavar="N", help="of flight, material, noise (default 0)")
    parser.add_argument("--snr", type=_number, default=20.0, metavar="DB", help="SNR of the echo [dB] (default 20)")
    parser.add_argument("--slots", type=_natural, default=12, metavar="N", help="length of the flight (default 12)")
    parser.add_argument("--airframe", metavar="NAME", help="a procedural airframe (default: drawn)")
    parser.add_argument("--run", metavar="RUN", help="weights of your own training run (default: the shipped ones)")


def _demo(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax import pipeline

    started = time.monotonic()
    networks, config = _weights(args, args.run)
    shot = pipeline.draw_flight(config, args.seed, args.slots, args.airframe)
    _note(f"{shot.airframe.name} flies {args.slots} slots, permittivity {shot.permittivity:.2f}, "
          f"conductivity {1e3 * shot.conductivity:.1f} mS/m")
    return _sense(args, networks, config, shot, started, following=[
        ("august reconstruct --mesh FILE --half-wheelbase 0.25" + _own(args), "your own drone, in any pose"),
        ("august demo --seed 1 --snr 30" + _own(args), "another flight, at a better SNR"),
    ])


def _own(args: argparse.Namespace) -> str:
    """The option that names the weights again, for a command line to try next."""
    return f" --run {args.run}" if args.run else ""


def _reconstruct_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--mesh", required=True, metavar="FILE", help="OBJ, STL, PLY, GLB, or DAE with the extra [dae]")
    parser.add_argument("--unit", default="m", help="of the file: m, cm, mm, in, ft, or metres a unit (default m)")
    parser.add_argument("--up", default="z", metavar="AXIS", help="the file's upward axis (default z)")
    parser.add_argument("--forward", default="x", metavar="AXIS", help="the file's forward axis (default x)")
    parser.add_argument("--half-wheelbase", type=_number, metavar="M", help="scale to this half-wheelbase [m]")
    parser.add_argument("--position", type=_numbers(3), metavar="X,Y,Z", help="[m] (default: the flight box's centre)")
    for angle in ("yaw", "pitch", "roll"):
        parser.add_argument(f"--{angle}", type=_number, default=0.0, metavar="DEG", help="[deg] (default 0)")
    parser.add_argument("--permittivity", type=_number, metavar="EPS", help="relative (default: mid-range)")
    parser.add_argument("--conductivity", type=_number, metavar="S", help="[S/m] (default: mid-range)")
    parser.add_argument("--snr", type=_number, default=20.0, metavar="DB", help="SNR of the echo [dB] (default 20)")
    parser.add_argument("--seed", type=_natural, default=0, metavar="N", help="of prediction and noise (default 0)")
    parser.add_argument("--run", metavar="RUN", help="weights of your own training run (default: the shipped ones)")


def _reconstruct(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax import pipeline
    from august_jax.scene import load_airframe

    started = time.monotonic()
    airframe = load_airframe(args.mesh, unit=args.unit, up=args.up, forward=args.forward,
                             half_wheelbase_m=args.half_wheelbase)
    networks, config = _weights(args, args.run)
    shot = pipeline.pose(networks.config, airframe, position=args.position, yaw_deg=args.yaw, pitch_deg=args.pitch,
                         roll_deg=args.roll, permittivity=args.permittivity, conductivity=args.conductivity)
    _note(f"{airframe.name}: half-wheelbase {airframe.half_wheelbase_m:.3f} m, at "
          f"({', '.join(f'{value:.2f}' for value in shot.positions[0])}) m")
    return _sense(args, networks, config, shot, started, following=[
        (f"august reconstruct --mesh {args.mesh} --snr 30 --yaw 45 --pitch 15" + _own(args),
         "another pose, at a better SNR; with your --unit, --up, --forward and --half-wheelbase"),
    ])


def _sampler_steps(config: Config) -> int:
    return config.evaluate.sampler_steps if config.evaluate.sampler == "dpm" else config.model.steps


def _sense(args, networks, config: Config, shot, started: float, following) -> dict[str, Any]:
    from august_jax import evaluation, pipeline, plotting, report
    from august_jax.export import write_ply, write_record
    from august_jax.files import write_text

    command = args.command
    out = _folder(args, f"august_{command}", configured=True)
    following = [*following, (f"august evaluate {args.run + ' ' if args.run else ''}--seed 1",
                              "the accuracy over SNR, beside its baselines"),
                 (f"august export {out} --format mat", "the clouds for MATLAB")]
    track = pipeline.sense(networks, config, shot, seed=args.seed, snr_db=args.snr, progress=_note)
    scores = evaluation.score_track(track, config, shot.airframe.half_wheelbase_m)
    seconds = time.monotonic() - started
    mean = {row["scheme"]: row for row in scores["schemes"]}
    slots = len(track.time_s)
    lead = (
        f"{'Over ' + str(slots) + ' slots the' if slots > 1 else 'The'} reconstructed cloud puts the drone "
        f"{100 * mean['august']['mpe_m']:.1f} cm from where it is{' on average' if slots > 1 else ''}; "
        f"the prediction it starts from is {100 * mean['prior']['mpe_m']:.1f} cm off."
    )
    title = f"{shot.airframe.name} at {args.snr:g} dB, seen by {config.array.count} antennas"
    setup = [
        ("weights", networks.name),
        ("array", f"{config.array.nx} x {config.array.nz} at "
                  f"{', '.join(f'{tone / 1e9:g}' for tone in config.array.frequencies_hz)} GHz"),
        ("drone", f"{shot.airframe.name}, half-wheelbase {shot.airframe.half_wheelbase_m:.3f} m"),
        ("material", f"permittivity {track.permittivity:.2f}, conductivity {1e3 * track.conductivity:.2f} mS/m"),
        ("channel", f"full-wave ({config.data.solver}), {config.signal.estimator} estimate"),
        ("sampler", f"{config.evaluate.sampler}, {_sampler_steps(config)} steps, {config.target.points} points"),
        ("first predictions", f"uniform within {config.region.threshold_m:g} m along each axis, as of a detection"),
        ("seed", str(args.seed)),
        ("computed in", f"{seconds:.0f} s"),
    ]
    metrics = {"command": command, "snr_db": args.snr, "seed": args.seed, "seconds": round(seconds, 1),
               "weights": networks.name, "airframe": shot.airframe.name, **scores}
    span = {"permittivity": config.target.permittivity, "conductivity": config.target.conductivity_s_m}
    write_record(out / "clouds.npz", track.record())
    write_ply(out / "cloud.ply", track.points[-1], track.point_permittivity[-1], track.point_conductivity[-1])
    write_text(out / "metrics.json", json.dumps(metrics, indent=1, allow_nan=False))
    write_text(out / "config.yaml", configuration.to_yaml(config))
    plotting.clouds(track, out / f"{command}.png", permittivity=span["permittivity"], title=title)
    report.write_report(out / "report.html", track, scores, title=title, lead=lead, note=evaluation.NOTE, setup=setup,
                        following=following, **span)
    files = ["report.html", f"{command}.png", "cloud.ply", "metrics.json", "config.yaml", "clouds.npz"]
    _say(args, f"\n{title}\n{lead}\n")
    _say(args, _scheme_table(scores["schemes"], snr=False))
    _say(args, f"\nwritten in {seconds:.0f} s to {out}/: {', '.join(files)}")
    _say(args, f"look:  {(out / 'report.html').resolve().as_uri()}")
    for command_line, why in following[:2]:
        _say(args, f"next:  {command_line}   # {why}")
    return {"out": str(out), "files": files, **metrics}


# ---- simulate ---------------------------------------------------------------------------------------------------


def _simulate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--shard", type=_part, default=(1, 1), metavar="I/N", help="make the i-th of n parts alone")
    parser.add_argument("--verify", action="store_true",
                        help="read what is there, compare its check sums, and make damaged pieces again")


def _simulate(args: argparse.Namespace) -> dict[str, Any]:
    config = _config(args)
    out = _folder(args, f"august_data/{config.preset}", configured=True)
    from august_jax.data import simulate

    manifest = simulate(config, out, part=args.shard, verify=args.verify, report=_note)
    done = manifest["rows"] >= manifest["wanted"]
    _say(args, f"{manifest['written']} samples written in {manifest['seconds']:.0f} s "
               f"({manifest['samples_per_s']:.1f} samples/s); {out}/ now holds {manifest['rows']} of "
               f"{manifest['wanted']}")
    _say(args, f"next:  august train --preset {config.preset} --data {out}" if done else
         "next:  the other parts, with --shard, or the same command without it")
    return {"out": str(out), "digest": manifest["digest"],
            **{name: manifest[name] for name in ("rows", "wanted", "written", "seconds", "samples_per_s")}}


# ---- train ------------------------------------------------------------------------------------------------------


def _train_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--data", metavar="DIR", help="what august simulate wrote (default: august_data/PRESET)")
    parser.add_argument("--init", metavar="RUN",
                        help="start from another run's weights, or from the shipped ones (--init shipped)")


def _train(args: argparse.Namespace) -> dict[str, Any]:
    preset = args.preset or "laptop"
    folder = Path(args.data or f"august_data/{preset}")
    if not (folder / "manifest.json").exists():
        _config(args)  # other mistakes are told first
        raise ConfigError(f"--data: {folder} holds no data (no manifest.json)\n"
                          f"make them: august simulate --preset {preset} --out {folder}")
    from august_jax import pipeline
    from august_jax.data import Dataset, TrainingBatches
    from august_jax.evaluation import validator
    from august_jax.plotting import training_curves
    from august_jax.training.loop import train

    weights = pipeline.run_files(None if args.init == "shipped" else args.init)[1] if args.init else None
    dataset = Dataset(folder)
    config = _training_config(args, dataset.config, folder)
    batches = TrainingBatches(dataset, config)
    out = _folder(args, f"august_runs/{config.preset}", configured=True)
    _note(f"{len(dataset.rows('train'))} of {dataset.count} samples are for training, {config.train.steps} steps")
    state = train(config, batches, out, validate=validator(dataset, config), draw=training_curves,
                  weights=weights, printer=_note)
    metrics = out / "metrics.jsonl"
    logged = metrics.read_text().splitlines() if metrics.exists() else []  # gone where nothing was left to train
    last = json.loads(logged[-1]) if logged else {}
    _say(args, f"trained to step {int(state.step)}: " + "  ".join(f"{name} {value:.4g}" for name, value in last.items()
                                                                  if name not in ("step", "seconds_left")))
    _say(args, f"written to {out}/: weights.npz, config.yaml, metrics.jsonl, curves.png, checkpoints\n"
               f"next:  august evaluate {out} --seed 1")
    return {"out": str(out), "metrics": last}


def _training_config(args: argparse.Namespace, made: Config, folder: Path) -> Config:
    """The preset's networks and training on what the data say about themselves, with the overrides."""
    if args.preset and args.preset != made.preset:
        raise ConfigError(f"preset: {args.preset!r}, but the data in {folder} were made with preset {made.preset!r}\n"
                          f"pass --preset {made.preset}, or make other data with august simulate")
    sections = ("array", "target", "flight", "region", "signal", "data")
    base = dataclasses.replace(configuration.preset(made.preset), **{name: getattr(made, name) for name in sections})
    config = configuration.override(base, args.overrides)
    # what is observed anew in every step does not depend on how it was observed when the data were made
    fixed = sections[:3] + ("data",) + (() if config.train.reobserve else ("region", "signal"))
    if config.model.scheme == "refchannel":
        raise ConfigError("model.scheme=refchannel: the data hold no reference channels, which it learns from\n"
                          "choose august, noebd or nolatent")
    for path, has, wanted in _differences(made, config, fixed):
        raise ConfigError(f"{path}={wanted}: the data in {folder} were made with {has}\n"
                          "leave the override out, or make other data with august simulate")
    return config


# ---- evaluate ---------------------------------------------------------------------------------------------------


def _evaluate_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(places=1)
    parser.usage = f"{parser.prog} [RUN] [options] [section.field=value ...]"
    parser.add_argument("--seed", type=_natural, default=1, metavar="N", help="of the fresh samples (default 1)")


def _evaluate(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax import evaluation, plotting
    from august_jax.files import write_text

    out = _folder(args, "august_evaluate")
    networks, config = _weights(args, args.rest[0] if args.rest else None)
    rows = evaluation.evaluate(networks, config, seed=args.seed, progress=_note)
    result = {"weights": networks.name, "seed": args.seed, "rows": rows}
    write_text(out / "evaluation.json", json.dumps(result, indent=1, allow_nan=False))
    plotting.evaluation_curves(rows, out / "evaluation.png",
                               title=f"{networks.name}, seed {args.seed}, {config.evaluate.count} samples at each SNR")
    _say(args, _scheme_table(rows, snr=True))
    _say(args, f"\n{evaluation.NOTE}\nwritten: {out / 'evaluation.json'}, {out / 'evaluation.png'}")
    return {"out": str(out), **result}


# ---- export -----------------------------------------------------------------------------------------------------


def _export_arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(places=1)
    parser.usage = f"{parser.prog} SOURCE --format FORMAT [options]"
    parser.add_argument("--format", required=True, metavar="FORMAT", help="ply, npz, mat or json")
    parser.add_argument("--index", type=int, default=-1, metavar="N",
                        help="slot of a result, or sample of a data set (default: the last)")


def _export(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax.export import FORMATS, write_ply, write_record

    if args.format not in FORMATS:
        raise ConfigError(f"--format: unknown format {args.format!r}; choose one of {', '.join(FORMATS)}")
    if not args.rest:
        raise _UsageError("SOURCE is missing: a folder that august demo, reconstruct or simulate wrote\n"
                          "see: august export --help")
    source, out = Path(args.rest[0]), _folder(args, "august_export")
    index, record, clouds = _source(source, args.index)
    name = f"{source.resolve().name}_{index:05d}"
    if args.format == "ply":
        paths = [out / f"{name}_{kind}.ply" for kind in clouds]
        for path, cloud in zip(paths, clouds.values()):
            write_ply(path, *cloud)
    else:
        paths = [out / f"{name}.{args.format}"]
        write_record(paths[0], record)
    _say(args, f"written: {', '.join(map(str, paths))}")
    return {"index": index, "files": [str(path) for path in paths]}


def _source(source: Path, index: int) -> tuple[int, dict[str, Any], dict[str, tuple]]:
    """Number, record and clouds (points, permittivity, conductivity) of one slot of a result or one sample."""
    import numpy as np

    from august_jax.pipeline import Track

    if (source / "clouds.npz").is_file():
        try:
            with (source / "clouds.npz").open("rb") as file, np.load(file) as stored:
                whole = {each.name: stored[each.name] for each in dataclasses.fields(Track)}
        except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
            raise ConfigError(f"SOURCE: {source / 'clouds.npz'} is damaged ({type(error).__name__}); make it again "
                              "with august demo or august reconstruct") from None
        index = _place(index, len(whole["time_s"]), source)
        record = {name: value[index] if np.ndim(value) else value for name, value in whole.items()}
        material = record["permittivity"], record["conductivity"]
        return index, record, {
            "true": (record["truth"], *material),
            "reconstructed": (record["points"], record["point_permittivity"], record["point_conductivity"]),
        }
    if (source / "manifest.json").is_file():
        from august_jax.data import Dataset, unpack

        dataset = Dataset(source)
        index = _place(index, dataset.count, source)
        record = {name: value[0] for name, value in dataset.read(np.array([index])).items()}
        for name in ("channel", "estimate"):
            record[name] = unpack(record[name])
        cloud = record["points"] + record["position"]
        return index, record, {"true": (cloud, record["permittivity"], record["conductivity"])}
    raise ConfigError(f"SOURCE: {source} holds neither clouds.npz nor manifest.json\n"
                      "give a folder that august demo, august reconstruct or august simulate wrote")


def _place(index: int, count: int, source: Path) -> int:
    if not -count <= index < count:
        raise ConfigError(f"--index: {index} is out of range; {source} holds 0 to {count - 1}")
    return index % count


_COMMANDS = {
    "doctor": _Command("check this installation", _doctor_arguments, _doctor, configured=False),
    "demo": _Command("fly a short track and reconstruct it with the shipped weights", _demo_arguments, _demo),
    "simulate": _Command("make a data set: flights, channels, clouds", _simulate_arguments, _simulate),
    "train": _Command("train the networks on a data set", _train_arguments, _train),
    "evaluate": _Command("accuracy over SNR beside the baselines", _evaluate_arguments, _evaluate),
    "reconstruct": _Command("your own drone from a mesh file, at one pose", _reconstruct_arguments, _reconstruct),
    "export": _Command("a result or a sample as PLY, NPZ, MATLAB or JSON", _export_arguments, _export,
                       configured=False),
}

if __name__ == "__main__":
    sys.exit(main())
