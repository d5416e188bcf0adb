"""Every number of a run in one tree of frozen dataclasses: presets, dotted overrides, YAML round trip.

Presets (:func:`preset`): ``smoke`` runs in seconds and is for tests; ``laptop`` places the flights near the
base station, where one tone carries enough information, and trains on two CPU cores; ``paper`` holds the
paper's numbers to the letter and wants a GPU.

This module imports nothing but the standard library and PyYAML, so that the command line stays quick.
"""

from __future__ import annotations

import dataclasses
import difflib
import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

Range = tuple[float, float]


class ConfigError(ValueError):
    """A field of the configuration is unknown or holds a value that cannot work."""


@dataclass(frozen=True)
class ArrayConfig:
    """The base station's half-wavelength planar array in the x-O-z plane (paper, Section II-A)."""

    nx: int = 16
    nz: int = 4
    frequency_hz: float = 3e9
    tones_hz: tuple[float, ...] = ()
    """Sounding frequencies [Hz]; empty means the carrier alone."""

    @property
    def count(self) -> int:
        """Number of antennas N_b."""
        return self.nx * self.nz

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """The tones that are sounded: ``tones_hz``, or the carrier alone."""
        return self.tones_hz or (self.frequency_hz,)


@dataclass(frozen=True)
class TargetConfig:
    """What flies: airframes, their lattice of cells and the range of their materials (paper, Section VI-A)."""

    airframes: tuple[str, ...] = ("quad_x", "quad_plus", "hexa", "octo", "coaxial_y6")
    """Names of procedural families, or paths of mesh files (metres, z up, x forward)."""
    half_wheelbase_m: float = 0.25
    """Every airframe is scaled to this half-wheelbase [m]."""
    cell_m: float = 0.012
    """Edge of the lattice cells [m]."""
    skin_m: float = 0.002
    """Thickness of the material about the surface [m]."""
    max_cells: int = 1200
    """An airframe that needs more cells than this gets a coarser lattice."""
    permittivity: Range = (1.5, 5.0)
    conductivity_s_m: Range = (1e-3, 1e-2)
    points: int = 1000
    """Points of the label cloud, M."""


@dataclass(frozen=True)
class FlightConfig:
    """Random flights (paper, Section VI-A): a box, a style, slots."""

    box_m: tuple[Range, Range, Range] = ((10.0, 30.0), (10.0, 30.0), (10.0, 20.0))
    style: str = "smooth"
    """``smooth``, ``dynamic`` or ``jump``."""
    slots: int = 50
    slot_s: float = 0.2
    tilt_deg: float = 30.0
    """Largest tilt of the thrust axis [deg]."""


@dataclass(frozen=True)
class RegionConfig:
    """The reconstruction region about the predicted position (paper, eq. 5D pc)."""

    scale_m: float = 0.85
    """s, the scale that divides positions: half-wheelbase plus prediction threshold [m]."""
    threshold_m: float = 0.5
    """The prediction misses by up to this much along each axis, uniformly [m]."""
    permittivity_max: float = 5.0
    conductivity_max_s_m: float = 1e-2


@dataclass(frozen=True)
class SignalConfig:
    """Pilots, power, noise and the channel estimator (paper, Sections II-A and II-B)."""

    beam_width_deg: tuple[float, float] = (30.0, 30.0)
    """Full widths of the RoI sector in azimuth and elevation [deg]."""
    mirror_beams: bool = False
    """True: the sign that the paper prints, which points at the mirror direction."""
    symbols: int = 0
    """L; 0 means one symbol an antenna."""
    pilots: str = "unitary"
    """``unitary`` (scrambled DFT) or ``gaussian``."""
    estimator: str = "lmmse_roi"
    """``ls``, ``ridge``, ``lmmse_roi`` or ``dft``."""
    noise_dbm: float = -120.0
    draw: str = "snr"
    """``snr``: draw the SNR and set the power to it; ``power``: draw the transmit power."""
    snr_db: Range = (0.0, 30.0)
    power_dbm: Range = (10.0, 40.0)


@dataclass(frozen=True)
class DataConfig:
    """How many samples, from which seed, in which pieces."""

    count: int = 50_000
    seed: int = 0
    shard_rows: int = 2_000
    split: tuple[int, int, int] = (8, 1, 1)
    """Train : validation : test, by flight."""
    solver: str = "mom"
    """``mom``, ``krylov``, ``local_field_born`` or ``born``."""
    observed: bool = True
    """Keep with every sample what the base station made of it (prediction, SNR, H_est); needed where
    ``train.reobserve`` is false."""


