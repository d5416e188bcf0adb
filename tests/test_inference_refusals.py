"""What cannot be searched is refused with argument, value and way out; what nothing explains is said to be so."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from august_jax.app import cli
from august_jax.app.cli.messages import told
from august_jax.config import preset
from august_jax.data import generate, prepare_targets, unpack
from august_jax.inference import Prior, find, find_craft, known_craft
from august_jax.physics import table_channel
from august_jax.signal import Statistics, observe_region

SMOKE = preset("smoke")
CONFIG = replace(SMOKE, target=replace(SMOKE.target, permittivity=(1.5, 4.0)))
pytestmark = [
    pytest.mark.usefixtures("optimized"),
    pytest.mark.filterwarnings("ignore:cells.volumes"),  # cells as large as these are for tests alone
]


@cache
def library():
    return known_craft(CONFIG, prepare_targets(CONFIG), spacing_deg=12.0)


@cache
def prior():
    return Prior.from_config(CONFIG)


@cache
def slot(aside_m=0.2):
    """A slot's sample, and what the station keeps of its echo at 30 dB where the craft is expected so far aside."""
    sample = generate(CONFIG, np.arange(1), library().targets, seed=3, domain="evaluate")
    place = sample.position[0]
    across = np.cross(place, [0.0, 0.0, 1.0])
    seen = observe_region(
        jax.random.key(1),
        unpack(jnp.asarray(sample.true_channel[0])),
        jnp.asarray(place + aside_m * across / np.linalg.norm(across), jnp.float32),
        array=CONFIG.array,
        signal=CONFIG.signal,
        region=CONFIG.region,
        snr_db=30.0,
    )
    return sample, seen.statistics


def known_with(*targets):
    return known_craft(CONFIG, targets)


def made_for_less(field, value):
    """Craft whose tables were made for a configuration of less range, taken for this one."""
    section, name = field.split(".")
    tables = [replace(library().targets[0], table=jax.tree.map(lambda leaf: leaf[0], library().table))]
    own = replace(getattr(CONFIG, section), **{name: value})
    return known_craft(replace(CONFIG, **{section: own}), tables)


def searched(statistics=None, **numbers):
    """A search of the slot with other statistics or another prior."""
    own = prior()._replace(**{name: jnp.asarray(number, jnp.float32) for name, number in numbers.items()})
    return find_craft(library(), slot()[1] if statistics is None else statistics, own, key=jax.random.key(0))


def spoilt(name, value):
    """The slot's statistics with a number put into one of its arrays."""
    array = getattr(slot()[1], name)
    return slot()[1]._replace(**{name: array.at[(0,) * array.ndim].set(value)})


def asked(place, permittivity_less_one=1.5):
    """A tabulated channel at a place and of a contrast."""
    known = library()
    place, upright = jnp.asarray(place, jnp.float32), jnp.eye(3)
    return table_channel(known.table, known.subspace.array, upright, place, permittivity_less_one, craft=0)


def of_tones(count, orders=None):
    """Statistics of so many tones, of an array that tells ``orders`` functions apart."""
    orders = library().subspace.orders if orders is None else orders
    values = jnp.ones((count, orders, orders), jnp.complex64)
    return Statistics(values, values, slot()[1].centre)


