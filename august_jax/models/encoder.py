r"""The conditional channel encoder: from the estimated channel to a feature vector f (paper, Section IV-B).

    h_vec = W_p v + b_p,   h_emb = [(1 + w1(xi(q_pre))) * h_vec ; w2(xi(P_snr))],   f = F_enc(h_emb),

F_enc a residual MLP of Linear-LeakyReLU pairs, w1 and w2 MLPs of two layers. (The paper has no 1 +; with it, the
product starts near h_vec itself and not near zero.) What enters as v is the choice ``encoder``:

- ``paper``: the real and imaginary parts of vec(H_est), divided by its Frobenius norm over all tones (the paper
  does not scale; the entries are near 1e-6, of which a network initialised as usual sees nothing), and the norm as a
  level beside them.
- ``roi``: features of A = U^H H conj(U), the channel in the field subspace of the region (`signal.roi`): the spherical
  phases of q_pre are taken out and Legendre polynomials over the aperture are left. The entries vary slowly with the
  target's offset from q_pre, where those of H turn through hundreds of radians. The centre is first moved from q_pre
  to the bearing of the echo (`signal.roi.towards`), which leaves range, attitude and shape to be told by what then
  remains beside A_00; the position features are those of the new centre. See :func:`roi_features`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Complex, Float

from august_jax.arrays import Array
from august_jax.config import Config
from august_jax.models.embedding import position_features, snr_features
from august_jax.models.layers import MLP, ResidualMLP, dense
from august_jax.signal import roi
from august_jax.signal.roi import Coefficients, Subspace

Heard = Complex[Array, "batch tones antennas antennas"] | Coefficients
"""What a base station made of an echo: the estimated channel, or its coefficients about q_pre."""

_GAINS = (1.0, 10.0, 100.0)


def level(norm: Float[Array, "batch tones"], distance: Float[Array, "batch 1"]) -> Float[jax.Array, "batch tones"]:
    """log10(||H|| r^2 / [m^2]), centred and scaled by rough constants: what is left of an echo's strength when two-way
    spreading over the distance r [m] is taken out tells the target's size and material."""
    return 4.0 * (jnp.log10(jnp.maximum(norm, 1e-30) * distance**2) + 1.7)


def paper_features(
    channel: Complex[Array, "batch tones antennas antennas"], predicted: Float[Array, "batch 3"]
) -> Float[jax.Array, "batch features"]:
    """Re and Im of vec(H)/||H||_F and :func:`level` at |q_pre|, (B, 2 F N^2 + 1), of channels (B, F, N, N) under
    predictions (B, 3) [m]."""
    flat = channel.reshape(channel.shape[0], -1)
    norm = jnp.maximum(jnp.linalg.norm(flat, axis=-1, keepdims=True), 1e-30)
    distance = jnp.linalg.norm(predicted, axis=-1, keepdims=True)
    return jnp.concatenate([flat.real / norm, flat.imag / norm, level(norm, distance)], axis=-1)


def roi_features(
    coefficients: Complex[Array, "batch tones orders orders"],
    predicted: Float[Array, "batch 3"],
    wavenumbers: Float[Array, " tones"],
) -> Float[jax.Array, "batch features"]:
    """Real features (B, D) of subspace coefficients A (B, F, K, K) under predictions (B, 3) [m].

    Each tone's A is divided by its Frobenius norm and turned so that A_00, the response to the mean field over the
    aperture, is real: its absolute phase repeats every half wavelength of range. The upper triangle's entries x then
    fall from 1 to 1e-4, the noise at 30 dB, with the order of their polynomials, so each enters three times, as
    asinh(g x) for the gains g = 1, 10, 100: large ones keep their detail in the first, small ones count in the last.
    Beside them, for each tone of wavenumber k (F,) [rad/m]: the cosine and sine of the phase of A_00 e^{-2jk|q_pre|}
    (the first tone) or of its difference from the first tone's, which tells by how much the range exceeds |q_pre|;
    and :func:`level` of ||A|| at |q_pre|.
    """
    size = coefficients.shape[-1]
    rows, columns = np.triu_indices(size)
    norm = jnp.maximum(jnp.linalg.norm(coefficients, axis=(-2, -1)), 1e-30)
    lead = coefficients[..., 0, 0]
    lead = lead / jnp.maximum(jnp.abs(lead), 1e-30)
    entries = coefficients[..., rows, columns] * (lead.conj() / norm)[..., None]
    entries = jnp.stack([entries.real, entries.imag], axis=-1)
    scaled = jnp.arcsinh(entries[..., None] * jnp.asarray(_GAINS, entries.dtype))
    distance = jnp.linalg.norm(predicted, axis=-1, keepdims=True)
    phase = lead * jnp.exp(-2j * jnp.asarray(wavenumbers, distance.dtype) * distance)
    phase = jnp.concatenate([phase[:, :1], phase[:, 1:] * phase[:, :1].conj()], axis=-1)
    batch = coefficients.shape[0]
    return jnp.concatenate([scaled.reshape(batch, -1), phase.real, phase.imag, level(norm, distance)], axis=-1)


