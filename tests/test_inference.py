"""A search by physics against what is known: derivatives, tables against bodies, posteriors against brute force."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from echoes import echo_of, truth_of

from august_jax.config import override, preset
from august_jax.data import generate, prepare_targets
from august_jax.inference import Prior, find, find_craft, known_craft, population, refined
from august_jax.inference.population import Poses, log_mean_likelihood, mixture, populate
from august_jax.inference.prior import TILT_BINS
from august_jax.inference.refine import begin, cost, improved, polished
from august_jax.inference.screen import attitude_lattice, moved_statistics, screen
from august_jax.physics import Parameters, body_channel, contrast, parameter_channel, rotation_from_vector
from august_jax.physics.body.local import local_coefficients
from august_jax.physics.body.survey import nearest_directions, surveyed_coefficients
from august_jax.scene import random_rotation
from august_jax.signal import Statistics, observe_region, project
from august_jax.signal.roi import change_of_centre

SMOKE = preset("smoke")
CONFIG = replace(SMOKE, target=replace(SMOKE.target, permittivity=(1.5, 4.0)))
pytestmark = pytest.mark.usefixtures("optimized")
POSE = (jnp.asarray(attitude_lattice(25.0, 40.0)[3]), jnp.asarray([4.5, 6.0, 3.2], jnp.float32))


@cache
def library():
    return known_craft(CONFIG, prepare_targets(CONFIG), spacing_deg=8.0)


@cache
def prior():
    return Prior.from_config(CONFIG)


@cache
def slots(count=6):
    return generate(CONFIG, np.arange(count) * CONFIG.flight.slots, library().targets, seed=3, domain="evaluate")


def heard(row, snr_db):
    """What the station keeps of a sample's echo."""
    return echo_of(CONFIG, slots(), row, snr_db)


def truth(row):
    return truth_of(slots(), row)


def exact(craft, theta, centre):
    """Coefficients of the factored body about ``centre``, the phase of the place's own distance taken out."""
    known = library()
    rotation, position = POSE
    channel = parameter_channel(
        known.body(craft), known.subspace.array, Parameters.split(theta), rotation, position, 2.5, 5e-3
    )
    k = jnp.asarray(known.subspace.wavenumbers)
    places = jnp.asarray(known.subspace.positions)
    unit = jnp.mean((position - places) / jnp.linalg.norm(position - places, axis=1, keepdims=True), axis=0)
    path = jnp.linalg.norm(position) + unit @ theta[:3]
    return project(channel * jnp.exp(-2j * k * path)[:, None, None], centre, known.subspace).values


def local(craft, rotation, position, **settings):
    known = library()
    return local_coefficients(
        known.table,
        known.subspace.array,
        known.subspace.basis,
        jnp.int32(craft),
        jnp.asarray(rotation, jnp.float32),
        jnp.asarray(position, jnp.float32),
        jnp.float32(2.5),
        jnp.float32(5e-3),
        **settings,
    )


@pytest.mark.parametrize("craft", [0, 1])
def test_local_coefficients_are_the_body_s_within_the_table_s_error(craft):
    found = local(craft, *POSE)
    wanted = exact(craft, jnp.zeros(10), POSE[1])
    error = jnp.linalg.norm(found.values - wanted) / jnp.linalg.norm(wanted)
    assert error < 3.0 * float(library().table.errors[craft, 0, 1])
    np.testing.assert_allclose(
        found.values, jnp.swapaxes(found.values, -1, -2), atol=1e-6 * float(jnp.abs(wanted).max())
    )


@pytest.mark.parametrize("craft", [0, 1])
def test_local_derivatives_are_the_body_s(craft):
    """Displacement, turn, permittivity, conductivity, against automatic differentiation of the factored body."""
    found = local(craft, *POSE).derivatives

    def parts(theta):
        values = exact(craft, theta, POSE[1])
        return jnp.stack([values.real, values.imag])

    real, imag = jax.jacfwd(parts)(jnp.zeros(10))
    for row in range(8):
        wanted = real[..., row] + 1j * imag[..., row]
        error = float(jnp.linalg.norm(found[row] - wanted) / jnp.linalg.norm(wanted))
        assert error < (0.15 if row < 3 else 0.03), (row, error)


