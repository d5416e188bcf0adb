"""Named configurations, each with the command that trains it, what that takes and what to expect of the result."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from august_jax.config.fields import ConfigError, near
from august_jax.config.schema import (
    ArrayConfig,
    Config,
    DataConfig,
    EvaluateConfig,
    FlightConfig,
    ModelConfig,
    RegionConfig,
    SignalConfig,
    TargetConfig,
    TrainConfig,
)
from august_jax.config.text import override
from august_jax.config.ties import DATA_SECTIONS, check_data


@dataclass(frozen=True)
class Preset:
    """A named configuration and its promise.

    Attributes:
        summary: what it is for.
        build: makes the configuration when it is first asked for, which the command line's help never does.
        command: makes data and weights with it, and scores them.
        time: what the command takes, on what machine.
        expected: the score.
    """

    summary: str
    build: Callable[[], Config]
    command: str
    time: str
    expected: str

    @cached_property
    def config(self) -> Config:
        """Every field."""
        return self.build()


def _paper() -> Config:
    # 0.3 mm of skin is 91 cm^3 (quad_plus) to 111 cm^3 (octo) of material: at 25 dBm the median SNR over the box is 14
    # to 16 dB (experiments/link_budget.py), so that 10 to 40 dBm move it from -1 to 30 dB.
    return Config(
        target=TargetConfig(half_wheelbase_m=0.35, cell_m=0.016, skin_m=0.0003),
        flight=FlightConfig(style="dynamic"),  # `smooth` tilts by 6 degrees (median), the paper's drones by up to 30
        signal=SignalConfig(draw="power", estimator="ls"),
        evaluate=EvaluateConfig(sampler="ancestral"),
    )


def _laptop() -> Config:
    # Heading and material hardly change within a flight: short flights show four times as many in as many samples.
    return Config(
        preset="laptop",
        flight=FlightConfig(box_m=((3.0, 7.0), (4.0, 8.0), (2.0, 5.0)), style="dynamic", slots=5),
        region=RegionConfig(scale_m=0.75),
        data=DataConfig(count=200_000, observed=False),
        model=ModelConfig(
            encoder="roi",
            latent=64,
            flow_layers=6,
            flow_features=64,
            fourier=4,
            denoiser=(64, 128, 256, 256, 128, 64),
            time_embedding="log_snr",
            frame="craft",
        ),
        train=TrainConfig(
            steps=12_000, batch=256, points=6, learning_rate=(1e-3, 1e-5), reobserve=True, weight_readout=1.0
        ),
    )


def _smoke(laptop: Config) -> Config:
    return replace(
        laptop,
        preset="smoke",
        array=ArrayConfig(nx=4, nz=2),
        target=TargetConfig(airframes=("quad_x", "hexa"), cell_m=0.03, max_cells=200, points=64),
        flight=replace(laptop.flight, slots=8),
        data=DataConfig(count=64, shard_rows=32, observed=False),
        model=replace(
            laptop.model,
            channel_features=32,
            encoder_features=32,
            encoder_layers=2,
            latent=8,
            flow_layers=2,
            flow_features=16,
            denoiser=(16, 32, 16),
            steps=20,
        ),
        train=replace(laptop.train, steps=20, batch=16, points=16, log_every=5, save_every=10),
        evaluate=EvaluateConfig(snr_db=(10.0, 30.0), count=8, sampler_steps=4, searched=4),
    )


def _command(name: str, scored: str) -> str:
    return f"august simulate --preset {name} && august train --preset {name} && august evaluate {scored}"


PRESETS: dict[str, Preset] = {
    "smoke": Preset(
        summary="for tests: every part of the path, none of it good",
        build=lambda: _smoke(_laptop()),
        command=_command("smoke", "august_runs/smoke --seed 1"),
        time="about four minutes on two CPU cores, most of it compiling the search (evaluate.searched=0: one)",
        expected="none: twenty steps learn nothing",
    ),
    "laptop": Preset(
        summary="flights near the base station, where one tone carries enough; two CPU cores",
        build=_laptop,
        command=_command("laptop", "august_runs/laptop --seed 1 evaluate.count=200"),
        time="on two CPU cores simulate: half an hour (104 samples/s), train: twenty minutes where nothing else runs "
        "(2700 samples/s, benchmarks/training.py), an hour beside other work (950)",
        expected="at 20 dB MPE 0.12 to 0.14 m where answering the prediction errs by 0.48 m (the shipped weights, "
        "of four times the steps on a stream: 0.112 m, MDE 0.028, WD -16.5 dB; five real drones: 0.138 m)",
    ),
    "paper": Preset(
        summary="the paper's settings, its misprints corrected; one GPU",
        build=_paper,
        command=_command("paper", "august_runs/paper --seed 1"),
        time="simulate: five to six minutes for the channels alone on two CPU cores (benchmarks/simulator.py, "
        "--parts set), their estimates beside; train: not timed with its 1000 points a cloud; with 100 a step takes "
        "4.3 ms on an NVIDIA H200 (benchmarks/training.py), some two minutes for 31,250. On a stream, which estimates "
        "anew in each step, 17 hours at 131 samples/s there (docs/results.md; quicker since, not timed on one). Never "
        "run to its end",
        expected="not known: it was never trained at its full scale",
    ),
}
"""Name -> preset."""


def preset(name: str) -> Config:
    """The configuration of a preset.

    Raises:
        ConfigError: there is none of that name.
    """
    if name not in PRESETS:
        hint = near(name, list(PRESETS))
        raise ConfigError(
            f"preset: unknown preset {name!r}; {hint + ' ' if hint else ''}choose one of {', '.join(PRESETS)}"
        )
    return PRESETS[name].config


def training_config(
    made: Config, assignments: Sequence[str] = (), *, name: str | None = None, data: Any = "the data"
) -> Config:
    """The configuration to train with on data: networks and training of their preset, all else as they were made.

    Args:
        made: configuration of the data.
        assignments: overrides, as :func:`override` takes them.
        name: the preset that is wanted; None takes that of the data.
        data: their folder, for messages.

    Raises:
        ConfigError: the data are of another preset, or an override asks for what the data are not.
    """
    if name is not None and name != made.preset:
        preset(name)
        raise ConfigError(
            f"preset: {name!r}, but {data} was made with preset {made.preset!r}\n"
            f"ask for {made.preset!r}, or make other data"
        )
    sections = {section: getattr(made, section) for section in DATA_SECTIONS}
    config = override(preset(made.preset), assignments, sections)
    check_data(config, made, data)
    return config
