"""The Krylov solver against dense LU: values, gradients, the fallback, batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import cross

from august_jax.physics import PlanarArray, interaction_matrix, sensing_channel, sensing_channels
from august_jax.physics.green import dipole_fields
from august_jax.physics.krylov import TOLERANCE, solve_krylov, stationary_channel
from august_jax.physics.mom import solve_dense, weighted_fields

ARRAY = PlanarArray(6, 4, 3e9)
CELLS = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cross(arm=4))
CELLS = CELLS._replace(positions=CELLS.positions + jnp.array([1.0, 2.5, 0.7]))
MIXED = jnp.linspace(0.0, 4.0, CELLS.count) * (1 + 0.02j)  # empty cells among them
WEIGHTS = jnp.asarray(np.random.default_rng(0).normal(size=(2, ARRAY.count, ARRAY.count)), jnp.float32)


def loss(positions, strength, solver):
    channel = sensing_channel(ARRAY, CELLS._replace(positions=positions), strength * (1 + 0.02j), solver=solver)
    return 1e6 * jnp.sum(WEIGHTS[0] * channel.real + WEIGHTS[1] * channel.imag)


gradient = jax.jit(jax.value_and_grad(loss, (0, 1)), static_argnums=2)


@pytest.mark.parametrize("chi", [0.5, 3.5 + 0.05j, MIXED])
def test_the_channel_equals_that_of_lu(chi):
    slow = sensing_channel(ARRAY, CELLS, chi)
    fast = sensing_channel(ARRAY, CELLS, chi, solver="krylov")
    assert jnp.linalg.norm(fast - slow) < 1e-5 * jnp.linalg.norm(slow)
    np.testing.assert_array_equal(fast, fast.T)


def system(chi):
    matrix = jax.jit(interaction_matrix)(CELLS, ARRAY.wavenumber)
    fields = weighted_fields(CELLS, dipole_fields(CELLS.positions, jnp.asarray(ARRAY.positions, jnp.float32),
                                                  jnp.array([0.0, 0.0, 1.0]), ARRAY.wavenumber))
    return matrix, jnp.asarray(chi, jnp.complex64), fields


def test_the_residual_comes_back_and_is_the_true_one():
    matrix, chi, fields = system(3.0)
    found = jax.jit(solve_krylov)(matrix, chi, fields)
    assert not found.by_lu and 0 < found.steps < 60 and 0 < found.residual <= TOLERANCE
    total = found.fields @ found.combinations.conj().T
    exact = solve_dense(matrix, chi, fields).polarization / chi
    assert jnp.linalg.norm(total - exact) < 3 * TOLERANCE * jnp.linalg.norm(exact)


def test_where_it_does_not_converge_lu_takes_over_and_says_so():
    matrix, chi, fields = system(3.0)
    stopped = jax.jit(lambda *parts: solve_krylov(*parts, steps=2))(matrix, chi, fields)
    assert stopped.by_lu and stopped.steps == 2 and stopped.residual < 1e-5
    channel = stationary_channel(matrix, chi, fields, stopped)
    exact = fields.T @ solve_dense(matrix, chi, fields).polarization
    assert jnp.linalg.norm(channel - exact) < 1e-5 * jnp.linalg.norm(exact)


def test_the_error_of_the_channel_is_the_square_of_the_solution_s():
    matrix, chi, fields = system(3.0)
    exact = fields.T @ solve_dense(matrix, chi, fields).polarization
    errors = []
    for tolerance in (0.3, 0.003):
        found = solve_krylov(matrix, chi, fields, tolerance=tolerance)
        errors.append(float(jnp.linalg.norm(stationary_channel(matrix, chi, fields, found) - exact)
                            / jnp.linalg.norm(exact)))
        assert errors[-1] < tolerance**2
    assert errors[1] < 0.2 * errors[0]


def test_gradients_equal_those_through_lu_and_differences():
    strength = jnp.linspace(0.0, 4.0, CELLS.count)
    value, (places, strengths) = gradient(CELLS.positions, strength, "krylov")
    expected_value, (expected_places, expected_strengths) = gradient(CELLS.positions, strength, "mom")
    np.testing.assert_allclose(value, expected_value, rtol=1e-4)
    for found, expected in ((places, expected_places), (strengths, expected_strengths)):
        assert jnp.linalg.norm(expected) > 1e-3  # there is something to compare
        assert jnp.linalg.norm(found - expected) < 2e-4 * jnp.linalg.norm(expected)
    with jax.enable_x64(True):
        wide = CELLS._replace(positions=jnp.asarray(np.asarray(CELLS.positions), jnp.float64))
        way = np.random.default_rng(1).normal(size=wide.positions.shape)

        def along(step):
            return loss(wide.positions + step * way, jnp.asarray(np.asarray(strength), jnp.float64), "mom")

        difference = (along(1e-6) - along(-1e-6)) / 2e-6
    np.testing.assert_allclose(np.sum(np.asarray(places) * way), difference, rtol=1e-3)


def test_the_gradient_sees_the_coupling():
    """Without the coupled part of dH the gradient would be that of the local-field approximation, which is far off."""
    strength = jnp.full(CELLS.count, 3.0)
    _, (coupled, _) = gradient(CELLS.positions, strength, "krylov")
    _, (alone, _) = gradient(CELLS.positions, strength, "local_field_born")
    assert jnp.linalg.norm(coupled - alone) > 0.2 * jnp.linalg.norm(coupled)


@pytest.mark.parametrize("size", [1, 2, None])
def test_a_batch_does_not_depend_on_how_many_are_in_flight(size):
    shifts = jnp.array([[0.0, 0.0, 0.0], [0.3, -0.1, 0.2], [0.1, 0.2, 0.0]])
    chi = jnp.array([1.0, 2.0, 3.0])
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), CELLS)
    many = many._replace(positions=CELLS.positions + shifts[:, None])
    found = sensing_channels(ARRAY, many, chi, solver="krylov", microbatch=size)
    for row in range(3):
        alone = sensing_channel(ARRAY, CELLS._replace(positions=CELLS.positions + shifts[row]), chi[row])
        assert jnp.linalg.norm(found[row] - alone) < 1e-5 * jnp.linalg.norm(alone)


def test_batches_by_vmap():
    shifts = jnp.array([[0.0, 0.0, 0.0], [0.3, -0.1, 0.2]])

    def one(shift):
        return sensing_channel(ARRAY, CELLS._replace(positions=CELLS.positions + shift), 2.0, solver="krylov")

    many = jax.jit(jax.vmap(one))(shifts)
    for row, shift in enumerate(shifts):
        alone = one(shift)
        assert jnp.linalg.norm(many[row] - alone) < 1e-5 * jnp.linalg.norm(alone)
