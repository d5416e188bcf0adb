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

An optional term trains a linear readout of the posterior mean to the cloud's reading (`craft.Reading`). It shapes
the latent early, when the diffusion's gradient is mostly noise, and reads a position without sampling a cloud. Where
``train.weight_readout`` is 0 there is no readout. With `config.model.frame` = ``craft``, which needs one, the cloud
first settles on one craft and heading (`signature`), and the diffusion draws points in the frame that these and the
readout state (`craft.CraftFrame`); the squared error of the signature's noise joins the loss with the weight gamma_pos.

Schemes (`config.model.scheme`): ``august``; ``noebd`` without the embeddings of position and SNR (with the ``roi``
encoder q_pre still centres the subspace); ``nolatent``, where f itself conditions the diffusion and there is no
prior; ``refchannel``, see `refchannel`.
"""

from __future__ import annotations

from functools import partial
from typing import Any, TypeAlias, get_args

import jax
import jax.numpy as jnp
import numpy as np
from flax import nnx
from jaxtyping import Float, Key

from august_jax import streams
from august_jax.arrays import Array, rows_not_finite
from august_jax.config import Config, Sampler
from august_jax.mesh import own_rows
from august_jax.models.craft import KIND_SIZE, READING_SIZE, CraftFrame, Reading, RegionFrame, frame_of
from august_jax.models.denoiser import Denoiser
from august_jax.models.diffusion import PointSampler, Schedule, add_noise, ancestral, dpm, draw_noise, draw_steps
from august_jax.models.encoder import ChannelInput, Encoder, Heard, Seen
from august_jax.models.flow import RealNVP
from august_jax.models.layers import MLP, dense
from august_jax.models.refchannel import RefChannel
from august_jax.models.signature import Signature, shaken

State: TypeAlias = nnx.State[str, Any]
"""The networks' arrays in a tree, as nnx splits them from their graphdef."""

_LOG_VARIANCE_LIMIT = 12.0
_LOG_VARIANCE_START = -4.0


