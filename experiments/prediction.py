"""How far predictions miss: three predictors, three styles of flight, three levels of noise, in two boxes.

    python experiments/prediction.py compute [--small] [--run DIR]   writes experiments/results/prediction.npz
    python experiments/prediction.py draw           prints the table of it, writes experiments/results/prediction.png

Flights of 50 slots of 0.2 s, on which nothing was trained, in the boxes of the presets `laptop` (4 x 4 x 3 m) and
`paper` (20 x 20 x 10 m). Each position is estimated with an independent Gaussian error along each axis; from the
estimates so far each predictor says where the craft will be in the next slot. Errors are distances to the true place
in slots 9 to 50, when the window of the LSTM is full. Standard errors take a flight, not a slot, for independent.

Compared are the paper's finite differences; the Kalman filter as it is used everywhere, told the style of flight but
not how large the noise is (it takes 10 cm); and the same with the LSTM on top. Beside them stand two lines: to repeat
the last estimate, which takes no knowledge at all, and a filter that is told more than a station knows, the noise and
the jerk density that is best for flights just like these (of a grid, on others). What the LSTM gains beyond that one
is not the repair of a filter's settings. The paper states the largest error of one flight of each kind, 0.41 m and
1.93 m, with an LSTM, and not its noise; so the table has the largest error of a flight, too.

Takes a minute and a half on two cores.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from script import run as run_script

from august_jax import streams
from august_jax.app.plotting import new_figure, save
from august_jax.config import FlightConfig, preset
from august_jax.progress import Progress
from august_jax.scene import fly_many
from august_jax.tracking import FiniteDifference, Kalman, KalmanLSTM, Predictor

BOXES = ("laptop", "paper")
STYLES = ("smooth", "dynamic", "jump")
NOISES_M = (0.03, 0.1, 0.3)
PREDICTORS = ("last estimate", "finite differences", "Kalman", "Kalman + LSTM", "Kalman, tuned")
JERKS = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
"""Densities [m^2/s^5] that the tuned filter has to choose from."""
FIRST = 8
"""Slots (from 0) that are left out."""
SLOTS = 50
PAPER_M = {"smooth": 0.41, "dynamic": 1.93}
_RESAMPLED = 60


def _along(predictor: Predictor, seen: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Predictions (flights, T - FIRST, 3) and innovation covariances, of slots from FIRST on."""

    def flight(estimates):
        def slot(state, estimate):
            state, ahead = predictor.predict(state)
            return predictor.update(state, estimate), ahead

        made = jax.lax.scan(slot, predictor.start(estimates[0]), estimates[1:])[1]
        return made.position[FIRST - 1 :], made.covariance[FIRST - 1 :]

    return jax.vmap(flight)(seen)


_predicted = jax.jit(_along, static_argnums=0)


@jax.jit
def _filtered(noise_m: float, jerk_density: float, seen: jax.Array) -> jax.Array:
    """Predictions of a filter with these settings."""
    return _along(Kalman(FlightConfig().slot_s, noise_m, jerk_density), seen)[0]


def compute(small: bool, run: str | None = None, progress: Progress = print) -> dict[str, np.ndarray]:
    """Mean, median, 95 % quantile and largest of a flight, with standard errors (box, style, noise, predictor)."""
    count = 60 if small else 1000
    shape = (len(BOXES), len(STYLES), len(NOISES_M), len(PREDICTORS))
    names = ("mean", "median", "q95", "largest")
    numbers = {f"{name}{part}_m": np.zeros(shape) for name in names for part in ("", "_se")}
    jerks, surprise = np.zeros(shape[:3]), np.zeros((*shape[:3], 2))
    for at, box in enumerate(BOXES):
        for which, style in enumerate(STYLES):
            flight = FlightConfig(box_m=preset(box).flight.box_m, style=style, slots=SLOTS)
            keys = jax.random.split(streams.key(0, "evaluate.flight", at, which), 2 * count)
            true, tuning = np.split(np.asarray(fly_many(keys, flight).positions, np.float32), 2)
            lstm = KalmanLSTM.for_flight(flight, run)
            for level, noise in enumerate(NOISES_M):
                generator = np.random.default_rng([at, which, level])
                seen, other = (
                    jnp.asarray(each + noise * generator.normal(size=each.shape), jnp.float32)
                    for each in (true, tuning)
                )
                tuned = [_miss(_filtered(noise, jerk, other), tuning).mean() for jerk in JERKS]
                jerks[at, which, level] = JERKS[int(np.argmin(tuned))]
                filtered = _predicted(Kalman.for_flight(flight), seen)
                corrected = _predicted(lstm, seen)
                made = (
                    seen[:, FIRST - 1 : -1],
                    _predicted(FiniteDifference(), seen)[0],
                    filtered[0],
                    corrected[0],
                    _filtered(noise, jerks[at, which, level], seen),
                )
                for member, places in enumerate(made):
                    for name, value in statistics(_miss(places, true)).items():
                        numbers[f"{name}_m"][at, which, level, member] = value
                surprise[at, which, level] = [_surprise(*each, seen) for each in (filtered, corrected)]
                told = zip(PREDICTORS, numbers["mean_m"][at, which, level])
                progress(
                    f"{box}, {style}, {100 * noise:.0f} cm: "
                    + ", ".join(f"{name} {100 * value:.1f} cm" for name, value in told)
                )
    numbers |= {
        "boxes": np.array(BOXES),
        "styles": np.array(STYLES),
        "noises_m": np.array(NOISES_M),
        "predictors": np.array(PREDICTORS),
        "flights": np.array(count),
        "jerk_density": jerks,
        "surprise": surprise,
    }
    progress(table(numbers))
    return numbers


