"""What the networks see of a channel: Fourier features, and the region's subspace checked on point targets."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from flax import nnx

from august_jax.config import preset
from august_jax.models.embedding import fourier_features, position_features, snr_features
from august_jax.models.encoder import ChannelInput, Encoder, paper_features, roi_features
from august_jax.physics.array import PlanarArray
from august_jax.signal.roi import Coefficients

SMOKE = preset("smoke")
CONFIG = replace(SMOKE, array=replace(SMOKE.array, nx=8, nz=3), model=replace(SMOKE.model, fourier=3))
ARRAY = PlanarArray(8, 3, CONFIG.array.frequency_hz)
PREDICTED = np.array([[5.0, 6.0, 3.0], [4.0, 5.0, 4.0]], np.float32)
SNR_DB = np.full(2, 15.0, np.float32)


def point_channel(point, frequency_hz=3e9, amplitude=1e-5):
    """H_mn = e^{jk(r_m + r_n)} / (r_m r_n), one point seen two ways."""
    distance = np.linalg.norm(point - ARRAY.positions, axis=-1)
    wave = np.exp(2j * np.pi * frequency_hz / 299_792_458.0 * distance) / distance
    return (amplitude * wave[:, None] * wave[None, :]).astype(np.complex64)


def channels(offset, config=CONFIG):
    return np.stack([np.stack([point_channel(q + offset, f) for f in config.array.frequencies_hz]) for q in PREDICTED])


def see(heard, config=CONFIG):
    return jax.jit(ChannelInput(config))(heard, PREDICTED, SNR_DB)


def coefficients_of(channel):
    return jax.jit(ChannelInput(CONFIG).coefficients)(channel, PREDICTED)


def test_fourier_features_by_hand():
    x, y = 0.3, -0.8
    result = np.asarray(fourier_features(np.array([x, y], np.float32), 2))
    expected = [x, y]
    for value in (x, y):
        expected += [np.sin(np.pi * value), np.sin(2 * np.pi * value), np.cos(np.pi * value), np.cos(2 * np.pi * value)]
    np.testing.assert_allclose(result, expected, atol=1e-6)


def test_the_box_spans_minus_one_to_one():
    low, high = np.array(CONFIG.flight.box_m, np.float32).T
    for corner, value in ((low, -1.0), (high, 1.0), ((low + high) / 2, 0.0)):
        np.testing.assert_allclose(position_features(corner, 4, CONFIG.flight, raw_metres=False)[:3], value, atol=1e-6)
    np.testing.assert_allclose(position_features(low, 4, CONFIG.flight, raw_metres=True)[:3], low)
    np.testing.assert_allclose(snr_features(np.array([15.0, 35.0], np.float32), 2)[:, 0], [0.0, 1.0])
    assert snr_features(np.zeros(2, np.float32), 10).shape == (2, 21)


def test_paper_features_are_the_normalised_channel_and_its_level():
    channel = 1e-6 * channels(np.zeros(3))
    features = np.asarray(paper_features(channel, PREDICTED))
    size = channel[0].size
    np.testing.assert_allclose(np.linalg.norm(features[:, :-1], axis=1), 1.0, rtol=1e-5)
    flat = np.asarray(channel).reshape(-1, size)
    back = features[:, :size] + 1j * features[:, size:-1]
    np.testing.assert_allclose(back, flat / np.linalg.norm(flat, axis=1, keepdims=True), atol=1e-6)
    louder = np.asarray(paper_features(10.0 * channel, PREDICTED))
    np.testing.assert_allclose(louder[:, :-1], features[:, :-1], atol=1e-6)
    np.testing.assert_allclose(louder[:, -1] - features[:, -1], 4.0, atol=1e-4)


def test_a_target_at_the_prediction_is_nearly_its_leading_coefficient():
    """The spherical phases of q_pre leave the constant over the aperture, but for the spreading of 1/r."""
    coefficients = np.asarray(coefficients_of(channels(np.zeros(3))).values)
    share = np.abs(coefficients[:, 0, 0, 0]) / np.linalg.norm(coefficients, axis=(2, 3))[:, 0]
    assert (share > 0.999).all()
    away = np.asarray(coefficients_of(channels(np.array([0.4, 0, 0]))).values)
    assert (np.abs(away[:, 0, 0, 0]) / np.linalg.norm(away, axis=(2, 3))[:, 0] < 0.99).all()


def test_coefficients_and_channels_give_the_same_features():
    channel = channels(np.array([0.2, -0.3, 0.1]))
    coefficients = coefficients_of(channel)
    assert coefficients.values.shape[-1] == ChannelInput(CONFIG).orders < ChannelInput(CONFIG).antennas
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), see(channel), see(coefficients))


def test_the_centre_is_the_bearing_of_the_echo_at_the_range_of_the_prediction():
    offset = np.array([0.2, -0.3, 0.1])
    seen = see(channels(offset))
    np.testing.assert_allclose(np.linalg.norm(seen.centre, axis=-1), np.linalg.norm(PREDICTED, axis=-1), rtol=1e-5)
    bearings = (seen.centre, PREDICTED + offset)
    np.testing.assert_allclose(*(each / np.linalg.norm(each, axis=-1, keepdims=True) for each in bearings), atol=2e-3)
    np.testing.assert_allclose(seen.offset, (seen.centre - PREDICTED) / CONFIG.region.scale_m, atol=1e-6)
    np.testing.assert_array_equal(seen.features[:, :3], seen.offset)
    seen = see(channels(offset), replace(CONFIG, model=replace(CONFIG.model, encoder="paper")))
    np.testing.assert_array_equal(seen.centre, PREDICTED)
    np.testing.assert_array_equal(seen.offset, 0.0)


def test_an_unknown_gain_moves_only_phase_and_level():
    channel = channels(np.array([0.2, -0.3, 0.1]))
    plain, turned = (
        np.asarray(see(each).features) for each in (channel, (10 * np.exp(0.7j) * channel).astype(np.complex64))
    )
    np.testing.assert_allclose(turned[:, :-3], plain[:, :-3], atol=2e-3)  # asinh(100 x) of a float32 x
    before, after = plain[:, -3] + 1j * plain[:, -2], turned[:, -3] + 1j * turned[:, -2]
    np.testing.assert_allclose(after / before, np.exp(0.7j), atol=1e-3)
    np.testing.assert_allclose(turned[:, -1] - plain[:, -1], 4.0, atol=1e-4)


def test_tones_tell_the_range_beyond_the_prediction():
    """Between two tones a point target turns by 2 (k' - k)(|q| - |q_pre|)."""
    config = replace(CONFIG, array=replace(CONFIG.array, tones_hz=(2.97e9, 3.03e9)))
    offset = np.array([0.2, 0.3, 0.1])
    features = np.asarray(see(channels(offset, config), config).features)
    phase = features[:, -5] + 1j * features[:, -3]  # cosines of two tones, sines of two tones, two levels
    beyond = np.linalg.norm(PREDICTED + offset, axis=-1) - np.linalg.norm(PREDICTED, axis=-1)
    expected = np.exp(2j * 2 * np.pi * 60e6 / 299_792_458.0 * beyond)
    # the aperture's mean phase differs from its centre's by up to k a^2/(6 r^2) of the offset
    np.testing.assert_allclose(phase, expected, atol=0.02)


def test_a_silent_channel_gives_finite_features():
    assert np.isfinite(roi_features(np.zeros((2, 1, 3, 3), np.complex64), PREDICTED, np.ones(1, "f"))).all()
    assert np.isfinite(paper_features(np.zeros((2, 1, 3, 3), np.complex64), PREDICTED)).all()


@pytest.mark.parametrize(
    "encoder, heard, message",
    [
        ("paper", np.zeros((2, 1, 5, 5), np.complex64), r"got channel of shape \(2, 1, 5, 5\).*\(batch, 1, 24, 24\)$"),
        ("roi", np.zeros((2, 1, 5, 5), np.complex64), r"got channel of shape \(2, 1, 5, 5\).*\(batch, 1, 24, 24\)$"),
        ("roi", np.zeros((2, 1, 15, 15), np.complex64), r"got channel of shape \(2, 1, 15, 15\)"),
        (
            "roi",
            Coefficients(np.zeros((2, 1, 9, 9), np.complex64), PREDICTED),
            r"got coefficients of shape \(2, 1, 9, 9\).*\(batch, 1, 15, 15\)$",
        ),
        (
            "paper",
            Coefficients(np.zeros((2, 1, 15, 15), np.complex64), PREDICTED),
            "got coefficients; the encoder 'paper'",
        ),
    ],
)
def test_what_is_heard_by_another_array_is_refused(encoder, heard, message):
    config = replace(CONFIG, model=replace(CONFIG.model, encoder=encoder))
    with pytest.raises(ValueError, match="heard: " + message):
        ChannelInput(config)(heard, PREDICTED, SNR_DB)


@pytest.mark.parametrize("embedding", [True, False])
def test_the_encoder_hears_snr_only_through_its_embedding(embedding):
    encoder = Encoder(CONFIG, embedding=embedding, rngs=nnx.Rngs(0))
    answer = jax.jit(lambda snr_db: encoder(ChannelInput(CONFIG)(channels(np.full(3, 0.1)), PREDICTED, snr_db)))
    low, high = np.asarray(answer(np.zeros(2, "f"))), np.asarray(answer(np.full(2, 20.0, "f")))
    assert low.shape == (2, CONFIG.model.encoder_features)
    assert (np.abs(low - high).max() > 0.01) == embedding
    assert 0.1 < low.std() < 10
