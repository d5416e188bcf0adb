"""Spans of fields: an orthonormal basis of the columns of a matrix, and as many of its rows as determine all others.

With U the basis and S the rows chosen (pivoted QR, as in the discrete empirical interpolation method), any x in the
span is U U_S^{-1} x_S. The body's fields over its cells and over the antennas' aperture are both thinned so.
"""

from __future__ import annotations

import numpy as np


def spanned(matrix: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal basis of the columns and its singular values, down to ``tolerance`` of the largest."""
    tall = matrix.shape[0] >= matrix.shape[1]
    values, vectors = np.linalg.eigh(matrix.conj().T @ matrix if tall else matrix @ matrix.conj().T)
    keep = values > max(tolerance**2, 1e-15) * values[-1]
    values, vectors = np.sqrt(values[keep][::-1]), vectors[:, keep][:, ::-1]
    return (matrix @ vectors / values if tall else vectors), values


def pivots(basis: np.ndarray) -> np.ndarray:
    """As many rows of an orthonormal basis as it has columns, chosen to be well conditioned; sorted."""
    import scipy.linalg

    _, order = scipy.linalg.qr(basis.T.astype(np.float32), mode="r", pivoting=True)
    return np.sort(order[: basis.shape[1]])
