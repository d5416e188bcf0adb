"""Four channel estimators of one tone (paper, Section II-B).

Y = H X + N with N circular white, E|N|^2 = sigma^2 an entry. Every estimate is symmetrised, (H + H^T)/2, because a
reciprocal channel is symmetric. The estimators, by name:

* ``ls``: the paper prints Y X^H (X X^H)^{-1}. The codebook of a sector is numerically singular (condition number 1e13
  and more), so the inverse is taken on the singular values of X above a tenth of the largest; how many those are is
  returned as the rank. They are the roots of the eigenvalues of G = X X^H. Of unitary symbols over plane-wave beams it
  is, on an array that is its own mirror image through its centre, persymmetric, J G J = conj(G) with J the reversal of
  the elements; then T = (I + jJ)/sqrt(2) makes T^H G T = Re G - Im G J real and symmetric.
* ``ridge``: Y X^H (X X^H + r I)^{-1}. With the pilots' mean gain on the illuminated directions,
  g = tr((X X^H)^2)/tr(X X^H), and the echo's energy E = ||Y||^2 - ||N||^2, the error is about
  E r^2/g^3 + 2 sigma^2 N_b/r (bias plus noise, for a spectrum that falls by a factor e every two modes); its minimum is
  r = g (sigma^2 N_b/E)^{1/3}.
* ``dft``: plain least squares from unitary pilots of the same power, which light all directions alike.
* ``lmmse_roi``: linear MMSE for a cloud of independent isotropic scatterers that fills the region's box about the
  prediction, H = sum_q a_q g_q g_q^T, a_q ~ CN(0, p w_q) on a Gauss-Legendre grid of nodes q with weights w_q (which
  integrates the covariance of the region exactly enough), p from the echo's energy. In the region's subspace
  (:mod:`august_jax.signal.roi`), c_q = U^H g_q, Z = U^H Y, B = U^T X:

      M_qr = (c_q^H c_r)(c_q^H conj(B) B^T c_r),   (sigma^2 diag(1/(p w)) + M) a = [c_q^H Z B^H conj(c_q)]_q,

      A = sum_q a_q c_q c_q^T,

  one Hermitian solve of 27 unknowns. U has orthonormal columns, so the noise in Z is as white as in Y.

An estimator is added by one function of (received, pilots, noise_w, region), one line in :data:`ESTIMATORS`, and its
name among the choices of ``signal.estimator`` (:mod:`august_jax.config`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Inexact, Int

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.checks import check_finite
from august_jax.physics.green import path_difference
from august_jax.signal.noise import energy, estimate_snr
from august_jax.signal.roi import field_basis

NODES_PER_AXIS = 3
"""Quadrature nodes along each edge of the region's box; four and five change the error by less than 1 dB."""
_KEPT = 0.1  # of the pilots' largest singular value; in float32 their squares do not tell them below some 1e-3


class ChannelEstimate(NamedTuple):
    """An estimated channel.

    Attributes:
        channel: (N_b, N_b) complex, symmetric.
        rank: directions of the pilots that the estimate uses, int32; below N_b where it truncated.
    """

    channel: Complex[Array, "antennas antennas"]
    rank: Int[Array, ""]


class Region(NamedTuple):
    """Where ``lmmse_roi`` expects scatterers, and how one tone sees them.

    Attributes:
        centre: of the box, q_pre (3,) [m].
        half_width_m: half the edge of the box [m].
        positions: array elements (N_b, 3) [m].
        wavenumber: k of the tone [rad/m].
        basis: P (N_b, K) of :func:`august_jax.signal.roi.legendre_basis`.
    """

    centre: Float[Array, "3"]
    half_width_m: float
    positions: Float[Array, "antennas 3"]
    wavenumber: ArrayLike
    basis: Float[Array, "antennas orders"]


Received = Complex[Array, "antennas symbols"]
"""Y (N_b, L) [sqrt(W)]."""
Pilots = Complex[Array, "antennas symbols"]
"""X (N_b, L) [sqrt(W)]."""


@dataclass(frozen=True)
class Estimator:
    """An estimator and what it asks of the station.

    Attributes:
        run: (Y, X, sigma^2, region) -> :class:`ChannelEstimate`, for one tone. The station hands Y and X over in units
            of the noise's amplitude, with sigma^2 = 1; any other unit must do as well.
        needs: which of ``noise_w`` and ``region`` must be given.
        uniform_pilots: it wants unitary pilots that light all directions alike, not the region's beams.
        run_beams: what ``run`` comes to, sooner, for pilots X = W S of unitary symbols (S S^H = L I) over the
            plane-wave beams of :func:`~august_jax.signal.beams.roi_codebook`, and wrong for others; None where
            nothing is saved.
    """

    run: Callable[[Received, Pilots, Any, Any], ChannelEstimate]
    needs: tuple[str, ...] = ()
    uniform_pilots: bool = False
    run_beams: Callable[[Received, Pilots, Any, Any], ChannelEstimate] | None = None


