"""Whether this installation can work: versions, devices, sums, a small physics check, room to write, weights."""

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
from august_jax.app.devices import describe_backend_error

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


class Check(NamedTuple):
    """One line of the doctor's report; ``passed`` is None for what is optional and absent."""

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
    if devices.passed:  # nothing can be computed otherwise
        yield _guarded("sums", _sums)
        yield _guarded("physics", _physics)
    yield _guarded("cache", _cache)
    yield _guarded("disk", lambda: _disk(out))
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
    return not missing, "missing: " + ", ".join(missing) if missing else ", ".join(found)


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

    from august_jax.physics import cache_folder

    place = cache_folder()
    place.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=place):
        pass
    compiled = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    return True, f"{place} can be written; compiled programs: {compiled or 'not kept'}"


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
