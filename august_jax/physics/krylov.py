r"""The coupled system where geometry moves: a Krylov solver, and a channel whose gradient needs no second solve.

With y = D^{-1/2} P the system of :mod:`august_jax.physics.mom` reads

    A y = b,    A = I - D^{1/2} K' D^{1/2},    b = D^{1/2} E',    H = k^2 b^T y,

A complex symmetric, A = A^T. Three properties of it are used:

- The N_b incident fields on a body some wavelengths away span few dimensions. Only the leading right singular vectors V
  of b are solved for, b V. By the form below H errs by the square of what V leaves out.
- Conjugate orthogonal conjugate residuals (Sogabe and Zhang, 2007) take one product with A a step and converge smoothly
  for contrasts of plastics and composites. All columns step together.
- In terms of the polarisation P = D^{1/2} y, the channel

      H(P) = k^2 (2 P^T E' - P^T D^{-1} P + P^T K' P)

  is stationary at the solution. The error of H is the square of that of P, and dH follows from dE', dD and dK' with P
  held fixed: a reciprocal array needs no adjoint solve, in either direction of differentiation. (Second derivatives
  would miss how P moves; take those through ``mom``.) D^{-1} appears as y^T y and, differentiated, as q^T dD q with the
  total field q = E' + K' P, so that cells of no contrast are no exception.

Where the residual is not reached (metal-like contrast, resonance) the same system is solved by LU, and the solution
says so.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

TOLERANCE = 3e-5
"""Relative residual at which a column is done: a gradient errs by as much, H by about its square."""
_STRONG, _COMPRESSION = 1e-2, 1e-5  # singular values of the incident fields that are told apart first, and left out
_MOST = 16  # columns that are solved for
_STEPS = 300


class KrylovSolution(NamedTuple):
    """Solution of the coupled system for R' combinations of the R incident fields.

    Attributes:
        scaled: y (3N, R') complex; the polarisations are D^{1/2} y V^H.
        fields: total fields q (3N, R') complex; those of the R incident fields are q V^H.
        combinations: V (R, R') complex, orthonormal columns.
        residual: largest |b - A y|/|b| over the columns, or the square of what the columns leave out, real.
        steps: Krylov steps taken, int32.
        by_lu: whether LU had to take over, bool.
    """

    scaled: jax.Array
    fields: jax.Array
    combinations: jax.Array
    residual: jax.Array
    steps: jax.Array
    by_lu: jax.Array


def solve_krylov(
    matrix: jax.Array, contrast: jax.Array, fields: jax.Array, *, tolerance: float = TOLERANCE, steps: int = _STEPS
) -> KrylovSolution:
    """Solve the coupled system by COCR on compressed right-hand sides, by LU where that does not converge.

    Args:
        matrix: K' (3N, 3N), from :func:`august_jax.physics.mom.interaction_matrix`.
        contrast: chi, scalar or (N,).
        fields: E' (3N, R).
        tolerance: relative residual to reach.
        steps: how many to try.
    """
    root = _root(contrast, matrix)
    vectors, missed = _leading(fields)
    few = fields @ vectors
    right = root * few
    interact = _real_product(matrix)
    scaled, taken = _cocr(lambda y: y - root * interact(root * y), right, tolerance, steps)

    def finish(y):
        image = interact(root * y)
        return y, image, _relative(right - y + root * image, right)

    # The recurrence drifts from the true residual in single precision: only the true one is believed.
    iterated = finish(scaled)
    failed = ~(iterated[2] <= 3.0 * tolerance)

    def by_lu(_):
        system = jnp.eye(matrix.shape[0], dtype=matrix.dtype) - root * matrix * root[:, 0]
        return finish(jnp.linalg.solve(system, right))

    scaled, image, residual = jax.lax.cond(failed, by_lu, lambda _: iterated, None)
    residual = jnp.maximum(residual, missed)
    return KrylovSolution(scaled, few + image, vectors, residual, taken, failed)


def stationary_channel(
    matrix: jax.Array, contrast: jax.Array, fields: jax.Array, solution: KrylovSolution
) -> jax.Array:
    """H/k^2 (R, R) of K', chi and E'; ``solution`` is held fixed under differentiation."""
    y, q, v = (jax.lax.stop_gradient(part) for part in solution[:3])
    chi = jnp.repeat(jnp.broadcast_to(contrast, (matrix.shape[0] // 3,)), 3)[:, None].astype(matrix.dtype)
    p = jax.lax.stop_gradient(_root(contrast, matrix)) * y
    cross = v.conj() @ (p.T @ fields)
    image = q - jax.lax.stop_gradient(fields) @ v
    own = _quadratic(matrix, p, image) - y.T @ y + q.T @ ((chi - jax.lax.stop_gradient(chi)) * q)
    return cross + cross.T + v.conj() @ own @ v.conj().T


def _leading(fields):
    """Right singular vectors V (R, R') of the fields, and the square of the largest singular value left out, relative.

    In two stages: squaring halves the digits, so that what is weak shows once what is strong is taken away.
    """
    half = min(_MOST // 2, fields.shape[1])
    found, rest, largest = [], fields, None
    for floor in (_STRONG, _COMPRESSION):
        values, vectors = jnp.linalg.eigh(rest.conj().T @ rest)
        largest = jnp.maximum(values[-1], jnp.finfo(values.dtype).tiny) if largest is None else largest
        # Columns below the floor are zeroed: they converge at once.
        found.append(jnp.where(values[-half:] > floor**2 * largest, vectors[:, -half:], 0.0)[:, ::-1])
        basis = jnp.concatenate(found, axis=1)
        basis = basis[:, jnp.argsort(jnp.all(basis == 0, axis=0), stable=True)[: fields.shape[1]]]
        # What is weak was found beside the rounding errors of what is strong: make it orthogonal to that again.
        basis = jnp.where(jnp.any(basis != 0, axis=0), jnp.linalg.qr(basis)[0], 0.0)
        rest = fields - (fields @ basis) @ basis.conj().T
    return basis, jnp.max(jnp.sum(jnp.abs(rest) ** 2, axis=0)) / largest


def _root(contrast, matrix):
    """D^{1/2} (3N, 1)."""
    root = jnp.sqrt(jnp.asarray(contrast).astype(matrix.dtype))
    return jnp.repeat(jnp.broadcast_to(root, (matrix.shape[0] // 3,)), 3)[:, None]


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
        solution, residual, direction, turned, image, weight, number = state
        # image = A direction, turned = A residual, weight = residual^T A residual
        alpha = ratio(weight, dot(image, image))
        solution = solution + alpha * direction
        residual = residual - alpha * image
        turned = times(residual)
        following = dot(residual, turned)
        beta = ratio(following, weight)
        return (solution, residual, residual + beta * direction, turned, turned + beta * image, following, number + 1)

    image = times(right)
    start = (jnp.zeros_like(right), right, right, image, image, dot(right, image), jnp.zeros((), jnp.int32))
    final = jax.lax.while_loop(going, step, start)
    return final[0], final[-1]


def _relative(residual, right):
    """Largest |residual|/|right| over the columns; NaN if there is one."""
    size = jnp.sqrt(jnp.sum(jnp.abs(right) ** 2, axis=0))
    error = jnp.sqrt(jnp.sum(jnp.abs(residual) ** 2, axis=0))
    return jnp.max(jnp.where(size > 0, error / jnp.where(size > 0, size, 1.0), 0.0))