def test_survey_agrees_with_local_coefficients_but_for_a_common_factor():
    """At the survey's contrast; the bend over the array's distances is what it leaves out."""
    known = library()
    rotations = [rotation for rotation in attitude_lattice(25.0, 30.0)][::17]
    _, place = POSE
    for rotation in rotations:
        sight = np.asarray(place / jnp.linalg.norm(place))
        towards = nearest_directions(known.survey, 1, -sight @ rotation[None])
        found = surveyed_coefficients(
            known.survey,
            known.subspace.array,
            known.subspace.basis,
            place,
            jnp.int32(1),
            jnp.int32(towards[0]),
            jnp.asarray(rotation)[None],
        )[:, 0]
        wanted = local_coefficients(
            known.table,
            known.subspace.array,
            known.subspace.basis,
            jnp.int32(1),
            jnp.asarray(rotation),
            place,
            jnp.float32(1.0 + known.survey_contrast),
            jnp.float32(np.mean(CONFIG.target.conductivity_s_m)),
            derivatives=False,
        ).values
        factor = jnp.sum(found.conj() * wanted) / jnp.sum(jnp.abs(found) ** 2)
        assert abs(factor - 1.0) < 0.02
        assert jnp.linalg.norm(factor * found - wanted) < 0.03 * jnp.linalg.norm(wanted)


def test_attitudes_cover_what_they_are_asked_for():
    spacing = 10.0
    lattice = attitude_lattice(30.0, spacing)
    np.testing.assert_allclose(
        lattice @ np.swapaxes(lattice, 1, 2), np.broadcast_to(np.eye(3), lattice.shape), atol=1e-5
    )
    assert lattice[:, 2, 2].min() > np.cos(np.radians(30.0)) - 1e-6
    keys = jax.random.split(jax.random.key(0), 2000)
    drawn = np.asarray(jax.vmap(random_rotation)(keys))
    drawn = drawn[drawn[:, 2, 2] > np.cos(np.radians(30.0))]
    assert len(drawn) > 50
    nearest = np.einsum("nij,mij->nm", drawn, lattice).max(axis=1)
    angles = np.degrees(np.arccos(np.clip(0.5 * (nearest - 1.0), -1.0, 1.0)))
    assert angles.max() < spacing
    assert np.median(angles) < 0.6 * spacing


def test_statistics_hold_the_likelihood_of_the_whole_echo():
    """Differences of ||Y - A B||^2 between channels are those of ||Z - A C||^2."""
    rng = np.random.default_rng(0)

    def noise(*shape):
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2.0)

    from august_jax.signal.station import _statistics

    sent, received = noise(1, 7, 20), noise(1, 7, 20)
    found = _statistics(jnp.asarray(received), jnp.asarray(sent), jnp.zeros(3))
    pairs = [noise(1, 7, 7) for _ in range(4)]
    whole = [np.sum(np.abs(received - a @ sent) ** 2) for a in pairs]
    few = [float(jnp.sum(jnp.abs(found.received - a @ found.pilots) ** 2)) for a in pairs]
    np.testing.assert_allclose(np.diff(few), np.diff(whole), rtol=1e-4)


@pytest.mark.slow
def test_moved_statistics_are_those_about_another_place():
    statistics = heard(0, 20.0)
    place = statistics.centre + jnp.asarray([0.1, 0.05, -0.1])
    received, pilots = moved_statistics(statistics, place[None], library().subspace)
    change = change_of_centre(statistics.centre, place, library().subspace)
    np.testing.assert_allclose(pilots[0], jnp.swapaxes(change, -1, -2) @ statistics.pilots, rtol=1e-3, atol=1e-3)
    kept = jnp.sum(jnp.abs(received[0]) ** 2) / jnp.sum(jnp.abs(statistics.received) ** 2)
    assert 0.9 < kept <= 1.0 + 1e-5


