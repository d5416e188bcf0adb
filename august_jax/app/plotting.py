"""Pictures: training curves, clouds, a flight, accuracy over SNR with its baselines and bound.

All go to files, none to a screen. Figures are made without pyplot, so that no global state of matplotlib changes.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from august_jax.files import replacing
from august_jax.schemes import SCHEMES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

    from august_jax.tracking import Track

SOFT, LINE = "#5c6b78", "#dfe5ea"
MODEL, TRUTH, BASE = "#0a6ebd", "#3a4652", "#c8641b"
STYLES: dict[str, dict[str, Any]] = {
    "august": {"color": MODEL, "marker": "o", "lw": 2.0, "ms": 5},
    "matched_field": {"color": "#6a3fb5", "marker": "D", "lw": 2.0, "ms": 4},
    "polar": {"color": "#1c8a8a", "marker": "^", "ms": 4, "lw": 1.2},
    "polar_angles": {"color": "#1c8a8a", "marker": "v", "ms": 4, "lw": 1.2, "ls": "--"},
    "prediction": {"color": BASE, "ls": "--"},
    "up": {"color": "#a63d7b", "ls": "--"},
    "mean_shape": {"color": "#8a6d1d", "ls": "--"},
    "resampling": {"color": "#7a8894", "ls": ":"},
}
"""Line styles of the schemes (:data:`august_jax.schemes.SCHEMES`)."""
_NETWORKS = (MODEL, "#d62839", "#2f3e46", "#35a7d6", "#7ca318", "#f277a0")


def styles_of(schemes: Collection[str]) -> dict[str, dict[str, Any]]:
    """A line style for each scheme: that of :data:`STYLES`, or of networks under other names their own colour."""
    taken = {STYLES[name]["color"] for name in schemes if name in STYLES}
    others = cycle(colour for colour in _NETWORKS if colour not in taken)
    return {name: STYLES.get(name) or {"color": next(others), "marker": "s", "ms": 4} for name in schemes}


class Panel(NamedTuple):
    """One chart of a training run.

    Attributes:
        name: of the number in ``metrics.jsonl``.
        base: of the number there that it is held against, None if of none.
        title: what the number is.
    """

    name: str
    base: str | None
    title: str


_TITLES = {
    "validation_mpe_m": "mean position error on validation samples [m]",
    "loss": "what is minimised, the weighted sum of the terms",
    "position": "denoising of x, y, z: squared error of the noise; 3 by answering none",
    "material": "denoising of permittivity and conductivity: squared error of the noise; 2 by answering none",
    "latent": "code: its log density as the encoder draws it, less that by the prior",
    "readout": "readout of place, normal, material and arms: squared error",
    "signature": "denoising of the arms' harmonics: mean squared error of the noise; 1 by answering none",
    "reference": "estimate of the channel at the reference place: squared error, relative to it",
    "gradient": "norm of the gradient, before it is clipped",
}
_OF_A_PREDICTOR = {"loss": "mean distance from the truth, in units of the filter's standard deviation"}


def training_panels(lines: Sequence[Mapping[str, Any]]) -> list[Panel]:
    """The charts of a run: what was validated first, then the loss, then its terms; each with its own baseline.

    Args:
        lines: of ``metrics.jsonl``, each with ``step`` and any number of scalars.
    """
    numbers = [name for name, value in (lines[-1] if lines else {}).items() if isinstance(value, int | float)]
    bases = {name: f"{name}_kalman" for name in numbers if f"{name}_kalman" in numbers}
    of_a_predictor = bool(bases)
    for name, base in (("validation_mpe_m", "validation_prediction_m"), ("loss", "kalman")):
        if name in numbers and base in numbers:
            bases[name] = base
    skipped = {"step", "samples_per_s", "seconds_left", *bases.values()}
    titles = _TITLES | {name: f"mean error on {name} flights [m]" for name in bases if f"{name}_kalman" in numbers}
    if of_a_predictor:
        titles |= _OF_A_PREDICTOR
    validated = [name for name in bases if name != "loss"]
    names = sorted(  # which keeps the order of equals
        (name for name in numbers if name not in skipped),
        key=lambda name: (name not in validated, name != "loss", name == "gradient"),
    )
    return [Panel(name, bases.get(name), titles.get(name, name)) for name in names]


def read_metrics(metrics_jsonl: str | Path) -> list[dict[str, Any]]:
    """The lines of a run's ``metrics.jsonl``."""
    text = Path(metrics_jsonl).read_text(encoding="utf-8")
    return [json.loads(line) for line in text.splitlines() if line.strip()]


