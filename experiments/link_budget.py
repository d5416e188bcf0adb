"""How strong an echo the `paper` preset hears over its flight box: signal-to-noise ratios at one transmit power.

    python experiments/link_budget.py compute [--small]     writes experiments/results/link_budget.npz
    python experiments/link_budget.py draw                  reads it, writes experiments/results/link_budget.png

Samples of the preset, as `august simulate` makes them, but that every one transmits at 25 dBm: the SNR in dB moves with
the power in dBm. The thickness of the craft's skin is what sets the strength of the echo: that of the preset, and that
of `laptop`.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from script import run

from august_jax.app.plotting import new_figure, save
from august_jax.config import preset
from august_jax.data import generate, prepare_targets
from august_jax.progress import Progress

POWER_DBM = 25.0
SKINS_M = tuple(preset(name).target.skin_m for name in ("paper", "laptop"))


def compute(small: bool, progress: Progress = print) -> dict[str, np.ndarray]:
    """SNRs [dB] (skin, airframe, flight) and volumes of material [m^3] (skin, airframe)."""
    paper = preset("paper")
    names, flights, most = (("quad_x",), 32, 500) if small else (paper.target.airframes, 200, paper.target.max_cells)
    snr, volumes = [], []
    for skin in SKINS_M:
        config = replace(
            paper,
            target=replace(paper.target, airframes=names, skin_m=skin, max_cells=most),
            signal=replace(paper.signal, power_dbm=(POWER_DBM, POWER_DBM)),
        )
        targets = prepare_targets(config)
        # the first slot of each flight; airframes take turns by flight
        heard = generate(config, np.arange(flights * len(names)) * config.flight.slots, targets).observed.snr_db
        snr.append(heard.reshape(flights, len(names)).T)
        volumes.append([np.sum(target.cells.fill * target.cells.volumes) for target in targets])
        for name, values, volume in zip(names, snr[-1], volumes[-1]):
            low, middle, high = np.percentile(values, (10, 50, 90))
            progress(
                f"skin {1e3 * skin:g} mm, {name}: {1e6 * volume:.0f} cm^3, SNR at {POWER_DBM:g} dBm: median "
                f"{middle:.1f} dB, 10 to 90 % of flights {low:.1f} to {high:.1f} dB"
            )
    return {
        "snr_db": np.array(snr),
        "material_m3": np.array(volumes),
        "skins_m": np.array(SKINS_M),
        "airframes": np.array(names),
        "power_dbm": np.array(POWER_DBM),
    }


def draw(results: dict[str, np.ndarray], path: Path) -> None:
    """Share of flights whose SNR stays below a value, one line an airframe, solid for the first skin."""
    fig = new_figure(8.0, 4.6)
    axis = fig.subplots()
    for skin, line, rows in zip(results["skins_m"], ("-", "--"), results["snr_db"]):
        for index, (name, values) in enumerate(zip(results["airframes"], rows)):
            axis.plot(
                np.sort(values),
                (np.arange(len(values)) + 0.5) / len(values),
                line,
                color=f"C{index}",
                label=f"{name}, skin {1e3 * skin:g} mm",
            )
    axis.set(xlabel=f"SNR at {float(results['power_dbm']):g} dBm [dB]", ylabel="share of flights below", ylim=(0, 1))
    axis.grid(True, alpha=0.3)
    axis.legend(fontsize=8)
    save(fig, path)


if __name__ == "__main__":
    run(__doc__, "link_budget", compute, draw)