@pytest.mark.slow  # the ordinary suite finds a craft at its largest tilt, and follows a flight
@pytest.mark.parametrize("snr_db, slots", [(30.0, 2), (20.0, 6), (30.0, 6)])
def test_search_is_as_good_as_from_the_truth_and_leaves_what_noise_leaves(snr_db, slots):
    good = explained = 0
    for row in range(slots):
        statistics = heard(row, snr_db)
        found = find_craft(library(), statistics, prior(), key=jax.random.key(row))
        start, _ = refined(library(), statistics, prior(), *truth(row))
        good += found.residual < float(start.residual[0]) + 2.0
        explained += found.explained
        np.testing.assert_allclose(found.weights.sum(), 1.0, rtol=1e-5)
        np.testing.assert_allclose(found.hypotheses.weight.sum(), 1.0, rtol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(found.mean_normal), 1.0, rtol=1e-5)
        assert np.all(np.diff(found.hypotheses.weight) <= 1e-12)
    assert good >= slots - 1
    assert explained >= slots - 1


def test_refinement_finds_the_pose_from_nearby():
    statistics = heard(1, 30.0)
    craft, rotation, position, permittivity, conductivity = truth(1)
    turned = np.asarray(rotation_from_vector(jnp.asarray([0.01, -0.01, 0.01]))) @ rotation
    known = library()
    start = begin(
        known.table,
        known.subspace,
        statistics,
        np.asarray([craft]),
        turned[None],
        position[None] + 0.03,
        np.asarray([permittivity]),
        np.asarray([conductivity]),
    )
    before = float(cost(start, statistics, prior())[0])
    after = improved(known.table, known.subspace, statistics, prior(), start, steps=8)
    after = polished(known.body(craft), known.table, known.subspace, statistics, prior(), after, steps=6)
    _, best = refined(known, statistics, prior(), *truth(1))  # the same program for another number of steps
    assert before > best + 10.0
    assert float(cost(after, statistics, prior())[0]) < best + 3.0


@pytest.mark.parametrize("snr_db", [pytest.param(-12.0, marks=pytest.mark.slow), -18.0])
def test_posterior_against_brute_force(snr_db):
    """Two craft, 8 antennas, little power: craft probabilities and moments of the place from 8e4 draws of the prior,
    within five deviations of what so many draws allow."""
    known, statistics, wide = library(), heard(2, snr_db), 40_000
    found = find_craft(known, statistics, prior(), key=jax.random.key(0))
    rng = np.random.default_rng(1)
    logs, places, crafts = [], [], np.repeat([0, 1], wide)
    for craft in range(2):
        rotation = attitude_lattice(float(np.degrees(prior().tilt_rad)) - 1e-3, 3.0)
        rotation = rotation[rng.integers(0, len(rotation), wide)]
        position = np.asarray(statistics.centre) + rng.uniform(-0.5, 0.5, (wide, 3))
        permittivity = rng.uniform(*CONFIG.target.permittivity, wide)
        conductivity = rng.uniform(*CONFIG.target.conductivity_s_m, wide)
        likely = brute(known, statistics, craft, rotation, position, permittivity, conductivity)
        logs.append(likely + np.asarray(prior().log_tilt(jnp.asarray(rotation))))
        places.append(position)
    weight = np.exp(np.concatenate(logs) - np.max(logs))
    weight /= weight.sum()
    draws = 1.0 / np.sum(weight**2)
    assert draws > 2000.0
    assert found.effective > 300.0
    chance = np.sqrt(1.0 / draws + 1.0 / found.effective)
    probability = np.bincount(crafts, weight)
    spread = np.sqrt(probability * (1.0 - probability))
    assert np.all(np.abs(found.craft_probability - probability) < 5.0 * chance * spread)
    position = np.concatenate(places)
    mean = weight @ position
    width = np.sqrt(weight @ (position - mean) ** 2)
    assert np.all(np.abs(found.mean_position - mean) < 5.0 * chance * width)
    own = np.sqrt(np.diagonal(found.position_covariance))
    np.testing.assert_allclose(own, width, rtol=5.0 * chance)


