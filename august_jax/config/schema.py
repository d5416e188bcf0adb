"""Every number of a run in one tree of frozen dataclasses.

A field's annotation says its type, its choices (a ``Literal``, of which there is one for each kind of choice) and its
bounds; the text below it what it means, with the unit. A section refuses what its fields cannot hold, and a
:class:`Config` what does not go together (:mod:`august_jax.config.ties`), whether a file, a command line or Python
made it. Bounds keep out nonsense, a kilometre for a millimetre or a milliard of points; they do not say what is wise.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from august_jax.config.fields import Bounds, Section, bounds_of, checked, distinct, filled, hints, near, rising, within
from august_jax.config.ties import check_ties

PresetName = Literal["smoke", "laptop", "paper"]
Family = Literal["quad_x", "quad_plus", "hexa", "octo", "coaxial_y6"]
"""Procedural airframes."""
Style = Literal["smooth", "dynamic", "jump"]
"""Of flights."""
Pilots = Literal["unitary", "gaussian"]
"""Unitary: a scrambled DFT."""
EstimatorName = Literal["ls", "ridge", "lmmse_roi", "dft"]
"""Of the channel."""
Draw = Literal["snr", "power"]
"""What of the echo's level is drawn: the SNR, to which the power is set, or the transmit power."""
Solver = Literal["mom", "table", "krylov", "local_field_born", "born"]
"""Of the scattered field."""
NetworkScheme = Literal["august", "noebd", "nolatent", "refchannel"]
"""Networks: the whole, without embeddings, without the latent code, with channels carried to a reference place."""
Encoder = Literal["paper", "roi"]
"""Of the channel: a linear map of vec(H), or the field subspace of the region of interest."""
TimeEmbedding = Literal["paper", "log_snr"]
"""Of the diffusion step: s/S and two octaves of sin and cos, or Fourier features of the noising's log-SNR."""
Frame = Literal["region", "craft"]
"""Where points are diffused: in the region (the paper's way), or in one craft's own axes."""
Source = Literal["stored", "stream"]
"""Of the training's samples: a data set, or a stream that never repeats."""
Sampler = Literal["dpm", "ancestral"]
"""Of the reverse diffusion: DPM-Solver++(2M), or ancestral."""

SNR_LIMIT_DB = 100.0
"""Beyond it single precision has nothing left to tell."""

Range = Annotated[tuple[float, float], rising]
"""A low and a high end."""
_Side = Annotated[Range, within(-1e4, 1e4, "m")]
_Snr = within(-SNR_LIMIT_DB, SNR_LIMIT_DB, "dB", "beyond it single precision has nothing left to tell")
_Tone = Annotated[float, within(1e6, 1e12, "Hz")]
_Width = Annotated[int, within(1, 65_536)]
_Seed = Annotated[int, within(0, 2**32 - 1, why="streams of random numbers repeat beyond")]
_Weight = Annotated[float, within(0.0, 1e9)]
_Repeats = Annotated[int, within(1, 1_000_000_000)]


def _airframe(name: str) -> str | None:
    """A note: a family or, by the looks of it, a mesh file, which is looked for where it is read."""
    if name in get_args(Family) or "." in name or "/" in name:
        return None
    hint = near(name, get_args(Family))
    return (
        f"is neither a family nor a mesh file; {hint + ' ' if hint else ''}"
        f"families: {', '.join(get_args(Family))}; a file has a suffix, such as drone.stl"
    )


@dataclass(frozen=True)
class ArrayConfig(Section):
    """The base station's half-wavelength planar array in the x-O-z plane (paper, Section II-A)."""

    nx: Annotated[int, within(1, 4096)] = 16
    """Antennas along x."""
    nz: Annotated[int, within(1, 4096)] = 4
    """Antennas along z."""
    frequency_hz: _Tone = 3e9
    """The carrier, which sets the spacing [Hz]."""
    tones_hz: tuple[_Tone, ...] = ()
    """Sounding frequencies [Hz]; empty means the carrier alone."""

    @property
    def count(self) -> int:
        """Number of antennas N_b."""
        return self.nx * self.nz

    @property
    def frequencies_hz(self) -> tuple[float, ...]:
        """The tones that are sounded: ``tones_hz``, or the carrier alone [Hz]."""
        return self.tones_hz or (self.frequency_hz,)


