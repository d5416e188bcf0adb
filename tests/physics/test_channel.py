"""The sensing channel: symmetry, a plain NumPy twin, limits, energy, and gradients against differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import cross, sphere, turned

from august_jax.physics import (
    SOLVERS,
    Cells,
    PlanarArray,
    contrast,
    interaction_matrix,
    self_term,
    sensing_channel,
    solve_dense,
)
from august_jax.physics.mom import weighted_fields

ARRAY = PlanarArray(4, 2, 3e9)
CENTRE = np.array([1.5, 2.5, 0.8])
CHI = 2.0 + 0.05j
SMALL = cross(arm=3)


def placed(cells, dtype=np.float32):
    moved = cells.moved(jnp.asarray(turned([0.3, 0.2, -0.4])), jnp.asarray(CENTRE))
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), moved)


def twin(array, cells, chi):
    """The same physics, written out with loops and 3 x 3 blocks in NumPy."""
    k, count = array.wavenumber, cells.count
    positions, volumes = np.asarray(cells.positions, float), np.asarray(cells.volumes, float)
    fill, tensors = np.asarray(cells.fractions(), float), np.asarray(cells.tensors(), float)

    def green(offset):
        r = np.linalg.norm(offset)
        unit, kr = offset / r, k * r
        g, h = 3 / kr**2 - 3j / kr - 1, 1 / kr**2 - 1j / kr - 1
        return (g * np.outer(unit, unit) - h * np.eye(3)) * np.exp(1j * kr) / (4 * np.pi * r)

    chi = np.broadcast_to(chi, count)
    system = np.zeros((count, 3, count, 3), complex)
    for i in range(count):
        x = k * (3 * volumes[i] / 4 / np.pi) ** (1 / 3)
        own = (2 / 3) * (1 - 1j * x) * np.exp(1j * x) - 1
        # 1/chi_cell = 1/(f chi) + ((1 - f)/f) n n^T, less what the cell does to itself.
        system[i, :, i, :] = (1 / (fill[i] * chi[i]) - own) * np.eye(3) + (1 - fill[i]) / fill[i] * tensors[i]
        for j in range(count):
            if i != j:
                system[i, :, j, :] = -(k**2) * volumes[j] * green(positions[i] - positions[j])
    fields = np.zeros((count, 3, array.count), complex)
    for n, antenna in enumerate(array.positions):
        for i in range(count):
            fields[i, :, n] = green(positions[i] - antenna) @ np.asarray(array.polarization)
    dipoles = np.linalg.solve(system.reshape(3 * count, -1), fields.reshape(3 * count, -1))
    return k**2 * fields.reshape(3 * count, -1).T @ (np.repeat(volumes, 3)[:, None] * dipoles)


def test_mom_agrees_with_the_written_out_twin():
    with jax.enable_x64(True):
        cells = placed(cross(), np.float64)
        fast = np.asarray(sensing_channel(ARRAY, cells, CHI))
        slow = twin(ARRAY, cells, CHI)
    np.testing.assert_allclose(fast, slow, atol=1e-11 * np.abs(slow).max())
    single = np.asarray(sensing_channel(ARRAY, placed(cross()), CHI))
    # Float32 positions at 3 m are rounded to 1e-7 m, 1e-5 rad of phase.
    assert np.linalg.norm(single - slow) < 1e-4 * np.linalg.norm(slow)


@pytest.mark.parametrize("solver", SOLVERS)
class TestEverySolver:
    """What holds of every solver, whatever it leaves out."""

    @pytest.mark.parametrize(("dtype", "tolerance"), [(np.float32, 1e-6), (np.float64, 1e-12)])
    def test_reciprocity_shape_and_precision(self, solver, dtype, tolerance):
        with jax.enable_x64(dtype == np.float64):
            channel = np.asarray(sensing_channel(ARRAY, placed(SMALL, dtype), CHI, solver=solver))
        assert channel.shape == (ARRAY.count,) * 2
        assert channel.dtype == (np.complex128 if dtype == np.float64 else np.complex64)
        assert np.abs(channel - channel.T).max() <= tolerance * np.abs(channel).max()

    def test_weak_contrast_is_born(self, solver):
        cells, weak = placed(SMALL._replace(fill=1.0)), 1e-4
        full, first = (np.asarray(sensing_channel(ARRAY, cells, weak, solver=name)) for name in (solver, "born"))
        assert np.linalg.norm(full - first) < 3.0 * weak * np.linalg.norm(first)

    def test_tones_are_a_leading_axis(self, solver):
        cells, tones = placed(SMALL), (2.9e9, 3.1e9)
        chi = np.asarray(contrast(3.0, 0.01, np.asarray(tones)))
        both = np.asarray(sensing_channel(ARRAY, cells, chi[:, None], frequencies_hz=tones, solver=solver))
        one = np.asarray(sensing_channel(ARRAY, cells, chi[1], frequencies_hz=tones[1:], solver=solver))[0]
        assert both.shape == (2, ARRAY.count, ARRAY.count)
        np.testing.assert_allclose(both[1], one, rtol=1e-5, atol=1e-6 * np.abs(one).max())

    def test_gradients_agree_with_differences(self, solver):
        """In positions and material; an iterative solution's to its residual, 3e-5."""
        with jax.enable_x64(True):
            cells = placed(SMALL, np.float64)
            weights = jnp.asarray(np.random.default_rng(2).normal(size=(ARRAY.count,) * 2))

            def value(positions, epsilon, sigma):
                chi = contrast(epsilon, sigma, ARRAY.frequency_hz)
                channel = sensing_channel(ARRAY, cells._replace(positions=positions), chi, solver=solver)
                return jnp.sum(weights * jnp.abs(channel)) * 1e6

            start = (cells.positions, jnp.asarray(3.0), jnp.asarray(0.01))
            compiled, random = jax.jit(value), np.random.default_rng(3)
            gradient = jax.jit(jax.grad(value, argnums=(0, 1, 2)))(*start)
            for argument, step in ((0, 1e-6), (1, 1e-5), (2, 1e-5)):
                direction = random.normal(size=np.shape(start[argument]))
                ahead, behind = (
                    compiled(*[x + sign * step * direction if n == argument else x for n, x in enumerate(start)])
                    for sign in (1, -1)
                )
                slope = float(np.sum(np.asarray(gradient[argument]) * direction))
                assert abs(slope) > 1e-8
                rtol = 1e-3 if solver == "krylov" else 1e-5
                np.testing.assert_allclose(slope, (ahead - behind) / (2 * step), rtol=rtol)


