"""AUGUST's networks: flax modules that see arrays, never meshes."""

from august_jax.models.august import August, create, parameter_count, reconstruct

__all__ = ["August", "create", "parameter_count", "reconstruct"]
