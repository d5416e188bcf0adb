"""AUGUST's loss and reconstruction, for every scheme, on tiny networks."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from flax import nnx
from jax.flatten_util import ravel_pytree

from august_jax.config import preset
from august_jax.models import Seen, create, parameter_count, reconstruct
from august_jax.models.refchannel import RefChannel

SMOKE = preset("smoke")
BATCH, POINTS = 4, 12


def config(scheme="august", encoder="roi", frame="craft", **train):
    model = replace(
        SMOKE.model,
        scheme=scheme,
        encoder=encoder,
        frame=frame,
        channel_features=12,
        encoder_features=16,
        latent=6,
        fourier=2,
        denoiser=(8, 8),
        steps=10,
    )
    return replace(
        SMOKE, array=replace(SMOKE.array, nx=5, nz=4), model=model, train=replace(SMOKE.train, points=8, **train)
    )


def batch(size=20):
    """What :meth:`August.loss` takes beside a key; the first three are what is heard."""
    generator = np.random.default_rng(0)
    channel = generator.normal(size=(2, BATCH, 1, size, size, 2)).astype(np.float32) @ np.array([1e-6, 1e-6j], "F")
    channel = channel + np.swapaxes(channel, -1, -2)
    return {
        "heard": channel[0],
        "predicted": generator.uniform([3, 4, 2], [7, 8, 5], (BATCH, 3)).astype(np.float32),
        "snr_db": generator.uniform(0, 30, BATCH).astype(np.float32),
        "cloud": generator.uniform(-1, 1, (BATCH, POINTS, 5)).astype(np.float32),
        "reference": channel[1],
    }


HEARD = tuple(batch().values())[:3]
SEEN = Seen(np.zeros((BATCH, 7), "f"), HEARD[2], HEARD[1], np.zeros((BATCH, 3), "f"))


def networks(settings):
    """Networks away from their start, where last layers are zero."""
    graphdef, state = create(settings, 0)
    generator = np.random.default_rng(1)
    return graphdef, jax.tree.map(lambda leaf: leaf + 0.1 * generator.normal(size=leaf.shape).astype("f"), state)


SCHEMES = [
    ("august", "roi", "craft"),
    ("noebd", "paper", "craft"),
    ("nolatent", "roi", "region"),
    ("refchannel", "paper", "craft"),
]


@pytest.mark.parametrize("scheme, encoder, frame", SCHEMES)
def test_the_loss_is_the_weighted_sum_and_reaches_every_parameter(scheme, encoder, frame):
    graphdef, state = networks(config(scheme, encoder, frame, weight_latent=0.01, weight_readout=0.5))

    @jax.jit
    def step(state):
        key = jax.random.key(0, impl="rbg")  # it compiles faster
        return jax.value_and_grad(lambda s: nnx.merge(graphdef, s).loss(key, **batch()), has_aux=True)(state)

    (loss, terms), gradient = step(state)
    extra = {"august": {"latent"}, "noebd": {"latent"}, "refchannel": {"reference"}}.get(scheme, set())
    assert set(terms) == {"position", "material", "readout"} | ({"signature"} if frame == "craft" else set()) | extra
    expected = 0.9 * (terms["position"] + terms.get("signature", 0.0)) + 0.1 * terms["material"]
    expected += 0.01 * terms.get("latent", 0.0) + terms.get("reference", 0.0) + 0.5 * terms["readout"]
    np.testing.assert_allclose(loss, expected, rtol=1e-5)
    silent = [
        jax.tree_util.keystr(path)
        for path, leaf in jax.tree_util.tree_leaves_with_path(gradient)
        if not np.abs(leaf).max() > 0
    ]
    assert not silent


def test_a_readout_of_weight_0_is_not_there():
    """No parameters, no term, no computation."""
    key = jax.random.key(0, impl="rbg")
    (bare, state), (_, more) = (create(config(frame="region", weight_readout=weight), 0) for weight in (0.0, 0.5))
    assert set(more) - set(state) == {"readout_head"}
    model = nnx.merge(bare, state)
    _, terms = jax.jit(lambda: model.loss(key, **batch()))()
    assert set(terms) == {"latent", "position", "material"}
    with pytest.raises(ValueError, match="train.weight_readout: 0 leaves the readout out"):
        model.readout(np.zeros((BATCH, 6), "f"), SEEN)


def test_an_untrained_denoiser_scores_the_noise_itself():
    """The first estimate is 0, so that the terms are E |eps|^2 = 3 and 2."""
    settings = config()
    graphdef, state = create(settings, 0)
    data = batch()
    big = {name: np.repeat(array, 200, axis=0) for name, array in data.items()}
    key = jax.random.key(0, impl="rbg")
    _, terms = jax.jit(lambda state: nnx.merge(graphdef, state).loss(key, **big))(state)
    # five standard errors: variance 6 and 4 of a chi-squared over 800 * 8 points
    np.testing.assert_allclose(terms["position"], 3.0, atol=0.16)
    np.testing.assert_allclose(terms["material"], 2.0, atol=0.13)


def test_the_latent_term_is_the_relative_entropy():
    """Before training the prior is a standard normal, for which the relative entropy has a closed form."""
    settings = config()
    graphdef, state = create(settings, 0)
    model = nnx.merge(graphdef, state)
    mean, log_variance = jax.jit(lambda: model.posterior(model.see(*HEARD)))()
    exact = 0.5 * np.sum(np.exp(log_variance) + np.square(mean) - 1.0 - log_variance, axis=-1).mean()
    terms = jax.jit(jax.vmap(lambda key: model.loss(key, **batch())[1]["latent"]))(
        jax.random.split(jax.random.key(0, impl="rbg"), 400)
    )
    np.testing.assert_allclose(np.mean(terms), exact, atol=5 * np.std(terms) / np.sqrt(400))


def test_the_condition_is_the_posterior_s_mean_or_a_sample_of_it():
    graphdef, state = networks(config())
    model = nnx.merge(graphdef, state)
    keys = jax.random.split(jax.random.key(0), 2000)

    @jax.jit
    def answers():
        seen = model.see(*HEARD)
        condition = model.condition(seen)
        samples = jax.vmap(lambda key: model.condition(seen, key))(keys)
        return seen, model.posterior(seen), condition, samples, model.readout(condition, seen)

    seen, (mean, log_variance), condition, samples, read = answers()
    np.testing.assert_array_equal(condition, mean)
    np.testing.assert_allclose(samples.std(0), np.exp(0.5 * log_variance), rtol=0.1)
    np.testing.assert_allclose(samples.mean(0), mean, atol=5 * np.exp(0.5 * log_variance).max() / np.sqrt(2000))
    expected = np.array(mean @ model.readout_head.kernel[...] + model.readout_head.bias[...])
    # the offset's components along the bearing of the region's centre, across it, and up
    offset = (seen.centre - HEARD[1]) / SMOKE.region.scale_m
    bearing = np.asarray(seen.centre[:, :2]) / np.linalg.norm(seen.centre[:, :2], axis=-1, keepdims=True)
    expected[:, 0] += np.sum(offset[:, :2] * bearing, axis=-1)
    expected[:, 1] += offset[:, 1] * bearing[:, 0] - offset[:, 0] * bearing[:, 1]
    expected[:, 2] += offset[:, 2]
    np.testing.assert_allclose(read.vector(), expected, rtol=1e-3, atol=1e-4)


def test_reconstruction_is_a_function_of_its_key():
    graphdef, state = networks(config())

    def clouds(seed, **options):
        return np.asarray(reconstruct(graphdef, state, jax.random.key(seed), *HEARD, count=9, **options))

    one = clouds(0, steps=4)
    assert one.shape == (BATCH, 9, 5) and np.isfinite(one).all()
    np.testing.assert_array_equal(one, clouds(0, steps=4))
    assert np.abs(one - clouds(1, steps=4)).max() > 0.1


@pytest.mark.parametrize(
    "options, message",
    [
        ({"sampler": "euler"}, "sampler: unknown sampler 'euler'; choose dpm or ancestral"),
        ({"steps": 11}, "sampler_steps: 11 .*2..10"),
        ({"instants": (3,)}, r"instants: \(3,\) are steps of the sampler ancestral, not of 'dpm'"),
        ({"sampler": "ancestral", "instants": (11,)}, r"instants: \(11,\) .*0..10"),
    ],
)
def test_a_sampler_that_does_not_fit_is_refused(options, message, unchecked):
    graphdef, state = create(config(), 0)
    with pytest.raises(ValueError, match=message):
        reconstruct(graphdef, state, jax.random.key(0), *HEARD, count=9, **options)


@pytest.mark.parametrize("frame", ["craft", "region"])
def test_the_path_of_a_reconstruction_ends_in_the_reconstruction(frame):
    graphdef, state = networks(config(frame=frame))

    def clouds(instants):
        return np.asarray(
            reconstruct(graphdef, state, jax.random.key(0), *HEARD, count=7, sampler="ancestral", instants=instants)
        )

    path = clouds((0, 4, 10))
    assert path.shape == (3, BATCH, 7, 5)
    assert np.isfinite(path).all() and np.abs(np.diff(path, axis=0)).max() > 0.1
    np.testing.assert_array_equal(path[-1], clouds(()))


def test_the_reference_channel_is_centred_on_the_box():
    """At the reference place itself the target's own channel is the reference: the loss compares like with like."""
    settings = config("refchannel")
    model, data = RefChannel(settings, rngs=nnx.Rngs(0)), batch()
    centre = np.broadcast_to(settings.flight.centre_m, (BATCH, 3)).astype(np.float32)
    np.testing.assert_allclose(centre[0], [5.0, 6.0, 3.5])
    vector = model.vector(data["heard"], centre)
    np.testing.assert_allclose(np.linalg.norm(vector, axis=-1), 1.0, rtol=1e-5)
    assert model.loss(vector, data["heard"]) < 1e-10
    np.testing.assert_allclose(model.loss(-vector, data["heard"]), 4.0, rtol=1e-5)