def test_solution_is_reciprocal_before_it_is_symmetrised():
    with jax.enable_x64(True):
        cells = placed(cross(), np.float64)
        fields = np.random.default_rng(0).normal(size=(3 * cells.count, 4)) + 0j
        solution = solve_dense(interaction_matrix(cells, ARRAY.wavenumber), CHI, jnp.asarray(fields))
    product = fields.T @ np.asarray(solution.polarization)
    np.testing.assert_allclose(product, product.T, atol=1e-12 * np.abs(product).max())
    assert np.asarray(solution.residual) < 1e-12


def test_local_field_born_is_born_times_the_lorentz_factor():
    cells = placed(cross(fill=1.0))
    local, first = (
        np.asarray(sensing_channel(ARRAY, cells, CHI, solver=name)) for name in ("local_field_born", "born")
    )
    np.testing.assert_allclose(local, first * 3 / (3 + CHI), rtol=2e-5)


@pytest.mark.parametrize(("exact", "tolerance"), [(False, 2e-3), (True, 1e-10)])
def test_energy_balance(exact, tolerance):
    """What a lossy body takes from the wave, it absorbs or scatters: Im E*.P = absorption + radiation.

    A self term with the imaginary part k^3 V/(6 pi), the radiation of a point dipole, makes it exact: then Im K' is the
    Gram matrix of the far fields. That of a sphere's average field is less by (ka)^2/10, here 1e-3.
    """
    cells = sphere(0.03, 8)
    k = ARRAY.wavenumber
    with jax.enable_x64(True):
        cells = jax.tree.map(jnp.asarray, cells)
        wave = jnp.zeros((cells.count, 3), complex).at[:, 0].set(jnp.exp(1j * k * cells.positions[:, 2]))
        fields = weighted_fields(cells, wave.reshape(-1, 1))
        matrix = interaction_matrix(cells, k)
        if exact:
            missing = k**3 * cells.volumes / (6.0 * np.pi) - jnp.imag(self_term(cells.volumes, k))
            matrix = matrix + 1j * jnp.diag(jnp.repeat(cells.fill * missing, 3))
        polarization = np.asarray(solve_dense(matrix, 3.0 + 0.4j, fields).polarization)[:, 0]
        incident = np.asarray(fields)[:, 0]
        # The radiated power by integration over all directions.
        nodes, weights = np.polynomial.legendre.leggauss(24)
        angles = 2 * np.pi * np.arange(48) / 48
        sine = np.sqrt(1 - nodes**2)
        directions = np.stack(
            [np.outer(sine, np.cos(angles)), np.outer(sine, np.sin(angles)), np.outer(nodes, np.ones(48))], -1
        ).reshape(-1, 3)
        moments = np.asarray(weighted_fields(cells, jnp.asarray(polarization[:, None]))).reshape(-1, 3)
        far = np.exp(-1j * k * directions @ np.asarray(cells.positions).T) @ moments
        far = far - directions * np.sum(far * directions, 1, keepdims=True)
        power = np.repeat(weights, 48) * (2 * np.pi / 48) @ np.sum(np.abs(far) ** 2, 1)
    extinction = np.imag(np.vdot(incident, polarization))
    absorbed = np.imag(-1 / (3.0 + 0.4j)) * np.sum(np.abs(polarization) ** 2)
    radiated = k**3 / (16 * np.pi**2) * power
    assert abs(extinction - absorbed - radiated) < tolerance * extinction
    assert absorbed > 0.05 * extinction and radiated > 0.05 * extinction