def spread_about(row, count=1):
    """A mixture with a part about the truth of a slot, and the candidate it is about."""
    known, statistics = library(), heard(row, 0.0)
    craft, *pose = truth(row)
    at = begin(
        known.table, known.subspace, statistics, np.full(count, craft), *(np.array([part] * count) for part in pose)
    )
    return mixture(at, np.ones(count), np.zeros(count, int), prior()), Poses(
        *(getattr(at, name) for name in Poses._fields)
    )


def test_a_sample_does_not_measure_the_part_that_was_laid_about_it():
    """What is left at the part's very middle is what the prior's share of the samples has there."""
    parts, middle = spread_about(0)
    centre = heard(0, 0.0).centre

    def density(at):
        return population._log_density(parts, at, len(library().names), centre, prior())[0]

    beside = middle._replace(position=middle.position + np.float32(1e-4))
    far = middle._replace(craft=1 - middle.craft)  # of which the mixture has no part
    assert density(beside) > density(far) + 5.0
    np.testing.assert_allclose(density(middle), density(far), atol=1e-4)


@pytest.mark.slow
def test_the_evidence_does_not_fall_as_rounds_go_on(monkeypatch):
    """Evidence from few samples in many rounds, whose parts lie about earlier samples, against single rounds of many:
    three quarters of it (descendants of a sample still lie about it), where it is the fifth part if samples measure
    their own parts."""
    known, statistics = library(), heard(2, -12.0)
    parts, _ = spread_about(2)
    nothing = np.zeros((1, *statistics.received.shape), np.complex64)
    monkeypatch.setattr(population, "_ENOUGH", np.inf)

    def evidence(samples, rounds, seeds):
        monkeypatch.setattr(population, "_SAMPLES", samples)
        monkeypatch.setattr(population, "_ROUNDS", rounds)
        found = []
        for key in jax.random.split(jax.random.key(rounds), seeds):
            _, weight = populate(key, known.table, known.subspace, statistics, prior(), parts, nothing)
            found.append(np.exp(np.logaddexp.reduce(weight)) / samples)
        return np.mean(found)

    assert abs(np.log(evidence(1024, 6, 3) / evidence(65_536, 1, 1))) < 0.6


@jax.jit
def _log_likelihood(table, statistics, craft, pose):
    known = library()

    def one(each):
        found = local_coefficients(table, known.subspace.array, known.subspace.basis, craft, *each, derivatives=False)
        change = change_of_centre(statistics.centre, each[1], known.subspace)
        model = change @ found.values @ jnp.swapaxes(change, -1, -2) @ statistics.pilots
        energy = jnp.sum(jnp.abs(model) ** 2)
        overlap = jnp.abs(jnp.sum(model.conj() * statistics.received))
        # phase and level of the gain on a grid of levels: log of the mean of exp(-|Z - g m|^2), I0 for the phase
        levels = jnp.linspace(-4.0, 4.0, 161) * prior().log_gain
        gain = jnp.exp(levels)
        bessel = 2.0 * gain * overlap
        phase = jnp.log(jax.scipy.special.i0e(bessel)) + bessel
        return jax.scipy.special.logsumexp(phase - gain**2 * energy - 0.5 * (levels / prior().log_gain) ** 2)

    return jax.lax.map(one, pose, batch_size=64)


def brute(known, statistics, craft, *pose):
    pose = tuple(jnp.asarray(part, jnp.float32) for part in pose)
    return np.asarray(_log_likelihood(known.table, statistics, jnp.int32(craft), pose), np.float64)


@pytest.mark.parametrize("energy", [0.01, 3.0, 60.0, 2000.0, 4e5])
@pytest.mark.parametrize("ratio", [0.9, 1.0, 1.2])
def test_mean_likelihood_is_the_integral_over_gains(energy, ratio):
    """Against SciPy's quadrature over modulus, with the Bessel function of the phase."""
    from scipy import integrate, special

    spread, overlap = 0.115, ratio * energy

    def log_part(level):
        gain = np.exp(level)
        wave = 2.0 * gain * overlap
        return np.log(special.i0e(wave)) + wave - gain**2 * energy - 0.5 * (level / spread) ** 2

    top = max(log_part(level) for level in np.linspace(-0.8, 0.8, 4001))
    whole, _ = integrate.quad(
        lambda level: np.exp(log_part(level) - top), -0.8, 0.8, points=[np.log(ratio), 0.0], limit=2000
    )
    wanted = top + np.log(whole) - np.log(spread * np.sqrt(2.0 * np.pi))
    assert abs(float(log_mean_likelihood(energy, overlap, spread)) - wanted) < max(
        0.05, 0.01 * abs(ratio - 1.0) * wanted
    )


