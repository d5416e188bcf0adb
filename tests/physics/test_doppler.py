"""Slow time: signs by bodies at constant speed, a point on a circle by Bessel's functions, blades by their symmetry."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from lattices import cross, turned
from scipy.special import jv

from august_jax.physics import (
    AntennaArray,
    Cells,
    PlanarArray,
    Spinning,
    blade_flash_rate,
    body_channel,
    doppler_shift,
    doppler_spectrum,
    factor_body,
    range_doppler,
    sensing_channel,
    slow_time_channels,
    spectrogram,
    tabulate,
    wavenumber,
)
from august_jax.physics.doppler import about_z
from august_jax.scene import procedural_airframe, rotorcraft

FREQUENCY = 3e9
K = wavenumber(FREQUENCY)
CHI = 2.0 + 0.05j
FAR = AntennaArray(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), FREQUENCY)
PLACE = np.array([0.0, 60.0, 0.0])


@pytest.fixture(scope="module")
def hull():
    return factor_body(cross(arm=2), FREQUENCY, nearest_m=2.0, cache=False)


@pytest.fixture(scope="module")
def speck():
    """Next to a point, 8 cm from its axis; moments along z answer alike from all sides of it."""
    cell = Cells(np.array([[0.08, 0.0, 0.0]]), np.array([1e-6]))
    return factor_body(cell, FREQUENCY, nearest_m=2.0, cache=False)


@pytest.mark.parametrize("speed, sign", [(-12.0, 1), (7.5, -1)])
def test_what_comes_nearer_is_heard_higher(hull, speed, sign):
    """2 v/lambda, folded nowhere; 60 m away the speed along the line of sight is that along y."""
    interval, count = 1e-3, 256
    velocity = np.array([4.0, speed, 0.0])
    times = np.arange(count) * interval
    series = slow_time_channels(hull, [], FAR, np.eye(3), PLACE, times, CHI, velocity_m_s=velocity)[:, 0, 0]
    shifts, spectrum = doppler_spectrum(np.asarray(series), interval)
    peak = shifts[np.argmax(np.abs(spectrum))]
    assert np.sign(peak) == sign
    assert abs(peak - doppler_shift(-speed, FREQUENCY)) < 1.0 / (count * interval)
    # and the amplitude is that of the standing craft, to what a window between lines takes (Hann's: 1.4 dB)
    still = abs(complex(body_channel(hull, FAR, jnp.eye(3), jnp.asarray(PLACE, jnp.float32), CHI)[0, 0]))
    assert 0.8 < np.abs(spectrum).max() / still < 1.02


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.3, 0.1, -0.2)])
def test_a_kilometre_away_a_line_is_as_clean_as_nearby(speck, offset):
    """Places are told to 6e-5 m there in single precision, 0.004 rad a way: noise that stood 58 dB below the line."""
    interval, count = 1e-4, 1000
    place, velocity, times = np.array([0.0, 1000.0, 0.0]), np.array([0.0, -5.0, 0.0]), np.arange(count) * interval
    array = AntennaArray(np.array([offset]), FAR.moments, FREQUENCY)
    series = slow_time_channels(speck, [], array, np.eye(3), place, times, CHI, velocity_m_s=velocity)[:, 0, 0]
    cell = np.array([0.08, 0.0, 0.0])
    distance = np.linalg.norm(place + cell + times[:, None] * velocity - np.array(offset), axis=1)
    exact = np.exp(2j * K * distance) / distance**2
    ratio = np.asarray(series) / exact
    assert np.abs(ratio / ratio.mean() - 1.0).max() < 3e-4
    shifts, spectrum = doppler_spectrum(np.asarray(series), interval)
    level = 20.0 * np.log10(np.abs(spectrum) / np.abs(spectrum).max())
    assert level[np.abs(shifts - doppler_shift(5.0, FREQUENCY)) > 100.0].max() < -75.0


@pytest.mark.parametrize("rate, phase", [(40.0, 0.3), (-40.0, 0.3)])
def test_a_point_on_a_circle_has_the_lines_of_bessels_functions(hull, speck, rate, phase):
    """At angle p = 2 pi f t + phase it is a sin p farther away: e^{2jka sin p} = sum J_n(2ka) e^{jnp}; a shift of
    +f stands for n = -1."""
    turn, count = 1.0 / abs(rate), 64
    times = np.arange(count) * turn / count
    every = slow_time_channels(hull, [Spinning(speck, (0.0, 0.0, 0.0), rate, phase)], FAR, np.eye(3), PLACE, times, CHI)
    alone = slow_time_channels(hull, [], FAR, np.eye(3), PLACE, times, CHI)
    series = np.asarray(every - alone)[:, 0, 0]
    shifts, found = doppler_spectrum(series, turn / count, window=False)
    order = np.round(-shifts / rate).astype(int)
    wanted = jv(order, 2.0 * K * 0.08) * np.exp(1j * order * phase)
    gain = np.vdot(wanted, found) / np.vdot(wanted, wanted)
    # 60 m away the wave is not quite plane, and nearer is louder: a/r = 1.3e-3
    assert np.linalg.norm(found - gain * wanted) < 6e-3 * np.linalg.norm(found)


@pytest.fixture(scope="module")
def rotor():
    parts = rotorcraft(procedural_airframe("quad_x", 0.25))
    cells = parts.rotors[0].cells(0.012, 0.002)
    return factor_body(cells, FREQUENCY, nearest_m=2.0, cache=False), float(parts.radii_m[0]), int(parts.blades[0])


def test_two_blades_flash_twice_a_turn_and_no_tip_is_faster_than_it_turns(hull, rotor):
    body, radius, blades = rotor
    rate, count = 80.0, 128
    times = np.arange(count) / (rate * count)
    spinning = [Spinning(body, (0.0, 0.0, 0.0), rate)]
    level = AntennaArray(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]), FREQUENCY)
    every = slow_time_channels(hull, spinning, level, np.eye(3), PLACE, times, CHI)
    series = np.asarray(every - slow_time_channels(hull, [], level, np.eye(3), PLACE, times, CHI))[:, 0, 0]
    shifts, lines = doppler_spectrum(series, times[1], window=False)
    order = np.round(shifts / rate).astype(int)
    power = np.abs(lines) ** 2
    assert blade_flash_rate(blades, rate) == 160.0
    assert power[order % blades != 0].sum() < 1e-5 * power.sum()
    fastest = doppler_shift(2.0 * np.pi * rate * radius, FREQUENCY)
    beyond, outer = np.abs(shifts) > fastest, np.abs(shifts) > 0.5 * fastest
    # Bessel's functions fall off beyond their argument: the next three lines hold what is left
    assert power[np.abs(shifts) > fastest + 3 * blades * rate].sum() < 1e-4 * power.sum()
    assert power[beyond].sum() < 0.1 * power[outer].sum()
    assert power[outer].sum() > 1e-3 * power.sum()


def test_other_pulses_repeat_after_a_turn_over_the_blades(hull, rotor):
    body, _, blades = rotor
    rate = 37.0
    times = np.array([0.0012, 0.0012 + 1.0 / (blades * rate), 0.0012 + 1.0 / rate, 0.0012 + 0.3 / rate])
    spinning = [Spinning(body, (0.1, 0.1, 0.03), rate, 0.4)]
    series = np.asarray(slow_time_channels(hull, spinning, FAR, turned((0.3, 0.1, 0.0)), PLACE, times, CHI))[:, 0, 0]
    np.testing.assert_allclose(series[1:3], series[0], rtol=3e-3)
    assert abs(series[3] - series[0]) > 1e-2 * abs(series[0])


def test_a_rotor_stands_where_the_craft_carries_it(hull, rotor):
    """A pulse's channel is the sum of two bodies' in their poses, by hand."""
    body, rotation, centre = rotor[0], turned((0.4, -0.2, 0.1)), np.array([0.17, -0.1, 0.03])
    array = PlanarArray(3, 2, FREQUENCY)
    velocity, time, rate, phase = np.array([3.0, -5.0, 1.0]), 0.05, 25.0, 0.2
    place = np.array([1.0, 6.0, 2.0])
    found = slow_time_channels(
        hull,
        [Spinning(body, centre, rate, phase)],
        array,
        rotation,
        place,
        np.array([time]),
        CHI,
        velocity_m_s=velocity,
    )
    there = place + velocity * time
    turn = np.asarray(about_z(np.asarray(2.0 * np.pi * rate * time + phase)), float)
    wanted = np.asarray(body_channel(hull, array, rotation, there, CHI))
    wanted = wanted + np.asarray(body_channel(body, array, rotation @ turn, there + rotation @ centre, CHI))
    assert np.linalg.norm(found[0] - wanted) < 1e-4 * np.linalg.norm(wanted)


@pytest.mark.slow
def test_tables_serve_as_the_bodies_that_they_were_made_of(hull, rotor):
    """To what they say of their errors; and what leads out of a table is refused, pulse by pulse."""
    array, rotation = PlanarArray(3, 2, FREQUENCY), turned((0.4, -0.2, 0.1))
    flown = {"array": array, "rotation": rotation, "translation": np.array([1.0, 6.0, 2.0]), "contrast": CHI}
    motion = {"times_s": np.linspace(0.0, 0.1, 9), "velocity_m_s": np.array([3.0, -5.0, 1.0])}
    bodies = hull, rotor[0]
    tables = [tabulate(each, array, distance_m=(5.0, 8.0), cache=False) for each in bodies]
    by_body, by_table = (
        np.asarray(slow_time_channels(first, [Spinning(second, (0.1, 0.1, 0.03), 25.0)], **flown, **motion))
        for first, second in (bodies, tables)
    )
    off = np.linalg.norm(by_table - by_body, axis=(1, 2)) / np.linalg.norm(by_body, axis=(1, 2))
    assert np.median(off) < 2.0 * max(float(table.errors[0, 1]) for table in tables) < 0.04
    with pytest.raises(ValueError, match="translation: the body is .* the table holds"):  # 9 m away in the end
        slow_time_channels(tables[0], [], **flown, times_s=np.array([0.0, 1.0]), velocity_m_s=(0.0, 2.5, 0.0))
    with pytest.raises(ValueError, match="contrast: got .* the table holds 0.5 to 4.2"):
        slow_time_channels(hull, [Spinning(tables[1], (0.1, 0.1, 0.03), 25.0)], **flown | {"contrast": 9.0}, **motion)


def test_channels_are_differentiable_in_speed_and_rate(hull, speck):
    """Against differences over what the phases turn by."""

    def heard(velocity, rate):
        spinning = [Spinning(speck, (0.0, 0.0, 0.0), rate, 0.3)]
        series = slow_time_channels(hull, spinning, FAR, jnp.eye(3), jnp.asarray(PLACE), jnp.array([0.01]), CHI,
                                    velocity_m_s=velocity)  # fmt: skip
        return 1e7 * jnp.real(series[0, 0, 0])

    start = (jnp.array([1.0, -5.0, 0.5]), 7.0)
    by_velocity, by_rate = jax.jit(jax.grad(heard, (0, 1)))(*start)
    step = jnp.array([0.0, 0.05, 0.0])  # [m/s], a thousandth of a wavelength
    slope = (heard(start[0] + step, start[1]) - heard(start[0] - step, start[1])) / 0.1
    np.testing.assert_allclose(by_velocity[1], slope, rtol=0.02)
    slope = (heard(start[0], 7.1) - heard(start[0], 6.9)) / 0.2
    np.testing.assert_allclose(by_rate, slope, rtol=0.02)


def test_scattering_between_bodies_is_what_is_left_out(hull, rotor):
    """Against one coupled solve of both, of what the rotor adds: much 4 cm above a cross of arms, little half a metre
    away (1/r of a field that falls so)."""
    cells = rotorcraft(procedural_airframe("quad_x", 0.25)).rotors[0].cells(0.012, 0.002)
    arms, turn = cross(arm=2), np.asarray(about_z(np.asarray(0.7)), float)
    array, place = PlanarArray(3, 2, FREQUENCY), np.array([1.0, 6.0, 2.0])
    alone = np.asarray(body_channel(hull, array, np.eye(3), place, CHI))
    left_out = []
    for height in (0.04, 0.5):
        centre = np.array([0.0, 0.0, height])
        both = together(arms.moved(np.eye(3), place), cells.moved(turn, centre + place))
        whole = np.asarray(sensing_channel(array, both, CHI))
        spinning = [Spinning(rotor[0], centre, 0.0, 0.7)]
        single = slow_time_channels(hull, spinning, array, np.eye(3), place, np.zeros(1), CHI)
        left_out.append(np.linalg.norm(whole - np.asarray(single[0])) / np.linalg.norm(whole - alone))
    assert 0.1 < left_out[0] < 0.6 and 1e-4 < left_out[1] < 0.08


def together(*parts):
    return Cells(
        np.concatenate([np.asarray(part.positions) for part in parts]),
        np.concatenate([np.asarray(part.volumes) for part in parts]),
        np.concatenate([np.asarray(part.fractions()) for part in parts]),
        np.concatenate([np.asarray(part.tensors()) for part in parts]),
        np.concatenate([np.asarray(part.sites()) for part in parts]),
    )


def test_range_and_speed_are_read_from_one_picture():
    tones = np.linspace(2.9e9, 3.1e9, 8)
    body = factor_body(Cells(np.zeros((1, 3)), np.array([1e-6])), list(tones), nearest_m=2.0, cache=False)
    interval, count, speed, distance = 1e-3, 64, 9.0, 4.2
    array = AntennaArray(np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]]), 3e9)
    series = slow_time_channels(body, [], array, np.eye(3), np.array([0.0, distance, 0.0]), np.arange(count) * interval,
                                np.full(8, CHI), velocity_m_s=(0.0, -speed, 0.0))  # fmt: skip
    picture = range_doppler(np.asarray(series)[:, :, 0, 0], interval, tones)
    row, column = np.unravel_index(np.argmax(np.abs(picture.values)), picture.values.shape)
    assert abs(picture.doppler_hz[row] - doppler_shift(speed, 3e9)) < 1.0 / (count * interval)
    middle = distance - speed * interval * count / 2.0
    assert abs(picture.across[column] - middle) < 0.25  # a range cell is 0.75 m


def test_a_spectrogram_follows_a_shift_that_changes():
    interval, times = 1e-3, np.arange(2000) * 1e-3
    series = np.exp(-2j * np.pi * (50.0 * times + 0.5 * 60.0 * times**2))  # 50 to 170 Hz, approaching
    picture = spectrogram(series, interval, window_s=0.1, hop_s=0.05)
    found = picture.doppler_hz[np.argmax(np.abs(picture.values), axis=0)]
    np.testing.assert_allclose(found, 50.0 + 60.0 * picture.across, atol=10.0)


@pytest.mark.usefixtures("unchecked")
@pytest.mark.parametrize(
    "change, message",
    [
        ({"times_s": np.zeros((2, 2))}, r"times_s: got shape \(2, 2\)"),
        ({"times_s": np.array([np.nan])}, "times_s: holds NaN"),
        ({"velocity_m_s": np.zeros(2)}, r"velocity_m_s: got shape \(2,\)"),
        ({"times_s": np.array([0.0, 20.0]), "velocity_m_s": (0.0, -3.0, 0.0)}, "translation: the body is .* m from an"),
        ({"contrast": np.ones(3)}, "contrast: "),
        ({"rotors": "other"}, "rotors: they were factored for other frequencies"),
    ],
)
def test_bad_motions_are_refused(hull, change, message):
    arguments = {"rotors": [], "times_s": np.zeros(2), "contrast": CHI} | change
    if arguments["rotors"] == "other":
        other = factor_body(cross(arm=1), 2.9e9, nearest_m=2.0, cache=False)
        arguments["rotors"] = [Spinning(other, (0.0, 0.0, 0.0), 1.0)]
    with pytest.raises(ValueError, match=message):
        slow_time_channels(hull, array=FAR, rotation=np.eye(3), translation=PLACE, **arguments)


@pytest.mark.parametrize("call, message", [
    (lambda: spectrogram(np.zeros(10), 1e-3, window_s=1.0, hop_s=0.1), "window_s: 1 s are 1000 pulses of 10"),
    (lambda: doppler_spectrum(np.zeros(2), 1e-3), r"series: got shape \(2,\)"),
    (lambda: doppler_spectrum(np.zeros(8), 0.0), "interval_s: got 0.0"),
    (lambda: range_doppler(np.zeros((8, 3)), 1e-3, [1e9, 1.1e9, 1.3e9]), "frequencies_hz: are not evenly spaced"),
    (lambda: range_doppler(np.zeros((8, 3)), 1e-3, [1e9, 1.1e9]), "frequencies_hz: got 2 for channels of shape"),
])  # fmt: skip
def test_bad_series_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