# Beside a contrast of 2 one of 6e5 costs LU of I - D K' three digits (9.6e-5 here, 1.6e-4 as users compile it);
# krylov's form, symmetric in D, loses none.
@pytest.mark.parametrize("solver, most", [("mom", 1e-4), ("krylov", 1e-5)])
def test_materials_may_differ_by_part_metal_among_them(solver, most):
    """An arm of plastic, a tip of carbon fibre and a metal-like block, against the twin in complex128."""
    cells = placed(cross(fill=0.6))
    chi = np.full(cells.count, CHI)
    chi[:5] = contrast(4.0, 50.0, 3e9)
    chi[-3:] = contrast(1.0, 1e5, 3e9)
    with pytest.warns(UserWarning, match="skin depths of their material"):  # such a metal is not resolved, but solved
        channel = np.asarray(sensing_channel(ARRAY, cells, jnp.asarray(chi, jnp.complex64), solver=solver))
    exact = twin(ARRAY, cells, chi.astype(np.complex64))
    assert np.linalg.norm(channel - exact) < most * np.linalg.norm(exact)


def test_coarse_cells_are_warned_of_with_the_number():
    coarse = Cells(np.array([[1.0, 2.5, 0.7], [1.03, 2.5, 0.7]]), np.full(2, 0.03**3))
    with pytest.warns(UserWarning, match=r"of 30 mm make 1.5 a wavelength in their material, of 5 wanted; use 8.* mm"):
        sensing_channel(ARRAY, coarse, 4.0)