def estimate_channel(
    name: str, received: Received, pilots: Pilots, *, noise_w: ArrayLike | None = None, region: Region | None = None
) -> ChannelEstimate:
    """Channel estimate of one tone.

    Args:
        name: one of :data:`ESTIMATORS`.
        received: Y (N_b, L) [sqrt(W)].
        pilots: X (N_b, L) [sqrt(W)]; for ``dft`` with X X^H proportional to the identity.
        noise_w: sigma^2 [W]; needed by ``ridge`` and ``lmmse_roi``.
        region: needed by ``lmmse_roi``.

    Raises:
        ValueError: an unknown name, shapes that do not fit, numbers that are not finite, or a missing argument.
    """
    if name not in ESTIMATORS:
        raise ValueError(f"name: unknown estimator {name!r}; choose one of {', '.join(ESTIMATORS)}")
    if received.ndim != 2 or received.shape != pilots.shape:
        raise ValueError(
            f"received: got shape {received.shape} for pilots of shape {pilots.shape}; both must be (N_b, L), "
            "map over more axes with jax.vmap"
        )
    check_finite("received", received, "leave that slot out")
    check_finite("pilots", pilots, "give what was sent")
    given = {"noise_w": noise_w, "region": region}
    wanted = {"noise_w": "the noise power in W", "region": "the region of interest, a Region(...)"}
    for missing in ESTIMATORS[name].needs:
        if given[missing] is None:
            raise ValueError(f"{missing}: {name} needs {wanted[missing]}; pass {missing}=")
    return ESTIMATORS[name].run(received, pilots, noise_w, region)


def least_squares(
    received: Received,
    pilots: Pilots,
    noise_w: ArrayLike | None = None,
    region: Region | None = None,
    *,
    beams: bool = False,
) -> ChannelEstimate:
    """Y X^H (X X^H)^+ on the singular values of X above a tenth of the largest, symmetrised.

    With ``beams`` by the module docstring's real form, for unitary symbols over plane-wave beams alone.
    """
    gram = pilots @ pilots.conj().T
    if beams:
        real, rank = _inverse_above(gram.real - gram.imag[:, ::-1], _KEPT**2)
        # T R T^H of the real form's inverse R
        inverse = jax.lax.complex(0.5 * (real + real[::-1, ::-1]), 0.5 * (real[::-1] - real[:, ::-1]))
    else:
        inverse, rank = _inverse_above(gram, _KEPT**2)
    return ChannelEstimate(_symmetrise(received @ pilots.conj().T @ inverse), rank)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _inverse_above(matrix: Inexact[Array, "n n"], share: float) -> tuple[Inexact[jax.Array, "n n"], Int[jax.Array, ""]]:
    """Inverse of a positive semidefinite matrix on its eigenvalues above a share of the largest, and how many those
    are."""
    _, vectors, inverses = _above(matrix, share)
    return _put_together(vectors, inverses)


@_inverse_above.defjvp
def _inverse_above_jvp(share: float, primals: tuple, tangents: tuple):
    """By divided differences of what is done to the eigenvalues, finite where eigenvalues meet, where eigenvectors have
    no derivative: -1/(a b) between two that are kept, 1/(a (a - b)) between one that is and one that is not."""
    (matrix,), (tangent,) = primals, tangents
    values, vectors, inverses = _above(matrix, share)
    kept = inverses > 0.0
    apart = kept[:, None] != kept
    gaps = jnp.where(apart, values[:, None] - values, 1.0)
    slopes = jnp.where(apart, (inverses[:, None] - inverses) / gaps, -inverses[:, None] * inverses)
    turned = vectors @ (slopes * (vectors.conj().T @ tangent @ vectors)) @ vectors.conj().T
    inverse, rank = _put_together(vectors, inverses)
    return (inverse, rank), (turned, np.zeros(rank.shape, jax.dtypes.float0))


def _above(matrix: Inexact[Array, "n n"], share: float):
    """Eigenvalues (n,), ascending, eigenvectors (n, n), and one over each value, zero up to a share of the largest."""
    values, vectors = jnp.linalg.eigh(matrix)
    kept = values > share * values[-1]
    return values, vectors, jnp.where(kept, 1.0 / jnp.where(kept, values, 1.0), 0.0)


def _put_together(vectors: Inexact[Array, "n n"], inverses: Float[Array, " n"]):
    return (vectors * inverses) @ vectors.conj().T, jnp.sum(inverses > 0.0, dtype=jnp.int32)


