"""What must agree: fields within a configuration, and a configuration with the data and the weights that it meets.

Messages name fields and arguments; a command line says which of its options these are.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from august_jax.config.fields import ConfigError, shown

if TYPE_CHECKING:
    from august_jax.config.schema import Config

_MOST_ANTENNAS = 16_384
DATA_SECTIONS = ("array", "target", "flight", "region", "signal", "data")
"""What of a configuration data are made with; the rest is the networks' and the training's."""
WEIGHTS_FIT = ("array", "region", "model", "flight.box_m")
"""What weights are trained for and cannot change afterwards."""


def check_ties(config: Config) -> None:
    """Refuse fields that are sound alone and do not go together.

    Raises:
        ConfigError: names the field to change, its value and the way out.
    """
    array, target, region, train = config.array, config.target, config.region, config.train
    reach = target.half_wheelbase_m + region.threshold_m
    ties = (
        (
            array.count <= _MOST_ANTENNAS,
            "array.nx",
            array.nx,
            f"times array.nz ({array.nz}) is more than {_MOST_ANTENNAS} antennas, a channel of 2 GB",
        ),
        (
            target.permittivity[1] > 1.0 or target.conductivity_s_m[1] > 0.0,
            "target.permittivity",
            target.permittivity,
            f"with target.conductivity_s_m={shown(target.conductivity_s_m)} is that of air, whose echo is zero; raise "
            "either",
        ),
        (
            region.scale_m >= (1.0 - 1e-6) * reach,
            "region.scale_m",
            region.scale_m,
            f"must reach target.half_wheelbase_m + region.threshold_m; set region.scale_m={reach:g}",
        ),
        (
            target.permittivity[1] <= region.permittivity_max,
            "region.permittivity_max",
            region.permittivity_max,
            f"must reach target.permittivity; set region.permittivity_max={target.permittivity[1]:g}",
        ),
        (
            target.conductivity_s_m[1] <= region.conductivity_max_s_m,
            "region.conductivity_max_s_m",
            region.conductivity_max_s_m,
            f"must reach target.conductivity_s_m; set region.conductivity_max_s_m={target.conductivity_s_m[1]:g}",
        ),
        (
            target.skin_m <= target.cell_m,
            "target.skin_m",
            target.skin_m,
            f"must not exceed target.cell_m ({target.cell_m:g})",
        ),
        (config.data.split[0] > 0, "data.split", config.data.split, "needs a share for training, its first number"),
        (
            config.signal.symbols == 0 or config.signal.symbols >= array.count,
            "signal.symbols",
            config.signal.symbols,
            f"needs at least one symbol an antenna ({array.count}), or 0 for just that",
        ),
        (
            train.points <= target.points,
            "train.points",
            train.points,
            f"must not exceed target.points ({target.points})",
        ),
        (
            train.reobserve or config.data.observed,
            "data.observed",
            config.data.observed,
            "leaves out what training without train.reobserve learns from; set data.observed=true or "
            "train.reobserve=true",
        ),
        (
            train.source == "stored" or train.reobserve,
            "train.source",
            train.source,
            "is observed as it is made; set train.reobserve=true, or train.source=stored",
        ),
        (
            train.source == "stored" or config.data.dense_solver == "mom",
            "data.solver",
            config.data.solver,
            "is not what a stream's tables hold; set data.solver=mom or table, or train.source=stored",
        ),
        (
            config.model.frame == "region" or train.weight_readout > 0.0,
            "model.frame",
            config.model.frame,
            "is read from the latent; set train.weight_readout above 0, or model.frame=region",
        ),
        (
            config.evaluate.sampler != "dpm" or 2 <= config.evaluate.sampler_steps <= config.model.steps,
            "evaluate.sampler_steps",
            config.evaluate.sampler_steps,
            f"must lie between 2 and model.steps ({config.model.steps}) for the sampler dpm",
        ),
    )
    for good, path, value, why in ties:
        if not good:
            raise ConfigError(f"{path}: {shown(value)} {why}")


def leaves(config: Config) -> dict[str, Any]:
    """Every value of a configuration by its field's path, such as ``train.steps``."""
    flat: dict[str, Any] = {}
    for name in (each.name for each in dataclasses.fields(config)):
        part = getattr(config, name)
        if dataclasses.is_dataclass(part):
            flat |= {f"{name}.{each.name}": getattr(part, each.name) for each in dataclasses.fields(part)}
        else:
            flat[name] = part
    return flat


def differences(first: Config, second: Config, below: Sequence[str]) -> list[tuple[str, Any, Any]]:
    """Fields in which two configurations differ.

    Args:
        first, second: the two.
        below: sections or single fields to compare, such as ``array`` and ``flight.box_m``.

    Returns:
        Path, value in the first, value in the second.
    """
    left, right = leaves(first), leaves(second)
    return [
        (path, left[path], right[path])
        for path in left
        if any(path == each or path.startswith(each + ".") for each in below) and left[path] != right[path]
    ]


def check_data(config: Config, made: Config, data: Any = "the data") -> None:
    """Refuse to train ``config`` on data that were made with ``made``.

    What is observed anew in every step does not depend on how it was observed when the data were made.

    Args:
        config: of the training.
        made: that the data hold.
        data: their folder, for messages.

    Raises:
        ConfigError: the data's solver is none that the scheme can learn with, or a field that the data depend on has
            another value.
    """
    if config.model.scheme == "refchannel" and config.data.dense_solver != "mom":
        raise ConfigError(
            f"data.solver: {config.data.solver}, but model.scheme=refchannel learns from channels at a reference "
            "place, which tables of bodies make\n"
            "make other data with data.solver=mom or table, or choose another scheme"
        )
    fixed = [name for name in DATA_SECTIONS if not (config.train.reobserve and name in ("region", "signal"))]
    for path, has, wanted in differences(made, config, fixed):
        raise ConfigError(
            f"{path}: {shown(wanted)}, but {data} was made with {shown(has)}\nkeep that value, or make other data"
        )


def check_weights(config: Config, trained: Config) -> None:
    """Refuse to use weights under a configuration that they do not fit.

    Args:
        config: that they are to be used under.
        trained: that they were trained with.

    Raises:
        ConfigError: a field that the weights are made for has another value.
    """
    for path, has, wanted in differences(trained, config, WEIGHTS_FIT):
        raise ConfigError(
            f"{path}: {shown(wanted)}, but the weights were trained with {shown(has)} and only fit that\n"
            "keep that value, or train weights of your own"
        )
