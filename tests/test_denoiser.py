"""The noise estimator: ConcatSquash by hand, groups of clouds, and a start from which it can learn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from august_jax.models import denoiser as module
from august_jax.models.denoiser import Denoiser, step_features
from august_jax.models.diffusion import Schedule

SCHEDULE = Schedule(200, (1e-4, 0.05))
PAPER_WIDTHS = (16, 64, 128, 256, 512, 1024, 512, 256, 128, 64, 16)


def denoiser(widths=(8, 6), condition=3, embedding="paper"):
    """A denoiser away from its start, where its output is zero."""
    graphdef, state = nnx.split(Denoiser(widths, condition, SCHEDULE, embedding, rngs=nnx.Rngs(0)))
    generator = np.random.default_rng(0)
    state = jax.tree.map(lambda leaf: leaf + 0.1 * generator.normal(size=leaf.shape).astype("f"), state)
    return nnx.merge(graphdef, state)


def inputs(batch=4, points=7, condition=3):
    generator = np.random.default_rng(1)
    return (
        generator.normal(size=(batch, points, 5)).astype(np.float32),
        generator.integers(1, 201, batch),
        generator.normal(size=(batch, condition)).astype(np.float32),
    )


def sigmoid(x):
    return 1.0 / (1.0 + np.exp(-x))


def test_layers_by_hand():
    model = denoiser()
    points, steps, conditions = inputs()
    result = np.asarray(model(points, steps, conditions))
    for cloud, step, condition, row in zip(points, steps, conditions, result):
        part = step / 200
        context = np.concatenate([[part, np.sin(part), np.cos(part), np.sin(2 * part), np.cos(2 * part)], condition])
        for point, expected in zip(cloud, row):
            x = point
            for index, layer in enumerate(model.layers):
                w1, b1 = np.asarray(layer.linear.kernel[...]), np.asarray(layer.linear.bias[...])
                w2, b2 = np.asarray(layer.gate.kernel[...]), np.asarray(layer.gate.bias[...])
                w3 = np.asarray(layer.shift.kernel[...])
                x = x * sigmoid(x) if index else x
                x = (x @ w1 + b1) * 2 * sigmoid(context @ w2 + b2) + context @ w3
            np.testing.assert_allclose(x, expected, rtol=1e-4, atol=1e-5)


def test_groups_of_clouds_change_neither_values_nor_gradients(monkeypatch):
    model = denoiser(embedding="log_snr")
    points, steps, conditions = inputs(batch=7)
    graphdef, state = nnx.split(model)

    def loss(state, conditions):
        return jnp.sum(nnx.merge(graphdef, state)(points, steps, conditions) ** 2)

    def gradient(loss):  # a new function each time: jit would reuse what it compiled for another size of group
        return jax.jit(jax.value_and_grad(lambda *arguments: loss(*arguments), argnums=(0, 1)))

    answers = []
    for rows in (10_000, 14, 1):  # all at once; groups of two, the last one padded; one by one
        monkeypatch.setattr(module, "_CPU_ROWS", rows)
        answers.append(gradient(loss)(state, conditions))
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    answers.append(gradient(loss)(state, conditions))
    for answer in answers[1:]:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=1e-4), answer, answers[0])


def test_points_are_independent_given_the_condition():
    model = denoiser()
    points, steps, conditions = inputs()
    whole = np.asarray(model(points, steps, conditions))
    order = np.random.default_rng(0).permutation(7)
    np.testing.assert_allclose(model(points[:, order], steps, conditions), whole[:, order], atol=1e-5)
    np.testing.assert_allclose(model(points[:, :2], steps, conditions), whole[:, :2], atol=1e-5)


def test_one_step_for_all_clouds():
    model = denoiser()
    points, _, conditions = inputs()
    np.testing.assert_allclose(model(points, jnp.asarray(9), conditions), model(points, np.full(4, 9), conditions))


@pytest.mark.parametrize("embedding", ["paper", "log_snr"])
def test_the_paper_s_twelve_layers_start_at_zero_but_carry_the_signal(embedding):
    model = Denoiser(PAPER_WIDTHS, 8, SCHEDULE, embedding, rngs=nnx.Rngs(0))
    points, steps, conditions = inputs(batch=8, points=32, condition=8)
    graphdef, state = nnx.split(model)
    assert (np.asarray(jax.jit(lambda state: nnx.merge(graphdef, state)(points, steps, conditions))(state)) == 0).all()

    # With plain sigmoids the points' share of the last hidden layer is below 2^-11 of this.
    def last_hidden(points):
        context = jnp.concatenate([step_features(steps, SCHEDULE, embedding), conditions], -1)
        for index, layer in enumerate(model.layers[:-1]):
            gate, addend = layer.modulation(context)
            points = jax.nn.swish(points) if index else points
            points = points @ layer.linear.kernel[...] * gate[:, None] + addend[:, None]
        return points

    share = np.std(np.asarray(jax.jit(last_hidden)(points)), axis=1).mean()
    assert 0.01 < share < 10


def test_log_snr_features_tell_the_first_steps_apart():
    for kind, width in (("paper", 5), ("log_snr", 13)):
        features = np.asarray(step_features(np.arange(1, 201), SCHEDULE, kind))
        assert features.shape == (200, width) and np.abs(features).max() <= 1.0 + 1e-6
    apart = {
        kind: np.linalg.norm(np.diff(np.asarray(step_features(np.array([1, 2]), SCHEDULE, kind)), axis=0))
        for kind in ("paper", "log_snr")
    }
    # s = 1 and 2 differ threefold in noise variance
    assert apart["paper"] < 0.02 and apart["log_snr"] > 0.3
