"""What every door of the package refuses, warns of or takes as it is meant: bad input against its messages."""

import tracemalloc
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import cross, turned

from august_jax.physics import (
    AntennaArray,
    Cells,
    PlanarArray,
    body_channel,
    contrast,
    factor_body,
    fisher_information,
    sensing_channel,
    sensing_channels,
    unknown_gain_position_bound,
    wavenumber,
)
from august_jax.physics.body import aperture_skeleton
from august_jax.physics.body.body import CHECKS

ARRAY = PlanarArray(2, 2, 3e9)
PLACE = np.array([1.0, 3.0, 0.5])
CELLS = cross(arm=3)
PLACED = CELLS._replace(positions=CELLS.positions + PLACE)
COARSE = Cells(np.array([[1.0, 2.5, 0.7], [1.03, 2.5, 0.7]]), np.full(2, 0.03**3))
TWO = Cells(np.array([[-0.006, 0.0, 0.0], [0.006, 0.0, 0.0]]), np.full(2, 0.012**3))
EYE = np.eye(3)


@pytest.fixture(scope="module")
def body():
    return factor_body(CELLS, 3e9)


def of_cells(**parts):
    return lambda body: sensing_channel(ARRAY, PLACED._replace(**parts), 2.0)


def of_tones(tones):
    return lambda body: sensing_channel(ARRAY, PLACED, 2.0, frequencies_hz=tones)


def of_body(rotation=EYE, translation=PLACE, chi=2.0, array=ARRAY, receiver=None):
    return lambda body: body_channel(body, array, rotation, translation, chi, receiver=receiver)


def of_bound(rotation=EYE, position=PLACE, permittivity=3.0, conductivity=5e-3, snr=100.0, door=fisher_information):
    return lambda body: door(body, ARRAY, rotation, position, permittivity, conductivity, snr)


MIRROR = np.diag([1.0, 1.0, -1.0])
OTHER = PlanarArray(2, 2, 5.8e9)
NEAR = np.concatenate([PLACED.positions[:-1], PLACED.positions[:1] + [1e-4, 0.0, 0.0]])
REFUSED = [
    # numbers that make no body
    (of_cells(positions=NEAR), r"cells 0 and 15 at \(0.964, 3, 0.5\) m are 0.0001 m apart"),
    (of_cells(positions=np.concatenate([PLACED.positions[:-1], PLACED.positions[:1]])), "cells 0 and 15 at .* are 0 m"),
    (of_cells(centroids=np.broadcast_to(ARRAY.positions[0], PLACED.positions.shape)), "cells.centroids: a cell is 0 m"),
    (of_cells(positions=PLACED.positions + 1j), "cells.positions: got complex"),
    (of_cells(volumes=["a"] * CELLS.count), "cells.volumes: got entries of type"),
    (of_cells(positions=[[0.0, 1.0, 2.0], [1.0]]), "cells.positions: got rows of different lengths"),
    (
        lambda body: sensing_channels(
            ARRAY, jax.tree.map(lambda part: part[None], CELLS.moved(EYE, ARRAY.positions[0])), np.ones(1)
        ),
        "cells.positions: a cell is",
    ),
    (
        lambda body: sensing_channels(ARRAY, jax.tree.map(lambda part: part[None], PLACED), np.full(1, np.nan)),
        "contrast: holds NaN",
    ),
    (lambda body: sensing_channels(ARRAY, PLACED, np.ones(1)), "give .B, N, 3. and .B,., one target a row"),
    (lambda body: factor_body(CELLS._replace(positions=NEAR), 3e9), "cells 0 and 15"),
    (lambda body: jax.jit(lambda cells: factor_body(cells, 3e9).weights)(CELLS), "cells: are traced"),
    # frequencies
    (of_tones([]), r"frequencies_hz: got \[\]"),
    (of_tones(3e9), "frequencies_hz: got 3000000000.0; give a sequence"),
    *((of_tones([bad]), "frequencies_hz: got .*; give a positive frequency") for bad in (0.0, -3e9, np.nan, np.inf)),
    (of_tones([3e9, None]), "frequencies_hz: got None; give a frequency"),
    (lambda body: factor_body(CELLS, []), "frequency_hz: got no tones"),
    (lambda body: factor_body(CELLS, [3e9, np.nan]), "frequency_hz: got nan"),
    (lambda body: factor_body(CELLS, 3e9, nearest_m=np.nan), "nearest_m: nan m"),
    (lambda body: contrast(3.0, 0.01, 0.0), "frequency_hz: got 0.0"),
    (lambda body: wavenumber(-3e9), "frequency_hz: got -3000000000.0"),
    (lambda body: contrast(np.nan, 0.01, 3e9), "permittivity: holds NaN"),
    (lambda body: contrast(3.0, np.inf, 3e9), "conductivity_s_m: holds NaN or infinity"),
    # arrays, and carriers that disagree
    (lambda body: PlanarArray(1.5, 2, 3e9), "nx: got 1.5; give a whole number"),
    (lambda body: PlanarArray(2, True, 3e9), "nz: got True"),
    (lambda body: PlanarArray(2, 2, "3e9"), "frequency_hz: got '3e9'"),
    (lambda body: PlanarArray(2, 2, np.nan), "frequency_hz: got nan"),
    (lambda body: PlanarArray(2, 2, 3e9, (0.0, np.nan, 1.0)), "polarization: got"),
    (lambda body: AntennaArray.joined(ARRAY, OTHER), r"arrays: got carriers of 3e\+09 and 5.8e\+09 Hz"),
    (lambda body: sensing_channel(ARRAY, PLACED, 2.0, receiver=OTHER), r"receiver: got carriers of 3e\+09 and 5.8e"),
    (of_body(receiver=OTHER), r"receiver: got carriers of 3e\+09 and 5.8e\+09"),
    (of_body(array=OTHER), r"array: its carrier is 5.8e\+09 Hz, but the body was factored for 3e\+09 Hz"),
    (lambda body: fisher_information(body, OTHER, EYE, PLACE, 3.0, 5e-3, 100.0), "array: its carrier is 5.8e"),
    # poses and materials
    *(
        (of_body(rotation=bad), message)
        for bad, message in (
            (2.0 * EYE, "rotation: R.T R differs from the identity by 3"),
            (MIRROR, "rotation: is a mirror"),
            (EYE * np.nan, "rotation: R.T R differs"),
        )
    ),
    *((lambda body, bad=bad: CELLS.moved(bad, PLACE), "rotation: ") for bad in (2.0 * EYE, MIRROR)),
    (lambda body: CELLS.moved(EYE, PLACE * np.nan), "translation: holds NaN"),
    (of_body(translation=PLACE * np.nan), "translation: holds NaN"),
    *((of_body(chi=bad), "contrast: holds NaN or infinity") for bad in (np.nan, np.inf, jnp.asarray(np.nan + 0j))),
    *(
        (of_bound(door=door, **bad), message)
        for door in (fisher_information, unknown_gain_position_bound)
        for bad, message in (
            ({"permittivity": 1.0, "conductivity": 0.0}, "permittivity: is 1 .* a body of air"),
            ({"permittivity": np.nan}, "permittivity: holds NaN"),
            ({"conductivity": np.inf}, "conductivity: holds"),
            ({"position": PLACE * np.nan}, "position: holds NaN"),
            ({"rotation": MIRROR}, "rotation: is a mirror"),
            ({"position": PLACE * 0.1}, "position: the body is .* pass a smaller nearest_m"),
            ({"snr": 0.0}, "snr: got 0"),
            ({"snr": np.nan}, "snr: holds NaN"),
        )
    ),
]


