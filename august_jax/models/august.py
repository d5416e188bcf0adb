r"""AUGUST: channel encoder, latent code with a learnable prior, conditional diffusion of points (paper, IV and V).

Training minimises, per batch (paper, eq. loss joint),

    gamma_pos L_pos + gamma_EP L_EP + gamma_z L_z,

L_pos and L_EP the squared error of the estimated noise, summed over the point's three coordinates and over its two
material numbers, averaged over points and clouds; L_z the relative entropy of the posterior to the prior by one
reparameterised sample z = mu + sigma * xi, summed over the latent's dimensions:

    L_z = -H(q) - log p_psi(z),   H(q) = sum_i (1 + log 2 pi + log sigma_i^2)/2.

(The paper's sign before the path term of its training objective is flipped; the noise estimator's loss is the minus of
it.) diag(sigma^2) is the posterior's covariance. At inference the condition is the posterior mean, unless a sample is
asked for: the mean spares the estimate the posterior's spread, and training saw codes all around it.

An optional term trains a linear readout of the posterior mean to the cloud's moments (`frame.moments`). It shapes
the latent early, when the diffusion's gradient is mostly noise, and reads a position without sampling a cloud. With
`config.model.frame` = ``craft`` the cloud first settles on one craft and heading (`signature`), and the diffusion draws
points in the frame that these and the readout state (`frame`); the squared error of the signature's noise joins the
loss with the weight gamma_pos.

Schemes (`config.model.scheme`): ``august``; ``noebd`` without the embeddings of position and SNR (with the ``roi``
encoder q_pre still centres the subspace); ``nolatent``, where f itself conditions the diffusion and there is no
prior; ``refchannel``, see `refchannel`.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx

from august_jax.config import Config, TrainConfig
from august_jax.models.denoiser import Denoiser
from august_jax.models.diffusion import Schedule, add_noise, ancestral, dpm, draw_steps
from august_jax.models.encoder import Encoder
from august_jax.models.flow import RealNVP
from august_jax.models.frame import READINGS, facing, facing_back, into_craft, moments, out_of_craft, straightened
from august_jax.models.layers import MLP, dense
from august_jax.models.refchannel import RefChannel
from august_jax.models.signature import NUMBERS, Signature, shaken

SAMPLERS = ("dpm", "ancestral")
_LOG_VARIANCE_LIMIT = 12.0
_LOG_VARIANCE_START = -4.0


class August(nnx.Module):
    """The networks of one scheme; arrays in, arrays out.

    Shapes throughout: channels (B, F, N_b, N_b) complex64, or subspace coefficients (B, F, K, K) where the encoder is
    ``roi``; predictions (B, 3) [m]; SNRs (B,) [dB]; clouds (B, M, 5).
    """

    def __init__(self, config: Config, rngs: nnx.Rngs):
        model = config.model
        self.config = config
        self.schedule = Schedule(model.steps, model.beta)
        if model.scheme == "refchannel":
            self.reference = RefChannel(config, rngs=rngs)
            condition = model.channel_features
        else:
            self.encoder = Encoder(config, embedding=model.scheme != "noebd", rngs=rngs)
            condition = model.encoder_features if model.scheme == "nolatent" else model.latent
        if self.has_latent:
            self.mean_head = MLP(model.encoder_features, model.encoder_features, model.latent, rngs=rngs)
            self.variance_head = MLP(model.encoder_features, model.encoder_features, model.latent, rngs=rngs)
            self.prior = RealNVP(model.latent, model.flow_layers, model.flow_features, rngs=rngs)
        self.signature = (Signature(condition, self.schedule, model.time_embedding, rngs=rngs)
                          if model.frame == "craft" else None)
        context = condition + (NUMBERS + 2 if self.signature else 0)  # the signature and the material
        self.denoiser = Denoiser(model.denoiser, context, self.schedule, model.time_embedding, rngs=rngs)
        self.readout_head = dense(condition, READINGS, gain=0.0, rngs=rngs)

    @property
    def has_latent(self) -> bool:
        """Whether the scheme has a latent code and a prior."""
        return self.config.model.scheme in ("august", "noebd")

    def posterior(self, channel: jax.Array, predicted: jax.Array, snr_db: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Mean and log-variance of q(z | H_est), each (B, d_z).

        Raises:
            ValueError: the scheme has no latent code.
        """
        if not self.has_latent:
            raise ValueError(f"model.scheme: {self.config.model.scheme!r} has no posterior; choose august or noebd")
        features = self.encoder(channel, predicted, snr_db)
        # Bounded, so that no exponential overflows; it starts narrow, so that the mean is heard through the sample.
        raw = self.variance_head(features) + _LOG_VARIANCE_START
        return self.mean_head(features), _LOG_VARIANCE_LIMIT * jnp.tanh(raw / _LOG_VARIANCE_LIMIT)

    def condition(self, channel: jax.Array, predicted: jax.Array, snr_db: jax.Array,
                  key: jax.Array | None = None) -> jax.Array:
        """What conditions the denoiser, (B, C): the posterior mean or, given a key, a sample of the posterior.

        Schemes without a latent code have one deterministic condition and ignore the key.
        """
        scheme = self.config.model.scheme
        if scheme == "refchannel":
            return self.reference.channel_map(self.reference(channel, predicted))
        if scheme == "nolatent":
            return self.encoder(channel, predicted, snr_db)
        mean, log_variance = self.posterior(channel, predicted, snr_db)
        return mean if key is None else _sample(key, mean, log_variance)

    def readout(self, channel: jax.Array, predicted: jax.Array, snr_db: jax.Array) -> jax.Array:
        """Linear reading of the condition (B, 30): what `frame.moments` says of the cloud, turned as `frame` says.

        It means something only where ``train.weight_readout`` was positive.
        """
        return self._read(self.condition(channel, predicted, snr_db), channel, predicted)

    def loss(self, key: jax.Array, batch: Mapping[str, jax.Array],
             train: TrainConfig) -> tuple[jax.Array, dict[str, jax.Array]]:
        """The training loss () and its terms, unweighted, by name.

        ``batch`` holds ``channel``, ``predicted``, ``snr_db``, ``cloud`` and, for the scheme ``refchannel``,
        ``reference``: the channels at the reference place, of the shape of ``channel``. Of clouds with more than
        ``train.points`` points a random subset is used.

        Raises:
            ValueError: an array is missing or its shape does not fit.
        """
        scheme = self.config.model.scheme
        self._check(batch)
        batch = {name: jnp.asarray(array) for name, array in batch.items()}
        step_key, noise_key, latent_key, point_key, signature_key = jax.random.split(key, 5)
        cloud = batch["cloud"]
        clouds, count = cloud.shape[:2]
        inputs = (batch["channel"], batch["predicted"], batch["snr_db"])
        terms = {}
        if self.has_latent:
            mean, log_variance = self.posterior(*inputs)
            condition, read = _sample(latent_key, mean, log_variance), mean
            entropy = 0.5 * jnp.sum(1.0 + jnp.log(2.0 * jnp.pi) + log_variance, axis=-1)
            terms["latent"] = jnp.mean(-entropy - self.prior.log_prob(condition))
        elif scheme == "nolatent":
            condition = read = self.condition(*inputs)
        else:
            estimate = self.reference(*inputs[:2])
            condition = read = self.reference.channel_map(estimate)
            terms["reference"] = self.reference.loss(estimate, batch["reference"])

        if self.signature:
            cloud = facing(cloud, self._centre(*inputs[:2]))
        truth = moments(cloud)
        points = cloud
        if train.points < count:
            points = cloud[:, jax.random.choice(point_key, count, (train.points,), replace=False)]
        if self.signature:
            draw_key, shake_key = jax.random.split(signature_key)
            terms["signature"] = self.signature.loss(draw_key, truth[:, -NUMBERS:], condition)
            own = truth.at[:, -NUMBERS:].set(shaken(shake_key, truth[:, -NUMBERS:]))
            condition = self._context(condition, own)
            points = into_craft(points, own, self._frame_scale)
        step = draw_steps(step_key, clouds, self.schedule)
        noise = jax.random.normal(noise_key, points.shape)
        noisy = add_noise(points, noise, step, self.schedule)
        error = (noise - self.denoiser(noisy, step, condition)) ** 2
        terms["position"] = jnp.mean(jnp.sum(error[..., :3], axis=-1))
        terms["material"] = jnp.mean(jnp.sum(error[..., 3:], axis=-1))
        terms["readout"] = jnp.mean(jnp.sum((self._read(read, *inputs[:2]) - truth) ** 2, axis=-1))
        weights = {
            "position": train.weight_position, "material": train.weight_material, "latent": train.weight_latent,
            "reference": 1.0, "readout": train.weight_readout, "signature": train.weight_position,
        }
        return sum(weights[name] * term for name, term in terms.items()), terms

    def reconstruct(self, key: jax.Array, channel: jax.Array, predicted: jax.Array, snr_db: jax.Array, count: int, *,
                    sampler: str = "dpm", steps: int = 10, sample_latent: bool = False) -> jax.Array:
        """Clouds (B, ``count``, 5) drawn given the channels.

        Args:
            sampler: ``dpm``, with ``steps`` network evaluations, or ``ancestral``, always with all S.
            sample_latent: condition on a sample of the posterior, not on its mean.

        Raises:
            ValueError: an unknown sampler, or a number of steps that does not fit the schedule.
        """
        if sampler not in SAMPLERS:
            raise ValueError(f"sampler: unknown sampler {sampler!r}; choose dpm or ancestral")
        latent_key, signature_key, key = jax.random.split(key, 3)
        condition = self.condition(channel, predicted, snr_db, latent_key if sample_latent else None)
        sample = self._sampler(sampler, steps)
        reading = self._read(condition, channel, predicted)
        context, reading = self._settle(signature_key, condition, reading, sample)
        cloud = sample(key, self._denoise(context), (len(context), count, 5))
        return self._in_region(cloud, reading, self._centre(channel, predicted))

    def denoising(self, key: jax.Array, channel: jax.Array, predicted: jax.Array, snr_db: jax.Array, count: int, *,
                  after: tuple[int, ...]) -> jax.Array:
        """The clouds on their way, (len(after), B, count, 5), once ``after`` of the S ancestral steps are done."""
        condition = self.condition(channel, predicted, snr_db)
        signature_key, key = jax.random.split(key)
        reading = self._read(condition, channel, predicted)
        context, reading = self._settle(signature_key, condition, reading, self._sampler("ancestral"))
        path = ancestral(key, self._denoise(context), (condition.shape[0], count, 5), self.schedule, after)
        return self._in_region(path, reading, self._centre(channel, predicted))

    @property
    def _frame_scale(self) -> float:
        return self.config.region.scale_m / self.config.target.half_wheelbase_m

    def _read(self, condition: jax.Array, channel: jax.Array, predicted: jax.Array) -> jax.Array:
        reading = self.readout_head(condition)
        # The place is read relative to the point about which the encoder describes the channel.
        centre = self._centre(channel, predicted)
        offset = (centre - predicted) / self.config.region.scale_m
        if self.signature:
            offset = facing(offset[:, None], centre)[:, 0]
        return reading.at[:, :3].add(offset)

    def _centre(self, channel: jax.Array, predicted: jax.Array) -> jax.Array:
        """The point (B, 3) [m] about which the channel is described: the echo's bearing for ``roi``, else q_pre."""
        if self.config.model.scheme == "refchannel":
            return predicted
        return self.encoder.channel_input.centred(channel, predicted)[1]

    def _context(self, condition: jax.Array, reading: jax.Array) -> jax.Array:
        """The denoiser's context: the condition, the signature in the craft's own axes, and the material.

        The material is read like the place: a mean errs less than one draw from the posterior.
        """
        return jnp.concatenate([condition, straightened(reading[:, -NUMBERS:]), reading[:, 3:5]], axis=-1)

    def _settle(self, key: jax.Array, condition: jax.Array, reading: jax.Array, sample) -> tuple[jax.Array, jax.Array]:
        """The denoiser's context and the reading, in which a signature that was drawn stands for the one read."""
        if self.signature is None:
            return condition, reading
        reading = reading.at[:, -NUMBERS:].set(self.signature.draw(key, condition, sample))
        return self._context(condition, reading), reading

    def _in_region(self, clouds: jax.Array, reading: jax.Array, centre: jax.Array) -> jax.Array:
        """Diffused clouds (..., B, M, 5) in the coordinates of the region."""
        if self.signature is None:
            return clouds
        return facing_back(out_of_craft(clouds, reading, self._frame_scale), centre)

    def _sampler(self, name: str, steps: int = 0):
        """(key, denoise, shape) -> draws, by one of SAMPLERS."""
        if name == "dpm":
            return lambda key, denoise, shape: dpm(key, denoise, shape, self.schedule, steps)
        return lambda key, denoise, shape: ancestral(key, denoise, shape, self.schedule)

    def _denoise(self, condition: jax.Array):
        return lambda points, step: self.denoiser(points, step, condition)

    def _check(self, batch: Mapping[str, jax.Array]) -> None:
        wanted = ["channel", "predicted", "snr_db", "cloud"]
        if self.config.model.scheme == "refchannel":
            wanted.append("reference")
        for name in wanted:
            if name not in batch:
                raise ValueError(f"batch: {name!r} is missing; scheme {self.config.model.scheme!r} needs "
                                 f"{', '.join(wanted)}, got {', '.join(batch)}")
        clouds = batch["cloud"].shape[0] if batch["cloud"].ndim else 0
        shapes = {"predicted": (clouds, 3), "snr_db": (clouds,), "cloud": (clouds, *batch["cloud"].shape[1:2], 5)}
        for name, shape in shapes.items():
            if batch[name].shape != shape:
                raise ValueError(f"batch[{name!r}]: got shape {batch[name].shape}; with {clouds} clouds it must be "
                                 f"{shape}")


