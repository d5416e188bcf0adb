"""AUGUST's networks: flax modules that see arrays, never meshes."""

from august_jax.models.august import August, State, create, parameter_count, reconstruct
from august_jax.models.craft import CraftFrame, Reading
from august_jax.models.encoder import Seen
from august_jax.models.networks import Networks

__all__ = ["August", "CraftFrame", "Networks", "Reading", "Seen", "State", "create", "parameter_count", "reconstruct"]