class Seen(NamedTuple):
    """What the networks are told of an echo, worked out once and passed on; a pytree.

    Attributes:
        features: v of the module's top (B, D).
        snr_db: SNR as the receiver estimates it (B,) [dB].
        centre: the point about which the features describe the channel (B, 3) [m].
        offset: how far it lies from q_pre, in units of the region's scale (B, 3).
    """

    features: Float[Array, "batch features"]
    snr_db: Float[Array, " batch"]
    centre: Float[Array, "batch 3"]
    offset: Float[Array, "batch 3"]


@dataclass(frozen=True)
class ChannelInput:
    """What the networks see of the channel: v of the module's top, from the antennas or from the subspace.

    Hashable, so that it may be static under jit.
    """

    config: Config

    @property
    def antennas(self) -> int:
        """N_b."""
        return self.config.array.count

    @property
    def orders(self) -> int:
        """K."""
        return self.subspace.orders

    @property
    def size(self) -> int:
        """Length of v."""
        tones = len(self.config.array.frequencies_hz)
        if self.config.model.encoder == "paper":
            return 2 * tones * self.antennas**2 + 1
        return tones * (len(_GAINS) * self.orders * (self.orders + 1) + 3) + 3

    @property
    def subspace(self) -> Subspace:
        """That of the configuration's array and tones."""
        return Subspace.from_config(self.config.array)

    def __call__(self, heard: Heard, predicted: Float[Array, "batch 3"], snr_db: Float[Array, " batch"]) -> Seen:
        """What is seen of channels (B, F, N_b, N_b) or, for ``roi``, also of coefficients (B, F, K, K), under
        predictions (B, 3) [m] and SNRs (B,) [dB].

        Its centre is q_pre for ``paper``, the echo's bearing at the range of q_pre for ``roi``.

        Raises:
            ValueError: of another array, or coefficients for ``paper``.
        """
        if self.config.model.encoder == "paper":
            features = paper_features(self.channel(heard), predicted)
            return Seen(features, snr_db, predicted, jnp.zeros_like(predicted))
        subspace = self.subspace
        coefficients = self.coefficients(heard, predicted)
        centre = jax.vmap(lambda each: roi.towards(each, subspace))(coefficients)
        moved = jax.vmap(lambda each, place: roi.recentre(each, place, subspace))(coefficients, centre)
        offset = (centre - predicted) / self.config.region.scale_m
        features = jnp.concatenate([offset, roi_features(moved.values, centre, subspace.wavenumbers)], axis=-1)
        return Seen(features, snr_db, centre, offset)

    def channel(self, heard: Heard) -> Complex[Array, "batch tones antennas antennas"]:
        """Estimated channels as they are.

        Raises:
            ValueError: of another array, or coefficients.
        """
        if isinstance(heard, Coefficients):
            raise ValueError("heard: got coefficients; the encoder 'paper' takes the estimated channel")
        self._check("channel", heard.shape, self.antennas)
        return heard

    def coefficients(self, heard: Heard, centre: Float[Array, "batch 3"]) -> Coefficients:
        """Coefficients as they are, or those of channels (B, F, N_b, N_b) about the centres (B, 3) [m].

        Raises:
            ValueError: of another array.
        """
        if isinstance(heard, Coefficients):
            self._check("coefficients", heard.values.shape, self.orders)
            return heard
        channel, subspace = self.channel(heard), self.subspace
        return jax.vmap(lambda each, place: roi.project(each, place, subspace))(channel, centre)

    def _check(self, name: str, shape: tuple[int, ...], size: int) -> None:
        tones = len(self.config.array.frequencies_hz)
        if len(shape) != 4 or shape[1:] != (tones, size, size):
            raise ValueError(
                f"heard: got {name} of shape {shape}; this array's are (batch, tones, n, n) = "
                f"(batch, {tones}, {size}, {size})"
            )


class Encoder(nnx.Module):
    """(v, q_pre, SNR) -> f (B, d_f). ``embedding`` False drops w1 and w2: f = F_enc(h_vec)."""

    def __init__(self, config: Config, *, embedding: bool, rngs: nnx.Rngs):
        model = config.model
        self.config = config
        self.channel_map = dense(ChannelInput(config).size, model.channel_features, rngs=rngs)
        self.embedding = embedding
        width = model.channel_features
        if embedding:
            waves = 2 * model.fourier + 1
            self.position_head = MLP(3 * waves, width, width, rngs=rngs)
            self.snr_head = MLP(waves, width, width, rngs=rngs)
        self.trunk = ResidualMLP(
            2 * width if embedding else width, model.encoder_features, model.encoder_layers, rngs=rngs
        )

    def __call__(self, seen: Seen) -> Float[jax.Array, "batch features"]:
        """Features f (B, d_f) of what :class:`ChannelInput` saw."""
        hidden = self.channel_map(seen.features)
        if self.embedding:
            model = self.config.model
            place = position_features(seen.centre, model.fourier, self.config.flight, raw_metres=model.raw_metres)
            told = self.snr_head(snr_features(seen.snr_db, model.fourier))
            hidden = jnp.concatenate([(1.0 + self.position_head(place)) * hidden, told], axis=-1)
        return self.trunk(hidden)