def ridge(received: Received, pilots: Pilots, noise_w: ArrayLike, region: Region | None = None) -> ChannelEstimate:
    """Y X^H (X X^H + r I)^{-1}, r as in the module's docstring, symmetrised."""
    count = pilots.shape[0]
    gram = pilots @ pilots.conj().T
    signal = estimate_snr(received, noise_w) * noise_w * received.size
    gain = energy(gram) / energy(pilots)
    regulariser = gain * jnp.cbrt(noise_w * count / signal)
    # Dividing by the gain keeps float32 away from the squares of milliwatts.
    system = gram / gain + (regulariser / gain) * jnp.eye(count, dtype=gram.dtype)
    cross = received @ pilots.conj().T / gain
    channel = jnp.linalg.solve(system.T, cross.T).T
    return ChannelEstimate(_symmetrise(channel), jnp.asarray(count, jnp.int32))


def orthogonal_least_squares(
    received: Received, pilots: Pilots, noise_w: ArrayLike | None = None, region: Region | None = None
) -> ChannelEstimate:
    """Y X^H / (||X||^2/N_b): least squares where X X^H is a multiple of the identity, symmetrised."""
    count = pilots.shape[0]
    channel = received @ pilots.conj().T * (count / energy(pilots))
    return ChannelEstimate(_symmetrise(channel), jnp.asarray(count, jnp.int32))


def lmmse_roi(received: Received, pilots: Pilots, noise_w: ArrayLike, region: Region) -> ChannelEstimate:
    """Linear MMSE over the region (see the module's docstring); symmetric by construction."""
    scale = jnp.sqrt(noise_w)
    waves = field_basis(region.centre, region.positions, region.wavenumber, region.basis)
    coefficients = roi_coefficients(waves.conj().T @ received / scale, waves.T @ pilots / scale, region)
    channel = waves @ coefficients @ waves.T
    return ChannelEstimate(channel, jnp.asarray(pilots.shape[0], jnp.int32))


def roi_coefficients(
    reduced_echo: Complex[Array, "orders symbols"], reduced_pilots: Complex[Array, "orders symbols"], region: Region
) -> Complex[jax.Array, "orders orders"]:
    """Linear MMSE estimate of A from Z = A B + N with white noise of unit power.

    Args:
        reduced_echo: Z = U^H Y / sigma (K, L).
        reduced_pilots: B = U^T X / sigma (K, L).
        region: the box, the array and the tone.

    Returns:
        A (K, K) complex, symmetric.
    """
    offsets, weights = _box_nodes()
    nodes = region.centre + region.half_width_m * jnp.asarray(offsets, region.centre.dtype)
    positions = jnp.asarray(region.positions, region.centre.dtype)
    # Path lengths to the nodes less those to the prediction: the phases of U are already taken out.
    differences = path_difference(positions, nodes[:, None])
    angle = region.wavenumber * (differences - path_difference(positions, region.centre))
    basis = jnp.asarray(region.basis)
    waves = jax.lax.complex(jnp.cos(angle) @ basis, jnp.sin(angle) @ basis).T  # c_q as columns (K, Q)
    cross = reduced_echo @ reduced_pilots.conj().T
    gains = (reduced_pilots @ reduced_pilots.conj().T).conj()
    gram = (waves.conj().T @ waves) * (waves.conj().T @ gains @ waves)
    matched = jnp.sum(waves.conj() * (cross @ waves.conj()), axis=0)
    signal = estimate_snr(reduced_echo, 1.0) * reduced_echo.size
    root = jnp.asarray(np.sqrt(weights), angle.dtype)
    received = jnp.sum(root**2 * jnp.real(jnp.diagonal(gram)))
    scatterer_power = signal / received
    # Rounding in the Gram matrix acts like noise; beyond some 35 dB it outweighs the noise in float32.
    floor = 1.0 + jnp.finfo(angle.dtype).eps * signal
    system = scatterer_power * root[:, None] * gram * root + floor * jnp.eye(root.size, dtype=gram.dtype)
    amplitudes = scatterer_power * root * jnp.linalg.solve(system, root * matched)
    return (waves * amplitudes) @ waves.T


def _box_nodes() -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes (Q, 3) of the cube [-1, 1]^3 and their weights (Q,), which add up to one."""
    places, weights = np.polynomial.legendre.leggauss(NODES_PER_AXIS)
    nodes = np.stack(np.meshgrid(places, places, places, indexing="ij"), axis=-1).reshape(-1, 3)
    products = np.einsum("i,j,k->ijk", weights, weights, weights).reshape(-1) / 8.0
    return nodes, products


def _symmetrise(channel: jax.Array) -> jax.Array:
    return 0.5 * (channel + channel.T)


ESTIMATORS: dict[str, Estimator] = {
    "ls": Estimator(least_squares, run_beams=partial(least_squares, beams=True)),
    "ridge": Estimator(ridge, needs=("noise_w",)),
    "dft": Estimator(orthogonal_least_squares, uniform_pilots=True),
    "lmmse_roi": Estimator(lmmse_roi, needs=("noise_w", "region")),
}
"""The estimators, by the name that ``signal.estimator`` gives them."""