REFUSED = {
    "no craft": (lambda: known_with(), ("targets", "at least one craft", "target.airframes")),
    "a craft twice": (lambda: known_with(*[library().targets[0]] * 2), ("targets", "quad_x", "twice", "once in")),
    "a craft under two names": (
        lambda: known_with(
            library().targets[0],
            replace(library().targets[0], airframe=replace(library().targets[0].airframe, name="other")),
        ),
        ("targets", "other", "as quad_x too", "once in"),
    ),
    "tables for another box": (
        lambda: made_for_less("flight.box_m", ((3.0, 30.0), (4.0, 8.0), (2.0, 5.0))),
        ("flight.box_m", "30.0", "the table, which holds", "make it for this configuration"),
    ),
    "tables for other materials": (
        lambda: made_for_less("target.permittivity", (1.5, 4.9)),
        ("target.permittivity", "4.9", "the table, which holds", "make it for this configuration"),
    ),
    "a table asked too far away": (
        lambda: asked([40.0, 40.0, 3.0]),
        ("translation", "56.", "the table holds", "tabulate for another distance_m"),
    ),
    "a table asked too near": (lambda: asked([1.0, 2.0, 0.5]), ("translation", "2.", "the table holds", "tabulate")),
    "a table asked for another contrast": (
        lambda: asked([4.5, 6.0, 3.2], 9.0),
        ("contrast", "9", "the table holds", "body_channel"),
    ),
    "more tones": (lambda: searched(of_tones(2)), ("statistics: received", "(2, ", "1 tone(s)", "the library's tones")),
    "another array": (
        lambda: searched(of_tones(1, 15)),
        ("statistics: received", "(1, 15, 15)", "7 functions", "array"),
    ),
    "NaN in the echo": (lambda: searched(spoilt("received", jnp.nan)), ("statistics: received", "not finite", "leave")),
    "infinite pilots": (lambda: searched(spoilt("pilots", jnp.inf)), ("statistics: pilots", "not finite", "leave")),
    "NaN in the place": (lambda: searched(spoilt("centre", jnp.nan)), ("statistics: centre", "not finite", "leave")),
    "a place that no table holds": (
        lambda: searched(slot()[1]._replace(centre=jnp.asarray([30.0, 40.0, 5.0]))),
        ("statistics: the centre", "50.2 m", "tables, which hold", "flight.box_m"),
    ),
    "no room for the place": (lambda: searched(half_m=0.0), ("prior: half_m", "is 0", "half the edge")),
    "no tilt": (lambda: searched(tilt_rad=0.0), ("prior: tilt_rad", "is 0", "largest tilt")),
    "tilts that are not numbers": (lambda: searched(tilt_rad=jnp.nan), ("prior: tilt_rad", "is nan", "largest tilt")),
    "tilts of no density": (
        lambda: searched(tilt_density=np.zeros(64)),
        ("prior: tilt_density", "is 0", "let tilt_rad bound"),
    ),
    "materials the wrong way round": (
        lambda: searched(permittivity=(4.0, 1.5)),
        ("prior: permittivity", "from 4 to 1.5", "the smaller first"),
    ),
    "a material without room": (
        lambda: searched(conductivity=(5e-3, 5e-3)),
        ("prior: conductivity", "from 0.005 to 0.005", "a thousandth of it"),
    ),
    "materials that no table holds": (
        lambda: searched(permittivity=(6.0, 7.0)),
        ("prior: permittivity", "from 6 to 7", "tables, which hold", "target.permittivity"),
    ),
    "losses that no table holds": (
        lambda: searched(conductivity=(0.0, 1.0)),
        ("prior: conductivity", "1 S/m", "tables, which hold", "target.conductivity_s_m"),
    ),
    "a gain of no spread": (lambda: searched(log_gain=0.0), ("prior: log_gain", "is 0", "standard deviation")),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_searched_is_refused_with_the_way_out(name):
    call, wanted = REFUSED[name]
    with pytest.raises(ValueError, match=wanted[0]) as refused:
        call()
    for words in wanted:
        assert words in str(refused.value)
    said = told(refused.value)
    assert len(said.splitlines()) <= 6 and "--" not in said and "\n  ..." not in said


def noise(shape, seed=0):
    rng = np.random.default_rng(seed)
    return jnp.asarray((rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2.0), jnp.complex64)


NOISE = "noise where an echo was sent for"
SILENT = {
    NOISE: lambda: slot()[1]._replace(received=noise(slot()[1].received.shape)),
    "silence where an echo was sent for": lambda: slot()[1]._replace(received=0.0 * slot()[1].received),
}


def finite(found):
    for number in (found.mean_position, found.mean_normal, found.craft_probability, found.position_covariance):
        assert np.all(np.isfinite(number))
    np.testing.assert_allclose(found.weights.sum(), 1.0, rtol=1e-5)
    np.testing.assert_allclose(found.craft_probability.sum(), 1.0, rtol=1e-5)


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name == NOISE)) for name in SILENT])
def test_where_nothing_is_heard_it_is_said(name, monkeypatch):
    """Of eight antennas an attitude in which a craft sends next to nothing back explains silence."""
    if name != NOISE:  # silence needs no second look
        monkeypatch.setattr(find, "_PATIENT", find._QUICK._replace())
    found = searched(SILENT[name]())
    assert not found.heard and found.silence > 0.01
    finite(found)


@pytest.mark.slow
def test_a_craft_outside_of_where_it_may_be_is_heard_and_not_explained():
    found = searched(slot(3.0)[1])
    assert found.heard and found.silence == 0.0 and not found.explained
    finite(found)


COARSE = (
    "target.max_cells=60",
    "target.cell_m=0.06",
    "evaluate.count=2",
    "evaluate.searched=1",
    "evaluate.snr_db=[20]",
)
REFUSED_COMMANDS = {
    "a craft twice": (
        ("target.airframes=[hexa,hexa]", *COARSE),
        ("target.airframes", "hexa", "twice", "evaluate.searched=0"),
    ),
    "no craft": (("target.airframes=[]",), ("target.airframes", "[]")),
    "other tones than the weights": (
        ("array.tones_hz=[2.96e9,3.04e9]",),
        ("array.tones_hz", "2.96e+09", "keep that value"),
    ),
}


@pytest.mark.parametrize("name", REFUSED_COMMANDS)
def test_the_command_line_refuses_in_a_few_lines(name, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words, wanted = REFUSED_COMMANDS[name]
    status = cli.main(["evaluate", *words])
    captured = capsys.readouterr()
    lines = captured.err[captured.err.rindex("august: ") :].strip().splitlines()  # after what it said on the way
    assert status == 2 and captured.out == "" and len(lines) <= 6 and "Traceback" not in captured.err
    for text in wanted:
        assert text in "\n".join(lines)
