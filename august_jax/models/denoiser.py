r"""The noise estimator: ConcatSquash layers shared by every point of a cloud (paper, eq. concatsquash).

    eta' = (W1 eta + b1) * gate + W3 c,   gate = 2 sigmoid(W2 c + b2),   Swish between layers,

with the context c = [features of the step s; condition]. The paper's gate is a plain sigmoid: at the start it is
1/2, and twelve layers of it leave 2^-12 of the signal, on top of the default initialisation's own loss; such a
network does not start to learn. Doubling the gate (so that it starts at 1), He initialisation and a zero last layer
(so that the first estimate is 0) cure that, and are used with either embedding of the step:

- ``paper``: s/S and the sine and cosine of it and of its double;
- ``log_snr``: Fourier features of the log-SNR of step s, scaled to [-1, 1] over the schedule. The noise level falls
  by decades within the first few of S steps, which s/S cannot tell apart.

The gate acts on a layer's output, so that all points of all clouds share one matrix product.
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from flax import nnx
from jaxtyping import Float, Int

from august_jax.arrays import Array
from august_jax.config import TimeEmbedding
from august_jax.models.diffusion import Schedule
from august_jax.models.embedding import fourier_features
from august_jax.models.layers import PRECISION, dense

_OCTAVES = 6
_CPU_ROWS = 2048


def step_features(
    step: Int[Array, "*batch"], schedule: Schedule, kind: TimeEmbedding
) -> Float[jax.Array, "*batch features"]:
    """Features (..., T) of the diffusion step s (...,) in 1..S; ``kind`` as in the module's top."""
    if kind == "paper":
        part = step[..., None] / schedule.steps
        return jnp.concatenate([part, jnp.sin(part), jnp.cos(part), jnp.sin(2 * part), jnp.cos(2 * part)], axis=-1)
    lambdas = schedule.half_log_snr
    scaled = 2.0 * (lambdas - lambdas[-1]) / max(lambdas[0] - lambdas[-1], 1e-9) - 1.0
    return fourier_features(jnp.asarray(scaled, jnp.float32)[step - 1][..., None], _OCTAVES)


class ConcatSquash(nnx.Module):
    """One gated layer from ``features_in`` to ``features_out`` under a context of ``context`` numbers."""

    def __init__(self, features_in: int, features_out: int, context: int, *, zero: bool, rngs: nnx.Rngs):
        self.linear = dense(features_in, features_out, gain=0.0 if zero else 2.0, rngs=rngs)
        self.gate = dense(context, features_out, rngs=rngs)
        self.shift = dense(context, features_out, gain=0.0 if zero else 1.0, bias=False, rngs=rngs)

    def modulation(
        self, context: Float[Array, "batch context"]
    ) -> tuple[Float[jax.Array, "batch out"], Float[Array, "batch out"]]:
        """What a cloud's context (B, C) does to the layer: the gate and the addend, each (B, out)."""
        gate = 2.0 * jax.nn.sigmoid(self.gate(context))
        return gate, gate * self.linear.bias[...] + self.shift(context)


class Denoiser(nnx.Module):
    """eps_theta(p, s, condition) for points of ``dimensions`` coordinates and a condition of ``condition`` numbers."""

    def __init__(
        self,
        widths: tuple[int, ...],
        condition: int,
        schedule: Schedule,
        time_embedding: TimeEmbedding,
        *,
        rngs: nnx.Rngs,
        dimensions: int = 5,
    ):
        self.schedule = schedule
        self.time_embedding = time_embedding
        times = 5 if time_embedding == "paper" else 2 * _OCTAVES + 1
        sizes = [dimensions, *widths, dimensions]
        self.layers = nnx.List(
            ConcatSquash(a, b, times + condition, zero=index == len(widths), rngs=rngs)
            for index, (a, b) in enumerate(zip(sizes, sizes[1:]))
        )

    def __call__(
        self,
        points: Float[Array, "batch points dimensions"],
        step: Int[Array, " batch"] | Int[Array, ""],
        condition: Float[Array, "batch condition"],
    ) -> Float[jax.Array, "batch points dimensions"]:
        """Estimated noise (B, P, D) of points (B, P, D) at the step s (B,) or () under the condition (B, C)."""
        step = jnp.broadcast_to(step, points.shape[:1])
        context = jnp.concatenate([step_features(step, self.schedule, self.time_embedding), condition], axis=-1)
        modulations = [layer.modulation(context) for layer in self.layers]
        kernels = [layer.linear.kernel[...] for layer in self.layers]

        def through(points, modulations):
            for index, (kernel, (gate, addend)) in enumerate(zip(kernels, modulations)):
                points = jax.nn.swish(points) if index else points
                points = jnp.matmul(points, kernel, precision=PRECISION) * gate[:, None] + addend[:, None]
            return points

        if jax.default_backend() != "cpu":
            return through(points, modulations)
        # On a CPU the cost is the traffic of activations, not arithmetic: groups of clouds that stay in the cache,
        # recomputed in the backward pass, train 1.5x faster than the whole batch at once.
        batch, count = points.shape[:2]
        group = min(batch, max(1, _CPU_ROWS // count))
        groups = math.ceil(batch / group)
        split = jax.tree.map(
            lambda array: jnp.pad(array, ((0, groups * group - batch), *[(0, 0)] * (array.ndim - 1))).reshape(
                groups, group, *array.shape[1:]
            ),
            (points, modulations),
        )
        _, noise = jax.lax.scan(lambda _, part: (None, jax.checkpoint(through)(*part)), None, split)
        return noise.reshape(groups * group, *points.shape[1:])[:batch]