class August(nnx.Module):
    """The networks of one scheme; arrays in, arrays out.

    What is heard passes :meth:`see` once; the other methods take what was :class:`~encoder.Seen`.
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
        craft = model.frame == "craft"
        self.signature = Signature(condition, self.schedule, model.time_embedding, rngs=rngs) if craft else None
        context = condition + KIND_SIZE if craft else condition
        self.denoiser = Denoiser(model.denoiser, context, self.schedule, model.time_embedding, rngs=rngs)
        read = craft or config.train.weight_readout > 0.0
        self.readout_head = dense(condition, READING_SIZE, gain=0.0, rngs=rngs) if read else None

    @property
    def has_latent(self) -> bool:
        """Whether the scheme has a latent code and a prior."""
        return self.config.model.scheme in ("august", "noebd")

    def see(self, heard: Heard, predicted: Float[Array, "batch 3"], snr_db: Float[Array, " batch"]) -> Seen:
        """What the networks are told of estimated channels (B, F, N_b, N_b), or of their coefficients in the subspace
        where the encoder is ``roi``, under predictions (B, 3) [m] and SNRs (B,) [dB].

        Raises:
            ValueError: what is heard is not of the configuration's array.
        """
        see = self.reference.see if self.config.model.scheme == "refchannel" else ChannelInput(self.config)
        return see(heard, jnp.asarray(predicted), jnp.asarray(snr_db))

    def posterior(self, seen: Seen) -> tuple[Float[jax.Array, "batch latent"], Float[jax.Array, "batch latent"]]:
        """Mean and log-variance of q(z | H_est), each (B, d_z).

        Raises:
            ValueError: the scheme has no latent code.
        """
        if not self.has_latent:
            raise ValueError(f"model.scheme: {self.config.model.scheme!r} has no posterior; choose august or noebd")
        features = self.encoder(seen)
        # Bounded, so that no exponential overflows; it starts narrow, so that the mean is heard through the sample.
        raw = self.variance_head(features) + _LOG_VARIANCE_START
        return self.mean_head(features), _LOG_VARIANCE_LIMIT * jnp.tanh(raw / _LOG_VARIANCE_LIMIT)

    def condition(self, seen: Seen, key: Key[Array, ""] | None = None) -> Float[jax.Array, "batch condition"]:
        """What conditions the denoiser, (B, C): the posterior mean or, given a key, a sample of the posterior.

        Schemes without a latent code have one deterministic condition and ignore the key.
        """
        scheme = self.config.model.scheme
        if scheme == "refchannel":
            return self.reference.channel_map(self.reference(seen))
        if scheme == "nolatent":
            return self.encoder(seen)
        mean, log_variance = self.posterior(seen)
        return mean if key is None else _sample(key, mean, log_variance)

    def readout(self, condition: Float[Array, "batch condition"], seen: Seen) -> Reading:
        """What a linear map of the condition (B, C) reads of the cloud, in the units of the region, its axes turned as
        the frame faces it.

        Raises:
            ValueError: the networks have no readout.
        """
        if self.readout_head is None:
            raise ValueError("train.weight_readout: 0 leaves the readout out; train with a positive weight")
        reading = Reading.from_vector(self.readout_head(condition))
        # The place is read relative to the point about which the channel is described.
        offset = self._frame(seen).faced(seen.offset[:, None])[:, 0]
        return reading._replace(place=reading.place + offset)

    def loss(
        self,
        key: Key[Array, ""],
        heard: Heard,
        predicted: Array,
        snr_db: Array,
        cloud: Array,
        reference: Heard | None = None,
    ) -> tuple[Float[jax.Array, ""], dict[str, Float[jax.Array, ""]]]:
        """The training loss () and its terms, unweighted, by name.

        Args:
            key: of all that is drawn.
            heard, predicted, snr_db: as :meth:`see` takes them.
            cloud: the true clouds (B, M, 5); of more than ``train.points`` points a random subset is used.
            reference: for the scheme ``refchannel``, the same of the channels at the reference place.

        Raises:
            ValueError: an array is missing or its shape does not fit.
        """
        train, scheme = self.config.train, self.config.model.scheme
        cloud = jnp.asarray(cloud)
        _check_batch(predicted, snr_db, cloud)
        step_key, noise_key, latent_key, point_key, signature_key = jax.random.split(key, 5)
        clouds, count = cloud.shape[:2]
        seen = self.see(heard, predicted, snr_db)
        frame = self._frame(seen)
        terms = {}
        if self.has_latent:
            mean, log_variance = self.posterior(seen)
            condition, read = _sample(latent_key, mean, log_variance), mean
            entropy = 0.5 * jnp.sum(1.0 + jnp.log(2.0 * jnp.pi) + log_variance, axis=-1)
            terms["latent"] = jnp.mean(-entropy - self.prior.log_prob(condition))
        elif scheme == "nolatent":
            condition = read = self.condition(seen)
        else:
            estimate = self.reference(seen)
            condition = read = self.reference.channel_map(estimate)
            if reference is None:
                raise ValueError(
                    "reference: got None; the scheme 'refchannel' learns from channels at the reference place"
                )
            terms["reference"] = self.reference.loss(estimate, reference)

        points = cloud
        if train.points < count:
            points = cloud[:, jax.random.choice(point_key, count, (train.points,), replace=False)]
        if self.readout_head is not None:
            truth = frame.read(cloud)
            error = self.readout(read, seen).vector() - truth.vector()
            terms["readout"] = jnp.mean(jnp.sum(error**2, axis=-1))
            if self.signature is not None:
                draw_key, shake_key = jax.random.split(signature_key)
                terms["signature"] = self.signature.loss(draw_key, truth.harmonics, condition)
                truth = truth._replace(harmonics=shaken(shake_key, truth.harmonics))
                condition = _context(condition, truth)
            points = frame.into(points, truth)
        step = draw_steps(step_key, clouds, self.schedule)
        noise = draw_noise(noise_key, points)
        noisy = add_noise(points, noise, step, self.schedule)
        error = (noise - self.denoiser(noisy, step, condition)) ** 2
        terms["position"] = jnp.mean(jnp.sum(error[..., :3], axis=-1))
        terms["material"] = jnp.mean(jnp.sum(error[..., 3:], axis=-1))
        weights = {
            "position": train.weight_position,
            "material": train.weight_material,
            "latent": train.weight_latent,
            "reference": 1.0,
            "readout": train.weight_readout,
            "signature": train.weight_position,
        }
        return sum((weights[name] * term for name, term in terms.items()), jnp.zeros((), jnp.float32)), terms

    def reconstruct(
        self,
        key: Key[Array, ""],
        heard: Heard,
        predicted: Float[Array, "batch 3"],
        snr_db: Float[Array, " batch"],
        count: int,
        *,
        sampler: Sampler = "dpm",
        steps: int = 10,
        sample_latent: bool = False,
        instants: tuple[int, ...] = (),
    ) -> Float[jax.Array, "*instants batch {count} 5"]:
        """Clouds (B, ``count``, 5) drawn given the channels.

        Args:
            key: of all that is drawn.
            heard, predicted, snr_db: as :meth:`see` takes them.
            count: points of a cloud.
            sampler: ``dpm``, with ``steps`` network evaluations, or ``ancestral``, always with all S.
            sample_latent: condition on a sample of the posterior, not on its mean.
            instants: counts of completed steps, 0..S, of the sampler ``ancestral``: the clouds on their way at these
                instants, (I, B, ``count``, 5). At S they are the clouds that the same key gives without.

        Raises:
            ValueError: an unknown sampler, instants of another than ``ancestral``, or a number of steps that does not
                fit the schedule.
        """
        if instants and sampler != "ancestral":
            raise ValueError(f"instants: {instants} are steps of the sampler ancestral, not of {sampler!r}")
        latent_key, signature_key, key = jax.random.split(key, 3)
        seen = self.see(heard, predicted, snr_db)
        context = condition = self.condition(seen, latent_key if sample_latent else None)
        sample, reading = self._sampler(sampler, steps), None
        if self.signature is not None:
            # Headings that the channel leaves open are drawn, once a cloud; the material is read, like the place: a
            # mean errs less than one draw from the posterior.
            harmonics = self.signature.draw(signature_key, condition, sample)
            reading = self.readout(condition, seen)._replace(harmonics=harmonics)
            context = _context(condition, reading)

        def denoise(points: jax.Array, step: jax.Array) -> jax.Array:
            return self.denoiser(points, step, context)

        def placed(points: jax.Array) -> jax.Array:
            return points if reading is None else self._frame(seen).out(points, reading)

        shape = (len(context), count, 5)
        if not instants:
            return placed(sample(key, denoise, shape))
        path = ancestral(key, denoise, shape, self.schedule, instants)
        return jax.lax.map(placed, path)

    def _frame(self, seen: Seen) -> RegionFrame | CraftFrame:
        return frame_of(self.config, seen.centre)

    def _sampler(self, name: Sampler, steps: int) -> PointSampler:
        if name == "dpm":
            return lambda key, denoise, shape: dpm(key, denoise, shape, self.schedule, steps)
        if name == "ancestral":
            return lambda key, denoise, shape: ancestral(key, denoise, shape, self.schedule)
        raise ValueError(f"sampler: unknown sampler {name!r}; choose {' or '.join(get_args(Sampler))}")


def create(config: Config, seed: int) -> tuple[nnx.GraphDef, State]:
    """The networks of ``config``, initialised from ``seed``, as (graphdef, state); ``nnx.merge`` joins them again."""
    return nnx.split(August(config, nnx.Rngs(streams.key(seed, "train.parameters"))))


def reconstruct(
    graphdef: nnx.GraphDef,
    state: State,
    key: Key[Array, ""],
    heard: Heard,
    predicted: Float[Array, "batch 3"],
    snr_db: Float[Array, " batch"],
    *,
    count: int,
    sampler: Sampler = "dpm",
    steps: int = 10,
    sample_latent: bool = False,
    instants: tuple[int, ...] = (),
) -> Float[jax.Array, "*instants batch {count} 5"]:
    """:meth:`August.reconstruct` of networks that :func:`create` split, compiled once for each shape.

    Raises:
        ValueError: a slot of which something is NaN or infinite; what is heard is not of the configuration's array.
    """
    for name, value in (("heard", heard), ("predicted", predicted), ("snr_db", snr_db)):
        if len(wrong := rows_not_finite(value)):
            raise ValueError(
                f"{name}: {len(wrong)} of {len(predicted)} slots hold NaN or infinity, the first is {wrong[0]}; leave "
                "them out"
            )
    return _reconstruct(
        graphdef,
        state,
        key,
        heard,
        predicted,
        snr_db,
        count=count,
        sampler=sampler,
        steps=steps,
        sample_latent=sample_latent,
        instants=instants,
    )


@partial(jax.jit, static_argnames=("graphdef", "count", "sampler", "steps", "sample_latent", "instants"))
def _reconstruct(graphdef, state, key, heard, predicted, snr_db, count, **options):
    return nnx.merge(graphdef, state).reconstruct(key, heard, predicted, snr_db, count, **options)


def parameter_count(state: State) -> int:
    """Number of trained numbers."""
    return int(sum(np.prod(leaf.shape, dtype=int) for leaf in jax.tree.leaves(state)))


def _check_batch(predicted: Array, snr_db: Array, cloud: Array) -> None:
    clouds = cloud.shape[0] if cloud.ndim else 0
    for name, array, shape in (
        ("predicted", predicted, (clouds, 3)),
        ("snr_db", snr_db, (clouds,)),
        ("cloud", cloud, (clouds, *cloud.shape[1:2], 5)),
    ):
        if array.shape != shape:
            raise ValueError(f"{name}: got shape {array.shape}; with {clouds} clouds it must be {shape}")


def _sample(key: Array, mean: jax.Array, log_variance: jax.Array) -> jax.Array:
    noise = own_rows(lambda rows: jax.random.normal(key, (rows, *mean.shape[1:])), len(mean))
    return mean + jnp.exp(0.5 * log_variance) * noise


def _context(condition: Array, reading: Reading) -> jax.Array:
    """The denoiser's context in the craft's frame: the condition, and what craft it is."""
    return jnp.concatenate([condition, reading.kind()], axis=-1)
