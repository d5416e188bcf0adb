"""Physics as the estimator: which known craft, how turned, where and of what explains an echo, and how surely."""

from august_jax.inference.find import LEVEL, find_craft, refined
from august_jax.inference.follow import DETECTED_SLOTS, LOST, Belief, Follower, Step
from august_jax.inference.hypotheses import Hypotheses, Posterior
from august_jax.inference.library import Library, known_craft
from august_jax.inference.motion import Motion
from august_jax.inference.prior import GAIN_DB, Prior
from august_jax.inference.refine import Candidates

__all__ = [
    "DETECTED_SLOTS",
    "GAIN_DB",
    "LEVEL",
    "LOST",
    "Belief",
    "Candidates",
    "Follower",
    "Hypotheses",
    "Library",
    "Motion",
    "Posterior",
    "Prior",
    "Step",
    "find_craft",
    "known_craft",
    "refined",
]
