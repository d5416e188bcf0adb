"""What a base station makes of true channels: predictions and levels are drawn, the echo is observed.

A sample is observed once when it is made and, with ``train.reobserve``, anew in every step, so that a network never
sees the same echo twice; for the encoder ``roi`` the echo is formed in the region's subspace, where it costs little.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Float

from august_jax.arrays import Array, ArrayLike, rows_not_finite
from august_jax.config import Config
from august_jax.data.fields import Batch, Sample, unpack
from august_jax.scene.cloud import to_cloud
from august_jax.signal.roi import Coefficients
from august_jax.signal.station import observe_for


def draw_prediction(key: jax.Array, position: Float[Array, "3"], config: Config) -> Float[jax.Array, "3"]:
    """A predicted position (3,) [m]: the true one, missed uniformly within the threshold along each axis."""
    threshold = config.region.threshold_m
    return position + jax.random.uniform(key, (3,), minval=-threshold, maxval=threshold)


def draw_level(key: jax.Array, config: Config) -> dict[str, jax.Array]:
    """``snr_db`` or ``power_dbm``, uniform in its range, as ``signal.draw`` says; arguments of ``observe``."""
    name = "snr_db" if config.signal.draw == "snr" else "power_dbm"
    low, high = getattr(config.signal, name)
    return {name: jax.random.uniform(key, minval=low, maxval=high)}


def observed_anew(
    key: jax.Array, samples: Sample, config: Config, snr_db: ArrayLike | None = None, *, statistics: bool = False
) -> Batch:
    """The networks' batch of true channels under new predictions, SNRs, pilots and noise.

    Args:
        key: of all that is drawn.
        samples: n of them; what they hold as observed is not looked at.
        config: static.
        snr_db: () or None; None draws the level as the configuration says.
        statistics: static; whether the batch holds what the echoes say beside what networks are told of them.

    Raises:
        ValueError: a sample that holds NaN or infinity.
    """
    for name, column in samples._replace(observed=None).columns().items():
        if len(wrong := rows_not_finite(column)):
            raise ValueError(
                f"samples: {name} holds NaN or infinity in {len(wrong)} of {samples.rows} samples, the first is "
                f"{wrong[0]}; leave them out"
            )
    return _observed_anew(key, samples, config, snr_db, statistics=statistics)


@partial(jax.jit, static_argnames=("config", "statistics"))
def _observed_anew(
    key: jax.Array, samples: Sample, config: Config, snr_db: ArrayLike | None, *, statistics: bool
) -> Batch:
    def one(key: jax.Array, packed: jax.Array, position: jax.Array):
        predicted_key, level_key, echo_key = jax.random.split(key, 3)
        predicted = draw_prediction(predicted_key, position, config)
        level = draw_level(level_key, config) if snr_db is None else {"snr_db": snr_db}
        seen = observe_for(config, echo_key, unpack(packed), predicted, **level)
        return predicted, seen.snr_estimate_db, seen.heard, seen.statistics if statistics else None

    keys = jax.random.split(key, samples.rows)
    predicted, level, heard, said = jax.vmap(one)(keys, samples.true_channel, samples.position)
    return _batch(samples, predicted, level, heard, config)._replace(statistics=said)


def as_observed(samples: Sample, config: Config) -> Batch:
    """The networks' batch of samples as they were observed when they were made.

    Raises:
        ValueError: that was not kept.
    """
    if samples.observed is None:
        raise ValueError(
            "data.observed: these samples were made with false, without what the base station made of "
            "them; set train.reobserve=true, or make others with data.observed=true"
        )
    seen = samples.observed
    heard = unpack(jnp.asarray(seen.estimated_channel))
    return _batch(
        samples.each(jnp.asarray), jnp.asarray(seen.predicted), jnp.asarray(seen.snr_estimate_db), heard, config
    )


def batch_of(key: jax.Array, samples: Sample, config: Config) -> Batch:
    """:func:`observed_anew` or, without ``train.reobserve``, :func:`as_observed`."""
    return observed_anew(key, samples, config) if config.train.reobserve else as_observed(samples, config)


def _batch(
    samples: Sample, predicted: jax.Array, snr_db: jax.Array, heard: Array | Coefficients, config: Config
) -> Batch:
    cloud = to_cloud(
        samples.points, samples.position, predicted, samples.permittivity, samples.conductivity, config.region
    )
    return Batch.of(predicted, snr_db, cloud, heard)
