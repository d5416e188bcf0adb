"""The Krylov solver against dense LU: values, gradients, the fallback, batches."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import cross

from august_jax.physics import PlanarArray, interaction_matrix, sensing_channel, sensing_channels
from august_jax.physics.green import dipole_fields
from august_jax.physics.krylov import (
    TOLERANCE,
    _blockwise,
    _local_factor,
    moving_channel,
    solve_krylov,
    solve_moving,
    stationary_channel,
)
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


@jax.jit
def found_at(positions, chi):
    """The channel of CELLS elsewhere, of contrast chi (N,)."""
    return sensing_channel(ARRAY, CELLS._replace(positions=positions), chi, solver="krylov")


def each_cell(chi):
    """One contrast for every cell, or one each: in a single form, so that one compilation serves all."""
    return jnp.broadcast_to(jnp.asarray(chi, jnp.complex64), (CELLS.count,))


@pytest.mark.parametrize("chi", [0.5, 3.5 + 0.05j, MIXED])
def test_the_channel_equals_that_of_lu(chi):
    chi = each_cell(chi)
    slow = sensing_channel(ARRAY, CELLS, chi)
    fast = found_at(CELLS.positions, chi)
    assert jnp.linalg.norm(fast - slow) < 1e-5 * jnp.linalg.norm(slow)
    np.testing.assert_array_equal(fast, fast.T)


compiled_solve, compiled_channel = jax.jit(solve_krylov, static_argnames="steps"), jax.jit(stationary_channel)


def system(chi):
    matrix = jax.jit(interaction_matrix)(CELLS, ARRAY.wavenumber)
    fields = weighted_fields(
        CELLS,
        dipole_fields(
            CELLS.positions, jnp.asarray(ARRAY.positions, jnp.float32), jnp.array([0.0, 0.0, 1.0]), ARRAY.wavenumber
        ),
    )
    return matrix, jnp.asarray(chi, jnp.complex64), fields


def test_the_residual_comes_back_and_is_the_true_one():
    matrix, chi, fields = system(3.0)
    found = compiled_solve(matrix, chi, fields, tolerance=TOLERANCE)
    assert not found.by_lu and 0 < found.steps < 60 and 0 < found.residual <= TOLERANCE
    total = found.fields @ found.combinations.conj().T
    exact = solve_dense(matrix, chi, fields).polarization / chi
    assert jnp.linalg.norm(total - exact) < 3 * TOLERANCE * jnp.linalg.norm(exact)


def test_where_it_does_not_converge_lu_takes_over_and_says_so():
    matrix, chi, fields = system(3.0)
    stopped = compiled_solve(matrix, chi, fields, steps=2)
    assert stopped.by_lu and stopped.steps == 2 and stopped.residual < 1e-5
    channel = stationary_channel(matrix, chi, fields, stopped)
    exact = fields.T @ solve_dense(matrix, chi, fields).polarization
    assert jnp.linalg.norm(channel - exact) < 1e-5 * jnp.linalg.norm(exact)


def test_the_error_of_the_channel_is_the_square_of_the_solution_s():
    matrix, chi, fields = system(3.0)
    exact = fields.T @ solve_dense(matrix, chi, fields).polarization
    errors = []
    for tolerance in (0.3, 0.003):
        found = compiled_solve(matrix, chi, fields, tolerance=tolerance)
        errors.append(
            float(jnp.linalg.norm(compiled_channel(matrix, chi, fields, found) - exact) / jnp.linalg.norm(exact))
        )
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


@pytest.mark.parametrize(("away", "few"), [(-2.0, False), (20.0, True)])
def test_planes_do_what_the_matrix_does(away, few):
    """Solution, channel and its derivatives in all that a cell is; from afar only half of the columns are used."""
    cells = CELLS._replace(positions=CELLS.positions + away * jnp.array([0.6, 0.64, 0.48]))
    k, chi = ARRAY.wavenumber, jnp.asarray(MIXED, jnp.complex64)
    fields = weighted_fields(
        cells, dipole_fields(cells.positions, jnp.asarray(ARRAY.positions, jnp.float32), jnp.array([0.0, 0.0, 1.0]), k)
    )
    slow = compiled_solve(interaction_matrix(cells, k), chi, fields, tolerance=TOLERANCE)
    fast = jax.jit(solve_moving)(cells, k, chi, fields)
    assert bool(jnp.all(fast.combinations[:, 8:] == 0)) == few
    assert not fast.by_lu and jnp.linalg.norm(fast.fields - slow.fields) < 2 * TOLERANCE * jnp.linalg.norm(slow.fields)

    def slopes(channel):
        def loss(positions, volumes, fill, k):
            value = channel(cells._replace(positions=positions, volumes=volumes, fill=fill), k)
            return jnp.sum(WEIGHTS[0] * value.real + WEIGHTS[1] * value.imag)

        return jax.jit(jax.value_and_grad(loss, (0, 1, 2, 3)))(cells.positions, cells.volumes, cells.fractions(), k)

    found = slopes(lambda cells, k: moving_channel(cells, k, chi, fields, slow))
    expected = slopes(lambda cells, k: stationary_channel(interaction_matrix(cells, k), chi, fields, slow))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected)):
        assert 0 < jnp.linalg.norm(a - b) + jnp.linalg.norm(b) and jnp.linalg.norm(a - b) < 2e-5 * jnp.linalg.norm(b)


@pytest.mark.slow
def test_forward_mode_agrees_with_reverse():
    way = jnp.asarray(np.random.default_rng(3).normal(size=CELLS.positions.shape), jnp.float32)
    strength = jnp.full(CELLS.count, 3.0)
    _, forwards = jax.jvp(lambda positions: loss(positions, strength, "krylov"), (CELLS.positions,), (way,))
    backwards = jnp.sum(gradient(CELLS.positions, strength, "krylov")[1][0] * way)
    np.testing.assert_allclose(forwards, backwards, rtol=1e-4)


def test_the_local_factor_undoes_what_a_cell_does_to_itself():
    random = np.random.default_rng(4)
    own = random.normal(size=(2, 5, 3, 3)) / 5
    own = jnp.asarray(own[0] + 1j * own[1])
    own = own + own.transpose(0, 2, 1)
    chi = jnp.asarray([0.0, 1.0, 3.0, 5.0 + 2j, 50j])
    factor = np.asarray(_local_factor(chi, own))
    np.testing.assert_allclose(
        (np.eye(3) - chi[:, None, None] * own) @ factor @ factor.transpose(0, 2, 1),
        np.tile(np.eye(3), (5, 1, 1)),
        atol=2e-5,
    )
    x = random.normal(size=(15, 2)) + 0j
    np.testing.assert_allclose(_blockwise(own, jnp.asarray(x)).reshape(5, 3, 2), own @ x.reshape(5, 3, 2), atol=1e-6)


def test_the_gradient_sees_the_coupling():
    """Without the coupled part of dH the gradient would be that of the local-field approximation, which is far off."""
    strength = jnp.full(CELLS.count, 3.0)
    _, (coupled, _) = gradient(CELLS.positions, strength, "krylov")
    _, (alone, _) = gradient(CELLS.positions, strength, "local_field_born")
    assert jnp.linalg.norm(coupled - alone) > 0.2 * jnp.linalg.norm(coupled)


@pytest.mark.slow
@pytest.mark.parametrize("size", [2, None])  # of its own accord, one
def test_a_batch_does_not_depend_on_how_many_are_in_flight(size):
    shifts = jnp.array([[0.0, 0.0, 0.0], [0.3, -0.1, 0.2], [0.1, 0.2, 0.0]])
    chi = jnp.array([1.0, 2.0, 3.0])
    many = jax.tree.map(lambda leaf: jnp.stack([leaf] * 3), CELLS)
    many = many._replace(positions=CELLS.positions + shifts[:, None])
    found = sensing_channels(ARRAY, many, chi, solver="krylov", microbatch=size)
    for row in range(3):
        alone = found_at(CELLS.positions + shifts[row], each_cell(chi[row]))
        assert jnp.linalg.norm(found[row] - alone) < 1e-5 * jnp.linalg.norm(alone)


def power(shift):
    moved = CELLS._replace(positions=CELLS.positions + shift)
    return jnp.sum(jnp.abs(1e6 * sensing_channel(ARRAY, moved, 2.0, solver="krylov")) ** 2)


def test_second_derivatives_raise_and_do_not_mislead():
    for second in (jax.hessian(power), jax.jit(jax.jacfwd(jax.jit(jax.grad(power))))):
        with pytest.raises(NotImplementedError, match="solver='mom'"):
            second(jnp.zeros(3))


@pytest.mark.slow
def test_what_is_linear_in_the_first_derivative_has_one_of_its_own():
    scaled = jax.grad(lambda scale: jax.grad(lambda shift: scale * power(shift))(jnp.zeros(3))[0])(2.0)
    np.testing.assert_allclose(scaled, jax.grad(power)(jnp.zeros(3))[0], rtol=1e-4)


def test_batches_by_vmap():
    shifts = jnp.array([[0.0, 0.0, 0.0], [0.3, -0.1, 0.2]])

    chi = each_cell(2.0)
    many = jax.jit(jax.vmap(lambda shift: found_at(CELLS.positions + shift, chi)))(shifts)
    for row, shift in enumerate(shifts):
        alone = found_at(CELLS.positions + shift, chi)
        assert jnp.linalg.norm(many[row] - alone) < 1e-5 * jnp.linalg.norm(alone)
