"""Sums of products at the sizes at which releases of jaxlib are known to fuse them wrongly on CPUs.

Each trial is one jitted computation whose right answer NumPy gives in double precision. Some of the faults give wrong
numbers; those of :data:`MANY_AXES` end the process, and are tried in one of their own. Which release fails where, and
what keeps it from failing, stands at :data:`august_jax.FUSES_SUMS_WRONGLY`.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np

__all__ = ["MANY_AXES", "TRIALS", "many_axes_fault", "wrong_sums"]

_TOLERANCE = 1e-4
"""Of the largest term: some hundred times the rounding of these sums in single precision."""
_PATIENCE_S = 120.0


def _error(found: jax.Array, right: np.ndarray) -> float:
    """Largest deviation, in parts of the largest value."""
    return float(np.abs(np.asarray(found, np.float64) - right).max() / np.abs(right).max())


def _broadcast_again() -> float:
    first, second = (np.sin(scale * np.arange(192.0, dtype=np.float32)).reshape(64, 3) for scale in (1.0, 2.0))
    rows = np.cos(np.arange(500.0, dtype=np.float32))[:, None]
    found = jax.jit(jax.vmap(lambda one: jnp.sum(first * one, axis=-1) + rows))(second)
    return _error(found, (second.astype(np.float64) @ first.T)[:, None] + rows)


def _mapped_product(dtype: type[np.floating], count: int) -> float:
    """|M x|^2 of the rows x = (i, 0, 0), M the identity; the fault shows in the row that begins a further block."""
    with jax.enable_x64(dtype is np.float64):
        places = np.zeros((count, 3), dtype)
        places[:, 0] = np.arange(count)
        matrix = jnp.eye(3, dtype=dtype)
        found = jax.jit(jax.vmap(lambda place: jnp.sum((matrix @ place) ** 2)))(places)
        return _error(found, np.arange(count, dtype=np.float64) ** 2)


def _eight_axes() -> float:
    first, second = np.ones((10, 4, 6), np.float32), np.ones((10, 4, 6, 9, 9, 9, 9, 9), np.float32)
    found = jax.jit(lambda few, many: jnp.log(jnp.sum(few[..., None, None, None, None, None] * many, axis=2)))
    return _error(found(first, second), np.full(1, np.log(6.0)))


def _seven_axes() -> float:
    first, second = np.random.default_rng(0).normal(size=(2, 3, 1, 2, 2, 8, 8, 8)).astype(np.float32)
    found = jax.jit(lambda left, right: jnp.sum(left * right, axis=3))(first, second)
    return _error(found, (first.astype(np.float64) * second).sum(axis=3))


TRIALS: Mapping[str, Callable[[], float]] = {
    "sums that are broadcast again": _broadcast_again,
    "32,769 mapped products in single precision": lambda: _mapped_product(np.float32, 32_769),
    "16,385 mapped products in double precision": lambda: _mapped_product(np.float64, 16_385),
}
"""What is summed -> its largest error, in parts of the largest value."""

MANY_AXES: Mapping[str, Callable[[], float]] = {
    "products with 8 axes": _eight_axes,
    "products with 7 axes": _seven_axes,
}
"""As :data:`TRIALS`, where the fault ends the process."""


def wrong_sums(trials: Mapping[str, Callable[[], float]] = TRIALS) -> list[str]:
    """What comes out wrong on this machine's CPU, in this process; empty where all is well.

    On the CPU also where a GPU is the default, unless ``JAX_PLATFORMS`` leaves the CPU out.
    """
    try:
        place = jax.devices("cpu")[0]
    except RuntimeError:
        place = None
    with jax.default_device(place):
        errors = {name: trial() for name, trial in trials.items()}
    return [f"{name} are off by {error:.1g}" for name, error in errors.items() if not error < _TOLERANCE]


def many_axes_fault() -> str | None:
    """What is wrong with sums of products with many axes, tried in a process of their own; None where all is well."""
    code = f"from {__name__} import MANY_AXES, wrong_sums; print('; '.join(wrong_sums(MANY_AXES)))"
    try:
        run = subprocess.run(
            [sys.executable, "-c", code],
            env=os.environ | {"JAX_PLATFORMS": "cpu"},
            text=True,
            capture_output=True,
            timeout=_PATIENCE_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"products with 7 or 8 axes do not end within {_PATIENCE_S:.0f} s"
    if run.returncode:
        return f"products with 7 or 8 axes end the process (status {run.returncode})"
    return run.stdout.strip() or None