@dataclass(frozen=True)
class ModelConfig:
    """AUGUST's networks (paper, Section IV and Section VI-A)."""

    scheme: str = "august"
    """``august``, ``noebd``, ``nolatent`` or ``refchannel``."""
    encoder: str = "paper"
    """``paper``: linear map of vec(H); ``roi``: the RoI's field subspace."""
    channel_features: int = 256
    """d_v = d_p, width of the embedded channel vector."""
    encoder_features: int = 512
    """d_f, width of the residual MLP."""
    encoder_layers: int = 6
    latent: int = 256
    """d_z."""
    fourier: int = 10
    """d_xi, number of octaves of the position and SNR features."""
    raw_metres: bool = False
    """True: Fourier features of q_pre in metres, as printed; False: of q_pre mapped from the box to [-1, 1]."""
    flow_layers: int = 14
    flow_features: int = 256
    denoiser: tuple[int, ...] = (16, 64, 128, 256, 512, 1024, 512, 256, 128, 64, 16)
    """Hidden widths; input and output are 5."""
    time_embedding: str = "paper"
    """``paper``: s/S and two octaves of sin, cos; ``log_snr``: Fourier features of the log-SNR of the noising."""
    frame: str = "region"
    """Where points are diffused: ``region`` (the paper's), or ``craft``: about the place, along the thrust axis and
    the heading of one craft, on which a cloud settles before its points are drawn; needs ``train.weight_readout``."""
    steps: int = 200
    """S, diffusion steps."""
    beta: Range = (1e-4, 0.05)


@dataclass(frozen=True)
class TrainConfig:
    """Optimisation (paper, Section V and Section VI-A)."""

    steps: int = 31_250
    """Gradient steps; the paper's 200 epochs of 40,000 samples at 256 a step."""
    batch: int = 256
    points: int = 1000
    """Random points of each cloud that a step uses."""
    learning_rate: Range = (1e-4, 1e-5)
    """First and last learning rate; linear in between."""
    weight_position: float = 0.9
    weight_material: float = 0.1
    weight_latent: float = 1e-4
    weight_readout: float = 0.0
    """Weight of a linear reading of the cloud's moments from the latent; not in the paper, 0 leaves it out."""
    ema: float = 0.999
    """Decay of the parameters' moving average, which is what is evaluated."""
    seed: int = 0
    reobserve: bool = False
    """True: every step draws a new prediction, SNR, pilots and noise for the stored channels."""
    log_every: int = 50
    save_every: int = 1_000


@dataclass(frozen=True)
class EvaluateConfig:
    """What ``august evaluate`` measures."""

    snr_db: tuple[float, ...] = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
    count: int = 500
    """Samples at each SNR."""
    sampler: str = "dpm"
    """``dpm`` (DPM-Solver++ 2M) or ``ancestral``."""
    sampler_steps: int = 10


@dataclass(frozen=True)
class Config:
    """One run of august_jax: everything that its numbers depend on."""

    preset: str = "paper"
    array: ArrayConfig = field(default_factory=ArrayConfig)
    target: TargetConfig = field(default_factory=TargetConfig)
    flight: FlightConfig = field(default_factory=FlightConfig)
    region: RegionConfig = field(default_factory=RegionConfig)
    signal: SignalConfig = field(default_factory=SignalConfig)
    data: DataConfig = field(default_factory=DataConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)

    def __post_init__(self):
        _validate(self)


PRESETS = ("smoke", "laptop", "paper")


