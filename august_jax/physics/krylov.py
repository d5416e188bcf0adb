r"""The coupled system where geometry moves: a Krylov solver, and a channel whose gradient needs no second solve.

With y = D^{-1/2} P the system of :mod:`august_jax.physics.mom` reads

    A y = b,    A = I - D^{1/2} K' D^{1/2},    b = D^{1/2} E',    H = k^2 b^T y,

A complex symmetric, A = A^T. Three properties of it are used:

- The N_b incident fields on a body some wavelengths away span few dimensions. Only the leading right singular vectors V
  of b are solved for, b V; what they miss enters H below a tolerance.
- Conjugate orthogonal conjugate residuals (Sogabe and Zhang, 2007) take one product with A a step and converge smoothly
  for contrasts of plastics and composites. All columns step together.
- In terms of the total field q = E' + K' P, the channel

      H(q) = k^2 (2 q^T D E' - q^T D q + q^T D K' D q)

  is stationary at the solution. The error of H is the square of that of q, and dH follows from dE', dD and dK' with q
  held fixed: a reciprocal array needs no adjoint solve, in either direction of differentiation. (Second derivatives
  would miss how q moves; take those through ``mom``.)

Where the residual is not reached (metal-like contrast, resonance) the same system is solved by LU, and the solution
says so.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

TOLERANCE = 3e-4
"""Relative residual at which a column is done; H then errs by about its square."""
_COMPRESSION = 1e-5  # singular values of the incident fields that are left out, relative to the largest
_MOST = 24  # columns that are solved for
_STEPS = 300


class KrylovSolution(NamedTuple):
    """Total fields that solve the coupled system for R' combinations of the R incident fields.

    Attributes:
        fields: q (3N, R') complex.
        combinations: V (R, R') complex, orthonormal columns; the R fields are q V^H.
        residual: largest |b - A y|/|b| over the columns, real.
        steps: Krylov steps taken, int32.
        by_lu: whether LU had to take over, bool.
    """

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
    root = jnp.sqrt(jnp.asarray(contrast).astype(matrix.dtype))
    root = jnp.repeat(jnp.broadcast_to(root, (matrix.shape[0] // 3,)), 3)[:, None]
    values, vectors = jnp.linalg.eigh(fields.conj().T @ fields)
    columns = min(_MOST, fields.shape[1])
    values, vectors = values[::-1][:columns], vectors[:, ::-1][:, :columns]
    # Columns below the tolerance are zeroed: they converge at once.
    kept = values > _COMPRESSION**2 * jnp.maximum(values[0], jnp.finfo(values.dtype).tiny)
    vectors = jnp.where(kept, vectors, 0.0)
    few = fields @ vectors
    interact = _real_product(matrix)
    solution, residual, taken = _cocr(lambda y: y - root * interact(root * y), root * few, tolerance, steps)
    failed = ~(residual <= tolerance)

    def by_lu(_):
        system = jnp.eye(matrix.shape[0], dtype=matrix.dtype) - root * matrix * root[:, 0]
        exact = jnp.linalg.solve(system, root * few)
        return exact, _relative(root * few - system @ exact, root * few)

    solution, residual = jax.lax.cond(failed, by_lu, lambda _: (solution, residual), None)
    return KrylovSolution(few + interact(root * solution), vectors, residual, taken, failed)


def stationary_channel(
    matrix: jax.Array, contrast: jax.Array, fields: jax.Array, solution: KrylovSolution
) -> jax.Array:
    """H/k^2 (R, R) of K', chi and E'; ``solution`` is held fixed under differentiation."""
    q, v = (jax.lax.stop_gradient(part) for part in solution[:2])
    chi = jnp.repeat(jnp.broadcast_to(contrast, (matrix.shape[0] // 3,)), 3)[:, None].astype(matrix.dtype)
    polarization = chi * q
    cross = v.conj() @ (polarization.T @ fields)
    own = polarization.T @ (_real_product(matrix)(polarization) - q)
    return cross + cross.T + v.conj() @ own @ v.conj().T


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
    """COCR for every column of ``right`` at once: solution, largest relative residual, steps taken."""

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
    # The recurrence drifts from the true residual in single precision: only the true one is believed.
    return final[0], _relative(right - times(final[0]), right), final[-1]


def _relative(residual, right):
    """Largest |residual|/|right| over the columns; NaN if there is one."""
    size = jnp.sqrt(jnp.sum(jnp.abs(right) ** 2, axis=0))
    error = jnp.sqrt(jnp.sum(jnp.abs(residual) ** 2, axis=0))
    return jnp.max(jnp.where(size > 0, error / jnp.where(size > 0, size, 1.0), 0.0))