def _miss(places: jax.Array | np.ndarray, true: np.ndarray) -> np.ndarray:
    return np.linalg.norm(np.asarray(places) - true[:, FIRST:], axis=-1)


def _surprise(places: jax.Array, covariance: jax.Array, seen: jax.Array) -> float:
    """Mean squared innovation in units of the stated covariance, an axis: 1 where that is right."""
    apart = np.asarray(seen)[:, FIRST:] - np.asarray(places)
    return float(np.mean(apart * np.linalg.solve(covariance, apart[..., None])[..., 0]))


def statistics(miss: np.ndarray) -> dict[str, float]:
    """Of errors (flights, slots): names as in the results, each with its standard error over flights."""
    flights = len(miss)
    generator = np.random.default_rng(0)
    drawn = [miss[generator.integers(0, flights, flights)] for _ in range(_RESAMPLED)]
    found = {}
    for name, share in (("median", 0.5), ("q95", 0.95)):
        found[name] = float(np.quantile(miss, share))
        found[f"{name}_se"] = float(np.std([np.quantile(each, share) for each in drawn]))
    for name, per_flight in (("mean", miss.mean(axis=1)), ("largest", miss.max(axis=1))):
        found[name] = float(per_flight.mean())
        found[f"{name}_se"] = float(per_flight.std() / np.sqrt(flights))
    return found


def table(numbers: dict[str, np.ndarray]) -> str:
    """The numbers as Markdown."""
    names = [str(name) for name in numbers["predictors"]]
    lines = [
        f"mean ± its standard error / median / 95 % of the errors [m], {int(numbers['flights'])} flights a row; "
        "largest of a flight on average [m]: Kalman, with LSTM (the paper's, of one flight)",
        "",
        f"| flights | noise | {' | '.join(names)} | largest |",
        "|---" * (len(names) + 3) + "|",
    ]
    for at, box in enumerate(numbers["boxes"]):
        for which, style in enumerate(numbers["styles"]):
            for level, noise in enumerate(numbers["noises_m"]):
                place = at, which, level
                cells = [
                    f"{numbers['mean_m'][place][member]:.3f} ± {numbers['mean_se_m'][place][member]:.3f} / "
                    f"{numbers['median_m'][place][member]:.2f} / {numbers['q95_m'][place][member]:.2f}"
                    for member in range(len(names))
                ]
                largest = [numbers["largest_m"][place][names.index(name)] for name in ("Kalman", "Kalman + LSTM")]
                paper = f" ({PAPER_M[str(style)]:.2f})" if str(style) in PAPER_M else ""
                lines.append(
                    f"| {box}, {style} | {100 * noise:.0f} cm | {' | '.join(cells)} | "
                    f"{largest[0]:.2f}, {largest[1]:.2f}{paper} |"
                )
    return "\n".join(lines)


_LOOK = (
    ("0.6", ":", "x"),
    ("#E69F00", "--", "s"),
    ("#0072B2", "-", "o"),
    ("#D55E00", "-", "D"),
    ("#009E73", "-.", "^"),
)
"""Colour (of Okabe and Ito), line and mark of each predictor."""
_TICKS_M = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0)


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Mean errors over noise, with the 95 % quantile as a thin line, a panel for each style and box."""
    print(table(results))
    fig = new_figure(13.0, 8.0)
    panels = fig.subplots(len(results["boxes"]), len(results["styles"]), sharex=True, sharey=True)
    noise = 100 * results["noises_m"]
    for row, box in zip(range(len(panels)), results["boxes"]):
        for column, style in enumerate(results["styles"]):
            axis = panels[row, column]
            for member, (name, (colour, line, mark)) in enumerate(zip(results["predictors"], _LOOK)):
                mean, error = (results[key][row, column, :, member] for key in ("mean_m", "mean_se_m"))
                axis.errorbar(
                    noise, mean, 2 * error, ls=line, marker=mark, ms=5, color=colour, label=str(name), capsize=2
                )
                axis.plot(noise, results["q95_m"][row, column, :, member], ls=line, lw=0.7, color=colour, alpha=0.6)
            line = ""
            if str(style) in PAPER_M:
                axis.axhline(PAPER_M[str(style)], color="k", lw=0.8)
                line = f"\nline: the paper's largest of a flight, {PAPER_M[str(style)]:.2f} m"
            axis.set(xscale="log", yscale="log", title=f"{style}, box of {box}{line}")
            axis.set_xticks(noise, [f"{value:.0f}" for value in noise])
            axis.set_yticks(_TICKS_M, [f"{value:g}" for value in _TICKS_M])
            axis.minorticks_off()
            axis.grid(True, alpha=0.3)
    for axis in panels[-1]:
        axis.set_xlabel("error of an estimate along an axis [cm]")
    for axis in panels[:, 0]:
        axis.set_ylabel("error of the prediction [m]")
    panels[0, 0].legend(fontsize=8)
    fig.suptitle("thick: mean error with two standard errors; thin: 95 % of the errors are below", fontsize=10)
    save(fig, path)


def _options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--run", metavar="DIR", help="a predictor of your own (default: the shipped one)")


if __name__ == "__main__":
    run_script(__doc__, "prediction", compute, draw, _options)