@dataclass(frozen=True)
class TargetConfig(Section):
    """What flies: airframes, their lattice of cells and the range of their materials (paper, Section VI-A)."""

    airframes: Annotated[tuple[Annotated[str, _airframe], ...], filled] = (
        "quad_x",
        "quad_plus",
        "hexa",
        "octo",
        "coaxial_y6",
    )
    """Names of procedural families, or paths of mesh files, after which unit and axes may stand
    (``"drone.stl?unit=mm&up=y&forward=-z"``, in double quotes)."""
    half_wheelbase_m: Annotated[float, within(0.01, 50.0, "m")] = 0.25
    """Every airframe is scaled to this half-wheelbase [m]."""
    cell_m: Annotated[float, within(1e-5, 10.0, "m")] = 0.012
    """Edge of the lattice cells [m]."""
    skin_m: Annotated[float, within(1e-6, 10.0, "m")] = 0.002
    """Thickness of the material about the surface [m]."""
    max_cells: Annotated[int, within(8, 1_000_000, why="fewer are no craft")] = 1200
    """An airframe that needs more cells than this gets a coarser lattice."""
    permittivity: Annotated[Range, within(1.0, 1e3, why="1 is that of air")] = (1.5, 5.0)
    """Relative permittivity, drawn uniformly for each flight."""
    conductivity_s_m: Annotated[Range, within(0.0, 1e8, "S/m")] = (1e-3, 1e-2)
    """Conductivity, drawn uniformly for each flight [S/m]."""
    points: Annotated[int, within(1, 1_000_000)] = 1000
    """Points of the label cloud, M."""


@dataclass(frozen=True)
class FlightConfig(Section):
    """Random flights (paper, Section VI-A): a box, a style, slots."""

    box_m: tuple[_Side, _Side, _Side] = ((10.0, 30.0), (10.0, 30.0), (10.0, 20.0))
    """Where they stay: ends along x, y and z [m]."""
    style: Style = "smooth"
    """``smooth``: slow and tilted little; ``dynamic``: up to the tilt limit; ``jump``: straight, with instant turns
    that no craft can fly (august_jax/scene/trajectory.py)."""
    slots: Annotated[int, within(1, 100_000)] = 50
    """Slots of a flight."""
    slot_s: Annotated[float, within(1e-3, 60.0, "s")] = 0.2
    """Time from one slot to the next [s]."""
    tilt_deg: Annotated[float, within(0.01, 89.0, "degrees")] = 30.0
    """Largest tilt of the thrust axis [deg]."""

    @property
    def centre_m(self) -> tuple[float, float, float]:
        """Middle of the box [m]: q_ref, where the scheme ``refchannel`` refers channels to."""
        (west, east), (south, north), (low, high) = self.box_m
        return 0.5 * (west + east), 0.5 * (south + north), 0.5 * (low + high)


@dataclass(frozen=True)
class RegionConfig(Section):
    """The reconstruction region about the predicted position (paper, eq. 5D pc)."""

    scale_m: Annotated[float, within(0.01, 1e3, "m")] = 0.85
    """s, the scale that divides positions: half-wheelbase plus prediction threshold [m]."""
    threshold_m: Annotated[float, within(0.0, 1e3, "m")] = 0.5
    """The prediction misses by up to this much along each axis, uniformly [m]."""
    permittivity_max: Annotated[float, within(1.0, 1e3)] = 5.0
    """Divides relative permittivities."""
    conductivity_max_s_m: Annotated[float, within(1e-12, 1e8, "S/m")] = 1e-2
    """Divides conductivities [S/m]."""


