"""Training: the gradient step, the run around it, and what it leaves on disk."""

from august_jax.training.checkpoint import Checkpoints, load_weights, save_weights
from august_jax.training.loop import train
from august_jax.training.step import ParameterLayout, TrainState, compiled_step, initial_state, train_step

__all__ = [
    "Checkpoints",
    "ParameterLayout",
    "TrainState",
    "compiled_step",
    "initial_state",
    "load_weights",
    "save_weights",
    "train",
    "train_step",
]
