"""A flight followed by any scheme that answers a position, in the closed loop of :mod:`august_jax.tracking.loop`."""

from __future__ import annotations

from functools import partial

import jax
from jaxtyping import Complex, Float

from august_jax.arrays import Array, ArrayLike
from august_jax.config import Config
from august_jax.config.fields import near
from august_jax.models import Networks
from august_jax.schemes import SCHEMES
from august_jax.schemes.answer import Answer, Setting, Slots
from august_jax.signal import Coefficients, Statistics
from august_jax.tracking import Followed, Predictor, follow


def check_scheme(name: str) -> None:
    """Refuse a name of no scheme that answers a position.

    Raises:
        ValueError: names the nearest, and all.
    """
    able = [each for each, scheme in SCHEMES.items() if scheme.follows]
    if name not in able:
        hint = near(name, able)
        what = "says of no place that the craft is there" if name in SCHEMES else "is no scheme"
        raise ValueError(f"scheme: {name!r} {what}; {hint + ' ' if hint else ''}choose of {', '.join(able)}")


def check_follows(name: str, networks: Networks | None, config: Config) -> None:
    """Refuse a scheme that cannot follow a flight with networks alone, or without any.

    Raises:
        ValueError: as :func:`check_scheme`, or it lacks what it needs.
    """
    check_scheme(name)
    if SCHEMES[name].prepare(Setting(config, networks, None, jax.random.key(0))) is None:
        needed = "networks" if name == "august" else "a library of known craft, as schemes.follow_flight takes one"
        raise ValueError(f"scheme: {name!r} needs {needed}; give that, or choose another scheme")


@partial(jax.jit, static_argnames=("scheme", "config", "predictor"))
def follow_by(
    scheme: str,
    networks: Networks | None,
    key: jax.Array,
    channels: Complex[Array, "slots tones antennas antennas"],
    detected: Float[Array, "slots 3"],
    config: Config,
    predictor: Predictor,
    snr_db: ArrayLike,
) -> Followed:
    """The loop over slots, in which a scheme finds the craft; compiled once. What is found is the scheme's answer.

    Args:
        scheme: its name in the registry, one that :func:`check_follows` lets pass.
        networks: those that it asks; None for a scheme without.
        key, channels, detected, config, predictor, snr_db: as :func:`august_jax.tracking.follow` takes them.
    """
    ask = SCHEMES[scheme].prepare(Setting(config, networks, None, key))
    assert ask is not None  # it follows

    def locate(
        key: jax.Array, heard: Array | Coefficients, predicted: jax.Array, snr: jax.Array, statistics: Statistics
    ) -> Answer:
        slot = jax.tree.map(lambda leaf: leaf[None], Slots(predicted, snr, heard, None, statistics))
        return jax.tree.map(lambda leaf: leaf[0], ask(key, slot))

    return follow(key, channels, detected, snr_db, config, predictor, locate)
