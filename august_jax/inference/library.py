"""The known craft: bodies and tables of what may be in the air, made once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from august_jax import streams
from august_jax.config import Config
from august_jax.data.simulator import Target, check_table, contrast_of, prepare_targets, tabulate_targets
from august_jax.inference.screen import attitude_lattice
from august_jax.mesh import WHOLE, own_accelerators, placed
from august_jax.physics import Body, Table, stack_tables
from august_jax.physics.body.survey import SurveyTable, survey_table
from august_jax.progress import Progress, silent
from august_jax.scene.airframes import Airframe
from august_jax.signal.roi import Subspace

SPACING_DEG = 3.2
"""Of the attitudes that are looked at first [deg]."""
_BEYOND_DEG = 1.0
_OTHERS = 1.1
"""Times as far apart as the first: another lattice, no point of which is where one of the first was in vain."""


@dataclass(frozen=True, eq=False)
class Library:
    """Known craft and all that a search needs of them.

    Attributes:
        config: array, ranges of place, tilt and material.
        targets: airframes, cells and factored bodies, C of them.
        table: their tables, stacked.
        survey: the tables at one contrast.
        survey_contrast: that of the survey, its real part.
        subspace: of the station.
        attitudes: that a search looks at first (n, 3, 3) float32.
        spacing_deg: of these [deg].
    """

    config: Config
    targets: tuple[Target, ...]
    table: Table
    survey: SurveyTable
    survey_contrast: float
    subspace: Subspace
    attitudes: Float[np.ndarray, "n 3 3"]
    spacing_deg: float

    @cached_property
    def others(self) -> Float[np.ndarray, "m 3 3"]:
        """Attitudes that a search looks at where the first led to no explanation (m, 3, 3) float32."""
        return _attitudes(self.config, _OTHERS * self.spacing_deg)

    @cached_property
    def shared_survey(self) -> SurveyTable:
        """The survey, on all of this host's accelerators."""
        return placed(self.survey, own_accelerators(), WHOLE)

    @property
    def airframes(self) -> tuple[Airframe, ...]:
        """The craft."""
        return tuple(target.airframe for target in self.targets)

    @property
    def names(self) -> tuple[str, ...]:
        """Their names."""
        return tuple(airframe.name for airframe in self.airframes)

    def body(self, craft: int) -> Body:
        """A craft's factored body."""
        body = self.targets[craft].body
        assert body is not None
        return body


def check_names(names: Sequence[str]) -> None:
    """Refuse craft that answers could not tell apart by name.

    Raises:
        ValueError: two are called alike.
    """
    for name in names:
        if list(names).count(name) > 1:
            raise ValueError(
                f"target.airframes: two of the known craft are called {name!r}, by which answers name a craft; give "
                "the file of one another name"
            )


@streams.pin
def known_craft(
    config: Config,
    targets: Sequence[Target] | None = None,
    *,
    spacing_deg: float = SPACING_DEG,
    progress: Progress = silent,
) -> Library:
    """Prepare a library of the craft of ``config.target.airframes``; minutes for the first time, then from the cache.

    Args:
        config: craft, array, box, materials.
        targets: of :func:`august_jax.data.prepare_targets` for the same configuration, where they are there already;
            tables that they hold are taken.
        spacing_deg: of the attitudes that a search looks at first [deg].
        progress: told how far it is.

    Raises:
        ValueError: no craft, a craft twice, two of one name, craft without bodies (``data.solver`` other than mom and
            table), or with tables that do not hold all that the configuration's craft may be.
    """
    targets = tuple(prepare_targets(config, progress) if targets is None else targets)
    if not targets:
        raise ValueError(
            "targets: a library needs at least one craft; give what prepare_targets makes of target.airframes"
        )
    digests: dict[str, str] = {}
    for target in targets:
        name = target.airframe.name
        twice = digests.get(target.airframe.digest)
        if twice is not None:
            raise ValueError(
                f"targets: {name} is in the library twice{'' if twice == name else f', as {twice} too'}; name each "
                "craft once in target.airframes"
            )
        digests[target.airframe.digest] = name
        if target.body is None:
            raise ValueError(
                f"data.solver: {config.data.solver!r} makes no bodies, without which {name} cannot be found; use mom"
            )
    check_names(list(digests.values()))
    tables = [target.table for target in targets]
    found = [table for table in tables if table is not None]
    for table in found:
        check_table(config, table)
    if len(found) < len(targets):
        found = tabulate_targets(config, [target.body for target in targets if target.body is not None], progress)
    ranges = config.target
    middle = contrast_of(config, np.mean(np.sqrt(ranges.permittivity)) ** 2, np.mean(ranges.conductivity_s_m))
    stacked = stack_tables(found)
    return Library(
        config,
        targets,
        stacked,
        survey_table(stacked, middle),
        float(np.real(middle[0])),
        Subspace.from_config(config.array),
        _attitudes(config, spacing_deg),
        spacing_deg,
    )


def _attitudes(config: Config, spacing_deg: float) -> Float[np.ndarray, "n 3 3"]:
    return attitude_lattice(config.flight.tilt_deg + _BEYOND_DEG, spacing_deg)
