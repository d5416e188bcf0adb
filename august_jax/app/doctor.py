"""Whether this installation can work, and what will be slow: versions, devices, memory, sums, a small physics check,
the cache, room to write, weights; each with the way out."""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

from august_jax import UNFUSED_SUMS, config, names_a_file
from august_jax.app.compiled import YES
from august_jax.app.devices import describe_backend_error
from august_jax.files import cache_folder
from august_jax.memory import memory

PACKAGES = (
    "jax",
    "jaxlib",
    "numpy",
    "scipy",
    "flax",
    "distrax",
    "optax",
    "orbax-checkpoint",
    "trimesh",
    "PyYAML",
    "matplotlib",
)
SETTINGS = ("JAX_PLATFORMS", "JAX_ENABLE_X64", "JAX_DEFAULT_PRNG_IMPL", "JAX_THREEFRY_PARTITIONABLE")
"""Variables by which JAX computes elsewhere, or other numbers."""
_ROOM_BYTES = 2 * 1024**3
"""For everything but data sets: factored bodies in the cache, runs, results."""


_MEMORY_BYTES, _LEAST_BYTES = 5 * 1024**3 // 2, 5 * 1024**3 // 4
"""A demo with a search among two drones, whose tables it makes, holds 2.2 GiB at most; one without holds 1.2."""
_NVIDIA = ("/proc/driver/nvidia/version", "/dev/nvidia0")


class Check(NamedTuple):
    """One line of the doctor's report; ``passed`` is None for what works but not as well as it could."""

    name: str
    passed: bool | None
    detail: str


def examine(out: Path) -> Iterator[Check]:
    """Yield one :class:`Check` after the other.

    Args:
        out: directory whose disk is checked for room, or the nearest above it that is there.
    """
    yield Check(
        "python",
        True,
        f"{platform.python_version()} on {platform.system()} {platform.machine()}, {os.cpu_count()} CPU cores",
    )
    yield _guarded("packages", _packages)
    yield _guarded("settings", _settings)
    devices = _guarded("devices", _devices)
    yield devices
    yield _guarded("memory", _memory)
    if devices.passed:  # nothing can be computed otherwise
        yield _guarded("sums", _sums)
        yield _guarded("physics", _physics)
    yield _guarded("cache", _cache)
    yield _guarded("disk", lambda: _disk(out))
    yield _guarded("speed", lambda: _speed(bool(devices.passed)))
    if devices.passed:  # arrays of a device
        yield _guarded("weights", _weights)
        yield _guarded("predictor", _predictor)


def _guarded(name: str, check: Callable[[], tuple[bool | None, str]]) -> Check:
    try:
        return Check(name, *check())
    except Exception as error:  # a broken installation may raise anything, and the doctor must say what
        first_line = next(iter(str(error).strip().splitlines()), "")
        return Check(name, False, describe_backend_error(error) or f"{type(error).__name__}: {first_line}")


def _packages() -> tuple[bool, str]:
    found, missing = [], []
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            missing.append(name)
    return (
        not missing,
        f"missing: {', '.join(missing)}; install again: pip install -c constraints.txt ."
        if missing
        else ", ".join(found),
    )


def _settings() -> tuple[bool, str]:
    found = [f"{name}={os.environ[name]}" for name in SETTINGS if name in os.environ]
    if not found:
        return True, "JAX's own"
    return True, ", ".join(found) + (
        ""
        if found[0].startswith("JAX_PLATFORMS") and len(found) == 1
        else "; stored samples come out the same under these, what else is computed may not"
    )


def _devices() -> tuple[bool, str]:
    import jax

    return True, ", ".join(str(device) for device in jax.devices())


def _memory() -> tuple[bool | None, str]:
    found = memory()
    if found is None:
        return None, "the system does not tell"
    wanted, least = _MEMORY_BYTES / 1024**3, _LEAST_BYTES / 1024**3
    said = f"{found.free / 1024**3:.1f} GiB free of {found.total / 1024**3:.1f}; wanted {wanted:.1f}"
    if found.free < _LEAST_BYTES:
        return False, said + f", {least:.1f} at the least: end other programs, or take a machine with more"
    if found.free < _MEMORY_BYTES:
        return None, said + f": end other programs, or leave the search out (--search 0), which works with {least:.1f}"
    return True, said + "; august train --dry-run says what a configuration takes"


