"""A flight whose truth and 'reconstruction' are made up: what the pictures and the report are tested with."""

import jax
import numpy as np

from august_jax.scene.airframes import procedural_airframe
from august_jax.tracking import Track


def made_up_track(slots: int = 3, points: int = 400, noise_m: float = 0.01) -> Track:
    rng = np.random.default_rng(1)
    body, other = (
        np.asarray(procedural_airframe("quad_x").sample_surface(jax.random.key(seed), points), np.float64)
        for seed in range(2)
    )
    time = 0.2 * np.arange(slots)
    position = np.stack([4.0 + 2.0 * time, 6.0 + np.sin(time), 3.0 + 0.3 * time], axis=-1)
    angle = np.radians(5.0 + 20.0 * time)
    zero, one = np.zeros(slots), np.ones(slots)
    rotation = np.stack(
        [np.cos(angle), zero, np.sin(angle), zero, one, zero, -np.sin(angle), zero, np.cos(angle)], axis=-1
    ).reshape(slots, 3, 3)
    truth = position[:, None] + np.einsum("tab,nb->tna", rotation, body)
    resampled = position[:, None] + np.einsum("tab,nb->tna", rotation, other)
    miss = rng.normal(0.0, 0.05, (slots, 1, 3))
    normal = rotation[..., 2] + rng.normal(0.0, 0.1, (slots, 3))
    return Track(
        time_s=time,
        position=position,
        rotation=rotation,
        predicted=position + rng.uniform(-0.3, 0.3, (slots, 3)),
        snr_db=np.full(slots, 20.0),
        permittivity=3.2,
        conductivity=5e-3,
        truth=truth,
        resampled=resampled,
        points=truth + miss + rng.normal(0.0, noise_m, truth.shape),
        point_permittivity=rng.normal(3.1, 0.2, truth.shape[:2]),
        point_conductivity=rng.normal(5e-3, 5e-4, truth.shape[:2]),
        normal_estimate=normal / np.linalg.norm(normal, axis=-1, keepdims=True),
    )
