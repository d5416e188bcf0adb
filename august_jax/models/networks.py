"""Trained networks with the configuration that they were trained with: what reconstructs."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
from flax import nnx
from jaxtyping import Float, Key

from august_jax.arrays import Array
from august_jax.config import Config
from august_jax.models.august import State, reconstruct
from august_jax.models.encoder import Heard


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Networks:
    """Parameters and all that gives them their meaning; a pytree whose leaves are the parameters.

    Attributes:
        name: where they come from, for people.
        config: that of their training.
        graphdef, state: as ``models.create`` splits the networks.
    """

    name: str = field(metadata={"static": True})
    config: Config = field(metadata={"static": True})
    graphdef: nnx.GraphDef = field(metadata={"static": True})
    state: State

    def reconstruct(
        self,
        key: Key[Array, ""],
        heard: Heard,
        predicted: Float[Array, "batch 3"],
        snr_db: Float[Array, " batch"],
        config: Config | None = None,
    ) -> Float[jax.Array, "batch points 5"]:
        """Clouds (B, ``target.points``, 5) by the sampler of ``evaluate.sampler``; see :func:`models.reconstruct`.

        Args:
            key: of the sampler.
            heard, predicted, snr_db: as :meth:`August.see` takes them.
            config: that of the networks, possibly with another sampler and number of points; None takes their own.
        """
        config = self.config if config is None else config
        return reconstruct(
            self.graphdef,
            self.state,
            key,
            heard,
            predicted,
            snr_db,
            count=config.target.points,
            sampler=config.evaluate.sampler,
            steps=config.evaluate.sampler_steps,
        )