def test_an_echo_of_noise_is_of_no_use_and_says_so():
    """No echo to speak of: the posterior is the prior's, no craft stands out, and the residual is noise."""
    statistics = heard(0, 20.0)
    rng = np.random.default_rng(0)
    shape = statistics.received.shape
    noise = (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2.0)
    faint = Statistics(jnp.asarray(noise, jnp.complex64), statistics.pilots * 1e-4, statistics.centre)
    found = find_craft(library(), faint, prior(), key=jax.random.key(0))
    assert found.explained
    assert np.all(np.isfinite(found.mean_position))
    assert np.sqrt(np.trace(found.position_covariance)) > 0.2


@pytest.mark.slow
def test_double_precision_elsewhere_does_not_reach_a_search():
    """What JAX is set to is a thread's own: a search, and each thread of its, is pinned."""
    statistics, key = heard(0, 30.0), jax.random.key(4)
    wanted = find_craft(library(), statistics, prior(), key=key)
    jax.config.update("jax_enable_x64", True)
    try:
        found = find_craft(library(), statistics, prior(), key=key)
    finally:
        jax.config.update("jax_enable_x64", False)
    assert found.position.dtype == np.float32
    np.testing.assert_array_equal(found.hypotheses.position, wanted.hypotheses.position)


def test_a_material_that_is_known_leaves_a_prior_with_a_density():
    for changes in (["target.permittivity=[3,3]"], ["target.conductivity_s_m=[0,0]"], ["target.permittivity=[1,1.5]"]):
        known = Prior.from_config(override(CONFIG, changes))
        known.check()
        for ends, least in ((known.permittivity, 1e-3), (known.conductivity, 1e-7)):
            assert 0.0 <= float(ends[0]) < float(ends[1]) - least
    assert np.asarray(Prior.from_config(override(CONFIG, changes)).permittivity).tolist() == [1.0, 1.5]


def test_a_prior_that_begins_at_air_is_within_tables_that_do_not():
    """Tables begin at a hundredth of the greatest contrast."""
    known = replace(library(), table=replace(library().table, contrast=(0.04, 4.0)))
    find._check_held(known, heard(0, 30.0), prior()._replace(permittivity=np.float32([1.0, 5.0])))
    with pytest.raises(ValueError, match="permittivity from 1 to 4 is beyond"):
        find._check_held(library(), heard(0, 30.0), prior()._replace(permittivity=np.float32([1.0, 4.0])))


@pytest.mark.parametrize("patience", [pytest.param("whole", marks=pytest.mark.slow), "little"])
def test_a_craft_that_is_not_known_is_not_explained(monkeypatch, patience):
    """The echo of a scatterer like none of the library's, at 30 dB."""
    if patience == "little":  # of the second look, which is there to find what the first one missed
        monkeypatch.setattr(find, "_PATIENT", find._QUICK._replace(stages=find._QUICK.stages[3:]))
    statistics = heard(0, 30.0)
    rng = np.random.default_rng(0)
    change = jnp.asarray(rng.normal(size=statistics.received.shape), jnp.complex64)
    energy = jnp.linalg.norm(statistics.received)
    other = Statistics(
        0.7 * statistics.received + 0.7 * energy * change / jnp.linalg.norm(change),
        statistics.pilots,
        statistics.centre,
    )
    found = find_craft(library(), other, prior(), key=jax.random.key(0))
    assert not found.explained
    assert found.probability < 1e-6