@pytest.mark.parametrize(
    "scheme, change, message",
    [
        ("refchannel", {"reference": None}, "reference: got None; the scheme 'refchannel' learns from"),
        ("august", {"cloud": np.zeros((BATCH, 9, 3), "f")}, r"cloud: got shape \(4, 9, 3\)"),
        ("august", {"predicted": np.zeros((1, 3), "f")}, r"predicted: .*must be \(4, 3\)"),
        ("august", {"snr_db": np.zeros(3, "f")}, r"snr_db: .*must be \(4,\)"),
    ],
)
def test_a_wrong_batch_is_named(scheme, change, message):
    model = nnx.merge(*create(config(scheme), 0))
    with pytest.raises(ValueError, match=message):
        model.loss(jax.random.key(0), **(batch() | change))


def test_a_scheme_without_a_latent_has_no_posterior():
    model = nnx.merge(*create(config("nolatent"), 0))
    with pytest.raises(ValueError, match="'nolatent' has no posterior; choose august or noebd"):
        model.posterior(SEEN)


def test_the_paper_s_networks_have_the_paper_s_sizes():
    _, state = create(preset("paper"), 0)
    widths = [5, 16, 64, 128, 256, 512, 1024, 512, 256, 128, 64, 16, 5]
    layers = state["denoiser"]["layers"]
    assert [layers[index]["linear"]["kernel"].shape for index in range(12)] == list(zip(widths, widths[1:]))
    assert layers[0]["gate"]["kernel"].shape == (5 + 256, 16)
    assert len(state["prior"]["conditioners"]) == 14 and len(state["encoder"]["trunk"]["blocks"]) == 6
    # Real and imaginary parts of the channel, and the level that their normalisation takes out.
    assert state["encoder"]["channel_map"]["kernel"].shape == (2 * 64 * 64 + 1, 256)
    assert state["encoder"]["position_head"]["layers"][0]["kernel"].shape[0] == 3 * 21
    assert parameter_count(state) == ravel_pytree(state)[0].size


def test_create_is_a_function_of_its_seed():
    one, same, other = (ravel_pytree(create(config(), seed)[1])[0] for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    assert np.abs(one - other).max() > 0.1
