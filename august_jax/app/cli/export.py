"""``august export``: a slot of a result, or a sample of a data set, as a file for other programs."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import Any

from august_jax.app.cli.common import folder
from august_jax.app.cli.messages import UsageError, say
from august_jax.app.cli.parser import Command, whole
from august_jax.config import ConfigError


def _arguments(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(places=1)
    parser.usage = f"{parser.prog} SOURCE --format FORMAT [options]"
    parser.epilog = "SOURCE is a folder that august demo, reconstruct, track or simulate wrote."
    parser.add_argument("--format", required=True, metavar="FORMAT", help="ply, csv, npz, mat or json")
    parser.add_argument(
        "--index",
        type=whole(-(2**31)),
        default=-1,
        metavar="N",
        help="slot of a result, or sample of a data set (default: the last)",
    )


def _run(args: argparse.Namespace) -> dict[str, Any]:
    from august_jax.app.export import DESCRIBED, FORMATS, write_csv, write_ply, write_record

    if args.format not in FORMATS:
        raise ConfigError(f"--format: unknown format {args.format!r}; choose one of {', '.join(FORMATS)}")
    if not args.rest:
        raise UsageError(
            "SOURCE is missing: a folder that august demo, reconstruct or simulate wrote\nsee: august export --help"
        )
    source, out = Path(args.rest[0]), folder(args, "august_export")
    index, record, clouds = _source(source, args.index)
    name = f"{source.resolve().name}_{index:05d}"
    if args.format in ("ply", "csv"):
        paths = [out / f"{name}_{kind}.{args.format}" for kind in clouds]
        for path, cloud in zip(paths, clouds.values()):
            (write_ply if args.format == "ply" else write_csv)(path, *cloud)
    else:
        paths = [out / f"{name}.{args.format}"]
        write_record(paths[0], record, described=DESCRIBED)
    say(args, f"written: {', '.join(map(str, paths))}")
    return {"index": index, "files": [str(path) for path in paths]}


def _source(source: Path, index: int) -> tuple[int, dict[str, Any], dict[str, tuple]]:
    """Number, record and clouds (points, permittivity, conductivity) of one slot of a result or one sample."""
    import numpy as np

    from august_jax.files import DamagedFile, read_npz
    from august_jax.pipeline import Track

    if (source / "clouds.npz").is_file():
        try:
            stored = read_npz(source / "clouds.npz")
            kept = [each for each in dataclasses.fields(Track) if each.name in stored or each.default is not None]
            whole = {each.name: stored[each.name] for each in kept}
        except DamagedFile as error:
            raise ConfigError(f"SOURCE: {error}; make it again with august demo or august reconstruct") from None
        except KeyError as error:
            raise ConfigError(
                f"SOURCE: {source / 'clouds.npz'} is of another version, without {error}; make it again with august "
                "demo or august reconstruct"
            ) from None
        index = _place(index, len(whole["time_s"]), source)
        record = {name: value[index] if np.ndim(value) else value for name, value in whole.items()}
        material = record["permittivity"], record["conductivity"]
        return (
            index,
            record,
            {
                "true": (record["truth"], *material),
                "reconstructed": (record["points"], record["point_permittivity"], record["point_conductivity"]),
            },
        )
    if (source / "manifest.json").is_file():
        from august_jax.data import Dataset, unpack

        dataset = Dataset(source)
        index = _place(index, dataset.count, source)
        record = {name: value[0] for name, value in dataset.read(np.array([index])).columns().items()}
        for name in {"true_channel", "estimated_channel"} & set(record):
            record[name] = unpack(record[name])
        cloud = record["points"] + record["position"]
        return index, record, {"true": (cloud, record["permittivity"], record["conductivity"])}
    raise ConfigError(
        f"SOURCE: {source} holds neither clouds.npz nor manifest.json\n"
        "give a folder that august demo, august reconstruct or august simulate wrote"
    )


def _place(index: int, count: int, source: Path) -> int:
    if not -count <= index < count:
        raise ConfigError(f"--index: {index} is out of range; {source} holds 0 to {count - 1}")
    return index % count


COMMAND = Command(
    "a result or a sample as PLY, CSV, NPZ, MATLAB or JSON", _arguments, _run, configured=False, out="august_export"
)