@dataclass(frozen=True)
class SignalConfig(Section):
    """Pilots, power, noise and the channel estimator (paper, Sections II-A and II-B)."""

    beam_width_deg: Annotated[tuple[float, float], within(0.1, 180.0, "degrees")] = (30.0, 30.0)
    """Full widths of the region's sector in azimuth and elevation [deg]."""
    mirror_beams: bool = False
    """True: the sign that the paper prints, which points at the mirror direction."""
    symbols: Annotated[int, within(0, 1_000_000)] = 0
    """L; 0 means one symbol an antenna."""
    pilots: Pilots = "unitary"
    """``unitary`` (scrambled DFT) or ``gaussian``."""
    estimator: EstimatorName = "lmmse_roi"
    """Of the channel."""
    noise_dbm: Annotated[float, within(-250.0, 100.0, "dBm")] = -120.0
    """Power of the noise at an antenna [dBm]."""
    draw: Draw = "snr"
    """``snr``: draw the SNR and set the power to it; ``power``: draw the transmit power."""
    snr_db: Annotated[Range, _Snr] = (0.0, 30.0)
    """SNR of the echo, where that is drawn [dB]."""
    power_dbm: Annotated[Range, within(-150.0, 150.0, "dBm")] = (10.0, 40.0)
    """Transmit power, where that is drawn [dBm]."""


@dataclass(frozen=True)
class DataConfig(Section):
    """How many samples, from which seed, in which pieces."""

    count: _Repeats = 50_000
    """Samples."""
    seed: _Seed = 0
    """Of all that is drawn."""
    shard_rows: Annotated[int, within(1, 10_000_000)] = 2_000
    """Samples a shard."""
    split: Annotated[tuple[int, int, int], within(0, 1000)] = (8, 1, 1)
    """Train : validation : test, by flight."""
    solver: Solver = "mom"
    """Of the scattered field; ``table`` looks ``mom``'s channels up in tables of the factored bodies, a channel
    tens of times and a data set ten times faster, with an error of some 1e-3 that is measured and told."""
    observed: bool = True
    """Keep with every sample what the base station made of it (prediction, SNR, estimated channel), which is needed
    where ``train.reobserve`` is false; false leaves it out."""

    @property
    def dense_solver(self) -> Solver:
        """``solver`` where channels are solved one by one: ``mom`` for ``table``."""
        return "mom" if self.solver == "table" else self.solver


@dataclass(frozen=True)
class ModelConfig(Section):
    """AUGUST's networks (paper, Section IV and Section VI-A)."""

    scheme: NetworkScheme = "august"
    """Which of the compared networks."""
    encoder: Encoder = "paper"
    """``paper``: linear map of vec(H); ``roi``: the region's field subspace."""
    channel_features: _Width = 256
    """d_v = d_p, width of the embedded channel vector."""
    encoder_features: _Width = 512
    """d_f, width of the residual MLP."""
    encoder_layers: Annotated[int, within(1, 1000)] = 6
    """Blocks of the residual MLP."""
    latent: _Width = 256
    """d_z."""
    fourier: Annotated[int, within(1, 30, why="the next octave is beyond single precision")] = 10
    """d_xi, number of octaves of the position and SNR features."""
    raw_metres: bool = False
    """True: Fourier features of q_pre in metres, as printed; False: of q_pre mapped from the box to [-1, 1]."""
    flow_layers: Annotated[int, within(1, 1000)] = 14
    """Coupling layers of the latent code's prior."""
    flow_features: _Width = 256
    """Hidden width of a coupling layer."""
    denoiser: Annotated[tuple[_Width, ...], filled] = (16, 64, 128, 256, 512, 1024, 512, 256, 128, 64, 16)
    """Hidden widths; input and output are 5."""
    time_embedding: TimeEmbedding = "paper"
    """``paper``: s/S and two octaves of sin, cos; ``log_snr``: Fourier features of the log-SNR of the noising."""
    frame: Frame = "region"
    """Where points are diffused: ``region`` (the paper's), or ``craft``: about the place, along the thrust axis and
    the heading of one craft, on which a cloud settles before its points are drawn; needs ``train.weight_readout``."""
    steps: Annotated[int, within(1, 1_000_000)] = 200
    """S, diffusion steps."""
    beta: Annotated[Range, within(1e-9, 0.9999)] = (1e-4, 0.05)
    """Variance of the noise of the first and of the last diffusion step."""