def preset(name: str) -> Config:
    """The named configuration; :class:`ConfigError` for an unknown name."""
    # 0.3 mm of skin is 91 cm^3 (quad_plus) to 111 cm^3 (octo) of material: at 25 dBm the median SNR over the box is 14
    # to 16 dB (experiments/link_budget.py), so that 10 to 40 dBm move it from -1 to 30 dB.
    paper = Config(
        target=TargetConfig(half_wheelbase_m=0.35, cell_m=0.016, skin_m=0.0003),
        flight=FlightConfig(style="dynamic"),  # `smooth` tilts by 6 degrees (median), the paper's drones by up to 30
        signal=SignalConfig(draw="power", estimator="ls"),
        evaluate=EvaluateConfig(sampler="ancestral"),
    )
    # Heading and material hardly change within a flight: short flights show four times as many in as many samples.
    laptop = Config(
        preset="laptop",
        flight=FlightConfig(box_m=((3.0, 7.0), (4.0, 8.0), (2.0, 5.0)), style="dynamic", slots=5),
        region=RegionConfig(scale_m=0.75),
        data=DataConfig(count=200_000, observed=False),
        model=ModelConfig(
            encoder="roi", latent=64, flow_layers=6, flow_features=64, fourier=4,
            denoiser=(64, 128, 256, 256, 128, 64), time_embedding="log_snr", frame="craft",
        ),
        train=TrainConfig(steps=12_000, batch=256, points=6, learning_rate=(1e-3, 1e-5), reobserve=True,
                          weight_readout=1.0),
    )
    smoke = replace(
        laptop,
        preset="smoke",
        array=ArrayConfig(nx=4, nz=2),
        target=TargetConfig(airframes=("quad_x", "hexa"), cell_m=0.03, max_cells=200, points=64),
        flight=replace(laptop.flight, slots=8),
        data=DataConfig(count=64, shard_rows=32, observed=False),
        model=replace(laptop.model, channel_features=32, encoder_features=32, encoder_layers=2, latent=8,
                      flow_layers=2, flow_features=16, denoiser=(16, 32, 16), steps=20),
        train=replace(laptop.train, steps=20, batch=16, points=16, log_every=5, save_every=10),
        evaluate=EvaluateConfig(snr_db=(10.0, 30.0), count=8, sampler_steps=4),
    )
    table = {"smoke": smoke, "laptop": laptop, "paper": paper}
    if name not in table:
        raise ConfigError(f"preset: unknown preset {name!r}; choose one of {', '.join(PRESETS)}")
    return table[name]


def override(config: Config, assignments: Sequence[str]) -> Config:
    """Apply dotted assignments such as ``train.steps=2000`` in order.

    Values are YAML. :class:`ConfigError` names the field, the value and what was wanted.
    """
    import yaml

    tree = to_dict(config)
    for text in assignments:
        path, separator, raw = text.partition("=")
        if path.strip() == "preset":
            raise ConfigError(f"{text}: a preset is not overridden but chosen, with --preset")
        if not separator:
            raise ConfigError(f"override {text!r} is not of the form section.field=value, e.g. train.steps=2000")
        *parents, leaf = path.strip().split(".")
        node: Any = tree
        for depth, key in enumerate([*parents, leaf]):
            if not isinstance(node, dict) or key not in node:
                known = sorted(node) if isinstance(node, dict) else []
                near = difflib.get_close_matches(key, known, n=1)
                hint = f"did you mean {near[0]!r}?" if near else f"known here: {', '.join(known) or 'nothing below'}"
                raise ConfigError(f"{path}: unknown field {key!r}; {hint}")
            if depth < len(parents):
                node = node[key]
        try:
            node[leaf] = yaml.safe_load(raw)
        except yaml.YAMLError as error:
            raise ConfigError(f"{path}: {raw!r} is not a YAML value") from error
    return from_dict(tree)


def to_dict(config: Config) -> dict[str, Any]:
    """Nested dictionaries and lists, fit for YAML and JSON."""
    return json.loads(json.dumps(dataclasses.asdict(config)))


def from_dict(tree: Mapping[str, Any]) -> Config:
    """Inverse of :func:`to_dict`; checks names and types."""
    return _build(Config, tree, "")


def to_yaml(config: Config) -> str:
    """The configuration as YAML text."""
    import yaml

    return yaml.safe_dump(to_dict(config), sort_keys=False)


def from_yaml(text: str) -> Config:
    """Inverse of :func:`to_yaml`."""
    import yaml

    try:
        tree = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"config: the text is not YAML ({str(error).splitlines()[0]})") from None
    if not isinstance(tree, Mapping):
        raise ConfigError("config: the text holds no mapping of sections")
    return from_dict(tree)


