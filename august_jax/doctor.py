"""Whether this installation can work: versions, devices, a small physics check, places to write, shipped weights."""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

from august_jax import UNFUSED_SUMS

PACKAGES = ("jax", "jaxlib", "numpy", "scipy", "flax", "distrax", "optax", "orbax-checkpoint", "trimesh", "PyYAML",
            "matplotlib")
_ROOM_BYTES = 2 * 1024**3


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
    yield Check("python", True, f"{platform.python_version()} on {platform.system()} {platform.machine()}, "
                                f"{os.cpu_count()} CPU cores")
    yield _guarded("packages", _packages)
    yield _guarded("devices", _devices)
    yield _guarded("sums", _sums)
    yield _guarded("physics", _physics)
    yield _guarded("cache", _cache)
    out = next(path for path in (out, *out.absolute().parents) if path.is_dir())
    room = shutil.disk_usage(out).free
    yield Check("disk", room > _ROOM_BYTES, f"{room / 1024**3:.1f} GiB free; wanted {_ROOM_BYTES / 1024**3:.0f}")
    yield _guarded("weights", _weights)
    collada = find_spec("collada") is not None
    yield Check("dae meshes", True if collada else None,
                "pycollada is here" if collada else "only with pycollada: pip install -c constraints.txt pycollada")


def _guarded(name: str, check: Callable[[], tuple[bool | None, str]]) -> Check:
    try:
        return Check(name, *check())
    except Exception as error:  # a broken installation may raise anything, and the doctor must say what
        return Check(name, False, f"{type(error).__name__}: {str(error).strip().splitlines()[0] if str(error) else ''}")


def _packages() -> tuple[bool, str]:
    found, missing = [], []
    for name in PACKAGES:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            missing.append(name)
    return not missing, "missing: " + ", ".join(missing) if missing else ", ".join(found)


def _devices() -> tuple[bool, str]:
    import jax

    return True, ", ".join(str(device) for device in jax.devices())


def _sums() -> tuple[bool, str]:
    import jax
    import jax.numpy as jnp
    import numpy as np

    first, second = (np.sin(scale * np.arange(192.0, dtype=np.float32)).reshape(64, 3) for scale in (1.0, 2.0))
    rows = np.cos(np.arange(500.0, dtype=np.float32))[:, None]
    fused = jax.jit(jax.vmap(lambda one: jnp.sum(first * one, axis=-1) + rows))(second)
    error = np.abs(np.asarray(fused) - ((second @ first.T)[:, None] + rows)).max()
    return bool(error < 1e-4), ("sums that are broadcast come out right" if error < 1e-4 else
                                f"XLA fuses sums wrongly (off by {error:.1g}): import august_jax before JAX computes, or "
                                f"set XLA_FLAGS={UNFUSED_SUMS}")


def _physics() -> tuple[bool, str]:
    import jax.numpy as jnp
    import numpy as np

    from august_jax.physics import Cells, PlanarArray, body_channel, factor_body, sensing_channel

    corner = 0.01 * np.stack(np.meshgrid([-1.0, 1.0], [-1.0, 1.0], [-1.0, 1.0]), axis=-1).reshape(8, 3)
    body = Cells(corner, np.full(8, 1e-6))
    array, place, chi = PlanarArray(4, 2, 3e9), np.array([1.0, 5.0, 2.0]), 2.0 + 0.05j
    direct = sensing_channel(array, body.moved(np.eye(3), place), chi)
    factored = body_channel(factor_body(body, 3e9, cache=False), array, jnp.eye(3), jnp.asarray(place), chi)
    error = float(jnp.linalg.norm(direct - factored) / jnp.linalg.norm(direct))
    # each holds four digits of a channel in single precision; a wrong BLAS or LAPACK misses by far more
    return error < 1e-3, f"the factored body and the coupled solve differ by {error:.0e}; wanted below 1e-3"


def _cache() -> tuple[bool, str]:
    from august_jax.physics import cache_folder

    place = cache_folder()
    place.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=place):
        pass
    return True, f"{place} can be written"


def _weights() -> tuple[bool, str]:
    from august_jax.pipeline import SHIPPED

    wanted = ("weights.npz", "config.yaml", "card.json", "card.md")
    missing = [name for name in wanted if not (SHIPPED / name).is_file()]
    if missing:
        return False, f"missing in {SHIPPED}: {', '.join(missing)}; install the package again"
    return True, f"laptop, {(SHIPPED / 'weights.npz').stat().st_size / 1024**2:.1f} MiB in {SHIPPED}"
