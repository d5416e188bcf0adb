"""Sums on CPUs: the flag that keeps some releases of jaxlib from fusing them wrongly, and the sums themselves."""

import os
import subprocess
import sys

import pytest
from jaxlib.version import __version__ as jaxlib_release

from august_jax import FUSES_SUMS_WRONGLY, LEAST_THREADS, UNFUSED_SUMS, names_a_file, threads_wanted, xla_flags
from august_jax.app.sums import MANY_AXES, TRIALS, many_axes_fault, wrong_sums

_OWN = "--xla_cpu_experimental_ynn_fusion_type="


@pytest.mark.parametrize(
    "jaxlib, flags, wanted",
    [
        ("0.10.2", "", UNFUSED_SUMS),
        ("0.11.0", "", UNFUSED_SUMS),
        ("0.10.2", "  ", UNFUSED_SUMS),
        ("0.10.2", "--xla_cpu_enable_fast_math=false", f"--xla_cpu_enable_fast_math=false {UNFUSED_SUMS}"),
        ("0.10.2", _OWN, _OWN),  # the user's own setting stays
        ("0.10.2", f"--xla_cpu_enable_fast_math=false {_OWN}dot", f"--xla_cpu_enable_fast_math=false {_OWN}dot"),
        ("0.10.2", UNFUSED_SUMS, UNFUSED_SUMS),
        ("0.10.2", "/etc/xla_flags", "/etc/xla_flags"),  # XLA would look for a file of the longer name
        ("0.11.0", "flags.txt", "flags.txt"),
        *((jaxlib, "", "") for jaxlib in ("0.10.0", "0.10.1", "0.11.1", "0.11.2", "0.12.0", "0.12.0.1", "0.13.0")),
        ("0.12.0", "--xla_cpu_enable_fast_math=false", "--xla_cpu_enable_fast_math=false"),
    ],
)
def test_the_flag_goes_where_it_is_needed_and_nowhere_else(jaxlib, flags, wanted):
    assert xla_flags(jaxlib, flags) == wanted


def _first_sum(flags: str) -> subprocess.CompletedProcess:
    code = "import os, august_jax, jax.numpy as jnp; print(os.environ['XLA_FLAGS'], jnp.ones(3).sum())"
    return subprocess.run(
        [sys.executable, "-c", code], env=os.environ | {"XLA_FLAGS": flags}, text=True, capture_output=True, check=False
    )


@pytest.mark.parametrize("content, warned", [("", True), (UNFUSED_SUMS, False)])
def test_a_file_of_flags_stays_and_what_it_lacks_is_said(tmp_path, content, warned):
    path = tmp_path / "flags"
    path.write_text(f"--xla_backend_optimization_level=0\n{content}\n")
    run = _first_sum(str(path))
    assert run.stdout == f"{path} 3.0\n", run.stderr
    assert ("add that line to it" in run.stderr) is (warned and jaxlib_release in FUSES_SUMS_WRONGLY)


def test_flags_of_ones_own_are_kept():
    flags, total = _first_sum("--xla_backend_optimization_level=0").stdout.rsplit(maxsplit=1)
    assert total == "3.0" and flags == xla_flags(jaxlib_release, "--xla_backend_optimization_level=0")


@pytest.mark.parametrize(
    "flags, file",
    [
        ("", False),
        ("  --xla_backend_optimization_level=0", False),
        ("-xla_backend_optimization_level=0", False),
        ("missing", True),
    ],
)
def test_what_is_taken_for_a_file_is_what_xla_takes_for_one(flags, file):
    assert names_a_file(flags) is file
    assert ("Could not open file" in _first_sum(flags).stderr) is file


@pytest.mark.parametrize("trial", TRIALS.values(), ids=TRIALS)
def test_sums_come_out_right_in_this_process(trial):
    assert trial() < 1e-6


def test_sums_of_products_with_many_axes_come_out_right():
    assert many_axes_fault() is None  # in a process of their own, which some releases end
    assert max(trial() for trial in MANY_AXES.values()) < 1e-6


def test_a_wrong_sum_is_told():
    assert wrong_sums({"right ones": lambda: 1e-7, "wrong ones": lambda: 2e-3, "lost ones": lambda: float("nan")}) == [
        "wrong ones are off by 0.002",
        "lost ones are off by nan",
    ]


@pytest.mark.parametrize(
    "jaxlib, cores, wanted",
    [
        ("0.10.0", 1, LEAST_THREADS),
        ("0.10.2", 2, LEAST_THREADS),
        ("0.10.3.dev20260801", 2, LEAST_THREADS),
        ("0.11.1", 2, LEAST_THREADS),
        ("0.10.2", LEAST_THREADS, None),
        ("0.10.2", 256, None),
        *((jaxlib, 2, None) for jaxlib in ("0.11.2", "0.12.0", "0.12.0.1", "0.13.0", "1.0.0")),
    ],
)
def test_a_small_pool_gets_threads_where_decompositions_wait_in_it(jaxlib, cores, wanted):
    assert threads_wanted(jaxlib, cores) == wanted


@pytest.mark.parametrize("own", [{}, {"PJRT_NPROC": "3"}, {"NPROC": "4"}])
def test_threads_of_ones_own_are_kept(own):
    code = "import os, august_jax; print(os.environ.get('PJRT_NPROC'))"
    clean = {name: value for name, value in os.environ.items() if name not in ("PJRT_NPROC", "NPROC")}
    run = subprocess.run([sys.executable, "-c", code], env=clean | own, text=True, capture_output=True, check=True)
    wanted = threads_wanted(jaxlib_release, len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count())
    assert run.stdout.strip() == (own.get("PJRT_NPROC") or str(None if own else wanted))