def _speed(computes: bool) -> tuple[bool | None, str]:
    """What will be slow here, and the way out; nothing of it keeps anything from working."""
    slow = []
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if cores < 2:
        slow.append("one CPU core: expect more than the times of august train --help, which are of two")
    if computes:
        import jax

        if jax.default_backend() == "cpu":
            if any(Path(mark).exists() for mark in _NVIDIA):
                slow.append(
                    "there is an NVIDIA GPU, but JAX does not use it: pip install -c constraints.txt 'jax[cuda12]', "
                    "and leave JAX_PLATFORMS unset"
                )
            slow.append("no GPU: train the preset laptop, paper is for one")
        if not jax.config.jax_compilation_cache_dir:  # type: ignore[attr-defined]
            slow.append(
                "compiled programs are not kept, so that each command compiles anew: unset "
                "JAX_ENABLE_COMPILATION_CACHE, or make the cache writable"
            )
    if not any(cache_folder().glob("body-*.npz")):
        slow.append("nothing is factored yet: the first command takes up to a minute a drone longer, once")
    if "xla_backend_optimization_level=0" in os.environ.get("XLA_FLAGS", ""):
        slow.append("XLA_FLAGS turns optimisation off: unset it")
    if os.environ.get("JAX_DISABLE_MOST_OPTIMIZATIONS", "").lower() in YES:
        slow.append("JAX_DISABLE_MOST_OPTIMIZATIONS turns optimisation off: unset it")
    return None if slow else True, "; ".join(slow) or "nothing is known to be slow here"


def _sums() -> tuple[bool, str]:
    from august_jax.app.sums import many_axes_fault, wrong_sums

    fault = many_axes_fault()
    wrong = [*wrong_sums(), *([fault] if fault else [])]
    if not wrong:
        return True, f"right at every size at which releases of jaxlib get them wrong ({version('jaxlib')} here)"
    flags = os.environ.get("XLA_FLAGS", "")
    mend = (
        f"add the line {UNFUSED_SUMS} to {flags}, which XLA_FLAGS names"
        if names_a_file(flags)
        else f"import august_jax before JAX computes, or set XLA_FLAGS={UNFUSED_SUMS}"
    )
    return False, f"jaxlib {version('jaxlib')} fuses sums wrongly: {'; '.join(wrong)}; {mend}"


def _physics() -> tuple[bool, str]:
    import jax.numpy as jnp
    import numpy as np

    from august_jax.physics import Cells, PlanarArray, body_channel, factor_body, sensing_channel

    corner = 0.01 * np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(8, 3)
    body = Cells(corner, np.full(8, 1e-6))
    array, place, chi = PlanarArray(4, 2, 3e9), np.array([1.0, 5.0, 2.0]), jnp.asarray(2.0 + 0.05j)
    direct = sensing_channel(array, body.moved(np.eye(3), place), chi)
    factored = body_channel(factor_body(body, 3e9, cache=False), array, jnp.eye(3), jnp.asarray(place), chi)
    error = float(jnp.linalg.norm(direct - factored) / jnp.linalg.norm(direct))
    # each holds four digits of a channel in single precision; a wrong BLAS or LAPACK misses by far more
    return error < 1e-3, f"the factored body and the coupled solve differ by {error:.0e}; wanted below 1e-3"


def _cache() -> tuple[bool, str]:
    import jax

    place = cache_folder()
    place.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=place):
        pass
    kept = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    sizes = f"{_told(_size_of(place))}"
    programs = f"{kept} ({_told(_size_of(Path(kept)))})" if kept else "not kept"
    return True, (
        f"{place} can be written and holds {sizes}; compiled programs: {programs}; AUGUST_CACHE puts it elsewhere, and "
        "what is removed is made again"
    )


def _size_of(place: Path) -> int:
    total = 0
    for path in place.rglob("*"):
        try:
            total += path.stat().st_size
        except FileNotFoundError:  # another process makes room
            continue
    return total


def _told(size: int) -> str:
    return f"{size / 1024**3:.1f} GiB" if size > 1024**3 / 2 else f"{size / 1024**2:.0f} MiB"


def _disk(out: Path) -> tuple[bool, str]:
    from august_jax.data import bytes_of

    out = next(path for path in (out, *out.absolute().parents) if path.is_dir())
    free = shutil.disk_usage(out).free
    data = {name: bytes_of(config.preset(name)) for name in config.PRESETS}
    needs = ", ".join(
        f"{name} {max(size / 1024**3, 0.1):.1f}{'' if size < free else ' (more than there is)'}"
        for name, size in data.items()
    )
    return free > _ROOM_BYTES, (
        f"{free / 1024**3:.1f} GiB free; wanted {_ROOM_BYTES / 1024**3:.0f}, and for august "
        f"simulate by preset [GiB]: {needs}"
    )


def _weights() -> tuple[bool, str]:
    from august_jax.pipeline import SHIPPED, load_networks
    from august_jax.schemes import title_of

    wanted = ("weights.npz", "config.yaml", "card.json", "card.md")
    missing = [name for name in wanted if not (SHIPPED / name).is_file()]
    if missing:
        return False, f"missing in {SHIPPED}: {', '.join(missing)}; install the package again"
    networks = load_networks()
    size = (SHIPPED / "weights.npz").stat().st_size / 1024**2
    return True, f"{networks.config.preset} ({title_of(networks)}) load, {size:.1f} MiB in {SHIPPED}"


def _predictor() -> tuple[bool, str]:
    from august_jax.config import preset
    from august_jax.tracking import KalmanLSTM
    from august_jax.tracking.predictors.lstm import SHIPPED

    try:
        KalmanLSTM.for_flight(preset("laptop").flight)
    except (ValueError, OSError) as error:
        return False, f"{error}; install the package again"
    return True, f"the LSTM over the Kalman filter loads from {SHIPPED}"
