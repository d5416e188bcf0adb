"""The closed loop: what is found in one slot says where to look in the next."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.config import FlightConfig, override, preset
from august_jax.schemes import Answer
from august_jax.tracking import PREDICTORS, follow, predict_next
from august_jax.tracking.loop import DETECTED_SLOTS

CONFIG = override(preset("smoke"), ["signal.estimator=ls"])
SLOTS = 9


@pytest.mark.parametrize("name", list(PREDICTORS))
def test_the_loop_predicts_from_what_was_found(name):
    """A locator that knows the truth: predictions are those that the predictor makes of the true positions."""
    rng = np.random.default_rng(0)
    count = CONFIG.array.count
    wave = rng.normal(size=(SLOTS, count)) + 1j * rng.normal(size=(SLOTS, count))
    channels = jnp.asarray(1e-6 * np.einsum("tn,tm->tnm", wave, wave)[:, None], jnp.complex64)
    time = 0.2 * np.arange(SLOTS)[:, None]
    true = jnp.asarray(np.array([5.0, 6.0, 3.0]) + time * [1.0, -0.5, 0.2], jnp.float32)
    detected = true + 0.3
    predictor = PREDICTORS[name].for_flight(FlightConfig(slot_s=0.2))
    asked = []

    def locate(key, heard, predicted, snr_db, statistics):
        # the true place that lies next to where it is told to look: 0.3 m against 0.23 m a slot, half a metre at most
        place = true[jnp.argmin(jnp.sum((true - predicted) ** 2, axis=-1) + 0 * snr_db)]
        asked.append(heard)
        return Answer(position=place)

    seen = jax.jit(lambda: follow(jax.random.key(0), channels, detected, 20.0, CONFIG, predictor, locate))()
    np.testing.assert_allclose(seen.predicted[:DETECTED_SLOTS], detected[:DETECTED_SLOTS])
    for slot in range(DETECTED_SLOTS, SLOTS):
        made = predict_next(predictor, seen.found.position[:slot]).position
        np.testing.assert_allclose(seen.predicted[slot], made, atol=1e-4)
    np.testing.assert_allclose(seen.snr_db, 20.0, atol=1.5)  # 64 noise entries: 0.5 dB
    assert asked and seen.found.position.shape == (SLOTS, 3)