def test_prior_adds_up_and_has_the_flights_tilts():
    known = prior()
    z = np.linspace(np.cos(float(known.tilt_rad)), 1.0, 20_001)
    rotations = np.zeros((len(z), 3, 3), np.float32)
    rotations[:, 2, 2] = z
    density = np.exp(np.asarray(known.log_tilt(jnp.asarray(rotations))))
    assert abs(2.0 * np.pi * np.trapezoid(density, z) - 1.0) < 0.02
    assert known.tilt_density.shape == (TILT_BINS,)
    upside_down = jnp.asarray(np.diag([1.0, -1.0, -1.0]), jnp.float32)
    assert np.isneginf(known.log_tilt(upside_down))
    degrees = float(np.degrees(known.tilt_rad)) + np.array([-0.01, 0.01, 0.5, 1.0, 2.0, 3.5])
    beyond = np.zeros((len(degrees), 3, 3), np.float32)
    beyond[:, 2, 2] = np.cos(np.radians(degrees))
    values = np.asarray(known.log_tilt(jnp.asarray(beyond)))
    assert abs(values[0] - values[1]) < 0.01 and np.all(np.diff(values[1:5]) < -0.4) and np.isneginf(values[5])
    assert abs(values[3] - values[1] + 2.0) < 0.05  # two half degrees


def test_a_craft_that_tilts_as_far_as_flights_do_is_found():
    """Half of what the echo allows lies beyond the largest tilt."""
    known, place = library(), jnp.asarray([4.5, 6.0, 3.2], jnp.float32)
    rotation = rotation_from_vector(jnp.asarray([float(prior().tilt_rad), 0.0, 0.0]))
    material = jnp.asarray(contrast(2.5, 5e-3, CONFIG.array.frequency_hz), jnp.complex64)
    channel = body_channel(known.body(0), known.subspace.array, rotation, place, material)[None]
    seen = observe_region(jax.random.key(0), channel, place + 0.1, array=CONFIG.array, signal=CONFIG.signal,
                          region=CONFIG.region, snr_db=30.0)  # fmt: skip
    found = find_craft(known, seen.statistics, prior(), key=jax.random.key(0))
    start, _ = refined(known, seen.statistics, prior(), 0, rotation, place, 2.5, 5e-3)
    assert found.residual < float(start.residual[0]) + 1.0 and found.explained


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("none", "targets: a library needs at least one craft"),
        ("twice", "is in the library twice"),
        ("bodiless", "data.solver: 'born' makes no bodies"),
        ("nan", "statistics: received holds numbers that are not finite"),
        ("tones", "want"),
        ("gain", "gain_db: 0 dB leaves no room"),
    ],
)
def test_what_cannot_be_searched_is_refused(case, message):
    with pytest.raises(ValueError, match=message):
        if case == "none":
            known_craft(CONFIG, [])
        elif case == "twice":
            known_craft(CONFIG, [library().targets[0]] * 2)
        elif case == "bodiless":
            born = replace(CONFIG, data=replace(CONFIG.data, solver="born"))
            known_craft(born, [replace(library().targets[0], body=None)])
        elif case == "gain":
            Prior.from_config(CONFIG, gain_db=0.0)
        else:
            statistics = heard(0, 20.0)
            wrong = (
                statistics._replace(received=statistics.received.at[0, 0, 0].set(jnp.nan))
                if case == "nan"
                else Statistics(
                    jnp.tile(statistics.received, (2, 1, 1)), jnp.tile(statistics.pilots, (2, 1, 1)), statistics.centre
                )
            )
            find_craft(library(), wrong, prior(), key=jax.random.key(0))


def test_screen_keeps_the_best_first():
    statistics = heard(0, 30.0)
    known = library()
    place = jnp.asarray(slots().position[0])
    found = screen(known.survey, known.subspace, statistics, place, known.attitudes, 500)
    assert len(found.residual) == 500
    assert np.all(np.diff(found.residual) >= 0.0)
    assert found.residual[0] < 0.5 * float(jnp.sum(jnp.abs(statistics.received) ** 2))
    np.testing.assert_allclose(np.linalg.det(found.rotation), 1.0, atol=2e-2)
