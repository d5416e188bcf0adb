r"""A craft as a T-matrix: what it makes of spherical waves, for other tools.

Under e^{-jwt}, with X_lm = L Y_lm/sqrt(l(l+1)), L = -j r x grad (Jackson, section 9.7; orthonormal on the sphere,
Condon and Shortley's phase), spherical waves are

    M_lm = z_l(kr) X_lm,    N_lm = (1/k) curl M_lm = (1/kr) (kr z_l)' r^ x X_lm + j sqrt(l(l+1)) z_l/(kr) Y_lm r^,

regular with z = j_l, outgoing with z = h_l. Of an incident field sum a W_regular the craft makes the scattered one
sum (T a) W_outgoing, outside of the sphere about it. Green's function is jk sum W_outgoing(r) W*_regular(r'), so that

    T_ab = jk k^2 sum_n W*_a(r_n) . D_n E_n(W_b),

the bilinear form of :mod:`august_jax.physics.mom` with regular waves in the place of the antennas' fields. Rows and
columns run over l = 1, 2, ..., then m = -l..l, then N (electric) before M (magnetic): the order, the waves, the phases
and the e^{-jwt} of treams (parity basis). For a sphere T is diagonal: -a_l of Mie's series for N, -b_l for M.

A lossless craft keeps energy: T + T^H + 2 T^H T = 0. It is reciprocal: T_(lm)(l'm') = (-1)^(m+m') T_(l'-m')(l-m).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float, Int
from scipy.special import lpmv, spherical_jn

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.array import wavenumber
from august_jax.physics.body.body import Body, in_modes, judge_contrast
from august_jax.physics.cells import Cells
from august_jax.physics.checks import (
    check_cells,
    check_contrast,
    check_frequency,
    edges_and_fills,
    is_concrete,
    settled_cells,
    warn_of_coarse_cells,
)
from august_jax.physics.mom import interaction_matrix, solve_dense, weighted_fields
from august_jax.physics.rcs import polarisations

_HIGHEST = 80


class SphericalBasis(NamedTuple):
    """What the rows and columns of a T-matrix are (n,) each, n = 2 L (L + 2).

    Attributes:
        degree: l, from 1.
        order: m, from -l to l.
        electric: 1 for N, 0 for M.
    """

    degree: Int[np.ndarray, " n"]
    order: Int[np.ndarray, " n"]
    electric: Int[np.ndarray, " n"]


def spherical_basis(degree: int) -> SphericalBasis:
    """The basis up to a degree L.

    Raises:
        ValueError: a degree below 1, or above 80, where factorials leave double precision.
    """
    if not 1 <= degree <= _HIGHEST:
        raise ValueError(f"degree: got {degree}; give a whole number from 1 to {_HIGHEST}")
    rows = [(l, m, p) for l in range(1, degree + 1) for m in range(-l, l + 1) for p in (1, 0)]  # noqa: E741
    return SphericalBasis(*np.array(rows).T)


def degree_for(radius_m: float, frequency_hz: float) -> int:
    """L that waves about a craft of a radius [m] need: ceil(x + 3 x^(1/3) + 1), x = kR (after Wiscombe)."""
    x = wavenumber(check_frequency("frequency_hz", frequency_hz)) * radius_m
    return max(1, math.ceil(x + 3.0 * x ** (1.0 / 3.0) + 1.0))


def regular_waves(points: Float[np.ndarray, "p 3"], wavenumber: float, degree: int) -> Complex[np.ndarray, "p 3 n"]:
    """The regular waves of :func:`spherical_basis` at points (P, 3) [m], Cartesian, complex128."""
    points = np.asarray(points, np.float64)
    distance = np.linalg.norm(points, axis=-1)
    # waves are smooth at the origin, where the sum of their two parts does not depend on the direction that is taken
    outward = np.where(distance[:, None] > 0.0, points / np.maximum(distance, 1e-300)[:, None], [0.0, 0.0, 1.0])
    x = np.maximum(wavenumber * distance, 1e-8)
    waves = np.empty((len(points), 3, 2 * degree * (degree + 2)), complex)
    column = 0
    for l in range(1, degree + 1):  # noqa: E741
        radial, over = spherical_jn(l, x), spherical_jn(l, x) / x
        slope = spherical_jn(l, x, derivative=True) + over
        scalar, vector = _harmonics(l, outward)
        across = np.cross(outward[:, None, :], vector)
        for row in range(2 * l + 1):
            along = 1j * math.sqrt(l * (l + 1)) * (over * scalar[:, row])[:, None] * outward
            waves[:, :, column] = slope[:, None] * across[:, row] + along
            waves[:, :, column + 1] = radial[:, None] * vector[:, row]
            column += 2
    return waves


def t_matrix(
    craft: Body | Cells, contrast: ArrayLike | Sequence, degree: int, *, frequency_hz: float | None = None
) -> Complex[np.ndarray, "*tones n n"]:
    """T of a craft about its own origin.

    Args:
        craft: a factored body or, for a coupled solve of its own, cells.
        contrast: chi, a scalar; of a body of F tones also (F,), of cells also (N,), one value a cell.
        degree: L, see :func:`degree_for`.
        frequency_hz: of cells; a body has its own.

    Returns:
        (n, n), or (F, n, n) for a body of several tones; complex128 from single precision.

    Raises:
        ValueError: a degree that is none of 1 to 80, a contrast of another shape or traced, a frequency where none
            belongs or none where one does, malformed cells.

    Warns as :func:`august_jax.physics.scattering_matrix` does.
    """
    spherical_basis(degree)
    of_body = isinstance(craft, Body)
    values = len(craft.frequencies_hz) if of_body else craft.count
    check_contrast(contrast, ((), (values,)), f"a scalar or ({values},), one value a {'tone' if of_body else 'cell'}")
    if not is_concrete((craft, contrast)):
        raise ValueError("craft, contrast: are traced; a T-matrix takes numbers, trace scattering_matrix instead")
    if isinstance(craft, Body):
        if frequency_hz is not None:
            raise ValueError(f"frequency_hz: got {frequency_hz:g}; a body has its own: leave it out")
        judge_contrast(craft, contrast)
        found = [
            _of_body(craft, tone, complex(chi), degree)
            for tone, chi in enumerate(np.broadcast_to(np.asarray(contrast), (values,)))
        ]
        return found[0] if craft.single else np.stack(found)
    if frequency_hz is None:
        raise ValueError("frequency_hz: got None; cells need the frequency [Hz] that they are asked at")
    k = wavenumber(check_frequency("frequency_hz", frequency_hz))
    check_cells(craft)
    warn_of_coarse_cells(*edges_and_fills(craft), contrast, k)
    cells = settled_cells(craft)
    waves = _flat(regular_waves(np.asarray(cells.sites()), k, degree))
    matrix = _solved(cells, jnp.asarray(contrast), jnp.asarray(waves), k)
    return 1j * k**3 * np.asarray(matrix, complex)


def scattering_from_t_matrix(
    matrix: Complex[np.ndarray, "n n"],
    receive: Float[Array, "looks 3"],
    transmit: Float[Array, "looks 3"] | Float[Array, "3"] | None = None,
    *,
    frequency_hz: float,
) -> Complex[np.ndarray, "looks 2 2"]:
    """S [m] of a T-matrix, ours or another tool's: as :func:`august_jax.physics.scattering_matrix` of a craft.

    Args:
        matrix: T in the basis of :func:`spherical_basis`.
        receive: unit vectors from the craft to the receiver (D, 3).
        transmit: to the transmitter (D, 3) or (3,); None is where the receiver is.
        frequency_hz: that T is of.

    Returns:
        (D, 2, 2) complex128; rows receive H and V, columns send H and V.

    Raises:
        ValueError: a matrix that is of no degree.
    """
    count = matrix.shape[-1]
    degree = round(math.sqrt(count / 2 + 1)) - 1
    if 2 * degree * (degree + 2) != count or matrix.shape != (count, count):
        raise ValueError(f"matrix: got shape {matrix.shape}; give (n, n) with n = 2 L (L + 2) of a degree L")
    k = wavenumber(check_frequency("frequency_hz", frequency_hz))
    receive = np.asarray(receive, np.float64)
    sender = receive if transmit is None else np.broadcast_to(np.asarray(transmit, np.float64), receive.shape)
    # far away an outgoing wave is e^{jkr}/(kr) times these; a plane wave from t is made of 4 pi j times their mirrors
    heard = np.einsum("dan,dqa->dqn", _far(receive, degree, conjugated=False), np.asarray(polarisations(receive)))
    sent = np.einsum("dan,dqa->dqn", _far(sender, degree, conjugated=True), np.asarray(polarisations(sender)))
    return math.sqrt(4.0 * np.pi) / k * 4.0j * np.pi * np.einsum("dqn,nm,dpm->dqp", heard, matrix, sent)


def _far(directions: np.ndarray, degree: int, *, conjugated: bool) -> np.ndarray:
    """(-j)^(l+1) X_lm and (-j)^l r^ x X_lm at directions (D, 3, n), their angular parts conjugated where asked."""
    found = np.empty((len(directions), 3, 2 * degree * (degree + 2)), complex)
    column = 0
    for l in range(1, degree + 1):  # noqa: E741
        _, vector = _harmonics(l, directions)
        across = np.cross(directions[:, None, :], vector)
        if conjugated:
            vector, across = vector.conj(), across.conj()
        for row in range(2 * l + 1):
            found[:, :, column] = (-1j) ** l * across[:, row]
            found[:, :, column + 1] = (-1j) ** (l + 1) * vector[:, row]
            column += 2
    return found


def _harmonics(l: int, outward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:  # noqa: E741
    """Y_lm (P, 2l + 1) and X_lm, Cartesian (P, 2l + 1, 3), at unit vectors: by ladders, which know no poles."""
    height = np.clip(outward[:, 2], -1.0, 1.0)
    turn = np.arctan2(outward[:, 1], outward[:, 0])
    padded = np.zeros((len(outward), 2 * l + 3), complex)  # m from -l-1 to l+1, where there is none
    for m in range(l + 1):
        norm = math.sqrt((2 * l + 1) / (4.0 * np.pi) * math.factorial(l - m) / math.factorial(l + m))
        padded[:, l + 1 + m] = norm * lpmv(m, l, height) * np.exp(1j * m * turn)
        padded[:, l + 1 - m] = (-1) ** m * padded[:, l + 1 + m].conj()
    orders = np.arange(-l, l + 1)
    raised = np.sqrt((l - orders) * (l + orders + 1)) * padded[:, 2:]
    lowered = np.sqrt((l + orders) * (l - orders + 1)) * padded[:, :-2]
    scalar = padded[:, 1:-1]
    vector = np.stack([0.5 * (raised + lowered), -0.5j * (raised - lowered), orders * scalar], axis=-1)
    return scalar, vector / math.sqrt(l * (l + 1))


def _flat(waves: np.ndarray) -> np.ndarray:
    return waves.reshape(-1, waves.shape[-1]).astype(np.complex64)


def _of_body(body: Body, tone: int, chi: complex, degree: int) -> np.ndarray:
    k = wavenumber(body.frequencies_hz[tone])
    waves = _flat(regular_waves(np.asarray(body.points[tone]), k, degree))[np.asarray(body.rows[tone])]
    eigenvalues = np.asarray(body.eigenvalues[tone], complex)
    heard, sent = (np.asarray(in_modes(body, tone, jnp.asarray(each)), complex) for each in (waves.conj(), waves))
    return 1j * k**3 * heard.T @ ((chi / (1.0 - chi * eigenvalues))[:, None] * sent)


@jax.jit
def _solved(cells, contrast, waves, k):
    sent, heard = (weighted_fields(cells, each) for each in (waves, waves.conj()))
    return heard.T @ solve_dense(interaction_matrix(cells, k), contrast, sent).polarization
