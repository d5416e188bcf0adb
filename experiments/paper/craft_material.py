"""Weighted distance over transmit power by the craft's material (paper: permittivity to 15, conductivity to 2 S/m).

    python experiments/paper/craft_material.py compute|draw [--preset laptop]

One set of networks knows the whole range of materials; what flies is of one material a line.
"""

from __future__ import annotations

from campaign import Campaign, Numbers, Run, run_of
from figure import Figure, main
from over_power import Case, drawn_over_power, over_power


def runs(preset: str) -> list[tuple[Run, bool]]:
    """AUGUST over the wide range of materials, with our encoder."""
    return [(run_of(preset, "august", "roi", wide=True), False)]


def compute(campaign: Campaign) -> Numbers:
    """Three permittivities of little loss, and the largest loss."""
    scale, run = campaign.scale, runs(campaign.preset)[0][0]
    weak, strong = 2.0, scale.permittivity
    middle = round((weak * strong) ** 0.5, 1)
    materials = [(weak, 1e-3), (middle, 1e-3), (strong, 1e-3), (middle, scale.conductivity_s_m)]
    cases = [
        Case(
            f"permittivity {permittivity:g}, {conductivity:g} S/m",
            run,
            (
                f"target.permittivity=[{permittivity:g},{permittivity:g}]",
                f"target.conductivity_s_m=[{conductivity:g},{conductivity:g}]",
                "data.solver=mom",
                "train.source=stored",
            ),
        )
        for permittivity, conductivity in materials
    ]
    return over_power(campaign, cases, scale.count)


FIGURE = Figure(
    "craft_material", "weighted distance over power by material", "UAV material: WD versus P_s", runs, compute,
    drawn_over_power, 3.0,
)  # fmt: skip


if __name__ == "__main__":
    main(FIGURE, __doc__)
