"""Arrays of any positions and polarisations, at one end or at both; and that only relative places matter."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import cross, turned

from august_jax.physics import (
    SOLVERS,
    AntennaArray,
    PlanarArray,
    body_channel,
    dipole_fields,
    factor_body,
    fisher_information,
    interaction_matrix,
    sensing_channel,
    solve_krylov,
)
from august_jax.physics.mom import weighted_fields

PLANAR = PlanarArray(4, 2, 3e9)
K = PLANAR.wavenumber
PLACE = np.array([1.0, 2.5, 0.7])
BODY_CELLS = cross()
CELLS = BODY_CELLS._replace(positions=BODY_CELLS.positions + PLACE)
CHI = 2.0 + 0.03j
TURN = turned([0.7, -0.4, 1.1])


def scattered(count=5, seed=0):
    """Antennas at random places within half a metre, each turned its own way."""
    random = np.random.default_rng(seed)
    moments = random.normal(size=(count, 3))
    return AntennaArray(
        random.uniform(-0.5, 0.5, (count, 3)), moments / np.linalg.norm(moments, axis=1, keepdims=True), 3e9
    )


@pytest.fixture(scope="module")
def body():
    return factor_body(BODY_CELLS, 3e9, nearest_m=1.5)


def in_double(array, cells, chi=CHI, **options):
    with jax.enable_x64(True):
        return np.asarray(sensing_channel(array, jax.tree.map(jnp.asarray, cells), chi, **options))


def off(value, reference):
    return np.linalg.norm(value - reference) / np.linalg.norm(reference)


def test_a_planar_array_is_a_special_case(body):
    same = AntennaArray(PLANAR.positions, PLANAR.moments, 3e9)
    assert off(in_double(same, CELLS), in_double(PLANAR, CELLS)) < 1e-12
    fast = [np.asarray(body_channel(body, array, np.eye(3), PLACE, CHI)) for array in (same, PLANAR)]
    assert off(*fast) < 1e-5


# the ordinary suite solves by Krylov over two ends in the next test, and moves arrays that are factored
QUICK = [pytest.param(solver, marks=[pytest.mark.slow] * (solver == "krylov")) for solver in SOLVERS]


@pytest.mark.parametrize("solver", QUICK)
def test_the_way_back_is_the_way_there(solver):
    there = in_double(PLANAR, CELLS, solver=solver, receiver=scattered())
    back = in_double(scattered(), CELLS, solver=solver, receiver=PLANAR)
    assert there.shape == (5, 8)
    assert off(there, back.T) < 1e-12


@pytest.mark.parametrize("solver", ["mom", "krylov"])
def test_two_ends_are_a_block_of_one_array_of_both(solver):
    whole = in_double(AntennaArray.joined(PLANAR, scattered()), CELLS)
    block = in_double(PLANAR, CELLS, solver=solver, receiver=scattered())
    assert off(block, whole[8:, :8]) < 1e-6  # what the Krylov solution leaves; LU leaves nothing


def test_a_factored_body_serves_any_two_ends(body):
    turn, place = TURN.astype(np.float32), PLACE.astype(np.float32)
    with jax.enable_x64(True):
        moved = BODY_CELLS.moved(turn.astype(float), place.astype(float))
    for send, receive in ((scattered(), PLANAR), (PLANAR, scattered(7, 1)), (scattered(), scattered(3, 2))):
        fast = body_channel(body, send, turn, place, CHI, receiver=receive)
        assert off(fast, in_double(send, moved, receiver=receive)) < 1e-4


@pytest.mark.parametrize("solver", QUICK)
def test_only_relative_places_and_directions_matter(solver):
    array, shift = scattered(), np.array([30.0, -20.0, 7.0])
    turned_array = AntennaArray(array.positions @ TURN.T + shift, array.moments @ TURN.T, 3e9)
    with jax.enable_x64(True):
        cells = CELLS.moved(TURN, shift)
    moved = in_double(turned_array, cells, solver=solver)
    assert off(moved, in_double(array, CELLS, solver=solver)) < 1e-10


def test_gradients_in_antennas_and_tones_agree_with_differences():
    random = np.random.default_rng(3)
    weights = random.normal(size=(1, 5, 5)) + 1j * random.normal(size=(1, 5, 5))
    base, direction = scattered(), random.normal(size=(5, 3))

    def heard(step, hertz, solver):
        array = AntennaArray(base.positions + step * direction, jnp.asarray(base.moments), 3e9)
        channel = sensing_channel(
            array, jax.tree.map(jnp.asarray, CELLS), CHI, solver=solver, frequencies_hz=(3e9 + hertz,)
        )
        return 1e6 * jnp.real(jnp.sum(channel * weights))

    value = jax.jit(lambda step, hertz: heard(step, hertz, "mom"))
    for solver in ("mom", "krylov"):
        with jax.enable_x64(True):
            slopes = jax.jit(jax.grad(lambda step, hertz, solver=solver: heard(step, hertz, solver), (0, 1)))(0.0, 0.0)
            for slope, (step, hertz) in zip(slopes, ((1e-6, 0.0), (0.0, 1e3)), strict=True):
                high, low = (float(value(sign * step, sign * hertz)) for sign in (1.0, -1.0))
                expected = (high - low) / (2.0 * (step + hertz))
                assert float(slope) == pytest.approx(expected, rel=1e-5 if solver == "mom" else 1e-3)
                assert abs(expected) > 0


def test_a_factored_body_has_gradients_in_its_antennas(body):
    base, direction = scattered(), np.random.default_rng(4).normal(size=(5, 3))

    def strength(step):
        array = AntennaArray(
            jnp.asarray(base.positions + step * direction, jnp.float32), jnp.asarray(base.moments), 3e9
        )
        return jnp.sum(jnp.abs(1e6 * body_channel(body, array, np.eye(3), PLACE, CHI)) ** 2)

    def exact(step):
        array = AntennaArray(base.positions + step * direction, base.moments, 3e9)
        return np.sum(np.abs(1e6 * in_double(array, CELLS)) ** 2)

    assert float(jax.grad(strength)(0.0)) == pytest.approx((exact(1e-5) - exact(-1e-5)) / 2e-5, rel=1e-3)


GOOD = scattered()


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ((GOOD.positions[0], GOOD.moments, 3e9), "positions: got shape"),
        ((GOOD.positions, GOOD.moments[:2], 3e9), "moments: got shape"),
        ((GOOD.positions * np.nan, GOOD.moments, 3e9), "positions: holds NaN"),
        ((jnp.asarray(GOOD.positions), 2.0 * jnp.asarray(GOOD.moments), 3e9), "moments: row 0 has length 2"),
        (([[0.0, 0.0, 0.0]], [[0.0, 0.0, 2.0]], 3e9), "moments: row 0 has length 2"),
        ((GOOD.positions, 2.0 * GOOD.moments, 3e9), "moments: row . has length 2"),
        ((GOOD.positions, GOOD.moments, -1.0), "frequency_hz"),
    ],
)
def test_bad_arrays_are_refused(parts, message, unchecked):
    with pytest.raises(ValueError, match=message):
        AntennaArray(*parts)


def test_a_receiver_inside_the_body_is_refused(body):
    inside = AntennaArray(np.asarray(CELLS.positions[:1]), np.array([[0.0, 0.0, 1.0]]), 3e9)
    with pytest.raises(ValueError, match="outside the body"):
        sensing_channel(PLANAR, CELLS, CHI, receiver=inside)
    with pytest.raises(ValueError, match="nearest_m"):
        body_channel(body, PLANAR, np.eye(3), PLACE, CHI, receiver=inside)


def ring(count, radius_m=3.0):
    """Antennas on all sides of the origin, level ones on a circle for eight and fewer, else over a sphere."""
    number = np.arange(count)
    height = np.zeros(count) if count <= 8 else 1.0 - 2.0 * (number + 0.5) / count
    angle = 2.0 * np.pi * number / count if count <= 8 else number * np.pi * (3.0 - np.sqrt(5.0))
    level = np.sqrt(1.0 - height**2)
    towards = np.stack([level * np.cos(angle), level * np.sin(angle), height], axis=1)
    moments = np.cross(towards, [1.0, 2.0, 4.0])
    return AntennaArray(radius_m * towards, moments / np.linalg.norm(moments, axis=1, keepdims=True), 3e9)


def test_a_body_in_the_very_middle_of_its_antennas_has_a_channel_and_slopes(body):
    """Middles of body and antennas coincide: the long way between them has length zero, and no direction."""
    around = ring(8)
    exact = in_double(around, BODY_CELLS._replace(positions=BODY_CELLS.positions + [1e-9, 0.0, 0.0]))
    whole = in_double(around, BODY_CELLS)
    assert np.isfinite(whole).all() and off(whole, exact) < 1e-6

    def at(place):
        return body_channel(body, around, jnp.eye(3), place, CHI)

    assert off(at(jnp.zeros(3)), whole) < 1e-4
    step = np.float32(2e-3)
    for axis in np.eye(3, dtype=np.float32):
        _, slope = jax.jvp(at, (jnp.zeros(3),), (jnp.asarray(axis),))
        difference = (at(step * axis) - at(-step * axis)) / (2.0 * step)
        assert jnp.linalg.norm(slope - difference) < 0.02 * jnp.linalg.norm(difference)
    unit = fisher_information(body, around, np.eye(3)[None], np.zeros((1, 3)), 3.0, 5e-3, 1.0)
    assert np.isfinite(unit).all()


@pytest.mark.parametrize("sloped", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_krylov_solves_for_all_antennas_where_a_few_combinations_do_not_hold_them(sloped):
    """24 antennas on all sides: 16 combinations of their fields leave out 7 % of the largest."""
    around, cells = ring(24), jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), cross(arm=7))
    weights = np.random.default_rng(4).normal(size=(24, 24))

    @partial(jax.jit, static_argnums=1)
    def value(contrast, solver):
        channel = sensing_channel(around, cells, contrast * (1.0 + 0.02j), solver=solver)
        return 1e6 * jnp.sum(weights * channel.real), channel

    if sloped:
        found, wanted = (jax.value_and_grad(value, has_aux=True)(2.0, solver) for solver in ("krylov", "mom"))
        assert abs(found[1] - wanted[1]) < 1e-3 * abs(wanted[1])
        return
    found, wanted = (value(2.0, solver)[1] for solver in ("krylov", "mom"))
    assert off(np.asarray(found), np.asarray(wanted)) < 1e-5
    fields = dipole_fields(cells.sites(), *(jnp.asarray(part) for part in (around.positions, around.moments)), K)
    solution = solve_krylov(interaction_matrix(cells, K), 2.0, weighted_fields(cells, fields))
    assert solution.missed > 1e-3 and solution.residual >= solution.missed