def training_curves(metrics_jsonl: str | Path, png: str | Path) -> None:
    """Draw every number of a run over its steps, with what it is held against.

    Args:
        metrics_jsonl: one JSON object a line, with ``step`` and any number of scalar terms.
        png: the picture.

    Raises:
        ValueError: there is nothing to draw.
    """
    lines = read_metrics(metrics_jsonl)
    panels = training_panels(lines)
    if not panels:
        raise ValueError(f"metrics_jsonl: {metrics_jsonl} holds no loss terms; train for at least one logged step")
    columns = min(3, len(panels))
    figure = new_figure(4.2 * columns, 2.9 * -(-len(panels) // columns))
    for index, panel in enumerate(panels):
        axes = figure.add_subplot(-(-len(panels) // columns), columns, index + 1)
        drawn = []
        for name, colour in ((panel.name, MODEL), (panel.base, BASE)):
            if name is None:
                continue
            steps, values = np.array([(line["step"], line[name]) for line in lines if line.get(name) is not None]).T
            drawn.append(values)
            axes.plot(steps, values, color=colour, lw=0.8, alpha=0.35 if len(values) > 20 else 1.0)
            if len(values) > 20:
                width = max(len(values) // 40, 3)
                smooth = np.convolve(values, np.ones(width) / width, mode="valid")
                axes.plot(steps[width - 1 :], smooth, color=colour, lw=1.8)
        every = np.concatenate(drawn)
        if (every > 0).all() and every.max() > 20 * every.min():
            axes.set_yscale("log")
        axes.set_title(panel.name, loc="left")
        if panel.base is not None:
            axes.set_title(panel.base, loc="right", color=BASE)
        axes.set_xlabel("step")
        _tidy(axes)
    save(figure, png)


class Shown(NamedTuple):
    """A cloud that a search found in a slot, to be drawn beside the networks' one: what it is called, its points (M, 3)
    [m], their permittivities (M,), and the normal of the rotor plane (3,)."""

    label: str
    points: Float[np.ndarray, "points 3"]
    permittivity: Float[np.ndarray, " points"]
    normal: Float[np.ndarray, "3"]


def clouds(
    track: Track,
    png: str | Path,
    *,
    permittivity: tuple[float, float],
    title: str,
    slots: int = 4,
    found: Mapping[int, Shown] | None = None,
) -> None:
    """True clouds above, reconstructed ones below (beside, for a single slot), and below these what a search found;
    coloured by permittivity, equal axes.

    Args:
        track: what was true and what was reconstructed.
        png: the picture.
        permittivity: range of the colour scale.
        title: heading.
        slots: at most so many slots are shown, evenly spaced and the last among them.
        found: what a search found, by slot; the others are not drawn.
    """
    total, found = len(track.time_s), found or {}
    shown = np.unique(np.linspace(total - 1, 0, min(slots, total)).round().astype(int))
    kinds = 3 if any(slot in found for slot in shown.tolist()) else 2
    rows, columns = (kinds, len(shown)) if len(shown) > 1 else (1, kinds)
    figure = new_figure(3.5 * columns + 1.1, 3.6 * rows)
    reach = float(np.quantile(np.linalg.norm(track.truth - track.position[:, None], axis=-1), 0.999)) * 1.02
    bearing = track.position[-1]
    azimuth = float(np.degrees(np.arctan2(-bearing[1], -bearing[0]))) + 30.0  # seen from beside the base station
    panels = []
    for column, slot in enumerate(shown):
        material = np.full(len(track.truth[slot]), track.permittivity)
        drawings = [
            (Shown(f"true, {track.time_s[slot]:.4g} s", track.truth[slot], material, track.normal[slot]), TRUTH),
            (
                Shown(
                    "networks" if found else "reconstructed",
                    track.points[slot],
                    track.point_permittivity[slot],
                    track.normal_estimate[slot],
                ),
                MODEL,
            ),
        ]
        if int(slot) in found:
            drawings.append((found[int(slot)], STYLES["matched_field"]["color"]))
        for row, ((label, points, value, normal), colour) in enumerate(drawings):
            axes = figure.add_subplot(rows, columns, row * len(shown) + column + 1, projection="3d")
            panels.append(axes)
            local = points - track.position[slot]
            drawn = axes.scatter(
                *local.T,
                c=value,
                cmap="viridis",
                vmin=permittivity[0],
                vmax=permittivity[1],
                s=6,
                linewidths=0,
                depthshade=True,
            )
            tip = 0.75 * reach * normal
            axes.quiver(*local.mean(axis=0), *tip, color=colour, lw=1.6, arrow_length_ratio=0.2)
            axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(-reach, reach))
            axes.set_box_aspect((1, 1, 1), zoom=1.25)
            axes.view_init(elev=28, azim=azimuth)
            _plain_box(axes, reach)
            q = points.mean(axis=0) if row else track.position[slot]
            place = f"({q[0]:.2f}, {q[1]:.2f}, {q[2]:.2f}) m"
            off = 100.0 * np.linalg.norm((q if row else track.predicted[slot]) - track.position[slot])
            axes.set_title(f"{label}\n{place}\n{'' if row else 'predicted '}{off:.0f} cm off", y=1.02, fontsize=9.5)
    figure.suptitle(f"{title}; metres about the true place", x=0.01, ha="left", fontsize=12, fontweight="bold")
    bar = figure.colorbar(drawn, ax=panels, shrink=0.5, pad=0.02, aspect=28)
    bar.set_label("relative permittivity")
    bar.outline.set_visible(False)
    save(figure, png)


def flight(
    track: Track, slots: Sequence[Mapping[str, Any]], png: str | Path, *, title: str, threshold_m: float | None = None
) -> None:
    """True, predicted and estimated track with the cloud of each slot; beside it errors and, of hypotheses, what they
    are expected to be and the craft, slot by slot, else what the region has to allow.

    Args:
        track: what was true and what was found.
        slots: one entry a slot, as :mod:`august_jax.evaluation.followed` gives them.
        png: the picture.
        title: heading.
        threshold_m: what the region allows [m], of a flight that a predictor's loop followed.
    """
    from matplotlib.ticker import MaxNLocator

    figure = new_figure(15.0, 8.2)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.55, 1.0))
    axes = figure.add_subplot(grid[:, 0], projection="3d")
    estimate, numbers = track.estimated_position, 1 + np.arange(track.slots)
    bearing = track.position.mean(axis=0)
    azimuth = float(np.degrees(np.arctan2(-bearing[1], -bearing[0]))) + 30.0  # seen from beside the base station
    every = max(1, -(-track.points.shape[1] // 250))
    shade = axes.scatter(
        *track.points[:, ::every].reshape(-1, 3).T,
        c=np.repeat(numbers, track.points[:, ::every].shape[1]),
        cmap="viridis",
        s=5.0,
        alpha=0.6,
        linewidths=0,
    )
    lines: tuple[tuple[np.ndarray, dict[str, Any]], ...] = (
        (track.position, {"color": TRUTH, "lw": 3.2, "alpha": 0.7, "label": "true"}),
        (track.predicted, {"color": BASE, "ls": "--", "lw": 1.1, "marker": "x", "ms": 5, "label": "predicted"}),
        (estimate, {"color": MODEL, "lw": 1.4, "marker": "o", "ms": 3.5, "label": "estimated"}),
    )
    for places, style in lines:
        axes.plot(*places.T, **style)
    lost = [row for row, slot in enumerate(slots) if slot["lost"]]
    if lost:
        axes.plot(*estimate[lost].T, ls="", marker="s", ms=10, mfc="none", mec="#a63d7b", mew=1.8, label="lost")
    shown = np.concatenate([track.points.reshape(-1, 3), track.position, track.predicted])
    low, high = shown.min(axis=0), shown.max(axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
    axes.set_box_aspect(np.maximum(high - low, 0.2), zoom=1.05)
    axes.view_init(elev=24, azim=azimuth)
    for name, axis in zip("xyz", (axes.xaxis, axes.yaxis, axes.zaxis)):
        axis.set_pane_color((0.965, 0.973, 0.976, 1.0))
        axis._axinfo["grid"].update(color=LINE, linewidth=0.6)
        axis.set_label_text(f"{name} [m]")
    axes.tick_params(colors=SOFT, labelsize=8)
    axes.legend(loc="upper left", frameon=False, fontsize=10)
    bar = figure.colorbar(shade, ax=axes, shrink=0.45, pad=0.06, aspect=28)
    bar.set_label("slot of the cloud")
    bar.locator = MaxNLocator(integer=True)
    bar.outline.set_visible(False)
    panels = [figure.add_subplot(grid[row, 1]) for row in range(3)]
    place, attitude, below = panels

    def line(axes: Axes, key: str, floor: float, label: str, **style: Any) -> None:
        """Over slots, where it is told."""
        values = [slot.get(key) for slot in slots]
        if any(value is not None for value in values):
            axes.plot(
                numbers, [np.nan if value is None else max(value, floor) for value in values], label=label, **style
            )

    base = {"color": BASE, "ls": "--", "marker": "x", "ms": 5}
    own: dict[str, Any] = {"color": MODEL, "marker": "o", "ms": 4}
    expected: dict[str, Any] = {"color": SOFT, "ls": ":"}
    line(place, "predicted_error_m", 1e-4, "prediction", **base)
    line(place, "position_error_m", 1e-4, "estimate", **own)
    line(place, "expected_error_m", 1e-4, "expected of it", **expected)
    line(attitude, "normal_error_up_deg", 1e-2, "always up", **base)
    line(attitude, "normal_error_deg", 1e-2, "estimate", **own)
    if "expected_mde" in slots[0]:
        angles = [np.degrees(np.arccos(np.clip(1.0 - slot["expected_mde"], -1.0, 1.0))) for slot in slots]
        attitude.plot(numbers, np.maximum(angles, 1e-2), label="expected of it", **expected)
    for each in (place, attitude):
        each.set_yscale("log")
        low, high = np.log10(each.dataLim.intervaly)
        each.set_ylim(10.0 ** np.floor(low), 10.0 ** np.ceil(high))
        each.yaxis.set_major_formatter("{x:g}")
        each.yaxis.set_minor_formatter("")
    if "search" in slots[0]:
        _craft(below, slots)
        last = "probability of each known craft (?: unexplained)"
    else:
        line(below, "threshold_m", 0.0, "asked for by the predictor", **own)
        below.axhline(threshold_m or 0.0, color=TRUTH, lw=1.2, label="of the region")
        marks = (("lost", "lost", "#a63d7b", "s"), ("detected", "listened at a detection", SOFT, "|"))
        for key, label, colour, marker in marks:
            at = [number for number, slot in zip(numbers, slots) if slot[key]]
            if at:
                below.plot(at, np.zeros(len(at)), ls="", marker=marker, ms=9, mfc="none", color=colour, label=label)
        below.set_ylim(bottom=-0.08)
        last = "threshold along each axis [m]"
    for each, label in zip(panels, ("position error [m]", "attitude error [degrees]", last)):
        each.set_title(label, loc="left", fontsize=11)
        each.set_xlim(0.3, track.slots + 0.7)
        each.xaxis.set_major_locator(MaxNLocator(integer=True))
        columns, where = (2, "center left") if each is below and "search" not in slots[0] else (5, "lower left")
        each.legend(frameon=each is below, framealpha=0.85, fontsize=8.5, loc=where, ncols=columns)
        _tidy(each)
    below.set_xlabel("slot")
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
    save(figure, png)


def _craft(axes: Axes, slots: Sequence[Mapping[str, Any]]) -> None:
    """How probable each known craft is, slot by slot, as stacked bars."""
    numbers = 1 + np.arange(len(slots))
    names = list(slots[0]["search"]["craft_probability"])
    below = np.zeros(len(slots))
    for name, colour in zip(names, ("#0a6ebd", "#2b9348", "#c8641b", "#8a6d1d", "#a63d7b", "#6a3fb5", "#7a8894") * 9):
        share = np.array([slot["search"]["craft_probability"][name] for slot in slots])
        axes.bar(numbers, share, bottom=below, color=colour, width=0.8, label=name)
        below += share
    for number, slot in zip(numbers, slots):
        if not slot["search"]["explained"]:
            axes.text(float(number), 1.02, "?", ha="center", fontsize=10, color="#a63d7b")
    axes.set_ylim(0.0, 1.12)


def evaluation_curves(rows: Sequence[Mapping[str, Any]], png: str | Path, *, title: str) -> None:
    """Accuracy over SNR: position, attitude and shape, every scheme that defines the metric, and the bound.

    Args:
        rows: as :func:`august_jax.evaluation.evaluate` gives them.
        png: the picture.
        title: heading.
    """
    panels = (
        ("mpe_m", "position error [m]", True),
        ("mde", "direction error 1 − cos", True),
        ("wd_db", "weighted distance [dB]", False),
        ("mcd_db", "Chamfer distance [dB]", False),
    )
    figure = new_figure(11.0, 7.4)
    schemes = list(dict.fromkeys(row["scheme"] for row in rows))
    styles = styles_of(schemes)
    most = max(row["count"] for row in rows)
    labels = {scheme: SCHEMES[scheme].label if scheme in SCHEMES else scheme for scheme in schemes}
    alone = len({row["snr_db"] for row in rows}) == 1
    labels |= {row["scheme"]: row["label"] for row in rows if "label" in row}
    for row in rows:
        if row["count"] < most:
            labels[row["scheme"]] = (
                f"{labels[row['scheme']].partition(',')[0]}, {row['count']} sample{'' if row['count'] == 1 else 's'}"
            )
    for index, (metric, label, logarithmic) in enumerate(panels):
        axes = figure.add_subplot(2, 2, index + 1)
        for scheme in schemes:
            pairs = {row["snr_db"]: row[metric] for row in rows if row["scheme"] == scheme and row[metric] is not None}
            style = {"lw": 1.6, **styles[scheme]}
            if pairs:
                _over_snr(axes, sorted(pairs.items()), alone, label=labels[scheme], **style)
        column = {"mpe_m": "bound_m", "mde": "bound_mde"}.get(metric)
        bound = sorted({(row["snr_db"], row[column]) for row in rows if row[column] is not None}) if column else []
        if bound:
            _over_snr(axes, bound, alone, color="#2b9348", lw=1.6, ls="-.", label="bound")
        if alone:
            axes.set_xlim(rows[0]["snr_db"] - 1.0, rows[0]["snr_db"] + 1.0)
            axes.set_xticks([rows[0]["snr_db"]])
        if logarithmic:
            axes.set_yscale("log")
            axes.yaxis.set_major_formatter("{x:g}")
        axes.set_xlabel("SNR [dB]")
        axes.set_title(label, loc="left", fontsize=11)
        _tidy(axes)
    named = {label: line for axes in figure.axes for line, label in zip(*axes.get_legend_handles_labels())}
    figure.legend(named.values(), named.keys(), loc="outside lower left", ncols=3, frameon=False, fontsize=9)
    figure.suptitle(title, x=0.01, ha="left", fontsize=12, fontweight="bold")
    save(figure, png)


def _over_snr(axes: Axes, pairs: Sequence[tuple[float, float]], alone: bool, **style: Any) -> None:
    """A line over SNR; where there is one SNR ``alone``, through which no line leads, a line across at its height."""
    if alone:
        at, value = pairs[-1]
        axes.plot([at - 1.0, at, at + 1.0], [value] * 3, markevery=[1], **style)
    else:
        axes.plot(*np.array(pairs).T, **style)


def cross_sections(
    azimuth_deg: Float[np.ndarray, " a"],
    elevation_deg: Float[np.ndarray, " e"],
    frequency_hz: Sequence[float],
    entries: Mapping[str, Float[np.ndarray, "e a f"]],
    png: str | Path,
    *,
    title: str,
) -> None:
    """Radar cross-sections [dBsm]: cuts over azimuth, level and from 45 degrees below, or over elevation where there is
    one azimuth; and all directions at once.

    Args:
        azimuth_deg, elevation_deg: of the directions [degrees].
        frequency_hz: the first is drawn [Hz].
        entries: name of two polarisations, received and sent -> dBsm by elevation, azimuth and frequency.
        png: the file.
        title: of the picture.
    """
    level = int(np.argmin(np.abs(elevation_deg)))
    below = int(np.argmin(np.abs(elevation_deg + 45.0)))
    rows = list(dict.fromkeys((level, below))) if len(azimuth_deg) > 1 else [None]
    whole = len(azimuth_deg) > 1 and len(elevation_deg) > 1
    figure = new_figure(4.2 * (len(rows) + whole), 4.6)
    top = max(float(values[..., 0].max()) for values in entries.values())
    low, high = 5.0 * np.floor((top - 40.0) / 5.0), 5.0 * np.ceil((top + 1.0) / 5.0)
    inks = dict(zip(entries, (MODEL, BASE, "#7a8894", "#1c8a8a")))
    for place, row in enumerate(rows):
        axes = figure.add_subplot(1, len(rows) + whole, place + 1, projection="polar")
        turns = np.radians(elevation_deg if row is None else azimuth_deg)
        for name, values in entries.items():
            cut = values[:, 0, 0] if row is None else values[row, :, 0]
            axes.plot(turns, np.maximum(cut, low), color=inks[name], lw=1.4, label=name.upper(),
                      ls="-" if name in ("hh", "vv") else ":")  # fmt: skip
        axes.set(rlim=(low, high), theta_zero_location="N" if row is not None else "E")
        axes.tick_params(colors=SOFT, labelsize=8)
        axes.grid(color=LINE, lw=0.7)
        cut_at = f"azimuth {azimuth_deg[0]:g}" if row is None else f"elevation {elevation_deg[row]:g}"
        axes.set_title(f"{cut_at} degrees [dBsm]", fontsize=10)
    if whole:
        axes = figure.add_subplot(1, len(rows) + 1, len(rows) + 1)
        drawn = axes.pcolormesh(
            azimuth_deg, elevation_deg, entries["vv"][..., 0], vmin=low, vmax=high, cmap="viridis", shading="nearest"
        )
        figure.colorbar(drawn, ax=axes, location="bottom", label="VV [dBsm]", shrink=0.9)
        axes.set(xlabel="azimuth [degrees]", ylabel="elevation [degrees]")
        axes.set_title("all directions", fontsize=10)
        axes.tick_params(colors=SOFT, labelsize=8)
    lines, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(lines, labels, loc="outside lower left", ncols=4, frameon=False, fontsize=9)
    figure.suptitle(f"{title}, {frequency_hz[0] / 1e9:.4g} GHz", x=0.01, ha="left", fontsize=12, fontweight="bold")
    save(figure, png)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of the given size [inch] that belongs to no window."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained", facecolor="white")


def _tidy(axes: Axes) -> None:
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(SOFT)
    axes.tick_params(colors=SOFT, which="both", labelsize=9)
    axes.grid(color=LINE, lw=0.7, which="major")
    axes.set_axisbelow(True)


def _plain_box(axes: Axes3D, reach: float) -> None:
    step = next((each for each in (0.1, 0.2, 0.3, 0.5) if 1.7 * each > reach), 1.0)
    for axis in (axes.xaxis, axes.yaxis, axes.zaxis):
        axis.set_pane_color((0.965, 0.973, 0.976, 1.0))
        axis.line.set_color(LINE)
        axis.set_ticks([-step, 0.0, step])
        axis._axinfo["grid"].update(color=LINE, linewidth=0.6)
    axes.tick_params(colors=SOFT, labelsize=7, pad=-2)


def save(figure: Figure, png: str | Path) -> None:
    """Write the figure as PNG; the file appears whole or not at all. A "$" in a text is a dollar sign."""
    from matplotlib.text import Text

    for text in figure.findobj(Text):
        if "$" in text.get_text() and "mathdefault" not in text.get_text():  # which ticks of powers of ten are in
            text.set_parse_math(False)
    with replacing(png) as aside:
        figure.savefig(aside, format="png", dpi=130)
