"""august_jax: sensing drones with a base station's antenna array.

A differentiable full-wave simulator (:mod:`august_jax.physics`), flights of airframes (:mod:`august_jax.scene`),
what the base station receives (:mod:`august_jax.signal`) and the AUGUST generative model
(:mod:`august_jax.models`). Subpackages are imported where they are used, so that this import stays light.

On import, ``XLA_FLAGS`` is told not to fuse sums on CPUs, where jaxlib 0.10 fuses some of them wrongly (a sum that is
broadcast again comes out as another row's). JAX reads the variable when it first computes: import august_jax before
that. ``august doctor`` says whether sums come out right.
"""

import os
from importlib.metadata import version

__version__ = "0.1.0"

UNFUSED_SUMS = "--xla_cpu_experimental_ynn_fusion_type=-reduce"
"""What ``XLA_FLAGS`` is told; a setting of the user's own stays."""
# Other versions may not know the flag, and XLA ends the process at flags that it does not know.
if version("jaxlib").startswith("0.10.") and UNFUSED_SUMS.split("=")[0] not in os.environ.get("XLA_FLAGS", ""):
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {UNFUSED_SUMS}".strip()