def create(config: Config, seed: int) -> tuple[nnx.GraphDef, nnx.State]:
    """The networks of ``config``, initialised from ``seed``, as (graphdef, state); ``nnx.merge`` joins them again."""
    return nnx.split(August(config, nnx.Rngs(seed)))


@partial(jax.jit, static_argnames=("graphdef", "count", "sampler", "steps", "sample_latent"))
def reconstruct(graphdef: nnx.GraphDef, state: nnx.State, key: jax.Array, channel: jax.Array, predicted: jax.Array,
                snr_db: jax.Array, *, count: int, sampler: str = "dpm", steps: int = 10,
                sample_latent: bool = False) -> jax.Array:
    """:meth:`August.reconstruct` of networks that :func:`create` split, compiled once for each shape."""
    model = nnx.merge(graphdef, state)
    return model.reconstruct(key, channel, predicted, snr_db, count, sampler=sampler, steps=steps,
                             sample_latent=sample_latent)


def parameter_count(state: nnx.State) -> int:
    """Number of trained numbers."""
    return int(sum(np.prod(leaf.shape, dtype=int) for leaf in jax.tree.leaves(state)))


def _sample(key: jax.Array, mean: jax.Array, log_variance: jax.Array) -> jax.Array:
    return mean + jnp.exp(0.5 * log_variance) * jax.random.normal(key, mean.shape)