def test_cells_may_be_constants_of_a_compiled_function_and_a_tone_its_argument():
    cells = jax.tree.map(jnp.asarray, placed(cross(arm=3)))

    def channel(tone, chi):
        return sensing_channel(ARRAY, cells, chi, frequencies_hz=(tone,))[0]

    expected = sensing_channel(ARRAY, cells, CHI)
    for compiled in (
        jax.jit(lambda chi: sensing_channel(ARRAY, cells, chi))(CHI),
        jax.jit(channel)(3e9, CHI),
        jax.jit(lambda tone: channel(tone, CHI))(3e9),
    ):
        np.testing.assert_allclose(compiled, expected, rtol=1e-4, atol=1e-5 * float(jnp.abs(expected).max()))


@pytest.mark.parametrize("solver", ["born", "local_field_born"])
def test_a_large_batch_is_the_single_case_again(solver):
    """64 targets at once, from where on a compiler has fused the sums of all but the first wrongly."""
    array, cells = PlanarArray(16, 4, 3e9), jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), sphere(0.08, 9))
    rng = np.random.default_rng(0)
    places = jnp.asarray(rng.uniform([10, 10, 10], [30, 30, 20], (64, 3)), jnp.float32)
    turns = jnp.asarray(np.stack([turned(angles) for angles in rng.uniform(-0.3, 0.3, (64, 3))]), jnp.float32)

    def channel(turn, place):
        return sensing_channel(array, cells.moved(turn, place), CHI, solver=solver)

    together = np.asarray(jax.jit(jax.vmap(channel))(turns, places))
    alone = np.asarray(jax.lax.map(lambda pose: channel(*pose), (turns, places)))
    assert (np.linalg.norm(together - alone, axis=(1, 2)) < 1e-4 * np.linalg.norm(alone, axis=(1, 2))).all()


def test_batches_are_maps_of_the_single_case():
    cells = placed(cross())
    batch = jax.vmap(lambda x: sensing_channel(ARRAY, cells._replace(positions=cells.positions + x), CHI))
    shifts = jnp.asarray([[0.0, 0.0, 0.0], [0.0, 0.1, 0.0]])
    alone = sensing_channel(ARRAY, cells._replace(positions=cells.positions + shifts[1]), CHI)
    np.testing.assert_allclose(batch(shifts)[1], alone, atol=2e-5 * np.abs(alone).max())


GOOD = cross()


@pytest.mark.parametrize(
    ("cells", "chi", "options", "message"),
    [
        (GOOD, CHI, {"solver": "fast"}, "unknown solver 'fast'"),
        (GOOD._replace(positions=GOOD.positions[None]), CHI, {}, "cells.positions: got shape"),
        (GOOD._replace(volumes=GOOD.volumes[:-1]), CHI, {}, "cells.volumes: got shape"),
        (GOOD._replace(volumes=-GOOD.volumes), CHI, {}, "must be positive"),
        (GOOD._replace(positions=GOOD.positions * np.nan), CHI, {}, "NaN"),
        (GOOD._replace(positions=np.zeros_like(GOOD.positions) + 1.0), CHI, {}, "cells 0 and 1 at"),
        (GOOD._replace(fill=1.5), CHI, {}, "cells.fill"),
        (GOOD._replace(centroids=np.zeros((2, 3))), CHI, {}, "cells.centroids: got shape"),
        (GOOD, np.ones(3), {}, "contrast: got shape"),
        (GOOD, np.nan, {}, "contrast: holds NaN"),
        (GOOD, CHI, {"at_array": True}, "outside the body"),
    ],
)
def test_bad_input_is_named(cells, chi, options, message, unchecked):
    options = dict(options)
    place = ARRAY.positions[3] if options.pop("at_array", False) else CENTRE
    cells = cells._replace(positions=cells.positions + place)
    with pytest.raises(ValueError, match=message):
        sensing_channel(ARRAY, cells, chi, **options)
