"""Samples on disk: folders of ``.npy`` arrays with a JSON description, and one manifest over them.

    DIR/manifest.json            what the data are: rows, shards, configuration and its digest
    DIR/config.yaml              the configuration
    DIR/shard-00003/meta.json    row range, sha256 and shape of each array, configuration digest
    DIR/shard-00003/true_channel.npy    one array a column of :class:`august_jax.data.fields.Sample`
    DIR/shard-00003/row_sums.npy    CRC-32 of each row of each column, which readers compare

A shard is written aside, flushed to the disk and renamed: it is whole or absent, so that a killed run continues
with the first shard that is missing. What is there is told by the shards themselves; the manifest's list of them is
what its last writer saw. Several processes may work in one folder on parts of it that share no shard.
"""

from __future__ import annotations

import hashlib
import math
import re
import shlex
import shutil
import time
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jax.sharding import Mesh
from jaxtyping import UInt32

from august_jax import streams
from august_jax.config import Config, data_digest, to_yaml
from august_jax.config import digest as digest_of
from august_jax.data.generate import generate
from august_jax.data.simulator import Target, prepare_targets
from august_jax.files import (
    DamagedFile,
    occupant,
    occupied,
    occupying,
    read_json,
    replacing_folder,
    sha256_of,
    write_array,
    write_json,
    write_text,
)
from august_jax.progress import Progress, silent, told_bytes
from august_jax.scene.airframes import mesh_path

ROW_SUMS = "row_sums.npy"
_PIECE = 2000  # rows generated between two progress lines
_FORMAT = 4  # of the columns, their meaning and their streams; in the digest, so that formats never mix


class DataError(ValueError):
    """Data on disk are missing, damaged, or of another configuration."""


