"""The factored body against the coupled solve of the moved cells, in complex128."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import cross, turned

from august_jax.physics import AntennaArray, PlanarArray, alike, body_channel, contrast, factor_body, sensing_channel
from august_jax.physics.body import cache_folder

ARRAY = PlanarArray(8, 4, 3e9)
CELLS = cross(arm=9)


@pytest.fixture(scope="module")
def body():
    return factor_body(CELLS, 3e9)


def exact(rotation, translation, chi, frequency=3e9):
    with jax.enable_x64(True):
        moved = CELLS.moved(jnp.asarray(np.asarray(rotation, float)), jnp.asarray(np.asarray(translation, float)))
        return np.asarray(sensing_channel(ARRAY, moved, np.asarray(chi), frequencies_hz=(frequency,)))[0]


@pytest.mark.parametrize("distance", [3.0, 8.0, 25.0])
@pytest.mark.parametrize("chi", [0.5 + 0.006j, 2.5 + 0.03j, 4.0 + 0.06j])
def test_every_pose_and_material_equals_the_coupled_solve(body, distance, chi):
    rotation = turned([2.0, 0.3, -0.4]).astype(np.float32)
    translation = (np.array([0.5, 0.7, 0.51]) * distance).astype(np.float32)
    fast = np.asarray(body_channel(body, ARRAY, rotation, translation, chi))
    slow = exact(rotation, translation, chi)
    assert np.linalg.norm(fast - slow) < 1e-4 * np.linalg.norm(slow)
    assert np.abs(fast - fast.T).max() < 1e-6 * np.abs(fast).max()
    assert body.error < 1e-4


@pytest.mark.filterwarnings("ignore:cells.volumes")
@pytest.mark.parametrize("permittivity, conductivity, ceiling", [(15.0, 0.01, 1e-3), (15.0, 2.0, 1e-2)])
def test_materials_beyond_the_nodes_are_served_less_well(body, permittivity, conductivity, ceiling):
    chi = complex(contrast(permittivity, conductivity, 3e9))
    rotation, translation = turned([2.0, 0.3, -0.4]).astype(np.float32), np.array([4.0, 5.0, 3.0], np.float32)
    fast, slow = np.asarray(body_channel(body, ARRAY, rotation, translation, chi)), exact(rotation, translation, chi)
    assert np.linalg.norm(fast - slow) < ceiling * np.linalg.norm(slow)


def test_fields_at_centroids_equal_the_coupled_solve_too():
    shifts = 0.004 * np.random.default_rng(0).uniform(-1, 1, CELLS.positions.shape)
    cells = CELLS._replace(centroids=CELLS.positions + shifts)
    rotation, translation = turned([2.0, 0.3, -0.4]).astype(np.float32), np.array([1.0, 2.5, 0.7], np.float32)
    fast = np.asarray(body_channel(factor_body(cells, 3e9, cache=False), ARRAY, rotation, translation, 2.0))
    with jax.enable_x64(True):
        place = (jnp.asarray(part.astype(float)) for part in (rotation, translation))
        slow = np.asarray(sensing_channel(ARRAY, cells.moved(*place), 2.0))
    assert np.linalg.norm(fast - slow) < 1e-4 * np.linalg.norm(slow)
    assert np.linalg.norm(fast - exact(rotation, translation, 2.0)) > 0.01 * np.linalg.norm(slow)


def test_the_error_that_a_body_states_is_the_one_it_has(monkeypatch):
    """Of a basis that is made much too small, so that nothing else errs as much."""
    from august_jax.physics.body import factor

    monkeypatch.setattr(factor, "_BASIS_TOLERANCES", (0.2,))
    body = factor_body(CELLS, 3e9, cache=False)
    direction, moment = np.random.default_rng(1).normal(size=(2, 48, 3))
    moment /= np.linalg.norm(moment, axis=1, keepdims=True)
    places = 2.1 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    antennas = AntennaArray(places, moment, 3e9)
    fast = np.asarray(body_channel(body, antennas, np.eye(3), np.zeros(3), factor._CHECK))
    with jax.enable_x64(True):
        slow = np.asarray(sensing_channel(antennas, CELLS, factor._CHECK, frequencies_hz=(3e9,)))[0]
    error = np.linalg.norm(fast - slow) / np.linalg.norm(slow)
    assert error > 1e-4
    assert 0.5 < error / body.error < 2.0, (error, body.error)


def test_what_cells_radiate_from_where_they_do_not_hear_is_in_the_basis():
    """A solid slab radiates strongly; without its own radiation in the basis the error is 5e-3."""
    axes = [(np.arange(count) - 0.5 * (count - 1)) * 0.01 for count in (12, 12, 2)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    shifts = 0.004 * np.random.default_rng(0).uniform(-1, 1, grid.shape)
    slab = CELLS._replace(
        positions=grid, volumes=np.full(len(grid), 1e-6), fill=1.0, normals=None, centroids=grid + shifts
    )
    assert factor_body(slab, 3e9, cache=False).error < 1e-3


def test_a_basis_of_all_there_is_serves_too(monkeypatch):
    from august_jax.physics.body import factor

    monkeypatch.setattr(factor, "_BASIS_TOLERANCES", (1e-4,))
    shifts = 0.006 * np.random.default_rng(0).uniform(-1, 1, CELLS.positions.shape)
    body = factor_body(CELLS._replace(centroids=CELLS.positions + shifts), 3e9, cache=False)
    assert body.eigenvalues.shape[-1] == 3 * CELLS.count
    assert body.error < 1e-5


def test_symmetric_bodies_have_equal_eigenvalues_and_stay_exact():
    """A square has pairs of equal modes, whose eigenvectors come in arbitrary mixtures."""
    steps = (np.arange(6) - 2.5) * 0.012
    grid = np.stack(np.meshgrid(steps, steps, [0.0], indexing="ij"), -1).reshape(-1, 3)
    square = CELLS._replace(positions=grid, volumes=np.full(36, 0.012**3), fill=1.0, normals=None)
    body = factor_body(square, 3e9, cache=False)
    translation = np.array([1.0, 2.5, 0.7], np.float32)
    fast = np.asarray(body_channel(body, ARRAY, np.eye(3, dtype=np.float32), translation, 3.0))
    with jax.enable_x64(True):
        slow = np.asarray(sensing_channel(ARRAY, square._replace(positions=grid + translation.astype(float)), 3.0))
    assert np.linalg.norm(fast - slow) < 1e-4 * np.linalg.norm(slow)


def test_bodies_made_alike_share_one_compilation_and_keep_their_channels(body):
    small = factor_body(cross(arm=5), 3e9)
    assert small.weights.shape != body.weights.shape
    padded = alike([body, small])
    translation = np.array([1.0, 2.5, 0.7], np.float32)
    traced = []

    @jax.jit
    def channel(body):
        traced.append(1)
        return body_channel(body, ARRAY, jnp.eye(3), jnp.asarray(translation), 2.0)

    for before, after in zip((body, small), padded):
        old = body_channel(before, ARRAY, np.eye(3), translation, 2.0)
        # A larger radius chooses other antennas to interpolate from.
        assert jnp.linalg.norm(channel(after) - old) < 5e-5 * jnp.linalg.norm(old)
    assert traced == [1]
    assert alike([]) == []
    with pytest.raises(ValueError, match="different frequencies"):
        alike([body, factor_body(cross(arm=3), 2.9e9)])


def test_vmap_jit_and_gradient(body):
    rotations = jnp.asarray(np.stack([turned([a, 0.1, 0.2]) for a in (0.0, 1.0)]), jnp.float32)
    translations = jnp.asarray([[1.0, 2.0, 1.0], [2.0, 3.0, 1.5]])
    chi = jnp.asarray([2.0 + 0.01j, 3.0])
    many = jax.jit(jax.vmap(lambda r, t, c: body_channel(body, ARRAY, r, t, c)))(rotations, translations, chi)
    one = body_channel(body, ARRAY, rotations[1], translations[1], chi[1])
    np.testing.assert_allclose(many[1], one, atol=1e-5 * np.abs(one).max())

    def strength(height):
        moved = translations[0].at[2].set(height)
        return 1e6 * jnp.linalg.norm(body_channel(body, ARRAY, rotations[0], moved, chi[0]))

    slope = jax.grad(strength)(1.0)
    # Central differences in float32 are good to the cube root of its rounding.
    np.testing.assert_allclose(slope, (strength(1.02) - strength(0.98)) / 0.04, rtol=2e-2)


def test_tones_are_factored_apart():
    tones = (2.9e9, 3.1e9)
    body = factor_body(CELLS, tones)
    chi = np.asarray(contrast(3.0, 0.01, np.asarray(tones)))
    translation = np.array([1.0, 2.5, 0.7], np.float32)
    fast = np.asarray(body_channel(body, ARRAY, np.eye(3, dtype=np.float32), translation, chi))
    for tone in range(2):
        slow = exact(np.eye(3), translation, chi[tone], tones[tone])
        assert np.linalg.norm(fast[tone] - slow) < 1e-4 * np.linalg.norm(slow)


def test_the_cache_is_used_and_a_damaged_file_is_made_again(monkeypatch, tmp_path):
    from august_jax.physics.body import factor

    monkeypatch.setenv("AUGUST_CACHE", str(tmp_path))
    cells = CELLS._replace(positions=CELLS.positions * 1.01)
    first = factor_body(cells, 3e9)
    (path,) = cache_folder().glob("*.npz")
    made = []
    original = factor._factor
    monkeypatch.setattr(factor, "_factor", lambda *args: made.append(1) or original(*args))
    second = factor_body(cells, 3e9)
    assert not made
    np.testing.assert_array_equal(first.weights, second.weights)
    path.write_bytes(path.read_bytes()[:100])
    third = factor_body(cells, 3e9)
    assert made == [1]
    np.testing.assert_allclose(third.eigenvalues, first.eigenvalues)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda body: factor_body(CELLS, -3e9), "frequency_hz"),
        (lambda body: factor_body(CELLS, 3e9, nearest_m=0.05), "nearest_m"),
        (lambda body: body_channel(body, ARRAY, np.eye(2), np.ones(3), 2.0), "rotation: got shape"),
        (lambda body: body_channel(body, ARRAY, np.eye(3), np.ones((2, 3)), 2.0), "translation: got shape"),
        (lambda body: body_channel(body, ARRAY, np.eye(3), np.array([0.0, 1.0, 0.0]), 2.0), "smaller nearest_m"),
        (
            lambda body: body_channel(body, ARRAY, np.eye(3), np.array([0.0, 5.0, 0.0]), np.ones(3)),
            "contrast: got shape",
        ),
    ],
)
def test_bad_input_is_named(body, call, message, unchecked):
    with pytest.raises(ValueError, match=message):
        call(body)