@pytest.mark.parametrize(("call", "message"), REFUSED, ids=[f"{n}: {row[1][:30]}" for n, row in enumerate(REFUSED)])
def test_what_cannot_be_computed_is_refused(body, call, message, unchecked):
    with pytest.raises(ValueError, match=message):
        call(body)


def test_arrays_of_a_body_s_own_band_are_taken():
    comb = factor_body(CELLS, (2.95e9, 3.05e9))
    assert np.all(np.isfinite(body_channel(comb, ARRAY, EYE, PLACE, 2.0)))
    assert body_channel(comb, PlanarArray(2, 2, 2.8e9), EYE, PLACE, 2.0).shape == (2, 4, 4)


# float16 itself keeps 10 bits, bfloat16 7: whole and quarter metres are exact in both
@pytest.mark.parametrize("dtype", [np.int32, np.uint8, np.float16, jnp.bfloat16, np.float32])
def test_the_argument_s_type_does_not_round_the_geometry(dtype, body, unchecked):
    places = np.array([[1, 3, 0], [1, 4, 1], [2, 3, 1]])
    expected = sensing_channel(ARRAY, Cells(places * 1.0, np.full(3, 1e-6)), 2.0)
    found = sensing_channel(ARRAY, Cells(places.astype(dtype), np.full(3, 1e-6)), np.asarray(2, dtype))
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == np.complex64
    moved = body_channel(body, ARRAY, np.eye(3).astype(dtype), places[0].astype(dtype), np.asarray(2, dtype))
    np.testing.assert_array_equal(moved, body_channel(body, ARRAY, EYE, places[0] * 1.0, 2.0))
    heights = np.arange(3)[:, None] * [0, 0, 1]
    antennas = AntennaArray(heights.astype(dtype), heights[[1, 1, 1]].astype(dtype), 3e9)
    wanted = AntennaArray(heights * 1.0, heights[[1, 1, 1]] * 1.0, 3e9)
    np.testing.assert_array_equal(sensing_channel(antennas, PLACED, 2.0), sensing_channel(wanted, PLACED, 2.0))


def test_lists_are_arrays_and_double_precision_stays():
    listed = Cells(*(part if part is None or np.ndim(part) == 0 else np.asarray(part).tolist() for part in PLACED))
    found = sensing_channel(ARRAY, listed, [2.0] * CELLS.count)
    np.testing.assert_array_equal(found, sensing_channel(ARRAY, PLACED, 2.0))
    with jax.enable_x64(True):
        assert sensing_channel(ARRAY, PLACED, 2.0).dtype == np.complex128