@streams.pin
def simulate(
    config: Config,
    folder: str | Path,
    *,
    part: tuple[int, int] = (1, 1),
    verify: bool = False,
    mesh: Mesh | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Make the data of ``config`` in ``folder``, or what of them is still missing.

    Args:
        config: ``config.data.count`` rows in shards of ``config.data.shard_rows``.
        folder: created if absent.
        part: (i, n) writes the i-th of n interleaved sets of shards, i from 1.
        verify: compare the sha256 of every array that is there, and make shards that are damaged again.
        mesh: devices that share the work; None takes :func:`~august_jax.mesh.own_accelerators`.
        progress: takes lines of progress.

    Returns:
        The manifest, with ``written`` (rows of this call), ``seconds`` and ``samples_per_s`` added.

    Raises:
        DataError: the folder holds data of another configuration, or more than are asked for, or its disk has no room
            for them.
        Occupied: another process makes any of these shards.
        ValueError: ``part`` is not 1 <= i <= n.
    """
    index, parts = part
    if not 1 <= index <= parts:
        raise ValueError(f"part: got {index}/{parts}; give i/n with 1 <= i <= n, e.g. 2/4")
    folder = Path(folder)
    digest = identity(config)
    began = time.perf_counter()
    with _sharing(folder, part):
        missing = _missing(folder, config, digest, part, verify)
        written, total = 0, sum(high - low for low, high in missing.values())
        _check_room(folder, config, total, progress)
        targets = prepare_targets(config, progress) if missing else []
        errors = _table_errors(config, targets)
        with occupying(folder, wait=True):  # of two parts that begin at once, each sees what the other is of
            _check_same(folder, config, digest)
            _write_manifest(folder, config, digest, errors)
        for done, (number, (low, high)) in enumerate(missing.items(), 1):
            pieces = []
            for start in range(low, high, _PIECE):
                rows = np.arange(start, min(start + _PIECE, high))
                pieces.append(generate(config, rows, targets, mesh=mesh))
                written += len(rows)
                elapsed = time.perf_counter() - began
                left = elapsed / written * (total - written)
                progress(f"{written}/{total} samples  {written / elapsed:.1f} samples/s  {left:.0f} s left")
            columns = [piece.columns() for piece in pieces]
            whole = {name: np.concatenate([each[name] for each in columns]) for name in columns[0]}
            _write_shard(folder, number, whole, (low, high), digest)
            # It looks at every shard: after each of them, a hundred thousand would cost more than they themselves.
            if done == len(missing) or done & (done - 1) == 0:
                _write_manifest(folder, config, digest, errors)
        manifest = read_manifest(folder)
    seconds = time.perf_counter() - began
    return manifest | {"written": written, "seconds": seconds, "samples_per_s": written / max(seconds, 1e-9)}


def missing_shards(config: Config, folder: Path) -> dict[int, tuple[int, int]]:
    """Number of each shard that :func:`simulate` would make, with its rows, the first one and the end.

    Raises:
        DataError: the folder holds data of another configuration, or more than are asked for.
    """
    return _missing(folder, config, identity(config), (1, 1), False)


def is_of_part(number: int, part: tuple[int, int]) -> bool:
    """Whether a shard is made by part (i, n)."""
    return number % part[1] == part[0] - 1


def _missing(
    folder: Path, config: Config, digest: str, part: tuple[int, int], verify: bool
) -> dict[int, tuple[int, int]]:
    count, size = config.data.count, config.data.shard_rows
    _check_same(folder, config, digest)
    spans = {number: (start, min(start + size, count)) for number, start in enumerate(range(0, count, size))}
    return {
        number: span
        for number, span in spans.items()
        if is_of_part(number, part) and not _complete(folder / shard_name(number), span, digest, verify)
    }


@contextmanager
def _sharing(folder: Path, part: tuple[int, int]) -> Iterator[None]:
    """Hold a part of the folder's shards; refused where another process makes any of them.

    Parts i of n and j of m share a shard where i and j agree modulo the greatest divisor of n and m.
    """
    index, parts = part
    own = f".lock-{index}-of-{parts}"

    def check() -> None:
        for lock in folder.glob(".lock-*-of-*"):
            if lock.name == own or not (numbers := re.fullmatch(r"\.lock-(\d+)-of-(\d+)", lock.name)):
                continue
            other, others = map(int, numbers.groups())
            if (other - index) % math.gcd(others, parts) == 0 and (who := occupant(lock)):
                raise occupied(folder, f"{who} (part {other}/{others})")

    with occupying(folder, own, check=check):
        yield


def _check_same(folder: Path, config: Config, digest: str) -> None:
    """Refuse a folder of other data, or of more: nothing that somebody may want is written over."""
    other = ""
    if (folder / "manifest.json").exists():
        found = read_manifest(folder)
        if found["shards"] and found["digest"] != digest:
            other = found["digest"]
        most = max((high for _, high in found["shards"].values()), default=0)
        if not other and most > config.data.count:
            raise DataError(
                f"data.count: {config.data.count} is less than the {most} samples that {folder} holds; ask "
                "for at least as many, or choose another folder"
            )
    for shard in folder.glob("shard-*"):  # whatever became of the manifest
        meta = read_meta(shard)
        if meta and meta["digest"] != digest:
            other = other or meta["digest"]
    if other:
        raise DataError(
            f"folder: {folder} holds data of another configuration, shard size, mesh file or version (digest "
            f"{other}, wanted {digest}); choose another folder, or remove it"
        )


def bytes_of(config: Config, rows: int | None = None) -> int:
    """Bytes that so many samples take on the disk; None takes ``data.count``."""
    array, points = config.array, config.target.points
    triangles = 8 * len(array.frequencies_hz) * (array.count * (array.count + 1) // 2)
    row = 4 * (3 + 9 + 2 + 3 + 3 * points) + triangles + 4 * 9  # the last are check sums, one a column
    if config.data.observed:
        row += 4 * (3 + 3) + triangles + 4 * 5
    return row * (config.data.count if rows is None else rows)


def _check_room(folder: Path, config: Config, rows: int, progress: Progress) -> None:
    """Say what the missing rows will take, and refuse before the work where the disk has no room for them."""
    if not rows:
        return
    wanted = bytes_of(config, rows)
    place = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(place).free
    progress(f"{rows} samples take {told_bytes(wanted)} in {folder}; {told_bytes(free)} are free there")
    if wanted > free:
        raise DataError(
            f"data.count: {rows} samples take {told_bytes(wanted)}, but {place} has {told_bytes(free)} free; make "
            "room, choose another folder or fewer samples"
        )


def identity(config: Config) -> str:
    """Digest of all that the stored samples depend on: configuration, format, shard size, content of mesh files."""
    files = {name: mesh_path(name) for name in config.target.airframes}
    meshes = {name: sha256_of(path) for name, path in files.items() if path is not None}
    return digest_of(data_digest(config), _FORMAT, config.data.shard_rows, meshes)


def shard_name(number: int) -> str:
    """Folder name of a shard."""
    return f"shard-{number:05d}"


def simulate_again(folder: str | Path, *words: str) -> str:
    """The command line that goes on with the data of a folder, by the configuration that it holds."""
    return shlex.join(["august", "simulate", "--out", str(folder), *words])


def read_manifest(folder: str | Path) -> dict[str, Any]:
    """The manifest of a data folder, its shards and rows counted anew; :class:`DataError` where there is none."""
    path = Path(folder) / "manifest.json"
    try:
        manifest = read_json(path)
    except FileNotFoundError:
        raise DataError(f"folder: {folder} holds no manifest.json; make data there with `august simulate`") from None
    except DamagedFile:
        manifest = {}
    if not {"format", "digest", "wanted"} <= set(manifest):
        raise DataError(f"{path}: is damaged\nremove it, and write it again: {simulate_again(folder)}")
    if manifest["format"] != _FORMAT:
        raise DataError(
            f"folder: {folder} holds data of another version (format {manifest['format']}, wanted {_FORMAT}); "
            "make them again with `august simulate`, in another folder"
        )
    return manifest | _present(Path(folder), manifest["digest"])


def read_meta(shard: Path) -> dict[str, Any] | None:
    """What a shard says of itself: ``rows``, ``digest`` and ``arrays``; None where that is missing or damaged."""
    try:
        meta = read_json(shard / "meta.json")
    except (OSError, DamagedFile):
        return None
    if not (isinstance(meta.get("digest"), str) and isinstance(meta.get("arrays"), dict)):
        return None
    rows = meta.get("rows")
    ordered = isinstance(rows, list) and len(rows) == 2 and all(type(end) is int for end in rows) and rows[0] < rows[1]
    whole = all(isinstance(each, dict) and isinstance(each.get("sha256"), str) for each in meta["arrays"].values())
    return meta if ordered and whole else None


def _complete(shard: Path, span: tuple[int, int], digest: str, verify: bool) -> bool:
    meta = read_meta(shard)
    if not meta or meta["digest"] != digest or meta["rows"] != list(span):
        return False
    paths = {shard / f"{name}.npy": array["sha256"] for name, array in meta["arrays"].items()}
    if "row_sums" in meta:
        paths[shard / ROW_SUMS] = meta["row_sums"]
    return all(path.exists() and (not verify or sha256_of(path) == wanted) for path, wanted in paths.items())


def content_sum(folder: str | Path) -> str:
    """The SHA-256, in hexadecimal, of all arrays of the shards that are there, in their order, as descriptions have
    theirs: the same whoever made them, and in how many parts.

    Raises:
        DataError: no manifest.
    """
    digest = hashlib.sha256()
    for name in read_manifest(folder)["shards"]:
        meta = read_meta(Path(folder) / name)
        assert meta is not None
        for column, array in sorted(meta["arrays"].items()):
            digest.update(f"{name} {meta['rows']} {column} {array['sha256']}\n".encode())
    return digest.hexdigest()


def row_sums(value: np.ndarray) -> UInt32[np.ndarray, " rows"]:
    """The CRC-32 of each row of an array (rows, ...)."""
    rows = np.ascontiguousarray(value).reshape(len(value), -1).view(np.uint8)
    return np.array([zlib.crc32(row) for row in rows], np.uint32)


def _write_shard(folder: Path, number: int, columns: dict[str, np.ndarray], span: tuple[int, int], digest: str) -> None:
    with replacing_folder(folder / shard_name(number)) as aside:
        arrays = {
            name: {
                "shape": list(value.shape),
                "dtype": str(value.dtype),
                "sha256": write_array(aside / f"{name}.npy", value),
            }
            for name, value in columns.items()
        }
        sums = write_array(aside / ROW_SUMS, np.stack([row_sums(value) for value in columns.values()], axis=1))
        write_json(aside / "meta.json", {"rows": list(span), "digest": digest, "arrays": arrays, "row_sums": sums})


def _write_manifest(folder: Path, config: Config, digest: str, errors: dict[str, Any]) -> None:
    if not errors and (folder / "manifest.json").exists():  # nothing was missing
        errors = read_json(folder / "manifest.json").get("table_errors", {})
    manifest = {
        "format": _FORMAT,
        "digest": digest,
        "preset": config.preset,
        "wanted": config.data.count,
        "airframes": list(config.target.airframes),
        **({"table_errors": errors} if errors else {}),
        **_present(folder, digest),
    }
    write_text(folder / "config.yaml", to_yaml(config))
    write_json(folder / "manifest.json", manifest | {"config": sha256_of(folder / "config.yaml")})


def _table_errors(config: Config, targets: Sequence[Target]) -> dict[str, Any]:
    """Airframe -> ``median`` and ``most`` (95 %) of its table's relative error, a value a tone; none without tables."""
    return {
        name: {
            kind: [float(f"{value:.3g}") for value in values]
            for kind, values in zip(("median", "most"), np.asarray(target.table.errors).T, strict=True)
        }
        for name, target in zip(config.target.airframes, targets)
        if target.table is not None
    }


def _present(folder: Path, digest: str) -> dict[str, Any]:
    """``shards``, name -> row range, of the shards that are there, and ``rows``, the sum of them."""
    shards = {}
    for shard in sorted(folder.glob("shard-*")):
        meta = read_meta(shard)
        if meta and meta["digest"] == digest:
            shards[shard.name] = meta["rows"]
    return {"rows": sum(high - low for low, high in shards.values()), "shards": shards}