@dataclass(frozen=True)
class TrainConfig(Section):
    """Optimisation (paper, Section V and Section VI-A)."""

    steps: _Repeats = 31_250
    """Gradient steps; the paper's 200 epochs of 40,000 samples at 256 a step."""
    batch: Annotated[int, within(1, 1_000_000)] = 256
    """Samples a step."""
    points: Annotated[int, within(1, 1_000_000)] = 1000
    """Random points of each cloud that a step uses."""
    learning_rate: Annotated[tuple[float, float], within(1e-12, 10.0)] = (1e-4, 1e-5)
    """First and last learning rate; linear in between."""
    weight_position: _Weight = 0.9
    """Of the points' coordinates in the loss."""
    weight_material: _Weight = 0.1
    """Of the points' material in the loss."""
    weight_latent: _Weight = 1e-4
    """Of the latent code's divergence from its prior in the loss."""
    weight_readout: _Weight = 0.0
    """Weight of a linear readout of the cloud's reading from the latent; not in the paper, 0 leaves it out."""
    ema: Annotated[float, within(0.0, 0.9999999)] = 0.999
    """Decay of the parameters' moving average, which is what is evaluated."""
    seed: _Seed = 0
    """Of all that is drawn."""
    reobserve: bool = False
    """True: every step draws a new prediction, SNR, pilots and noise for the stored channels."""
    source: Source = "stored"
    """``stored``: samples of a data set; ``stream``: samples that never repeat, made by table as training goes, which
    needs ``train.reobserve``."""
    log_every: _Repeats = 50
    """Steps from one line of metrics to the next."""
    save_every: _Repeats = 1_000
    """Steps from one checkpoint to the next."""


@dataclass(frozen=True)
class EvaluateConfig(Section):
    """What ``august evaluate`` measures."""

    snr_db: Annotated[tuple[float, ...], filled, distinct, _Snr] = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
    """At which SNRs of the echo [dB]."""
    count: Annotated[int, within(1, 1_000_000)] = 500
    """Samples at each SNR."""
    sampler: Sampler = "dpm"
    """``dpm`` (DPM-Solver++ 2M) or ``ancestral``."""
    sampler_steps: Annotated[int, within(1, 1_000_000)] = 10
    """Steps of the sampler ``dpm``."""
    searched: Annotated[int, within(0, 1_000_000)] = 20
    """Samples at each SNR that a search among the known craft answers, too, which takes seconds each (at most
    ``evaluate.count``); 0 leaves it out. Only with bodies, of ``data.solver`` ``mom`` or ``table``."""


@dataclass(frozen=True)
class Config:
    """One run of august_jax: everything that its numbers depend on.

    Raises:
        ConfigError: fields that do not go together.
    """

    preset: PresetName = "paper"
    array: ArrayConfig = field(default_factory=ArrayConfig)
    target: TargetConfig = field(default_factory=TargetConfig)
    flight: FlightConfig = field(default_factory=FlightConfig)
    region: RegionConfig = field(default_factory=RegionConfig)
    signal: SignalConfig = field(default_factory=SignalConfig)
    data: DataConfig = field(default_factory=DataConfig)
    model: ModelConfig = field(default_factory=ModelConfig)
    train: TrainConfig = field(default_factory=TrainConfig)
    evaluate: EvaluateConfig = field(default_factory=EvaluateConfig)

    def __post_init__(self) -> None:
        checked(hints(Config)["preset"], self.preset, "preset")
        check_ties(self)


def bounds(path: str) -> Bounds:
    """The bounds of a field, such as ``signal.snr_db``.

    Raises:
        KeyError: there is no such field, or it has none.
    """
    section, _, name = path.partition(".")
    found = bounds_of(hints(hints(Config)[section])[name])
    if found is None:
        raise KeyError(path)
    return found
