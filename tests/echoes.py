"""Echoes of generated samples, as a station keeps them, for the tests of a search."""

import jax
import jax.numpy as jnp

from august_jax.data import unpack
from august_jax.signal import observe_region


def echo_of(config, samples, row, snr_db):
    """What the station keeps of a sample's echo, q_pre somewhere in the cube about it."""
    where, noise = jax.random.split(jax.random.fold_in(jax.random.key(1), row))
    half = config.region.threshold_m
    predicted = jnp.asarray(samples.position[row]) + jax.random.uniform(where, (3,), minval=-half, maxval=half)
    channel = unpack(jnp.asarray(samples.true_channel[row]))
    return observe_region(
        noise, channel, predicted, array=config.array, signal=config.signal, region=config.region, snr_db=snr_db
    ).statistics


def truth_of(samples, row):
    """Craft, attitude, place and material of a sample."""
    return (
        int(samples.airframe[row]),
        samples.rotation[row],
        samples.position[row],
        float(samples.permittivity[row]),
        float(samples.conductivity[row]),
    )
