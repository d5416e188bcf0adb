"""What several commands share: where they write, and from which configuration or weights they start."""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from august_jax import config as configuration
from august_jax.config import Config, ConfigError

if TYPE_CHECKING:
    from august_jax.pipeline import Networks

_MARKS = {"manifest.json": "august simulate", "checkpoints": "august train", "weights.npz": "august train",
          "clouds.npz": "august demo or august reconstruct"}
"""What is in a folder -> which command keeps its config.yaml there."""


def folder(args: argparse.Namespace, default: str, *, configured: bool = False) -> Path:
    """Where the command writes; refused before the work where nothing can be written there.

    With ``configured``, also refused where the ``config.yaml`` is another command's.
    """
    if args.out == "":
        raise ConfigError("--out: '' names no folder; leave it out, or give one")
    out = Path(args.out or default)
    for mark, owner in _MARKS.items():
        if configured and (out / mark).exists() and f"august {args.command}" not in owner:
            raise ConfigError(f"--out: {out} holds what {owner} wrote ({mark}), which august {args.command} would "
                              "damage; choose another folder")
    parent = next(path for path in (out, *out.absolute().parents) if path.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise ConfigError(f"--out: nothing can be written to {out}, because {parent} is "
                          f"{'read-only' if parent.is_dir() else 'a file'}; choose another folder")
    return out


def chosen_config(args: argparse.Namespace) -> Config:
    """The preset (``laptop`` unless named) with its overrides."""
    return configuration.override(configuration.preset(args.preset or "laptop"), args.overrides)


def chosen_weights(args: argparse.Namespace, run: str | None) -> tuple[Networks, Config]:
    """Networks, and their configuration with the overrides that they allow."""
    from august_jax import pipeline

    networks = pipeline.load_networks(run)
    if args.preset:
        configuration.preset(args.preset)  # refuses unknown ones
    if args.preset and args.preset != networks.config.preset:
        raise ConfigError(
            f"preset: {args.preset!r}, but these weights were trained with preset {networks.config.preset!r}\n"
            f"train your own: august simulate --preset {args.preset}, then august train --preset {args.preset}"
        )
    config = configuration.override(networks.config, args.overrides)
    for path, has, wanted in differences(networks.config, config, ("array", "region", "model", "flight.box_m")):
        raise ConfigError(f"{path}={wanted}: the weights were trained with {has} and only fit that\n"
                          "train weights of your own (august simulate, august train) to change it")
    return networks, config


def differences(first: Config, second: Config, sections: Sequence[str]) -> list[tuple[str, Any, Any]]:
    """Fields below ``sections`` in which two configurations differ: (path, value in the first, in the second)."""
    left, right = _leaves(configuration.to_dict(first)), _leaves(configuration.to_dict(second))
    return [(path, left[path], right[path]) for path in left
            if any(path == each or path.startswith(each + ".") for each in sections) and left[path] != right[path]]


def _leaves(tree: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in tree.items():
        flat.update(_leaves(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value})
    return flat
