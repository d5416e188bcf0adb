"""The shipped weights: they are whole, and give the clouds that they gave when they were scored."""

import jax
import numpy as np
from flax import nnx

from august_jax.config import override
from august_jax.physics import PlanarArray
from august_jax.pipeline import load_networks

PREDICTED = np.array([[5.0, 6.0, 3.0], [4.0, 5.5, 4.0]], np.float32)
OFFSETS = np.array([[0.2, -0.1, 0.05], [-0.1, 0.3, 0.1]])
SNR_DB = np.array([20.0, 10.0], np.float32)
# Clouds of two points, and what is read of them, as these weights gave them when their card was written.
CLOUDS = {
    "dpm": [
        [[-0.2058, -0.7436, -0.1731, 0.9548, 0.5504], [-0.0656, -0.5501, -0.0569, 0.9083, 0.55]],
        [[-0.1273, 0.2612, 0.1087, 1.0616, 0.5953], [-0.2237, 0.312, 0.1309, 1.054, 0.5949]],
    ],
    "ancestral": [
        [[-0.3458, -0.6134, 0.0202, 0.9207, 0.5555], [0.2713, -0.5546, -0.1773, 0.9471, 0.5778]],
        [[-0.294, 0.2753, 0.0723, 1.0739, 0.5853], [-0.0119, 0.2376, 0.0931, 1.0491, 0.5864]],
    ],
}
READINGS = [
    [-0.4124, -0.2701, -0.1156, 0.9169, 0.5522, 0.3384, -0.1053, 0.9241],
    [0.1729, 0.3433, 0.1382, 1.0621, 0.5905, -0.5737, -0.0391, 0.8799],
]


def four_arms(centre):
    """The channel (1, 64, 64) of a made-up craft: four points about its centre (3,) [m], each seen two ways."""
    array = PlanarArray(16, 4, 3e9)
    points = centre + 0.25 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    distance = np.linalg.norm(points[:, None] - array.positions, axis=-1)
    waves = np.exp(1j * array.wavenumber * distance) / distance
    return (1e-3 * np.einsum("pm,pn->mn", waves, waves)).astype(np.complex64)[None]


def test_the_shipped_weights_give_the_clouds_that_were_scored():
    networks = load_networks()
    channels = np.stack([four_arms(place) for place in PREDICTED + OFFSETS])
    for sampler, expected in CLOUDS.items():
        config = override(networks.config, [f"evaluate.sampler={sampler}", "target.points=6"])
        clouds = networks.reconstruct(jax.random.key(7), channels, PREDICTED, SNR_DB, config)
        assert clouds.shape == (2, 6, 5)
        np.testing.assert_allclose(clouds[:, :2], expected, atol=1e-3)
    model = nnx.merge(networks.graphdef, networks.state)

    @jax.jit
    def read():
        seen = model.see(channels, PREDICTED, SNR_DB)
        return model.readout(model.condition(seen), seen)

    reading = read()
    numbers = np.concatenate([reading.place, reading.material, reading.normal], axis=-1)
    np.testing.assert_allclose(numbers, READINGS, atol=1e-3)


def test_networks_are_a_pytree_of_their_parameters():
    """So that a compiled function takes them as an argument, and equal ones do not compile it again."""
    networks = load_networks()
    compiled = jax.jit(lambda networks: networks.state)
    compiled(networks)
    compiled(load_networks())
    assert compiled._cache_size() == 1
    assert len(jax.tree.leaves(networks)) == len(jax.tree.leaves(networks.state))