def read(path: str | os.PathLike) -> Config:
    """The configuration in a file that :func:`to_yaml` made; :class:`ConfigError` names the file."""
    try:
        return from_yaml(Path(path).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {error}\nit is damaged or of another version; make that folder again") from None


def digest(*parts: Any) -> str:
    """Sixteen hexadecimal digits that identify configuration sections by content."""
    plain = [dataclasses.asdict(part) if dataclasses.is_dataclass(part) else part for part in parts]
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()[:16]


def data_digest(config: Config) -> str:
    """Identity of the samples that ``config`` describes; the count and the shard size are not part of it."""
    return digest(config.array, config.target, config.flight, config.region, config.signal,
                  config.data.seed, config.data.solver)


def _build(kind: type, tree: Mapping[str, Any], path: str) -> Any:
    hints = get_type_hints(kind)
    values = {}
    for key, value in tree.items():
        where = f"{path}{key}"
        if key not in hints:
            raise ConfigError(f"{where}: unknown field; known: {', '.join(hints)}")
        wanted = hints[key]
        if dataclasses.is_dataclass(wanted):
            if not isinstance(value, Mapping):
                raise ConfigError(f"{where}: {value!r} is not a section")
            values[key] = _build(wanted, value, where + ".")
        else:
            values[key] = _coerce(wanted, value, where)
    return kind(**values)


def _coerce(wanted: Any, value: Any, where: str) -> Any:
    if get_origin(wanted) is tuple:
        items = get_args(wanted)
        if isinstance(value, str) or not isinstance(value, Sequence):
            raise ConfigError(f"{where}: {value!r} is not a list; write {where}=[a,b]")
        if items[-1] is Ellipsis:
            return tuple(_coerce(items[0], item, where) for item in value)
        if len(items) != len(value):
            raise ConfigError(f"{where}: {value!r} has {len(value)} values; {len(items)} wanted")
        return tuple(_coerce(item, each, where) for item, each in zip(items, value))
    if wanted is bool and isinstance(value, bool) or wanted is str and isinstance(value, str):
        return value
    if wanted in (int, float) and not isinstance(value, bool):
        try:
            number = float(value)  # YAML reads 1e-3 as text
        except (TypeError, ValueError, OverflowError):
            number = None
        if number is not None and not math.isfinite(number):
            raise ConfigError(f"{where}: {value!r} is not a finite number")
        if number is not None and wanted is float:
            return number
        if number is not None and number.is_integer():
            if abs(number) >= _TOO_MANY:
                raise ConfigError(f"{where}: {value!r} is too large; wanted less than 2^31")
            return int(number)
    raise ConfigError(f"{where}: {value!r} is not {'an integer' if wanted is int else f'a {wanted.__name__}'}")


_TOO_MANY = 2**31  # seeds beyond 2^32 repeat; an evaluation adds 2^30 to them
_CHOICES = {
    "preset": PRESETS,
    "flight.style": ("smooth", "dynamic", "jump"),
    "signal.pilots": ("unitary", "gaussian"),
    "signal.estimator": ("ls", "ridge", "lmmse_roi", "dft"),
    "signal.draw": ("snr", "power"),
    "data.solver": ("mom", "krylov", "local_field_born", "born"),
    "model.scheme": ("august", "noebd", "nolatent", "refchannel"),
    "model.encoder": ("paper", "roi"),
    "model.time_embedding": ("paper", "log_snr"),
    "model.frame": ("region", "craft"),
    "evaluate.sampler": ("dpm", "ancestral"),
}
_POSITIVE = (
    "array.nx", "array.nz", "array.frequency_hz", "target.half_wheelbase_m", "target.cell_m", "target.skin_m",
    "target.max_cells", "target.points", "flight.slots", "flight.slot_s", "flight.tilt_deg", "region.scale_m",
    "region.permittivity_max", "region.conductivity_max_s_m", "data.count", "data.shard_rows",
    "model.channel_features", "model.encoder_features", "model.encoder_layers", "model.latent", "model.fourier",
    "model.flow_layers", "model.flow_features", "model.steps", "train.steps", "train.batch", "train.points",
    "train.log_every", "train.save_every", "evaluate.count", "evaluate.sampler_steps",
)
SNR_LIMIT_DB = 100.0
"""Beyond it single precision has nothing left to tell."""
_RANGES = (
    "target.permittivity", "target.conductivity_s_m", "signal.snr_db", "signal.power_dbm", "model.beta",
)


def _get(config: Config, path: str) -> Any:
    node: Any = config
    for key in path.split("."):
        node = getattr(node, key)
    return node


def _validate(config: Config) -> None:
    for path, choices in _CHOICES.items():
        value = _get(config, path)
        if value not in choices:
            raise ConfigError(f"{path}: unknown value {value!r}; choose one of {', '.join(choices)}")
    for path in _POSITIVE:
        value = _get(config, path)
        if not 0 < value < float("inf"):
            raise ConfigError(f"{path}: {value!r} must be a positive number")
    boxes = [(f"flight.box_m[{axis}]", span) for axis, span in enumerate(config.flight.box_m)]
    for path, (low, high) in [*((path, _get(config, path)) for path in _RANGES), *boxes]:
        if not low <= high:
            raise ConfigError(f"{path}: [{low}, {high}] must not decrease")
    reach = config.target.half_wheelbase_m + config.region.threshold_m
    checks = (
        (bool(config.target.airframes), "target.airframes", config.target.airframes, "name at least one airframe"),
        (config.target.permittivity[0] >= 1.0, "target.permittivity", config.target.permittivity, "must be at least 1"),
        (config.target.conductivity_s_m[0] >= 0.0, "target.conductivity_s_m", config.target.conductivity_s_m,
         "must not be negative"),
        (config.region.threshold_m >= 0.0, "region.threshold_m", config.region.threshold_m, "must not be negative"),
        (config.region.scale_m >= (1.0 - 1e-6) * reach, "region.scale_m", config.region.scale_m,
         f"must reach target.half_wheelbase_m + region.threshold_m; set region.scale_m={reach:g}"),
        (config.target.permittivity[1] <= config.region.permittivity_max, "region.permittivity_max",
         config.region.permittivity_max, f"must reach target.permittivity; set region.permittivity_max="
                                         f"{config.target.permittivity[1]:g}"),
        (config.target.conductivity_s_m[1] <= config.region.conductivity_max_s_m, "region.conductivity_max_s_m",
         config.region.conductivity_max_s_m, f"must reach target.conductivity_s_m; set region.conductivity_max_s_m="
                                             f"{config.target.conductivity_s_m[1]:g}"),
        (len(config.model.denoiser) > 0 and min(config.model.denoiser) > 0, "model.denoiser", config.model.denoiser,
         "needs at least one positive width"),
        (0.0 < config.model.beta[0] and config.model.beta[1] < 1.0, "model.beta", config.model.beta,
         "must lie in (0, 1)"),
        (min(config.data.split) >= 0 and config.data.split[0] > 0, "data.split", config.data.split,
         "needs a positive training share and no negative ones"),
        (config.signal.symbols == 0 or config.signal.symbols >= config.array.count, "signal.symbols",
         config.signal.symbols, f"needs at least one symbol an antenna ({config.array.count}), or 0 for just that"),
        (config.train.points <= config.target.points, "train.points", config.train.points,
         f"must not exceed target.points ({config.target.points})"),
        (all(tone > 0 for tone in config.array.tones_hz), "array.tones_hz", config.array.tones_hz, "must be positive"),
        (config.data.seed >= 0 and config.train.seed >= 0, "seed", (config.data.seed, config.train.seed),
         "data.seed and train.seed must not be negative"),
        (config.evaluate.sampler != "dpm" or 2 <= config.evaluate.sampler_steps <= config.model.steps,
         "evaluate.sampler_steps", config.evaluate.sampler_steps,
         f"must lie between 2 and model.steps ({config.model.steps}) for the sampler dpm"),
        (bool(config.evaluate.snr_db), "evaluate.snr_db", config.evaluate.snr_db, "name at least one SNR"),
        (max(map(abs, config.evaluate.snr_db), default=0.0) <= SNR_LIMIT_DB, "evaluate.snr_db", config.evaluate.snr_db,
         f"must lie within {SNR_LIMIT_DB:g} dB of 0"),
        (max(map(abs, config.signal.snr_db)) <= SNR_LIMIT_DB, "signal.snr_db", config.signal.snr_db,
         f"must lie within {SNR_LIMIT_DB:g} dB of 0"),
        (0.0 < min(config.signal.beam_width_deg) and max(config.signal.beam_width_deg) <= 180.0,
         "signal.beam_width_deg", config.signal.beam_width_deg, "must lie in (0, 180]"),
        (min(config.train.weight_position, config.train.weight_material, config.train.weight_latent,
             config.train.weight_readout) >= 0.0, "train.weight_*", (
                 config.train.weight_position, config.train.weight_material, config.train.weight_latent,
                 config.train.weight_readout), "must not be negative"),
        (min(config.train.learning_rate) > 0.0, "train.learning_rate", config.train.learning_rate, "must be positive"),
        (0.0 <= config.train.ema < 1.0, "train.ema", config.train.ema, "must lie in [0, 1)"),
        (config.model.frame == "region" or config.train.weight_readout > 0, "model.frame", config.model.frame,
         "is read from the latent; set train.weight_readout above 0, or model.frame=region"),
        (config.target.skin_m <= config.target.cell_m, "target.skin_m", config.target.skin_m,
         f"must not exceed target.cell_m ({config.target.cell_m})"),
    )
    for good, path, value, why in checks:
        if not good:
            raise ConfigError(f"{path}: {value!r} {why}")
