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
        [[0.0767, -0.6291, -0.2389, 0.9892, 0.5413], [0.0637, -0.4672, -0.1017, 0.9907, 0.5432]],
        [[-0.1123, 0.3437, 0.1431, 0.9798, 0.546], [-0.1945, 0.3811, 0.1614, 0.9796, 0.5462]],
    ],
    "ancestral": [
        [[-0.1333, -0.7535, 0.0197, 0.9902, 0.5453], [0.3231, -0.3576, -0.2027, 0.9928, 0.5444]],
        [[-0.2164, 0.315, 0.1066, 0.9781, 0.5457], [-0.1177, 0.4526, 0.1697, 0.9795, 0.5459]],
    ],
}
READINGS = [
    [-0.3268, -0.3033, -0.1054, 0.99, 0.544, 0.3197, -0.232, 0.9235],
    [0.2344, 0.3539, 0.1648, 0.9794, 0.5461, -0.6279, -0.0626, 0.8628],
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
