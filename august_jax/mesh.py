"""The devices that share one computation: a row of them, each with an equal part of the rows of a batch.

A mean over a batch of B rows on D devices is the mean of D means over B/D rows each,

    1/B sum_i f(x_i) = 1/D sum_d (D/B sum_{i of d} f(x_i)),

and so is its gradient: each device works on its rows (:func:`spread`), and what all need is averaged once
(:func:`mean_over_devices`). What is drawn for a batch is drawn for all of it on every device, which keeps its own rows
(:func:`own_rows`): the numbers are those of one device, whatever generator draws them. On one device none of this is
there, and programs are those of the functions alone.

The devices may be those of several hosts (:mod:`august_jax.hosts`). Each then has the whole batch, of which it places
the rows of its own devices (:func:`placed`), or it makes these alone (:func:`rows_here`, :func:`joined`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

ROWS = "data"
"""Name of the one axis of a mesh."""
SPLIT = PartitionSpec(ROWS)
"""Of arrays whose rows are shared out."""
WHOLE = PartitionSpec()
"""Of arrays that every device has whole."""

T = TypeVar("T")


def data_mesh(devices: int | None = None, *, local: bool = False) -> Mesh:
    """Visible devices in a row, of all hosts in their order.

    Args:
        devices: how many of each host; None takes all that it sees.
        local: those of this host alone.

    Raises:
        ValueError: more than a host sees, or none; or hosts that see different numbers of them.
    """
    found = jax.local_devices() if local else jax.devices()
    hosts: dict[int, list[jax.Device]] = {}
    for device in found:
        hosts.setdefault(device.process_index, []).append(device)
    least, most = (pick(len(each) for each in hosts.values()) for pick in (min, max))
    if devices is not None and not 1 <= devices <= least:
        hint = " (of a CPU, XLA_FLAGS=--xla_force_host_platform_device_count=N makes N)" if _on_cpu(found) else ""
        raise ValueError(f"devices: {devices}, but JAX sees {least} here{hint}; give 1 to {least}, or leave it out")
    if devices is None and least != most:
        raise ValueError(f"devices: hosts see {least} to {most} of them; give {least}, so that all have equal parts")
    chosen = [device for _, each in sorted(hosts.items()) for device in each[: devices or most]]
    return Mesh(np.array(chosen), (ROWS,), axis_types=(AxisType.Auto,))


def own_accelerators() -> Mesh:
    """This host's devices, for work that shares nothing between hosts; of a processor its first device.

    Devices that XLA makes of one processor share its cores. There is no speed in them, and where a program calls LAPACK
    (estimators of channels do) they may wait for one another for ever (jaxlib 0.10.2).
    """
    return data_mesh(1 if _on_cpu(jax.local_devices()) else None, local=True)


def _on_cpu(devices: list[jax.Device]) -> bool:
    return all(device.platform == "cpu" for device in devices)


def check_divides(batch: int, mesh: Mesh) -> None:
    """Refuse a batch that devices cannot share equally.

    Raises:
        ValueError: names the nearest that they can.
    """
    below, above = batch // mesh.size * mesh.size, -(-batch // mesh.size) * mesh.size
    if below != above:
        nearest = " or ".join(f"train.batch={each}" for each in (below, above) if each)
        fewer = max(number for number in range(1, mesh.size) if batch % number == 0)
        raise ValueError(
            f"train.batch: {batch} samples cannot be shared equally by {mesh.size} devices; set {nearest}, or take "
            + ("fewer devices" if jax.process_count() > 1 else f"devices={fewer}")
        )


def spread(function: Callable[..., T], mesh: Mesh, takes: Any, gives: Any) -> Callable[..., T]:
    """``function``, run by every device on its rows; on one device ``function`` itself.

    Args:
        function: of arrays or trees of them.
        takes: :data:`SPLIT` or :data:`WHOLE` of each argument.
        gives: the same of what it returns.
    """
    if mesh.size == 1:
        return function
    return jax.shard_map(function, mesh=mesh, in_specs=takes, out_specs=gives, check_vma=False)


def own_rows(draw: Callable[[int], jax.Array], count: int) -> jax.Array:
    """Rows (count, ...) of this device, of what ``draw`` makes for the whole batch; outside of :func:`spread` all.

    Args:
        draw: number of rows -> (rows, ...).
        count: rows that this device works on.
    """
    if not _apart():
        return draw(count)
    first = jax.lax.axis_index(ROWS) * count
    return jax.lax.dynamic_slice_in_dim(draw(count * jax.lax.axis_size(ROWS)), first, count)


def mean_over_devices(tree: T) -> T:
    """The mean of what devices have, the same on all; outside of :func:`spread` ``tree`` itself."""
    return jax.lax.pmean(tree, ROWS) if _apart() else tree


def _apart() -> bool:
    """Whether this is traced for each device on its rows."""
    return ROWS in jax.sharding.get_abstract_mesh().manual_axes


def placed(tree: T, mesh: Mesh, spec: PartitionSpec) -> T:
    """Arrays where ``spec`` has them on the mesh, of which every host gives the whole, or :func:`joined` ones. On one
    device ``tree`` itself."""
    if mesh.size == 1:
        return tree
    sharding = NamedSharding(mesh, spec)

    def leaf(value: Any) -> jax.Array:
        if jax.process_count() == 1:
            return jax.device_put(value, sharding)
        if isinstance(value, jax.Array) and not value.is_fully_addressable:
            return value
        if jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(leaf(jax.random.key_data(value)), impl=jax.random.key_impl(value))
        whole = np.asarray(value)
        return jax.make_array_from_callback(whole.shape, sharding, lambda part: whole[part])

    return jax.tree.map(leaf, tree)


def rows_here(count: int, mesh: Mesh) -> tuple[int, int]:
    """The first of a batch's rows that belong to this host's devices, and the one behind the last."""
    own = [number for number, device in enumerate(mesh.devices.flat) if device.process_index == jax.process_index()]
    each = count // mesh.size
    return own[0] * each, (own[-1] + 1) * each


def joined(tree: T, mesh: Mesh) -> T:
    """Arrays of all rows, of which each host gives its own (:func:`rows_here`). On one host ``tree`` itself."""
    if jax.process_count() == 1:
        return tree
    sharding = NamedSharding(mesh, SPLIT)
    own = [device for device in mesh.devices.flat if device.process_index == jax.process_index()]

    def leaf(value: jax.Array) -> jax.Array:
        each = len(value) // len(own)
        parts = [jax.device_put(value[each * i : each * (i + 1)], device) for i, device in enumerate(own)]
        return jax.make_array_from_single_device_arrays((each * mesh.size, *value.shape[1:]), sharding, parts)

    return jax.tree.map(leaf, tree)


def rows_kept_here(tree: T) -> T:
    """Of :func:`joined` arrays the rows of this host, as NumPy; others as they are."""

    def leaf(value: Any) -> Any:
        if not isinstance(value, jax.Array) or value.is_fully_addressable:
            return value
        return np.concatenate([np.asarray(part.data) for part in value.addressable_shards])

    return jax.tree.map(leaf, tree)


def brought_home(tree: T) -> T:
    """Arrays that every device has whole, as they are on this host's first; those of one device as they are."""

    def leaf(value: Any) -> Any:
        if jax.dtypes.issubdtype(value.dtype, jax.dtypes.prng_key):
            return jax.random.wrap_key_data(leaf(jax.random.key_data(value)), impl=jax.random.key_impl(value))
        return value if len(value.sharding.device_set) == 1 else value.addressable_data(0)

    return jax.tree.map(leaf, tree)
