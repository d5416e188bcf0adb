"""Ways to answer where a target is, how it is turned and what it looks like, all under one contract.

Evaluation loops over :data:`SCHEMES`, in this order.
"""

from august_jax.schemes.answer import Answer, Ask, Scheme, Setting, Slots, Truth
from august_jax.schemes.baselines import MEAN_SHAPE, PREDICTION, RESAMPLING, UP, mean_shape
from august_jax.schemes.followed import Flown, follow_flight
from august_jax.schemes.matched_field import MATCHED_FIELD
from august_jax.schemes.networks import AUGUST, lines_of, title_of
from august_jax.schemes.polar import POLAR, POLAR_ANGLES

SCHEMES: dict[str, Scheme] = {
    scheme.name: scheme
    for scheme in (AUGUST, MATCHED_FIELD, POLAR, POLAR_ANGLES, PREDICTION, UP, MEAN_SHAPE, RESAMPLING)
}
"""The schemes by name."""

__all__ = [
    "SCHEMES",
    "Answer",
    "Ask",
    "Flown",
    "Scheme",
    "Setting",
    "Slots",
    "Truth",
    "follow_flight",
    "lines_of",
    "mean_shape",
    "title_of",
]
