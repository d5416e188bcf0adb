"""One gradient step: a state pytree, a pure function of (state, batch), compiled once by its caller.

Adam under a linearly falling learning rate (paper, Section VI-A), the gradient clipped to a global norm of 1, and an
exponential moving average of the parameters. Evaluation uses the average. It starts with a short memory,
min(decay, (1 + n)/(10 + n)) after n steps, so that it is useful from the beginning.

All parameters travel as one vector, which the step splits into the networks' arrays. The optimiser is then a handful
of kernels instead of several for each of a hundred arrays, and the step compiles in half the time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import nnx
from jax.flatten_util import ravel_pytree

from august_jax.config import Config, TrainConfig
from august_jax.models import August, create

_CLIP = 1.0


class TrainState(NamedTuple):
    """Everything that training carries from step to step; a pytree.

    Attributes:
        params: the networks' parameters, a float32 vector in the order of ``jax.flatten_util.ravel_pytree``.
        ema: their moving average, likewise.
        opt_state: optax's.
        step: gradient steps done, int32 ().
        key: the run's random key; step n draws from ``fold_in(key, n)`` and the key itself never changes.
    """

    params: jax.Array
    ema: jax.Array
    opt_state: Any
    step: jax.Array
    key: jax.Array


class Networks(NamedTuple):
    """What turns a vector of parameters into networks."""

    graphdef: nnx.GraphDef
    unravel: Callable[[jax.Array], nnx.State]

    def __call__(self, params: jax.Array) -> August:
        return nnx.merge(self.graphdef, self.unravel(params))


def optimizer(train: TrainConfig) -> optax.GradientTransformation:
    """Clip, then Adam with the learning rate falling linearly over ``train.steps``."""
    rate = optax.linear_schedule(*train.learning_rate, train.steps)
    return optax.chain(optax.clip_by_global_norm(_CLIP), optax.adam(rate))


def initial_state(config: Config) -> tuple[Networks, TrainState]:
    """The networks' form, and the state before the first step, both from ``config.train.seed``."""
    graphdef, arrays = create(config, config.train.seed)
    params, unravel = ravel_pytree(arrays)
    key = jax.random.fold_in(jax.random.key(config.train.seed), 1)
    state = TrainState(params, jnp.copy(params), optimizer(config.train).init(params), jnp.zeros((), jnp.int32), key)
    return Networks(graphdef, unravel), state


def train_step(networks: Networks, train: TrainConfig, state: TrainState,
               batch: Mapping[str, jax.Array]) -> tuple[TrainState, dict[str, jax.Array]]:
    """The state after one step on ``batch`` (see ``August.loss``), and what to report: each a float32 ().

    Reported are ``loss``, its unweighted terms, and ``gradient``, the global norm before clipping.
    """

    def loss(params):
        return networks(params).loss(jax.random.fold_in(state.key, state.step), batch, train)

    (value, terms), gradient = jax.value_and_grad(loss, has_aux=True)(state.params)
    updates, opt_state = optimizer(train).update(gradient, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    done = state.step + 1
    decay = jnp.minimum(getattr(train, "ema", 0.999), (1.0 + done) / (10.0 + done))
    ema = decay * state.ema + (1.0 - decay) * params
    report = {"loss": value, **terms, "gradient": optax.global_norm(gradient)}
    return TrainState(params, ema, opt_state, done, state.key), report


def compiled_step(networks: Networks, train: TrainConfig) -> Callable:
    """``(state, batch) -> (state, report)``, jitted; the state that goes in is donated."""
    return jax.jit(lambda state, batch: train_step(networks, train, state, batch), donate_argnums=0)
