"""Samples on disk: folders of ``.npy`` arrays with a JSON description, and one manifest over them.

    DIR/manifest.json            what the data are: rows, shards, configuration and its digest
    DIR/config.yaml              the configuration
    DIR/shard-00003/meta.json    row range, sha256 and shape of each array, configuration digest
    DIR/shard-00003/channel.npy  one array a field of :func:`august_jax.data.generate.generate`

A shard is written aside, flushed to the disk and renamed: it is whole or absent, so that a killed run continues
with the first shard that is missing. What is there is told by the shards themselves; the manifest's list of them is
what its last writer saw. Rows are written as memory-mapped arrays are read: in place.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from august_jax.config import Config, data_digest, to_yaml
from august_jax.config import digest as digest_of
from august_jax.data.generate import Sample, generate, prepare_targets
from august_jax.files import write_text

_PIECE = 2000  # rows generated between two progress lines
_FORMAT = 3  # of the fields and their meaning; in the digest, so that formats never mix


class DataError(ValueError):
    """Data on disk are missing, damaged, or of another configuration."""


def simulate(
    config: Config,
    folder: str | Path,
    *,
    part: tuple[int, int] = (1, 1),
    verify: bool = False,
    report: Callable[[str], None] = lambda line: None,
) -> dict:
    """Make the data of ``config`` in ``folder``, or what of them is still missing.

    Args:
        config: ``config.data.count`` rows in shards of ``config.data.shard_rows``.
        folder: created if absent.
        part: (i, n) writes the i-th of n interleaved sets of shards, i from 1.
        verify: compare the sha256 of every array that is there, and make shards that are damaged again.
        report: called with lines of progress.

    Returns:
        The manifest, with ``written`` (rows of this call), ``seconds`` and ``samples_per_s`` added.

    Raises:
        DataError: the folder holds data of another configuration, or more than are asked for.
        ValueError: ``part`` is not 1 <= i <= n.
    """
    index, parts = part
    if not 1 <= index <= parts:
        raise ValueError(f"shard: got {index}/{parts}; give i/n with 1 <= i <= n, e.g. 2/4")
    folder = Path(folder)
    digest = identity(config)
    if (folder / "manifest.json").exists():
        found = read_manifest(folder)
        if found["shards"] and found["digest"] != digest:
            raise DataError(
                f"{folder}: holds data of another configuration, shard size, mesh file or version (digest "
                f"{found['digest']}, wanted {digest}); choose another --out, or remove the folder"
            )
        most = max((high for _, high in found["shards"].values()), default=0)
        if most > config.data.count:
            raise DataError(f"data.count: {config.data.count} is less than the {most} samples that {folder} holds; ask "
                            "for at least as many, or choose another --out")
    count, size = config.data.count, config.data.shard_rows
    spans = {number: (start, min(start + size, count)) for number, start in enumerate(range(0, count, size))}
    missing = [
        number for number in spans
        if number % parts == index - 1 and not _complete(folder / shard_name(number), spans[number], digest, verify)
    ]
    began = time.perf_counter()
    written, total = 0, sum(spans[number][1] - spans[number][0] for number in missing)
    targets = prepare_targets(config, report) if missing else []
    folder.mkdir(parents=True, exist_ok=True)
    _write_manifest(folder, config, digest)
    for number in missing:
        low, high = spans[number]
        pieces = []
        for start in range(low, high, _PIECE):
            rows = np.arange(start, min(start + _PIECE, high))
            pieces.append(generate(config, rows, targets))
            written += len(rows)
            elapsed = time.perf_counter() - began
            left = elapsed / written * (total - written)
            report(f"{written}/{total} samples  {written / elapsed:.1f} samples/s  {left:.0f} s left")
        fields = {name: np.concatenate([piece[name] for piece in pieces]) for name in pieces[0]}
        _write_shard(folder, number, fields, (low, high), digest)
        _write_manifest(folder, config, digest)
    manifest = read_manifest(folder)
    seconds = time.perf_counter() - began
    return manifest | {"written": written, "seconds": seconds, "samples_per_s": written / max(seconds, 1e-9)}


def identity(config: Config) -> str:
    """Digest of all that the stored samples depend on: configuration, format, shard size, content of mesh files."""
    meshes = {name: _sha256(Path(name)) for name in config.target.airframes if Path(name).is_file()}
    return digest_of(data_digest(config), _FORMAT, config.data.shard_rows, meshes)


def shard_name(number: int) -> str:
    """Folder name of a shard."""
    return f"shard-{number:05d}"


def read_manifest(folder: str | Path) -> dict:
    """The manifest of a data folder, its shards and rows counted anew; :class:`DataError` where there is none."""
    path = Path(folder) / "manifest.json"
    try:
        manifest = json.loads(path.read_text())
    except FileNotFoundError:
        raise DataError(f"{folder}: holds no manifest.json; make data with `august simulate --out {folder}` and the "
                        "preset that you want") from None
    except ValueError:
        manifest = None
    if not isinstance(manifest, dict) or not {"format", "digest", "wanted"} <= set(manifest):
        raise DataError(f"{path}: is damaged; remove it and run `august simulate` again, which keeps the shards")
    if manifest["format"] != _FORMAT:
        raise DataError(f"{folder}: holds data of another version (format {manifest['format']}, wanted {_FORMAT}); "
                        "make them again with `august simulate`, in another folder")
    return manifest | _present(Path(folder), manifest["digest"])


def _meta(shard: Path) -> dict | None:
    """What a shard says of itself; None where it is missing or damaged."""
    try:
        meta = json.loads((shard / "meta.json").read_text())
    except (OSError, ValueError):
        return None
    return meta if isinstance(meta, dict) and {"rows", "digest", "arrays"} <= set(meta) else None


def _complete(shard: Path, span: tuple[int, int], digest: str, verify: bool) -> bool:
    meta = _meta(shard)
    if not meta or meta["digest"] != digest or meta["rows"] != list(span):
        return False
    paths = {shard / f"{field}.npy": about["sha256"] for field, about in meta["arrays"].items()}
    return all(path.exists() and (not verify or _sha256(path) == wanted) for path, wanted in paths.items())


def _write_shard(folder: Path, number: int, fields: Sample, span: tuple[int, int], digest: str) -> None:
    final, aside = folder / shard_name(number), folder / f".{shard_name(number)}.part"
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir()
    arrays = {}
    for name, value in fields.items():
        path = aside / f"{name}.npy"
        with path.open("wb") as file:
            np.save(file, value)
            file.flush()
            os.fsync(file.fileno())
        arrays[name] = {"shape": list(value.shape), "dtype": str(value.dtype), "sha256": _sha256(path)}
    write_text(aside / "meta.json", json.dumps({"rows": list(span), "digest": digest, "arrays": arrays}, indent=1))
    shutil.rmtree(final, ignore_errors=True)
    os.replace(aside, final)


def _write_manifest(folder: Path, config: Config, digest: str) -> None:
    manifest = {"format": _FORMAT, "digest": digest, "preset": config.preset, "wanted": config.data.count,
                "airframes": list(config.target.airframes), **_present(folder, digest)}
    write_text(folder / "config.yaml", to_yaml(config))
    write_text(folder / "manifest.json", json.dumps(manifest, indent=1))


def _present(folder: Path, digest: str) -> dict:
    """``shards``, name -> row range, of the shards that are there, and ``rows``, the sum of them."""
    shards = {}
    for shard in sorted(folder.glob("shard-*")):
        meta = _meta(shard)
        if meta and meta["digest"] == digest:
            shards[shard.name] = meta["rows"]
    return {"rows": sum(high - low for low, high in shards.values()), "shards": shards}


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
