"""Rigid bodies whose coupled system is factored once and serves every pose and material."""

from august_jax.files import cache_folder
from august_jax.physics.body.aperture import aperture_skeleton
from august_jax.physics.body.body import Body, alike, body_channel, evened, judge_contrast
from august_jax.physics.body.factor import factor_bodies, factor_body

__all__ = [
    "Body",
    "alike",
    "aperture_skeleton",
    "body_channel",
    "cache_folder",
    "evened",
    "factor_bodies",
    "factor_body",
    "judge_contrast",
]
