"""AUGUST in PyTorch, eager, from the same parameters: the peer that ``training.py`` times and checks the step against.

The paper's networks (``model.encoder=paper``, ``model.frame=region``, no readout): what `august_jax.models` writes in
flax and distrax, written again in `torch.nn`, layer by layer. PyTorch is no dependency of the project.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import torch
from flax import nnx
from torch import nn

from august_jax.config import Config
from august_jax.data.fields import Batch
from august_jax.models import August
from august_jax.models.diffusion import Schedule, draw_steps

DEVICE = "cuda" if jax.default_backend() == "gpu" and torch.cuda.is_available() else "cpu"
torch.set_default_device(DEVICE)
torch.set_float32_matmul_precision("high")  # on a GPU factors are rounded as JAX's defaults round them (TF32)

_LOG_VARIANCE_LIMIT, _LOG_VARIANCE_START, _LOG_SCALE_LIMIT = 12.0, -4.0, 2.0


class Draws(NamedTuple):
    """What a step draws: diffusion steps (B,), the points' noise (B, P, 5), the latent's (B, d_z)."""

    step: torch.Tensor
    noise: torch.Tensor
    latent: torch.Tensor


class Heard(NamedTuple):
    """A batch: channels (B, F, N, N), predictions (B, 3) [m], SNR (B,) [dB], clouds (B, P, 5)."""

    channel: torch.Tensor
    predicted: torch.Tensor
    snr_db: torch.Tensor
    cloud: torch.Tensor


def heard(batch: Batch) -> Heard:
    """The same batch for PyTorch."""
    parts = (batch.heard, batch.predicted, batch.snr_db, batch.cloud)
    return Heard(*(torch.from_numpy(np.array(part)).to(DEVICE) for part in parts))


def drawn_alike(config: Config, key: jax.Array, points: tuple[int, int, int]) -> Draws:
    """What :meth:`August.loss` draws of a key for clouds of this shape, all of whose points are used."""
    step_key, noise_key, latent_key, _, _ = jax.random.split(key, 5)
    parts = (
        draw_steps(step_key, points[0], Schedule(config.model.steps, config.model.beta)),
        jax.random.normal(noise_key, points),
        jax.random.normal(latent_key, (points[0], config.model.latent)),
    )
    return Draws(*(torch.from_numpy(np.array(part)).to(DEVICE) for part in parts))


def _linear(layer: nnx.Linear) -> nn.Linear:
    kernel = np.asarray(layer.kernel[...])
    made = nn.Linear(*kernel.shape, bias=layer.use_bias)
    with torch.no_grad():
        made.weight.copy_(torch.from_numpy(kernel.T.copy()))
        if layer.use_bias:
            made.bias.copy_(torch.from_numpy(np.array(layer.bias[...])))
    return made


def _mlp(network) -> nn.Sequential:
    layers = [_linear(layer) for layer in network.layers]
    return nn.Sequential(*(part for layer in layers[:-1] for part in (layer, nn.LeakyReLU())), layers[-1])


def _fourier(values: torch.Tensor, octaves: int) -> torch.Tensor:
    angles = math.pi * 2.0 ** torch.arange(octaves) * values[..., None]
    return torch.cat([values, torch.cat([angles.sin(), angles.cos()], -1).flatten(-2)], -1)


class _Trunk(nn.Module):
    def __init__(self, network):
        super().__init__()
        self.stem = _linear(network.stem)
        self.blocks = nn.ModuleList(_linear(block) for block in network.blocks)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        hidden = self.stem(x)
        for block in self.blocks:
            hidden = hidden + nn.functional.leaky_relu(block(hidden)) / math.sqrt(len(self.blocks))
        return hidden


class _Flow(nn.Module):
    def __init__(self, prior):
        super().__init__()
        self.size = prior.size
        self.conditioners = nn.ModuleList(_mlp(each.network) for each in prior.conditioners)

    def log_prob(self, latent: torch.Tensor) -> torch.Tensor:
        even = torch.arange(self.size) % 2 == 0
        log_det = torch.zeros(len(latent))
        for index in reversed(range(len(self.conditioners))):
            kept = even if index % 2 == 0 else ~even
            raw, shift = self.conditioners[index](torch.where(kept, latent, 0.0)).chunk(2, -1)
            scale = torch.where(kept, 0.0, _LOG_SCALE_LIMIT * torch.tanh(raw / _LOG_SCALE_LIMIT))
            latent = torch.where(kept, latent, (latent - shift) * torch.exp(-scale))
            log_det = log_det - scale.sum(-1)
        return log_det - 0.5 * (latent**2 + math.log(2.0 * math.pi)).sum(-1)


class _ConcatSquash(nn.Module):
    def __init__(self, layer):
        super().__init__()
        self.linear, self.gate, self.shift = map(_linear, (layer.linear, layer.gate, layer.shift))

    def forward(self, points: torch.Tensor, context: torch.Tensor) -> torch.Tensor:
        gate = 2.0 * torch.sigmoid(self.gate(context))[:, None]
        return self.linear(points) * gate + self.shift(context)[:, None]


class TorchAugust(nn.Module):
    """The networks with the parameters of ours."""

    def __init__(self, networks: August):
        super().__init__()
        config = self.config = networks.config
        model, train = config.model, config.train
        if (model.scheme, model.encoder, model.frame, train.weight_readout) != ("august", "paper", "region", 0.0):
            raise ValueError("networks: this peer has the paper's alone: encoder paper, frame region, no readout")
        encoder = networks.encoder
        self.channel_map, self.trunk = _linear(encoder.channel_map), _Trunk(encoder.trunk)
        self.position_head, self.snr_head = _mlp(encoder.position_head), _mlp(encoder.snr_head)
        self.mean_head, self.variance_head = _mlp(networks.mean_head), _mlp(networks.variance_head)
        self.prior = _Flow(networks.prior)
        self.layers = nn.ModuleList(_ConcatSquash(layer) for layer in networks.denoiser.layers)
        schedule = networks.schedule
        self.register_buffer("bars", torch.tensor(schedule.alpha_bars, dtype=torch.float32))
        lambdas = schedule.half_log_snr
        scaled = 2.0 * (lambdas - lambdas[-1]) / max(lambdas[0] - lambdas[-1], 1e-9) - 1.0
        self.register_buffer("log_snr", torch.tensor(np.concatenate([[0.0], scaled]), dtype=torch.float32))
        low, high = torch.tensor(config.flight.box_m).T
        self.register_buffer("low", low)
        self.register_buffer("span", high - low)

    def features(self, batch: Heard) -> torch.Tensor:
        """f (B, d_f)."""
        flat, model = batch.channel.flatten(1), self.config.model
        norm = torch.linalg.vector_norm(flat, dim=-1, keepdim=True)
        distance = torch.linalg.vector_norm(batch.predicted, dim=-1, keepdim=True)
        level = 4.0 * (torch.log10(norm * distance**2) + 1.7)
        hidden = self.channel_map(torch.cat([flat.real / norm, flat.imag / norm, level], -1))
        place = batch.predicted if model.raw_metres else 2.0 * (batch.predicted - self.low) / self.span - 1.0
        told = self.snr_head(_fourier((batch.snr_db[:, None] - 15.0) / 20.0, model.fourier))
        return self.trunk(torch.cat([(1.0 + self.position_head(_fourier(place, model.fourier))) * hidden, told], -1))

    def _time(self, step: torch.Tensor) -> torch.Tensor:
        if self.config.model.time_embedding == "log_snr":
            return _fourier(self.log_snr[step][:, None], 6)
        part = step[:, None] / self.config.model.steps
        return torch.cat([part, part.sin(), part.cos(), (2 * part).sin(), (2 * part).cos()], -1)

    def forward(self, batch: Heard, draws: Draws) -> torch.Tensor:
        """The training loss ()."""
        train = self.config.train
        features = self.features(batch)
        mean, raw = self.mean_head(features), self.variance_head(features) + _LOG_VARIANCE_START
        log_variance = _LOG_VARIANCE_LIMIT * torch.tanh(raw / _LOG_VARIANCE_LIMIT)
        condition = mean + torch.exp(0.5 * log_variance) * draws.latent
        entropy = 0.5 * (1.0 + math.log(2.0 * math.pi) + log_variance).sum(-1)
        latent = (-entropy - self.prior.log_prob(condition)).mean()
        bars = self.bars[draws.step][:, None, None]
        points = bars.sqrt() * batch.cloud + (1.0 - bars).sqrt() * draws.noise
        context = torch.cat([self._time(draws.step), condition], -1)
        for index, layer in enumerate(self.layers):
            points = layer(nn.functional.silu(points) if index else points, context)
        error = (draws.noise - points) ** 2
        return (
            train.weight_position * error[..., :3].sum(-1).mean()
            + train.weight_material * error[..., 3:].sum(-1).mean()
            + train.weight_latent * latent
        )


class TorchTraining:
    """A run of gradient steps, as :func:`august_jax.training.step.train_step` makes them."""

    def __init__(self, networks: August):
        train = networks.config.train
        self.networks = TorchAugust(networks)
        self.average = torch.optim.swa_utils.AveragedModel(
            self.networks, multi_avg_fn=torch.optim.swa_utils.get_ema_multi_avg_fn(train.ema)
        )
        first, last = train.learning_rate
        self._optimizer = torch.optim.Adam(self.networks.parameters(), lr=first)
        self._rate = torch.optim.lr_scheduler.LinearLR(self._optimizer, 1.0, last / first, train.steps)

    def step(self, batch: Heard) -> float:
        """One step on a batch; the loss before it."""
        config, (clouds, points, _) = self.networks.config, batch.cloud.shape
        places = (torch.rand(()) + torch.arange(clouds) / clouds) % 1.0
        draws = Draws(
            (1 + (places * config.model.steps).long()).clamp(max=config.model.steps),
            torch.randn(clouds, points, 5),
            torch.randn(clouds, config.model.latent),
        )
        self._optimizer.zero_grad()
        loss = self.networks(batch, draws)
        loss.backward()
        nn.utils.clip_grad_norm_(self.networks.parameters(), 1.0)
        self._optimizer.step()
        self._rate.step()
        self.average.update_parameters(self.networks)
        return loss.item()


def disagreement(networks: August, batch: Batch, key: jax.Array) -> tuple[float, float]:
    """How far the loss and its gradient of the two lie apart on a batch with the same draws, relative."""
    cloud = jnp.asarray(batch.cloud)
    graphdef, state = nnx.split(networks)

    def loss(state):
        return nnx.merge(graphdef, state).loss(key, batch.heard, batch.predicted, batch.snr_db, cloud)[0]

    value, gradient = jax.jit(jax.value_and_grad(loss))(state)
    peer = TorchAugust(networks)
    theirs = peer(heard(batch), drawn_alike(networks.config, key, cloud.shape))
    theirs.backward()
    norm = math.sqrt(sum(float(parameter.grad.square().sum()) for parameter in peer.parameters()))
    # kernels are transposed, so that norms and a few arrays are compared, not the trees
    ours = [np.asarray(leaf) for leaf in jax.tree.leaves(gradient)]
    own = math.sqrt(sum(float((leaf.astype(np.float64) ** 2).sum()) for leaf in ours))
    first = peer.channel_map.weight.grad.cpu().numpy().T
    mine = np.asarray(gradient["encoder"]["channel_map"]["kernel"][...])
    apart = max(abs(norm - own) / own, float(np.linalg.norm(first - mine) / np.linalg.norm(mine)))
    return abs(theirs.item() - float(value)) / abs(float(value)), apart
