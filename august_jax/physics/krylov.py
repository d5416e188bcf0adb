r"""The coupled system where geometry moves: a Krylov solver, and a channel whose gradient needs no second solve.

With y = D^{-1/2} P the system of :mod:`august_jax.physics.mom` reads

    A y = b,    A = I - D^{1/2} K' D^{1/2},    b = D^{1/2} E',    H = k^2 b^T y,

A complex symmetric, A = A^T. Four properties of it are used:

- The N_b incident fields on a body some wavelengths away span few dimensions. Only the leading right singular vectors V
  of b are solved for, b V. By the form below H errs by the square of what V leaves out; the fields of antennas on all
  sides have more, and a solution says what its columns miss.
- What a cell does to itself, the block K'_ii, is undone exactly: with C_i C_i^T = (I - chi_i K'_ii)^{-1} and y = C z,

      C^T A C z = C^T b,    C^T A C = I - C^T D^{1/2} (K' - diag K'_ii) D^{1/2} C,

  which is complex symmetric again and knows the coupling alone: a third fewer steps.
- Conjugate orthogonal conjugate residuals (Sogabe and Zhang, 2007) take one product a step and converge smoothly for
  contrasts of plastics and composites. All columns step together.
- In terms of the polarisation P = D^{1/2} y, the channel

      H(P) = k^2 (2 P^T E' - P^T D^{-1} P + P^T K' P)

  is stationary at the solution. The error of H is the square of that of P, and dH follows from dE', dD and dK' with P
  held fixed: a reciprocal array needs no adjoint solve, in either direction of differentiation. (Second derivatives
  would miss how P moves: they raise, see :func:`differentiable_once`; take those through ``mom``.) D^{-1} appears as
  y^T y and, differentiated, as q^T dD q with the total field q = E' + K' P, so that cells of no contrast are no
  exception.

Where the residual is not reached (metal-like contrast, resonance) the same system is solved by LU, and the solution
says so.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir
from jaxtyping import Bool, Complex, Float, Inexact, Int

from august_jax.arrays import Array, ArrayLike
from august_jax.physics.cells import Cells
from august_jax.physics.mom import centred, coupling_weights, interaction_matrix, own_blocks
from august_jax.physics.planes import coupled_fields, coupling_change, coupling_planes

TOLERANCE = 3e-5
"""Relative residual at which a column is done: a gradient errs by as much, H by about its square."""
_STRONG, _COMPRESSION = 1e-2, 1e-5  # singular values of the incident fields that are told apart first, and left out
_MOST = 16  # columns that are solved for
_STEPS = 300
LEFT_OUT = 1e-6
"""The most that :attr:`KrylovSolution.missed` may be for a channel of these columns alone: it errs by some ten times as
much."""


class KrylovSolution(NamedTuple):
    """Solution of the coupled system for R' combinations of the R incident fields.

    Attributes:
        scaled: y (3N, R') complex; the polarisations are D^{1/2} y V^H.
        fields: total fields q (3N, R') complex; those of the R incident fields are q V^H.
        combinations: V (R, R') complex, orthonormal columns.
        residual: largest |b - A y|/|b| over the columns, or the square of what the columns leave out, real.
        steps: Krylov steps taken, int32.
        by_lu: whether LU had to take over, bool.
        missed: the square of what the columns leave out, relative to the largest singular value, real.
    """

    scaled: Complex[Array, "rows c"]
    fields: Complex[Array, "rows c"]
    combinations: Complex[Array, "r c"]
    residual: Float[Array, ""]
    steps: Int[Array, ""]
    by_lu: Bool[Array, ""]
    missed: Float[Array, ""]


def solve_krylov(
    matrix: Complex[Array, "rows rows"],
    contrast: ArrayLike,
    fields: Inexact[Array, "rows r"],
    *,
    tolerance: ArrayLike = TOLERANCE,
    steps: int = _STEPS,
) -> KrylovSolution:
    """Solve the coupled system by COCR on compressed right-hand sides, by LU where that does not converge.

    Args:
        matrix: K' (3N, 3N), from :func:`august_jax.physics.mom.interaction_matrix`.
        contrast: chi, scalar or (N,).
        fields: E' (3N, R).
        tolerance: relative residual to reach.
        steps: how many to try.
    """
    place = jnp.arange(matrix.shape[0] // 3)
    own = matrix.reshape(len(place), 3, len(place), 3)[place, :, place]
    interact = _real_product(matrix)
    return solve_coupled(
        lambda p: interact(p) - _blockwise(own, p),
        own,
        lambda: matrix,
        contrast,
        fields,
        tolerance=tolerance,
        steps=steps,
    )


def solve_moving(
    cells: Cells, wavenumber: ArrayLike, contrast: ArrayLike, fields: Inexact[Array, "rows r"]
) -> KrylovSolution:
    """:func:`solve_krylov` of cells, from planes: K' itself is assembled only where LU has to take over."""
    planes = coupling_planes(centred(cells), wavenumber)
    weights = coupling_weights(cells, wavenumber)
    return solve_coupled(
        lambda p: weights * coupled_fields(planes, weights * p),
        own_blocks(cells, wavenumber),
        lambda: interaction_matrix(cells, wavenumber),
        contrast,
        fields,
    )


def solve_coupled(
    couple: Callable[[jax.Array], jax.Array],
    own: jax.Array,
    matrix: Callable[[], jax.Array],
    contrast: ArrayLike,
    fields: jax.Array,
    *,
    tolerance: ArrayLike = TOLERANCE,
    steps: int = _STEPS,
) -> KrylovSolution:
    """The solution where K' is given by what it does.

    Args:
        couple: P (3N, R') to what the other cells add to the fields, (K' - diag K'_ii) P.
        own: K'_ii (N, 3, 3).
        matrix: gives K' (3N, 3N), for LU.
        contrast, fields, tolerance, steps: as in :func:`solve_krylov`.
    """
    root = _root(contrast, fields)
    local = _local_factor(contrast, own)
    turned = jnp.swapaxes(local, -1, -2)
    vectors, missed = _leading(fields)

    def image(y):
        p = root * y
        return couple(p) + _blockwise(own, p)

    def iterated(few):
        right = root * few
        local_solution, taken = _cocr(
            lambda z: z - _blockwise(turned, root * couple(root * _blockwise(local, z))),
            _blockwise(turned, right),
            tolerance,
            steps,
        )
        y = _blockwise(local, local_solution)
        return y, image(y), taken

    few = _product(fields, vectors)
    y, inner, taken = _on_used_columns(iterated, few)
    right = root * few
    # The recurrence drifts from the true residual in single precision: only the true one is believed.
    residual = _relative(right - y + root * inner, right)
    failed = ~(residual <= 3.0 * tolerance)

    def by_lu(_):
        system = matrix()
        system = jnp.eye(len(system), dtype=system.dtype) - root * system * root[:, 0]
        y = jnp.linalg.solve(system, right)
        inner = image(y)
        return y, inner, _relative(right - y + root * inner, right)

    y, inner, residual = jax.lax.cond(failed, by_lu, lambda _: (y, inner, residual), None)
    return KrylovSolution(y, few + inner, vectors, jnp.maximum(residual, missed), taken, failed, missed)


def stationary_channel(
    matrix: jax.Array, contrast: jax.Array, fields: jax.Array, solution: KrylovSolution
) -> jax.Array:
    """H/k^2 (R, R) of K', chi and E'; ``solution`` is held fixed under differentiation."""
    return _stationary(lambda p, image: _quadratic(matrix, p, image), contrast, fields, solution)


def moving_channel(
    cells: Cells, wavenumber: float | jax.Array, contrast: jax.Array, fields: jax.Array, solution: KrylovSolution
) -> jax.Array:
    """:func:`stationary_channel` of cells, differentiable in them without K'."""
    own, weights = own_blocks(cells, wavenumber), coupling_weights(cells, wavenumber)
    fixed_own, fixed_weights = jax.lax.stop_gradient((own, weights))

    def quadratic(p, image):
        # Each term but the first is zero, and is there for its derivative: in w, in the blocks, in G.
        weighing = p.T @ ((weights / fixed_weights - 1.0) * (image - _blockwise(fixed_own, p)))
        moving = _on_used_columns(
            lambda x: coupling_change(centred(cells), wavenumber, x), fixed_weights * p, square=True
        )
        return p.T @ image + weighing + weighing.T + p.T @ _blockwise(own - fixed_own, p) + moving

    return _stationary(quadratic, contrast, fields, solution)


def _stationary(quadratic, contrast, fields, solution):
    """The stationary form, of which ``quadratic`` gives P^T K' P from P and K' P, both held fixed."""
    y, q, v = (jax.lax.stop_gradient(part) for part in solution[:3])
    fixed_fields = jax.lax.stop_gradient(fields)
    chi = jnp.repeat(jnp.broadcast_to(contrast, (len(fields) // 3,)), 3)[:, None].astype(fields.dtype)
    p = jax.lax.stop_gradient(_root(contrast, fields)) * y
    cross = v.conj() @ _product(p.T, fields)
    image = q - _product(fixed_fields, v)
    own = quadratic(p, image) - y.T @ y + q.T @ ((chi - jax.lax.stop_gradient(chi)) * q)
    return cross + cross.T + v.conj() @ own @ v.conj().T


def _on_used_columns(call, x, square=False):
    """``call`` on the first half of the columns of ``x`` where the others are zero, as beyond some 20 m they are.

    What it returns has as many columns, as many rows too if ``square``, and is zero where they are; or is a number.
    """
    half = x.shape[1] // 2
    if x.shape[1] < _MOST:
        return call(x)

    def grown(part):
        return jnp.pad(part, ((0, half if square else 0), (0, half))) if part.ndim else part

    return jax.lax.cond(jnp.any(x[:, half:] != 0), call, lambda x: jax.tree.map(grown, call(x[:, :half])), x)


def _leading(fields):
    """Right singular vectors V (R, R') of the fields, and the square of the largest singular value left out, relative.

    In two stages: squaring halves the digits, so that what is weak shows once what is strong is taken away.
    """
    half = min(_MOST // 2, fields.shape[1])
    found, rest, largest = [], fields, None
    for floor in (_STRONG, _COMPRESSION):
        values, vectors = jnp.linalg.eigh(_product(rest.conj().T, rest))
        largest = jnp.maximum(values[-1], jnp.finfo(values.dtype).tiny) if largest is None else largest
        # Columns below the floor are zeroed: they converge at once.
        found.append(jnp.where(values[-half:] > floor**2 * largest, vectors[:, -half:], 0.0)[:, ::-1])
        basis = jnp.concatenate(found, axis=1)
        basis = basis[:, jnp.argsort(jnp.all(basis == 0, axis=0), stable=True)[: fields.shape[1]]]
        # What is weak was found beside the rounding errors of what is strong: make it orthogonal to that again.
        basis = jnp.where(jnp.any(basis != 0, axis=0), jnp.linalg.qr(basis)[0], 0.0)
        rest = fields - _product(_product(fields, basis), basis.conj().T)
    return basis, jnp.max(jnp.sum(jnp.abs(rest) ** 2, axis=0)) / largest


def _root(contrast, fields):
    """D^{1/2} (3N, 1)."""
    root = jnp.sqrt(jnp.asarray(contrast).astype(fields.dtype))
    return jnp.repeat(jnp.broadcast_to(root, (len(fields) // 3,)), 3)[:, None]


def _local_factor(contrast, own):
    """C (N, 3, 3) of C C^T = (I - chi K'_ii)^{-1}: the transposed inverse of a Cholesky factor, without conjugates."""
    chi = jnp.broadcast_to(contrast, own.shape[:1]).astype(own.dtype)
    (a, _, _), (b, c, _), (d, e, f) = (
        [(row == column) - chi * own[:, row, column] for column in range(3)] for row in range(3)
    )
    # The factor's rows: (a), (b, c), (d, e, f).
    a = jnp.sqrt(a)
    b, d = b / a, d / a
    c = jnp.sqrt(c - b * b)
    e = (e - d * b) / c
    f = jnp.sqrt(f - d * d - e * e)
    zero = jnp.zeros_like(a)
    columns = [
        (1.0 / a, zero, zero),
        (-b / (a * c), 1.0 / c, zero),
        ((b * e - d * c) / (a * c * f), -e / (c * f), 1.0 / f),
    ]
    return jnp.stack([jnp.stack(column, axis=-1) for column in columns], axis=-1)


def _blockwise(blocks, x):
    """Blocks (N, 3, 3) on the diagonal, times x (3N, R)."""
    parts = x.reshape(-1, 3, x.shape[-1])
    return sum(blocks[:, :, column, None] * parts[:, None, column] for column in range(3)).reshape(x.shape)


@jax.custom_jvp
def _quadratic(matrix, p, image):
    """P^T K' P, of which K' P is known; differentiated in K' alone."""
    return p.T @ image


@_quadratic.defjvp
def _quadratic_tangent(primals, tangents):
    _, p, image = primals
    return p.T @ image, p.T @ _real_product(tangents[0])(p)


def _real_product(matrix):
    """x -> matrix @ x by real products, which XLA computes three times faster than complex ones."""
    stacked = jnp.concatenate([matrix.real, matrix.imag])

    def times(x):
        half = x.shape[1]
        product = stacked @ jnp.concatenate([x.real, x.imag], axis=1)
        real, imaginary = product[: len(matrix)], product[len(matrix) :]
        return jax.lax.complex(real[:, :half] - imaginary[:, half:], real[:, half:] + imaginary[:, :half])

    return times


def _product(a, b):
    """a @ b, both complex."""
    return _real_product(a)(b)


def _cocr(times, right, tolerance, steps):
    """COCR for every column of ``right`` at once: solution and steps taken."""

    def dot(a, b):
        return jnp.sum(a * b, axis=0)  # unconjugated

    def ratio(a, b):
        return jnp.where(b == 0, 0.0, a / jnp.where(b == 0, 1.0, b))

    def going(state):
        residual, step = state[1], state[-1]
        return (step < steps) & (_relative(residual, right) > tolerance)

    def step(state):
        solution, residual, direction, image, weight, number = state
        # image = A direction, weight = residual^T A residual of the step before
        turned = times(residual)
        following = dot(residual, turned)
        beta = ratio(following, weight)
        direction, image = residual + beta * direction, turned + beta * image
        alpha = ratio(following, dot(image, image))
        return solution + alpha * direction, residual - alpha * image, direction, image, following, number + 1

    nothing = jnp.zeros_like(right)
    start = (nothing, right, nothing, nothing, nothing[0], jnp.zeros((), jnp.int32))
    final = jax.lax.while_loop(going, step, start)
    return final[0], final[-1]


def _relative(residual, right):
    """Largest |residual|/|right| over the columns; NaN if there is one."""
    size = jnp.sqrt(jnp.sum(jnp.abs(right) ** 2, axis=0))
    error = jnp.sqrt(jnp.sum(jnp.abs(residual) ** 2, axis=0))
    return jnp.max(jnp.where(size > 0, error / jnp.where(size > 0, size, 1.0), 0.0))


@jax.custom_jvp
def differentiable_once(channel: jax.Array) -> jax.Array:
    """``channel`` as it is; a second derivative of it raises NotImplementedError where it would be wrong in silence."""
    return channel


@differentiable_once.defjvp
def _first_derivative(values, tangents):
    # A factor of one, of which the derivative of the tangent would need the derivative.
    return differentiable_once(*values), _one_p.bind(*values) * tangents[0]


def _refuse(values, tangents):
    raise NotImplementedError("solver: krylov gives first derivatives alone; take second ones through solver='mom'")


_one_p = Primitive("one_of_first_order")
_one_p.def_impl(lambda channel: jnp.ones((), channel.real.dtype))
_one_p.def_abstract_eval(lambda channel: jax.core.ShapedArray((), jnp.finfo(channel.dtype).dtype))
ad.primitive_jvps[_one_p] = _refuse
batching.primitive_batchers[_one_p] = lambda values, axes: (_one_p.bind(*values), None)
mlir.register_lowering(_one_p, mlir.lower_fun(lambda channel: jnp.ones((), channel.real.dtype), multiple_results=False))
