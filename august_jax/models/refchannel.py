r"""RefChannel-Diff: the channel carried to a reference place conditions the diffusion (paper, Section VI-A).

An MLP maps [Re and Im of the channel; xi(q_pre)] to the channel that the same target would have, at the same offset
from its prediction, if the prediction were the centre of the flight box: q_ref + (q - q_pre). A linear map of the
result is the condition. Channels enter and leave divided by their Frobenius norms, as the upper triangle of H
(encoder ``paper``) or of its subspace coefficients (encoder ``roi``); their symmetry makes the rest redundant.
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
from august_jax.models.encoder import ChannelInput, Seen
from august_jax.models.layers import ResidualMLP, dense
from august_jax.signal.roi import Coefficients


def reference_centre(config: Config) -> np.ndarray:
    """q_ref (3,) [m]: the centre of the flight box."""
    return np.mean(np.asarray(config.flight.box_m), axis=1)


class RefChannel(nnx.Module):
    """(H_est, q_pre) -> the estimated reference channel, and its linear map to the condition."""

    def __init__(self, config: Config, *, rngs: nnx.Rngs):
        model = config.model
        self.config = config
        self.channel_input = ChannelInput(config)
        size = self.channel_input.antennas if model.encoder == "paper" else self.channel_input.orders
        self.size = len(config.array.frequencies_hz) * size * (size + 1)
        self.trunk = ResidualMLP(self.size + 3 * (2 * model.fourier + 1), model.encoder_features,
                                 model.encoder_layers, rngs=rngs)
        self.head = dense(model.encoder_features, self.size, rngs=rngs)
        self.channel_map = dense(self.size, model.channel_features, rngs=rngs)

    def vector(self, heard: Array | Coefficients, centre: Float[Array, "batch 3"]) -> Float[Array, "batch features"]:
        """Re and Im of the triangles (B, size) of channels, or of their coefficients, of norm one, about ``centre``
        (B, 3) [m]."""
        if self.config.model.encoder == "roi":
            heard = self.channel_input.coefficients(heard, centre).values
        rows, columns = np.triu_indices(heard.shape[-1])
        flat = heard[..., rows, columns].reshape(heard.shape[0], -1)
        flat = flat / jnp.maximum(jnp.linalg.norm(flat, axis=-1, keepdims=True), 1e-30)
        return jnp.concatenate([flat.real, flat.imag], axis=-1)

    def see(self, heard: Array | Coefficients, predicted: Float[Array, "batch 3"], snr_db: Float[Array, " batch"]) -> Seen:
        """What is seen of channels under predictions (B, 3) [m]: :meth:`vector` about q_pre itself."""
        return Seen(self.vector(heard, predicted), snr_db, predicted, jnp.zeros_like(predicted))

    def __call__(self, seen: Seen) -> Float[Array, "batch features"]:
        """The estimated reference channel (B, size), as :meth:`vector` writes it, from what :meth:`see` saw."""
        model = self.config.model
        place = position_features(seen.centre, model.fourier, self.config.flight, raw_metres=model.raw_metres)
        return self.head(self.trunk(jnp.concatenate([seen.features, place], axis=-1)))

    def loss(self, estimate: Float[Array, "batch features"], reference: Array | Coefficients) -> Float[Array, ""]:
        """Mean squared error () of ``estimate`` (B, size) against reference channels (B, F, N, N), relative to them."""
        centre = jnp.broadcast_to(jnp.asarray(reference_centre(self.config), jnp.float32), estimate.shape[:1] + (3,))
        return jnp.mean(jnp.sum((estimate - self.vector(reference, centre)) ** 2, axis=-1))
