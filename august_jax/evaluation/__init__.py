"""How good answers are: metrics, scores, the bound and where it is left, and the loop over schemes and SNRs."""

from august_jax.evaluation.bound import Bound
from august_jax.evaluation.evaluate import evaluate, validator
from august_jax.evaluation.followed import score_flown, score_followed
from august_jax.evaluation.metrics import along_and_across_m, mcd_db, mde, mpe_m, wd_db
from august_jax.evaluation.score import NOTE, score, score_track
from august_jax.evaluation.threshold import threshold_db, thresholds

__all__ = [
    "NOTE",
    "Bound",
    "along_and_across_m",
    "evaluate",
    "mcd_db",
    "mde",
    "mpe_m",
    "score",
    "score_flown",
    "score_followed",
    "score_track",
    "threshold_db",
    "thresholds",
    "validator",
    "wd_db",
]
