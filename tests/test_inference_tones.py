"""Several tones in a search: they share one gain, so that their phases against each other tell the range."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from echoes import echo_of, truth_of

from august_jax.config import preset
from august_jax.data import generate, prepare_targets
from august_jax.data.simulator import contrast_of
from august_jax.inference import Prior, find_craft, known_craft, refined
from august_jax.inference.refine import begin
from august_jax.inference.screen import attitude_lattice, screen
from august_jax.physics import PlanarArray, sensing_channel
from august_jax.physics.body.local import local_coefficients
from august_jax.signal import Statistics, project

SMOKE = preset("smoke")
TONES = (2.96e9, 3.04e9)  # 80 MHz apart: their phase repeats every 1.9 m of range
ROTATION = attitude_lattice(25.0, 40.0)[3]
POSITION = np.asarray([4.5, 6.0, 3.2], np.float32)
MATERIAL = (2.5, 5e-3)
pytestmark = [
    pytest.mark.slow,  # tables of two tones are made for these tests alone
    pytest.mark.usefixtures("optimized"),
    pytest.mark.filterwarnings("ignore:cells.volumes"),  # cells as large as these are for tests alone
]


def configured(tones):
    return replace(
        SMOKE, array=replace(SMOKE.array, tones_hz=tones), target=replace(SMOKE.target, permittivity=(1.5, 4.0))
    )


@cache
def library(tones=TONES):
    config = configured(tones)
    return known_craft(config, prepare_targets(config), spacing_deg=6.0)


@cache
def prior():
    return Prior.from_config(configured(TONES))


@cache
def slots(count=4):
    known = library()
    return generate(
        known.config, np.arange(count) * known.config.flight.slots, known.targets, seed=3, domain="evaluate"
    )


def heard(row, snr_db, tones=slice(None)):
    """What the station keeps of a sample's echo at some of the tones."""
    seen = echo_of(library().config, slots(), row, snr_db)
    return Statistics(seen.received[tones], seen.pilots[tones], seen.centre)


def truth(row):
    return truth_of(slots(), row)


def along(row, position):
    """How far a place lies beyond the true one, along the line of sight [m]."""
    true = slots().position[row]
    return float((position - true) @ true / np.linalg.norm(true))


def local(craft, position=POSITION):
    known = library()
    numbers = (jnp.asarray(number, jnp.float32) for number in (ROTATION, position, *MATERIAL))
    return local_coefficients(known.table, known.subspace.array, known.subspace.basis, jnp.int32(craft), *numbers)


def solved(craft, position):
    """Coefficients of every tone about POSITION by the coupled solve in double precision, the phase e^{2jk'|q|} of the
    mean wavenumber taken out."""
    known = library()
    with jax.enable_x64(True):
        cells = known.targets[craft].cells.moved(
            jnp.asarray(ROTATION, jnp.float64), jnp.asarray(np.asarray(position, np.float64))
        )
        chi = np.asarray(contrast_of(known.config, *MATERIAL))[:, None]
        channel = np.asarray(
            sensing_channel(PlanarArray.from_config(known.config.array), cells, chi, frequencies_hz=TONES)
        )
    common = np.mean(known.subspace.wavenumbers.astype(float))
    channel = channel * np.exp(-2j * common * np.linalg.norm(np.asarray(position, float)))
    return np.asarray(project(jnp.asarray(channel, jnp.complex64), jnp.asarray(POSITION), known.subspace).values)


@pytest.mark.parametrize("craft", [0, 1])
def test_coefficients_of_every_tone_are_the_coupled_solve_s_with_the_phase_between_tones(craft):
    found, wanted = np.asarray(local(craft).values), solved(craft, POSITION)
    for tone in range(len(TONES)):
        error = np.linalg.norm(found[tone] - wanted[tone]) / np.linalg.norm(wanted[tone])
        assert error < 3.0 * float(library().table.errors[craft, tone, 1])


def test_a_step_in_range_turns_the_tones_against_each_other():
    """The derivative along the line of sight, against a difference of coupled solves; one tone's hardly changes."""
    sight, step = POSITION / np.linalg.norm(POSITION), 0.01
    found = np.einsum("i,ifkl->fkl", sight, np.asarray(local(0).derivatives)[:3])
    ends = [solved(0, POSITION.astype(float) + sign * step * sight) for sign in (1.0, -1.0)]
    wanted = (ends[0] - ends[1]) / (2.0 * step)
    assert np.linalg.norm(found - wanted) < 0.15 * np.linalg.norm(wanted)
    apart = np.ptp(library().subspace.wavenumbers)
    turned = np.sum(found * np.asarray(local(0).values).conj(), axis=(1, 2))
    per_metre = turned.imag / np.sum(np.abs(np.asarray(local(0).values)) ** 2, axis=(1, 2))
    assert np.diff(per_metre)[0] == pytest.approx(2.0 * apart, rel=0.05)


