"""Devices that are asked for and not there: what JAX leaves unsaid, put into words."""

from __future__ import annotations

__all__ = ["describe_backend_error"]


def describe_backend_error(error: BaseException) -> str | None:
    """What to tell the user if ``error`` came of a device that ``JAX_PLATFORMS`` names and that is not there.

    On such a machine the first computation raises, depending on the platform, an AssertionError without a word or a
    RuntimeError. That the device is missing is then found by asking for devices once more, not by the error's text.

    Args:
        error: whatever a command raised.

    Returns:
        One line with the variable, its value and the way out; None for every other error.
    """
    if not isinstance(error, (AssertionError, RuntimeError)):
        return None
    import jax

    wanted = jax.config.jax_platforms  # type: ignore[attr-defined]  # an attribute from when JAX is imported
    if not wanted:
        return None
    try:
        jax.devices()
    except (AssertionError, RuntimeError) as again:
        said = str(again).partition("(set JAX_PLATFORMS")[0].strip()
        return (
            f"JAX_PLATFORMS: {wanted!r}, but JAX finds no such device here{f' ({said})' if said else ''}; unset "
            "JAX_PLATFORMS, or set JAX_PLATFORMS=cpu (for an NVIDIA GPU JAX needs its driver and jax[cuda12])"
        )
    return None