def coarse_body():
    return factor_body(COARSE._replace(positions=COARSE.positions - COARSE.positions.mean(axis=0)), 3e9)


@pytest.mark.parametrize(
    "call",
    [
        lambda: sensing_channel(ARRAY, COARSE, 4.0),
        lambda: sensing_channel(ARRAY, COARSE, 4.0, frequencies_hz=[2.9e9]),
        lambda: sensing_channels(ARRAY, jax.tree.map(lambda part: np.asarray(part)[None], COARSE), np.array([4.0])),
        lambda: jax.jit(lambda chi: sensing_channel(ARRAY, COARSE, chi))(4.0),
        lambda: jax.jit(lambda place: sensing_channel(ARRAY, COARSE.moved(EYE, place), 4.0))(PLACE),
        coarse_body,
        lambda: body_channel(factor_body(TWO, 3e9), ARRAY, EYE, PLACE, 30.0),
    ],
    ids=["one", "tones", "batch", "jitted", "moving", "factored", "body"],
)
def test_every_route_that_meets_coarse_cells_warns_with_the_number(call):
    with pytest.warns(UserWarning, match=r"cells of .* mm make .* a wavelength in .*, of .* wanted; use .* mm or less"):
        call()


def test_cells_that_do_are_not_warned_of(body):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sensing_channel(ARRAY, PLACED, 4.0)
        body_channel(body, ARRAY, EYE, PLACE, 4.0)


def test_a_body_states_its_error_over_the_contrast_and_warns_with_it():
    """A solid block, which the reduction serves badly beyond its nodes; against the whole system, in complex128."""
    axes = [(np.arange(count) - 0.5 * (count - 1)) * 0.008 for count in (8, 6, 3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    block = Cells(grid, np.full(len(grid), 0.008**3))
    made = factor_body(block, 3e9)
    direction, moment = np.random.default_rng(1).normal(size=(2, 24, 3))
    ball = AntennaArray(
        2.1 * direction / np.linalg.norm(direction, axis=1, keepdims=True),
        moment / np.linalg.norm(moment, axis=1, keepdims=True),
        3e9,
    )

    def error(chi):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fast = np.asarray(body_channel(made, ball, EYE, np.zeros(3), chi))
            with jax.enable_x64(True):
                slow = np.asarray(sensing_channel(ball, block, chi))
        return np.linalg.norm(fast - slow) / np.linalg.norm(slow)

    for chi, stated in zip(CHECKS, made.errors, strict=True):
        # Single precision leaves 3e-5 of its own.
        assert stated / 3 - 3e-5 < error(chi) < 5 * stated + 6e-5, (chi, stated)
    assert made.error_at(14.0) == pytest.approx(made.errors[CHECKS.index(14.0)], rel=0.1)
    assert np.isnan(made.error_at(-5.0)) and np.isnan(made.error_at(1e4))
    assert made.error_at(20.0) > 3e-3
    with pytest.warns(UserWarning, match="contrast: at 20.* the error of the factored body is about 0"):
        body_channel(made, ARRAY, EYE, PLACE, 20.0)
    with pytest.warns(UserWarning, match="is not known"):
        body_channel(made, ARRAY, EYE, PLACE, -8.0)


@pytest.mark.parametrize(
    "call", [lambda body: sensing_channel(ARRAY, PLACED, 0.0), lambda body: body_channel(body, ARRAY, EYE, PLACE, 0j)]
)
def test_the_echo_of_air_is_zero_and_told(body, call):
    with pytest.warns(UserWarning, match="contrast: is 0, a body of air: its echo is zero"):
        assert not np.any(call(body))


def test_a_large_array_takes_little_memory():
    """64 x 64 elements; and what they are interpolated from determines them, for bodies that no element touches."""
    array = PlanarArray(64, 64, 3e9)
    tracemalloc.start()
    chosen, spread = aperture_skeleton(array, 3e9, 0.3, 8.0)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 400e6
    assert len(chosen) < 200
    random = np.random.default_rng(7)
    place, at = random.normal(size=(2, 50, 3))
    place *= 12.0 / np.linalg.norm(place, axis=1, keepdims=True)
    at *= 0.3 / np.linalg.norm(at, axis=1, keepdims=True)
    r, far = (np.linalg.norm(end[:, None] - array.positions, axis=-1) for end in (place + at, place))
    waves = np.exp(1j * array.wavenumber * (r - far)) / r
    assert np.linalg.norm(waves[:, chosen] @ spread.T - waves) < 3e-5 * np.linalg.norm(waves)


def test_rotations_that_rounding_left_are_taken(body):
    turn = turned([0.3, 0.2, -0.4])
    for kind in (np.float64, np.float32):
        assert np.all(np.isfinite(body_channel(body, ARRAY, turn.astype(kind), PLACE, 2.0)))
