"""What ``august demo`` and ``august reconstruct`` share: sense a scenario, write the results, say what was found."""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from august_jax import config as configuration
from august_jax.app.cli.common import counted, folder
from august_jax.app.cli.messages import UsageError, command_line, note
from august_jax.app.cli.parser import whole
from august_jax.app.cli.results import array_told, leave
from august_jax.config import Config

if TYPE_CHECKING:
    from august_jax.app.plotting import Shown
    from august_jax.data import Target
    from august_jax.inference import Library
    from august_jax.pipeline import Networks, Scenario
    from august_jax.scene.airframes import Airframe
    from august_jax.schemes.matched_field import Found, Search
    from august_jax.tracking import Track


def search_arguments(parser: argparse.ArgumentParser, search: int, known: int | None) -> None:
    """``--search`` and ``--known``, which both commands take, each with its own defaults; a ``known`` of None: all."""
    most = int(configuration.bounds("flight.slots").high)
    parser.add_argument(
        "--search",
        type=whole(0, most),
        default=search,
        metavar="N",
        help=f"look for the drone among known ones, too, in N slots; takes minutes at first (default {search})",
    )
    parser.add_argument(
        "--known",
        type=whole(1),
        default=known,
        metavar="N",
        help="how many known drones a search compares with, the one that flies among them; each takes half a minute at "
        f"first (default {'all of the configuration' if known is None else known})",
    )


