"""Memory before the run: the compiled step's need against a limit that is made up."""

from dataclasses import replace

import pytest
from test_training import CONFIG, next_batch

from august_jax import memory
from august_jax.mesh import data_mesh
from august_jax.training import fit, initial_state
from august_jax.training.fit import bytes_needed, compiled, fitted_step

MANY = replace(CONFIG.train, batch=512)


@pytest.fixture(scope="module")
def asked():
    """What a step of 512 samples needs, and all that it was asked of."""
    layout, state = initial_state(CONFIG)
    batch, mesh = next_batch(0, MANY.batch), data_mesh(1)
    return layout.loss, state, batch, mesh, bytes_needed(compiled(layout.loss, MANY, state, batch, mesh))


def test_what_fits_is_compiled_once_and_runs(asked, monkeypatch):
    loss, state, batch, mesh, needed = asked
    state = initial_state(CONFIG)[1]  # it is donated
    monkeypatch.setattr(memory, "for_a_program", lambda _: 10 * needed)
    state, numbers = fitted_step(loss, MANY, state, batch, mesh)(state, batch)
    assert int(state.step) == 1 and float(numbers["loss"]) > 0.0


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.8, 0.5])
def test_too_much_is_answered_with_a_batch_that_fits(asked, monkeypatch, share):
    loss, state, batch, mesh, needed = asked
    monkeypatch.setattr(memory, "for_a_program", lambda _: int(share * needed))
    with pytest.raises(
        ValueError, match=r"train.batch: 512 samples ask for .* on each device.*; set train.batch=\d+$"
    ) as told:
        fitted_step(loss, MANY, state, batch, mesh)
    fits = int(str(told.value).rpartition("=")[2])
    assert 0.2 * share * 512 < fits < 512
    fewer = replace(MANY, batch=fits)
    fitted_step(loss, fewer, state, next_batch(0, fits), mesh)


def test_where_nothing_fits_that_is_said(asked, monkeypatch):
    loss, state, batch, mesh, _ = asked
    monkeypatch.setattr("august_jax.training.fit.bytes_available", lambda *_: 1000)
    with pytest.raises(ValueError, match="no batch fits; take smaller networks"):
        fitted_step(loss, MANY, state, batch, mesh)


def test_where_nobody_tells_the_memory_nothing_is_refused(asked, monkeypatch):
    loss, state, batch, mesh, _ = asked
    monkeypatch.setattr(memory, "for_a_program", lambda _: None)
    fitted_step(loss, MANY, state, batch, mesh)


def test_files_that_were_read_do_not_count_as_used(monkeypatch, tmp_path):
    """A container counts them; the system drops them when programs want the room."""
    monkeypatch.setattr(memory, "_CONTAINER", tmp_path)
    (tmp_path / "memory.max").write_text(f"{2**28}\n")
    (tmp_path / "memory.current").write_text(f"{2**28 - 1000}\n")
    assert memory.memory().free <= 1000
    (tmp_path / "memory.stat").write_text(f"anon 5\ninactive_file {2**26}\n")
    assert memory.memory().free == min(2**26 + 1000, memory.memory().free) > 1000
    (tmp_path / "memory.max").write_text("max\n")
    assert memory.memory().total > 2**28


def test_devices_of_one_processor_share_its_memory(monkeypatch):
    monkeypatch.setattr(memory, "memory", lambda: memory.Memory(10**9, 8 * 10**8))
    assert memory.for_a_program(data_mesh(1)) == 8 * 10**8


def affine(rows):
    return 4000 + 100 * rows


SIZES = {
    "a little": (affine, 0.5, (10, 12)),
    "next to all": (affine, 0.98, (50, 61)),
    "sizes in steps": (lambda rows: 4800 + 40 * -(-rows // 8), 0.97, (24, 32)),
    "one sample alone": (lambda rows: 1000 * rows, 1.5 / 64, (1, 1)),
    "less than one": (affine, 0.3, None),
}
"""Bytes over rows, the part of them that there is of 64 rows, and what is near the largest batch that fits."""


@pytest.mark.parametrize("case", SIZES)
def test_a_batch_near_the_largest_is_found_with_few_programs(monkeypatch, unchecked, case):
    """By made-up sizes of programs; each costs a compilation."""
    size, share, wanted = SIZES[case]
    met = []
    monkeypatch.setattr(fit, "_of_rows", lambda _, rows: rows)
    monkeypatch.setattr(fit, "compiled", lambda loss, train, state, rows, mesh: met.append(rows) or rows)
    monkeypatch.setattr(fit, "bytes_needed", size)
    available = int(share * size(64) / fit._SHARE)
    found = fit.largest_batch(None, replace(MANY, batch=64), None, None, data_mesh(1), size(64), available)
    assert len(met) <= 5
    if wanted is None:
        assert found is None
    else:
        assert wanted[0] <= found <= wanted[1] and size(found) <= fit._SHARE * available
