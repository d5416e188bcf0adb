r"""RefChannel-Diff: the channel carried to a reference place conditions the diffusion (paper, Section VI-A).

An MLP maps [Re and Im of the channel; xi(q_pre)] to the channel that the same target would have, at the same offset
from its prediction, if the prediction were the centre of the flight box: q_ref + (q - q_pre). A linear map of the
result is the condition. Channels enter and leave divided by their Frobenius norms, as the upper triangle of H
(encoder ``paper``) or of its subspace coefficients (encoder ``roi``); their symmetry makes the rest redundant.

A channel's absolute phase repeats every half wavelength of range. Lines of sight to the two places differ, and so do
the phases there, by several turns from one offset to another, which no estimate of the offset can follow: of H as it is
nothing but its mean can be learned, zero. So ``roi`` takes the phase out, of what enters and of what is learned, after
which most of the reference channel can be told; ``paper`` keeps it, as it is printed.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float

from august_jax.arrays import Array
from august_jax.config import Config
from august_jax.models.embedding import position_features
from august_jax.models.encoder import ChannelInput, Heard, Seen
from august_jax.models.layers import ResidualMLP, dense


class RefChannel(nnx.Module):
    """(H_est, q_pre) -> the estimated reference channel, and its linear map to the condition."""

    def __init__(self, config: Config, *, rngs: nnx.Rngs):
        model = config.model
        self.config = config
        self.channel_input = ChannelInput(config)
        size = self.channel_input.antennas if model.encoder == "paper" else self.channel_input.orders
        self.size = len(config.array.frequencies_hz) * size * (size + 1)
        self.trunk = ResidualMLP(
            self.size + 3 * (2 * model.fourier + 1), model.encoder_features, model.encoder_layers, rngs=rngs
        )
        self.head = dense(model.encoder_features, self.size, rngs=rngs)
        self.channel_map = dense(self.size, model.channel_features, rngs=rngs)

    def see(self, heard: Heard, predicted: Float[Array, "batch 3"], snr_db: Float[Array, " batch"]) -> Seen:
        """What is seen under predictions (B, 3) [m]: :meth:`vector`, and q_pre itself as the centre."""
        return Seen(self.vector(heard, predicted), snr_db, predicted, jnp.zeros_like(predicted))

    def vector(self, heard: Heard, centre: Float[Array, "batch 3"]) -> Float[jax.Array, "batch features"]:
        """Re and Im of the triangles (B, size) of channels (B, F, N, N), or of their coefficients about ``centre``
        (B, 3) [m] with the phase taken out, of norm one.

        Raises:
            ValueError: of another array, or coefficients for the encoder ``paper``.
        """
        if self.config.model.encoder == "roi":
            matrices: Array = self._turned(self.channel_input.coefficients(heard, centre).values, centre)
        else:
            matrices = self.channel_input.channel(heard)
        rows, columns = np.triu_indices(matrices.shape[-1])
        flat = matrices[..., rows, columns].reshape(matrices.shape[0], -1)
        flat = flat / jnp.maximum(jnp.linalg.norm(flat, axis=-1, keepdims=True), 1e-30)
        return jnp.concatenate([flat.real, flat.imag], axis=-1)

    def _turned(self, values: Array, centre: Array) -> jax.Array:
        """Coefficients (B, F, K, K), the first tone's A_00 real: what is left of a tone f is its phase beyond the first
        one's and beyond 2 (k_f - k_0)|centre|, which tells by how much the range exceeds that of the centre."""
        k = jnp.asarray(self.channel_input.subspace.wavenumbers)
        angle = -2.0 * (k - k[0]) * jnp.linalg.norm(centre, axis=-1, keepdims=True)
        values = jnp.asarray(values) * jax.lax.complex(jnp.cos(angle), jnp.sin(angle))[..., None, None]
        lead = values[:, :1, :1, :1]
        return values * (lead.conj() / jnp.maximum(jnp.abs(lead), 1e-30))

    def __call__(self, seen: Seen) -> Float[jax.Array, "batch features"]:
        """The estimated reference channel (B, size), as :meth:`vector` writes it, from what :meth:`see` saw."""
        model = self.config.model
        place = position_features(seen.centre, model.fourier, self.config.flight, raw_metres=model.raw_metres)
        return self.head(self.trunk(jnp.concatenate([seen.features, place], axis=-1)))

    def loss(self, estimate: Float[Array, "batch features"], reference: Heard) -> Float[jax.Array, ""]:
        """Mean squared error () of ``estimate`` (B, size) against reference channels, relative to them."""
        centre = jnp.broadcast_to(jnp.asarray(self.config.flight.centre_m, jnp.float32), (len(estimate), 3))
        return jnp.mean(jnp.sum((estimate - self.vector(reference, centre)) ** 2, axis=-1))
