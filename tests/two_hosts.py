"""One of two hosts that train as one; tests/test_scale_hosts.py starts both, on 127.0.0.1.

python tests/two_hosts.py PLACE PORT FOLDER WHAT     PLACE 1 or 2
"""

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from test_training import CONFIG, next_batch

from august_jax import hosts
from august_jax.config import override, preset
from august_jax.data import StreamedBatches, prepare_targets
from august_jax.mesh import SPLIT, data_mesh, placed, rows_kept_here
from august_jax.training import train

RUN = replace(CONFIG, train=replace(CONFIG.train, steps=8, batch=16, save_every=4))
"""Eight steps, saved twice."""
STREAM = override(preset("smoke"), ["train.source=stream", "train.batch=8", "target.points=20"])


def batch_of(step):
    return next_batch(step, RUN.train.batch)


def trained(folder: Path, place: int) -> None:
    """The run, cut on both hosts behind its first save and continued."""

    def cut(step):
        if step == 6:
            raise ConnectionError("power cut")
        return batch_of(step)

    said = []
    try:
        train(RUN, cut, folder, progress=said.append)
    except ConnectionError:
        said.append("cut")
    state = train(RUN, batch_of, folder, progress=said.append)
    told = {"said": said, "loss": float(np.sum(np.asarray(state.params))), "devices": data_mesh().size}
    print(json.dumps(told), flush=True)


def differs(folder: Path, place: int) -> None:
    """Each host is given another configuration."""
    train(replace(RUN, train=replace(RUN.train, seed=place)), batch_of, folder)


def occupied(folder: Path, place: int) -> None:
    """The first host finds the folder in use, which the other cannot know."""
    from august_jax.files import occupying

    if place == 1:
        with occupying(folder / "run"):
            train(RUN, batch_of, folder / "run")
    else:
        train(RUN, batch_of, folder / "run")


def dies(folder: Path, place: int) -> None:
    """The second host is gone amid the run."""

    def batch(step):
        if step == 5 and place == 2:
            os._exit(9)
        return batch_of(step)

    train(RUN, batch, folder)


def streamed(folder: Path, place: int) -> None:
    """Each host makes its own rows of a streamed batch."""
    batches = StreamedBatches(STREAM, prepare_targets(override(STREAM, ["data.solver=table"])))
    batch = rows_kept_here(batches(3))
    print(json.dumps({"cloud": batch.cloud.tolist(), "predicted": batch.predicted.tolist()}), flush=True)


def own_parts(folder: Path, place: int) -> None:
    """Each host places its own rows of what all have."""
    rows = placed(np.arange(8.0), data_mesh(), SPLIT)
    print(json.dumps([float(value) for shard in rows.addressable_shards for value in shard.data]), flush=True)


if __name__ == "__main__":
    place, port, folder, what = int(sys.argv[1]), sys.argv[2], Path(sys.argv[3]), sys.argv[4]
    hosts.join(f"127.0.0.1:{port}", (place, 2), wait_s=60)
    try:
        {each.__name__: each for each in (trained, differs, occupied, dies, streamed, own_parts)}[what](folder, place)
    except ValueError as error:
        print(json.dumps({"refused": str(error)}), flush=True)
