"""The trained networks, whatever their ``model.scheme``: cloud, its mean as the position, the plane of its rotors.

Where several are compared, each is a line of its own, by the name that :func:`lines_of` gives it.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Float

from august_jax.arrays import Array
from august_jax.config import Config, NetworkScheme
from august_jax.models import Networks
from august_jax.scene.cloud import WorldCloud, from_cloud
from august_jax.schemes.answer import Answer, Ask, Scheme, Setting, Slots
from august_jax.signal.roi import Coefficients
from august_jax.tracking.attitude import cloud_normals

TITLES: dict[NetworkScheme, str] = {
    "august": "AUGUST",
    "noebd": "AUGUST-NoEBD",
    "nolatent": "AUGUST-NoLatent",
    "refchannel": "RefChannel-Diff",
}
"""The compared networks as the paper calls them."""


def title_of(networks: Networks) -> str:
    """What networks are, for people: the paper's name, and the encoder."""
    model = networks.config.model
    return f"{TITLES[model.scheme]}, encoder {model.encoder}"


def lines_of(networks: Sequence[Networks]) -> dict[str, Networks]:
    """Networks by scheme and encoder, such as ``noebd_roi``; further ones that are alike get a number, ``noebd_roi_2``.

    Args:
        networks: in the order in which they are to stand.
    """
    lines: dict[str, Networks] = {}
    for each in networks:
        model = each.config.model
        name = f"{model.scheme}_{model.encoder}"
        taken = sum(line == name or line.startswith(f"{name}_") for line in lines)
        lines[f"{name}_{taken + 1}" if taken else name] = each
    return lines


@partial(jax.jit, static_argnames="config")
def _reconstructed(
    networks: Networks,
    config: Config,
    key: jax.Array,
    heard: Array | Coefficients,
    predicted: Float[Array, "batch 3"],
    snr_db: Float[Array, " batch"],
) -> WorldCloud:
    """Clouds of B slots in the world, drawn by the networks; arguments as of :meth:`Networks.reconstruct`."""
    return from_cloud(networks.reconstruct(key, heard, predicted, snr_db, config), predicted, config.region)


def _prepare(setting: Setting) -> Ask | None:
    networks = setting.networks
    if networks is None:
        return None

    def ask(key: jax.Array, slots: Slots) -> Answer:
        cloud_key, normal_key = jax.random.split(key)
        cloud = _reconstructed(networks, setting.config, cloud_key, slots.heard, slots.predicted, slots.snr_db)
        normal, triple = cloud_normals(normal_key, cloud.points)
        return Answer(jnp.mean(cloud.points, axis=1), normal, triple, cloud)

    return ask


AUGUST = Scheme("august", "the networks", _prepare, hears=True)