def test_search_finds_craft_and_place_and_tones_tell_the_range():
    """At 30 dB. With one tone the range is off by a decimetre and more; the gain takes its phase."""
    found = {row: find_craft(library(), heard(row, 30.0), prior(), key=jax.random.key(row)) for row in range(3)}
    good = 0
    for row, posterior in found.items():
        start, _ = refined(library(), heard(row, 30.0), prior(), *truth(row))
        craft = int(np.argmax(posterior.craft_probability)) == truth(row)[0]
        near = np.linalg.norm(posterior.mean_position - truth(row)[2]) < 0.06
        told = abs(along(row, posterior.mean_position)) < 0.03
        good += posterior.residual < float(start.residual[0]) + 2.0 and posterior.explained and craft and near and told
    assert good >= 2


def test_the_screen_looks_at_ranges_where_several_tones_tell_them():
    """From a place half a metre too near, some of the best candidates are at the true range."""
    known, row = library(), 0
    statistics = heard(row, 30.0)
    true = slots().position[row]
    place = true * (1.0 - 0.5 / np.linalg.norm(true))
    statistics = moved_to(statistics, place)
    seen = screen(known.survey, known.subspace, statistics, place, known.attitudes, 50, reach_m=0.8)
    ranges = np.asarray([along(row, position) for position in seen.position])
    assert np.median(np.abs(ranges)) < 0.15
    blind = screen(known.survey, known.subspace, statistics, place, known.attitudes, 50)
    np.testing.assert_allclose([along(row, position) for position in blind.position], -0.5, atol=0.05)
    assert seen.residual[0] < blind.residual[0]


def moved_to(statistics, place):
    """About another centre."""
    from august_jax.inference.screen import moved_statistics

    received, pilots = moved_statistics(statistics, jnp.asarray(place, jnp.float32)[None], library().subspace)
    return Statistics(received[0], pilots[0], jnp.asarray(place, jnp.float32))


def informed(row, tones):
    """Information (6, 6) of place and attitude at the truth from some tones, material and gain not known."""
    known = library()
    table = replace(
        known.table,
        functions=known.table.functions[:, tones],
        responses=known.table.responses[:, tones],
        errors=known.table.errors[:, tones],
        frequencies_hz=known.table.frequencies_hz[tones],
    )
    subspace = replace(known.subspace, frequencies_hz=known.subspace.frequencies_hz[tones])
    at = [np.asarray(number)[None] for number in truth(row)]
    whole = np.asarray(begin(table, subspace, heard(row, 20.0, tones), *at).information[0], np.float64)
    rest = whole[6:, 6:] + 1e-6 * np.diag(np.diagonal(whole)[6:])
    return whole[:6, :6] - whole[:6, 6:] @ np.linalg.solve(rest, whole[6:, :6])


@pytest.mark.parametrize("row", range(3))
def test_two_tones_hold_no_less_than_one_and_the_range_besides(row):
    both = informed(row, slice(0, 2))
    sight = truth(row)[2] / np.linalg.norm(truth(row)[2])
    for tone in range(2):
        one = informed(row, slice(tone, tone + 1))
        assert np.linalg.eigvalsh(both - one).min() > -1e-3 * np.linalg.eigvalsh(both).max()
        assert sight @ both[:3, :3] @ sight > 10.0 * (sight @ one[:3, :3] @ sight)


def test_a_list_of_one_tone_is_the_carrier_alone():
    """The path of several tones with one tone says what the path of a plain carrier says."""
    plain, listed = library(()), library((SMOKE.array.frequency_hz,))
    assert plain.table.single and not listed.table.single
    statistics = heard(1, 30.0, slice(0, 1))
    place = jnp.asarray(truth(1)[2])
    at = [np.asarray(number)[None] for number in truth(1)]
    looked, begun = [], []
    for known in (plain, listed):
        looked.append(screen(known.survey, known.subspace, statistics, place, known.attitudes, 20, reach_m=0.8))
        begun.append(begin(known.table, known.subspace, statistics, *at))
    for one, other in (looked, begun):
        for left, right in zip(one, other, strict=True):
            np.testing.assert_allclose(left, right, rtol=1e-5, atol=1e-5 * np.abs(left).max())
