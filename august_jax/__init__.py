"""august_jax: sensing drones with a base station's antenna array.

A differentiable full-wave simulator (:mod:`august_jax.physics`), flights of airframes (:mod:`august_jax.scene`),
what the base station receives (:mod:`august_jax.signal`) and the AUGUST generative model
(:mod:`august_jax.models`). Subpackages are imported where they are used, so that this import stays light.
"""

__version__ = "0.1.0"