def sensed(
    args: argparse.Namespace,
    networks: Networks,
    config: Config,
    shot: Scenario,
    started: float,
    following: Sequence[tuple[str, str]],
    craft: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Sense ``shot``, write report, picture, clouds and numbers, and return the numbers.

    Args:
        args: of the command.
        networks, config: what senses, and under which settings.
        shot: what flies.
        started: :func:`time.monotonic` when the command began [s].
        following: pairs of a command line to try next and what it does.
        craft: where the craft came from and how it was turned, kept with the numbers; None for a flight that was drawn.
    """
    from august_jax import evaluation, pipeline
    from august_jax.app import plotting
    from august_jax.evaluation.bound import track_bound

    out = folder(args, f"august_{args.command}", configured=True)
    if args.known is not None and not args.search and any(word.partition("=")[0] == "--known" for word in args.words):
        raise UsageError("--known: says how many drones a search compares with; leave it out, or give --search N")
    known: tuple[str, ...] | None = None
    if args.search and config.data.dense_solver == "mom":
        known = _known(config, shot.airframe, args.known)  # what cannot be searched for is said before it is sensed
    elif args.search:
        note(f"no search: data.solver={config.data.solver} makes no bodies, without which no craft can be found")
    following = [
        *following,
        (
            command_line("evaluate", *([args.run] if args.run else []), "--seed", "1", *args.overrides),
            "the accuracy over SNR, beside its baselines",
        ),
        (command_line("export", str(out), "--format", "mat"), "the clouds for MATLAB"),
    ]
    track = pipeline.sense(networks, config, shot, seed=args.seed, snr_db=args.snr, progress=note)
    title = f"{shot.airframe.name} at {args.snr:g} dB, seen by {counted(config.array.count, 'antenna')}"
    draw = partial(plotting.clouds, track, permittivity=config.target.permittivity, title=title)
    search, bound = None, None
    if known is not None:
        first = out / f"{args.command}.first.png"
        draw(first)
        note(f"a first picture, what the networks find: {first}; a search among known drones follows")
        search, target = _searched(args, config, shot.airframe, known, track)
        note("working out the bound")
        bound = track_bound(track, target, config, args.snr)
        first.unlink(missing_ok=True)  # the whole picture follows
    scores: dict[str, Any] = evaluation.score_track(track, config, shot.airframe.half_wheelbase_m, search=search)
    if bound is not None and bound["bound_m"] is not None:
        scores["bound"] = bound
    seconds = time.monotonic() - started
    mean = {row["scheme"]: row for row in scores["schemes"]}
    slots = track.slots
    lead = (
        f"{f'Over {slots} slots the' if slots > 1 else 'The'} reconstructed cloud puts the drone "
        f"{100 * mean['august']['mpe_m']:.1f} cm from where it is{' on average' if slots > 1 else ''}; "
        f"the prediction it starts from is {100 * mean['prediction']['mpe_m']:.1f} cm off."
    )
    if search is not None:
        named = sum(
            int(found.answer.craft[0]) == search.craft for found in search.found if found.answer.craft is not None
        )
        error = 100 * mean["matched_field"]["mpe_m"]
        lead += (
            f" A search among {len(search.names)} known drones puts it {error:.1f} cm off, and names it in {named} of "
        )
        lead += f"{counted(len(search.found), 'slot')}."
    setup = [
        ("weights", networks.name),
        ("array", array_told(config)),
        ("drone", f"{shot.airframe.name}, half-wheelbase {shot.airframe.half_wheelbase_m:.3f} m"),
        *([("mesh", f"{args.mesh}: {shot.airframe.source}")] if shot.airframe.source else []),
        ("material", f"permittivity {track.permittivity:.2f}, conductivity {1e3 * track.conductivity:.2f} mS/m"),
        ("channel", f"full-wave ({config.data.dense_solver}), {config.signal.estimator} estimate"),
        ("sampler", f"{config.evaluate.sampler}, {counted(_sampler_steps(config), 'step')}, "
         f"{counted(config.target.points, 'point')}"),
        ("first predictions", f"uniform within {config.region.threshold_m:g} m along each axis, as of a detection"),
        *([("known drones", ", ".join(search.names))] if search is not None else []),
    ]  # fmt: skip
    return leave(
        args,
        out,
        config,
        track,
        scores,
        made={"weights": networks.name, "airframe": shot.airframe.name, **({"craft": dict(craft)} if craft else {})},
        seconds=seconds,
        title=title,
        lead=lead,
        setup=setup,
        following=following,
        draw=partial(
            draw, found={} if search is None else {each.slot: _shown(each, search.names) for each in search.found}
        ),
        hypotheses={} if search is None else {each.slot: each.clouds for each in search.found},
    )


def _shown(found: Found, names: Sequence[str]) -> Shown:
    """What a search found in a slot, as a picture shows it."""
    import numpy as np

    from august_jax.app.plotting import Shown

    answer = found.answer
    craft = int(np.argmax(found.posterior.craft_probability))
    label = f"search: {names[craft]}, {100 * found.posterior.craft_probability[craft]:.0f} %"
    if not found.posterior.found:
        label = "search: none of the known"
    cloud = answer.cloud
    assert cloud is not None and answer.normal is not None  # a search always says both
    return Shown(label, np.asarray(cloud.points)[0], np.asarray(cloud.permittivity)[0], np.asarray(answer.normal)[0])


def _searched(
    args: argparse.Namespace, config: Config, airframe: Airframe, known: tuple[str, ...], track: Track
) -> tuple[Search, Target]:
    """A search of the last slot, and of others spread over the flight, ``--search`` in all; and what flies."""
    import numpy as np

    from august_jax.schemes.matched_field import search_track

    library, craft, target = _library(config, airframe, known)
    slots = np.unique(np.linspace(track.slots - 1, 0, min(args.search, track.slots)).round().astype(int)).tolist()
    return search_track(track, library, config, seed=args.seed, slots=slots, craft=craft, progress=note), target


def _known(config: Config, airframe: Airframe, most: int | None) -> tuple[str, ...]:
    """Which craft of the configuration a search compares with, in its order: ``most`` in all with the one that flies,
    whether it is among them or not, or every one.

    Raises:
        ValueError: two are called alike.
    """
    from august_jax.inference.library import check_names
    from august_jax.scene import resolve_airframe

    every = config.target.airframes
    known = [resolve_airframe(name, config.target.half_wheelbase_m) for name in every]
    own = [row for row, drone in enumerate(known) if drone.digest == airframe.digest]
    others = [row for row in range(len(every)) if row not in own][: None if most is None else most - 1]
    rows = sorted(own + others)
    check_names(list({drone.digest: drone.name for drone in (*(known[row] for row in rows), airframe)}.values()))
    return tuple(every[row] for row in rows)


def _library(config: Config, airframe: Airframe, names: tuple[str, ...]) -> tuple[Library, int, Target]:
    """The drone that flies and others of the configuration, ``most`` in all or every one, in the configuration's order;
    which of them flies, and that one."""
    from august_jax.data import Target, lattice_of, nearest_distance, prepare_targets
    from august_jax.inference import known_craft
    from august_jax.physics import factor_body

    note("preparing the known drones, which takes half a minute each for the first time")
    targets = []
    if names:
        targets = prepare_targets(replace(config, target=replace(config.target, airframes=names)), note)
    flies = [row for row, target in enumerate(targets) if target.airframe.digest == airframe.digest]
    if not flies:
        cells, cell_m = lattice_of(airframe, config.target)
        note(f"{airframe.name}: {cells.count} cells of {1e3 * cell_m:.3g} mm")
        body = factor_body(
            cells, config.array.tones_hz or config.array.frequency_hz, nearest_m=nearest_distance(config)
        )
        targets = [*targets, Target(airframe, cells, cell_m, body, airframe.surface)]
    own_row = flies[0] if flies else len(targets) - 1
    return known_craft(config, targets, progress=note), own_row, targets[own_row]


def _sampler_steps(config: Config) -> int:
    return config.evaluate.sampler_steps if config.evaluate.sampler == "dpm" else config.model.steps
