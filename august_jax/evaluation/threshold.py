"""Where a posterior's own expected error parts from the local bound: the threshold SNR.

A bound by Fisher information knows the neighbourhood of the truth alone. A posterior knows every explanation of the
echo: while several are left, its mean errs by what lies between them, and the bound says nothing of that. The SNR from
which on there is no such difference is the threshold. It is looked for among the SNRs that were measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from august_jax.arrays import Array

WITHIN = 1.5
"""How many times the bound an expected error may be and still count as it: of lengths and angles. 1 - cos of an angle
goes with its square, and so does its factor."""
METRICS = {
    "position": ("expected_mpe_m", "own_bound_m", WITHIN),
    "normal": ("expected_mde", "own_bound_mde", WITHIN**2),
}
"""What is compared: names in a row of the expected error and of the bound on the same slots, and the factor."""


def threshold_db(
    snr_db: Float[Array, " n"], expected: Float[Array, " n"], bound: Float[Array, " n"], within: float = WITHIN
) -> float | None:
    """The lowest of n SNRs from which on, at every one of them, ``expected`` is at most ``within`` times ``bound``.

    Args:
        snr_db: in any order [dB].
        expected: errors that a posterior expects of its mean.
        bound: in the same unit.
        within: the factor.

    Returns:
        That SNR [dB]; -inf where it is the lowest of all, so that the threshold lies below what was measured; None
        where the highest SNR does not reach it.

    Raises:
        ValueError: no SNR, or numbers that are not finite.
    """
    values = np.asarray([snr_db, expected, bound], np.float64)
    if not values.size or not np.all(np.isfinite(values)):
        raise ValueError("snr_db, expected, bound: give finite numbers, at least one of each")
    order = np.argsort(values[0])
    near = values[1][order] <= within * values[2][order]
    if not near[-1]:
        return None
    first = int(np.argmin(near[::-1]))  # from above, the first that is not near; 0 where all are
    return -math.inf if first == 0 else float(values[0][order][len(near) - first])


def said(found: float | None, snr_db: Float[Array, " n"]) -> str:
    """A threshold in words: "20 dB", "below 0 dB" or "not reached by 30 dB"."""
    if found is None:
        return f"not reached by {np.max(snr_db):g} dB"
    return f"{found:g} dB" if math.isfinite(found) else f"below {np.min(snr_db):g} dB"


def thresholds(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The thresholds of the schemes that say how much they expect to err.

    Args:
        rows: of :func:`august_jax.evaluation.evaluate`.

    Returns:
        A row for each such scheme and each of ``position`` and ``normal`` (:data:`METRICS`): ``scheme``, ``of``,
        ``within``, ``threshold_db`` [dB], None where it was not measured to be at one of the SNRs, and ``said``, in
        words. SNRs at which a scheme expects nothing, or the bound is not known, are left out.
    """
    found = []
    for scheme in dict.fromkeys(row["scheme"] for row in rows):
        for of, (expected, bound, within) in METRICS.items():
            told = [
                (row["snr_db"], row[expected], row[bound])
                for row in rows
                if row["scheme"] == scheme and row.get(expected) is not None and row.get(bound) is not None
            ]
            if told:
                snrs, errors, bounds = np.array(told, np.float64).T
                snr = threshold_db(snrs, errors, bounds, within)
                exact = snr if snr is not None and math.isfinite(snr) else None
                found.append(
                    {"scheme": scheme, "of": of, "within": within, "threshold_db": exact, "said": said(snr, snrs)}
                )
    return found
