"""One gradient step: a state pytree, a pure function of (state, batch), compiled once by its caller.

Adam under a linearly falling learning rate (paper, Section VI-A), the gradient clipped to a global norm of 1, and an
exponential moving average of the parameters. Evaluation uses the average. It starts with a short memory,
min(decay, (1 + n)/(10 + n)) after n steps, so that it is useful from the beginning.

All parameters travel as one vector, which the step splits into the networks' arrays. The optimiser is then a handful
of kernels instead of several for each of a hundred arrays, and the step compiles in half the time.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx

from august_jax.config import Config, TrainConfig
from august_jax.models import August, create

_CLIP = 1.0


class TrainState(NamedTuple):
    """Everything that training carries from step to step; a pytree.

    Attributes:
        params: the networks' parameters, a float32 vector in the order of the leaves of ``models.create``'s state.
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


@dataclass(frozen=True)
class Networks:
    """What turns a vector of parameters into networks; hashable, so that it may be static under jit."""

    graphdef: nnx.GraphDef
    structure: jax.tree_util.PyTreeDef
    shapes: tuple[tuple[int, ...], ...]

    def arrays(self, params: jax.Array | np.ndarray) -> nnx.State:
        """The networks' arrays, as ``models.create`` orders them; NumPy stays NumPy, so that nothing compiles."""
        split = np.split if isinstance(params, np.ndarray) else jnp.split
        pieces = split(params, np.cumsum([math.prod(shape) for shape in self.shapes])[:-1])
        return jax.tree.unflatten(self.structure, [a.reshape(shape) for a, shape in zip(pieces, self.shapes)])

    def __call__(self, params: jax.Array) -> August:
        return nnx.merge(self.graphdef, self.arrays(params))


def optimizer(train: TrainConfig) -> optax.GradientTransformation:
    """Clip, then Adam with the learning rate falling linearly over ``train.steps``."""
    rate = optax.linear_schedule(*train.learning_rate, train.steps)
    return optax.chain(optax.clip_by_global_norm(_CLIP), optax.adam(rate))


def initial_state(config: Config) -> tuple[Networks, TrainState]:
    """The networks' form, and the state before the first step, both from ``config.train.seed``."""
    graphdef, arrays = create(config, config.train.seed)
    leaves, structure = jax.tree.flatten(arrays)
    params = jnp.asarray(np.concatenate([np.ravel(leaf) for leaf in leaves]))
    key = jax.random.fold_in(jax.random.key(config.train.seed), 1)
    state = TrainState(params, jnp.copy(params), optimizer(config.train).init(params), jnp.zeros((), jnp.int32), key)
    return Networks(graphdef, structure, tuple(leaf.shape for leaf in leaves)), state


def train_step(networks: Networks, train: TrainConfig, state: TrainState,
               batch: Mapping[str, jax.Array]) -> tuple[TrainState, dict[str, jax.Array]]:
    """The state after one step on ``batch`` (see ``August.loss``), and what to report: each a float32 ().

    Reported are ``loss``, its unweighted terms, and ``gradient``, the global norm before clipping.
    """
    # On a CPU each shape drawn by the default generator costs 1-4 s of compilation, by "rbg" 0.3 s.
    seed = jax.random.key_data(jax.random.fold_in(state.key, state.step))
    key = jax.random.wrap_key_data(jnp.concatenate([seed, seed]), impl="rbg")

    def loss(params):
        return networks(params).loss(key, batch, train)

    (value, terms), gradient = jax.value_and_grad(loss, has_aux=True)(state.params)
    updates, opt_state = optimizer(train).update(gradient, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    done = state.step + 1
    decay = jnp.minimum(train.ema, (1.0 + done) / (10.0 + done))
    ema = decay * state.ema + (1.0 - decay) * params
    report = {"loss": value, **terms, "gradient": jnp.linalg.norm(gradient)}
    return TrainState(params, ema, opt_state, done, state.key), report


compiled_step = jax.jit(train_step, static_argnums=(0, 1), donate_argnums=2)
""":func:`train_step`, compiled once for equal networks and settings; the state that goes in is donated."""
