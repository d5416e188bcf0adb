"""One gradient step: a state pytree, a pure function of (state, batch), compiled once by its caller.

Adam under a linearly falling learning rate (paper, Section VI-A), the gradient clipped to a global norm of 1, and an
exponential moving average of the parameters. Evaluation uses the average. It starts with a short memory,
min(decay, (1 + n)/(10 + n)) after n steps, so that it is useful from the beginning.

All parameters travel as one vector, which the step splits into the networks' arrays. The optimiser is then a handful
of kernels instead of several for each of a hundred arrays, and the step compiles in half the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import nnx
from jax.sharding import Mesh
from jaxtyping import Float, Int, Key

from august_jax import streams
from august_jax.arrays import Array
from august_jax.config import Config, TrainConfig
from august_jax.data.fields import Batch
from august_jax.mesh import SPLIT, WHOLE, mean_over_devices, spread
from august_jax.models import August, State, create

Loss = Callable[[Array, Array, Any], tuple[Array, Mapping[str, Array]]]
"""(parameters (n,), key, batch) -> the loss () and its terms by name; hashable, so that it may be static under jit."""

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

    params: Float[Array, " parameters"]
    ema: Float[Array, " parameters"]
    opt_state: Any
    step: Int[Array, ""]
    key: Key[Array, ""]


@dataclass(frozen=True)
class ParameterLayout:
    """Where in a vector of parameters each of the networks' arrays lies; hashable, so that it may be static under jit.

    Attributes:
        graphdef: of the networks, as ``models.create`` splits them.
        structure: of their state as a pytree.
        shapes: of its leaves, in order.
    """

    graphdef: nnx.GraphDef
    structure: jax.tree_util.PyTreeDef
    shapes: tuple[tuple[int, ...], ...]

    def arrays(self, params: Float[Array, " parameters"]) -> State:
        """The networks' arrays, as ``models.create`` orders them; NumPy stays NumPy, so that nothing compiles."""
        ends = np.cumsum([math.prod(shape) for shape in self.shapes])[:-1]
        pieces: Any = np.split(params, ends) if isinstance(params, np.ndarray) else jnp.split(params, ends)
        return jax.tree.unflatten(self.structure, [a.reshape(shape) for a, shape in zip(pieces, self.shapes)])

    def networks(self, params: Float[Array, " parameters"]) -> August:
        """The networks of these parameters."""
        return nnx.merge(self.graphdef, self.arrays(params))

    def loss(
        self, params: Float[Array, " parameters"], key: Key[Array, ""], batch: Batch
    ) -> tuple[Float[jax.Array, ""], dict[str, Float[jax.Array, ""]]]:
        """:meth:`August.loss` of a batch, a :data:`Loss`."""
        return self.networks(params).loss(
            key, batch.heard, batch.predicted, batch.snr_db, batch.cloud, batch.reference_channel
        )


L = TypeVar("L", bound=ParameterLayout)


def optimizer(train: TrainConfig) -> optax.GradientTransformation:
    """Clip, then Adam with the learning rate falling linearly over ``train.steps``."""
    rate = optax.linear_schedule(*train.learning_rate, train.steps)
    return optax.chain(optax.clip_by_global_norm(_CLIP), optax.adam(rate))


def initial_state(config: Config) -> tuple[ParameterLayout, TrainState]:
    """The networks' form, and the state before the first step, both from ``config.train.seed``."""
    return laid_out(ParameterLayout, config.train, *create(config, config.train.seed))


def laid_out(kind: type[L], train: TrainConfig, graphdef: nnx.GraphDef, arrays: State) -> tuple[L, TrainState]:
    """The form of networks that were split, as a ``kind`` that says what their loss is, and the state before the first
    step."""
    leaves, structure = jax.tree.flatten(arrays)
    params = jnp.asarray(np.concatenate([np.ravel(leaf) for leaf in leaves]))
    key = streams.key(train.seed, "train.step")
    state = TrainState(params, jnp.copy(params), optimizer(train).init(params), jnp.zeros((), jnp.int32), key)
    return _only(kind(graphdef, structure, tuple(leaf.shape for leaf in leaves))), state


@cache
def _only(layout: L) -> L:
    """The first of equal forms: methods of two objects are never equal, and so a step that is compiled for a loss would
    be compiled, and kept, for every run of a process."""
    return layout


def train_step(
    loss: Loss, train: TrainConfig, state: TrainState, batch: Any, mesh: Mesh | None = None
) -> tuple[TrainState, dict[str, Float[Array, ""]]]:
    """The state after one step on a batch of what ``loss`` takes, and the numbers of the step, each a float32 ().

    The numbers are ``loss``, its unweighted terms, and ``gradient``, the global norm before clipping.

    With a ``mesh`` of several devices each works on its rows of the batch, and losses and gradients are averaged over
    them: a loss must be a mean over rows, whose draws are :func:`~august_jax.mesh.own_rows`.
    """
    # On a CPU each shape drawn by the default generator costs 1-4 s of compilation, by "rbg" 0.3 s.
    seed = jax.random.key_data(jax.random.fold_in(state.key, state.step))
    key = jax.random.wrap_key_data(jnp.concatenate([seed, seed]), impl="rbg")

    def found(params: Array, key: Array, batch: Any) -> Any:
        return mean_over_devices(jax.value_and_grad(loss, has_aux=True)(params, key, batch))

    if mesh is not None:
        found = spread(found, mesh, (WHOLE, WHOLE, SPLIT), WHOLE)
    (value, terms), gradient = found(state.params, key, batch)
    updates, opt_state = optimizer(train).update(gradient, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    done = state.step + 1
    decay = jnp.minimum(train.ema, (1.0 + done) / (10.0 + done))
    ema = decay * state.ema + (1.0 - decay) * params
    numbers = {"loss": value, **terms, "gradient": jnp.linalg.norm(gradient)}
    return TrainState(params, ema, opt_state, done, state.key), numbers


compiled_step = jax.jit(train_step, static_argnums=(0, 1), static_argnames="mesh", donate_argnums=2)
""":func:`train_step`, compiled once for equal losses, settings and meshes; the state that goes in is donated."""
