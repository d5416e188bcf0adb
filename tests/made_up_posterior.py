"""A posterior that nobody searched for: what the scheme, the evaluation and the report make of one is tried with it."""

import sys
from dataclasses import replace
from typing import Any

import jax
import numpy as np

import august_jax.evaluation
from august_jax.inference import Hypotheses, Posterior
from august_jax.scene import procedural_airframe

LEAN = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
"""The attitude of the most probable hypothesis: the others are level."""


class MadeUpLibrary:
    """As much of a library as there is to ask of one that is not searched."""

    def __init__(self, names: tuple[str, ...]):
        self.names, self.airframes = names, tuple(procedural_airframe(name) for name in names)


def made_up_posterior(place: Any, *, samples: int = 400, crafts: int = 2, **rest: Any) -> Posterior:
    """Samples about ``place`` (3,) [m] of two hypotheses: the last craft, leaning, 0.1 m off, and the first, level."""
    rng = np.random.default_rng(0)
    place = np.asarray(place, np.float64)
    modes = Hypotheses(
        craft=np.array([crafts - 1, 0]),
        rotation=np.stack([LEAN, np.eye(3)]),
        position=np.stack([place + 0.1, place]),
        permittivity=np.array([2.0, 3.0]),
        conductivity=np.array([4e-3, 5e-3]),
        weight=np.array([0.7, 0.3]),
        residual=np.array([200.0, 201.0]),
        covariance=np.tile(1e-4 * np.eye(8), (2, 1, 1)),
    )
    mode = (np.arange(samples) >= 0.7 * samples).astype(int)
    made = Posterior(
        hypotheses=modes,
        craft=modes.craft[mode],
        rotation=modes.rotation[mode],
        position=place + rng.normal(size=(samples, 3)) * [0.01, 0.02, 0.05],
        permittivity=modes.permittivity[mode],
        conductivity=modes.conductivity[mode],
        log_weight=np.log(rng.dirichlet(np.full(samples, 0.3)) + 1e-12),
        crafts=crafts,
        effective=100.0,
        residual=200.0,
        degrees=390,
        probability=0.6,
        level=0.01,
        seconds={"screen": 1.0, "refine": 0.5},
    )
    return replace(made, **rest)


def search_is_made_up(monkeypatch: Any, unexplained: tuple[int, ...] = ()) -> None:
    """Every search finds a made-up posterior about q_pre; those with these numbers find no explanation."""
    asked: list[int] = []

    def found(library: Any, statistics: Any, prior: Any, *, key: jax.Array) -> Posterior:
        asked.append(1)
        probability = 1e-9 if len(asked) - 1 in unexplained else 0.6
        return made_up_posterior(statistics.centre, crafts=len(library.names), probability=probability)

    def known(config: Any, targets: Any, *, progress: Any) -> MadeUpLibrary:
        return MadeUpLibrary(tuple(target.airframe.name for target in targets))

    monkeypatch.setattr("august_jax.schemes.matched_field.find_craft", found)
    monkeypatch.setattr("august_jax.inference.known_craft", known)
    # a function of this name stands in the way of its module's
    monkeypatch.setattr(sys.modules[f"{august_jax.evaluation.__name__}.evaluate"], "known_craft", known)
