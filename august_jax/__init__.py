"""august_jax: sensing drones with a base station's antenna array.

A differentiable full-wave simulator (:mod:`august_jax.physics`), flights of airframes (:mod:`august_jax.scene`),
what the base station receives (:mod:`august_jax.signal`) and the AUGUST generative model
(:mod:`august_jax.models`). Subpackages are imported where they are used, so that this import stays light.

On import, ``XLA_FLAGS`` is told not to fuse sums on CPUs where the installed jaxlib is a release that fuses some of
them wrongly (:func:`xla_flags`). JAX reads the variable when it first computes: import august_jax before that.
``august doctor`` says whether sums come out right.

Where the installed jaxlib is a release whose batched decompositions wait for the pool of threads that they run in,
``PJRT_NPROC`` gives that pool six threads at the least (:func:`threads_wanted`): two of them at once never end on two
cores.

And products of matrices are asked of JAX in full single precision, unless ``JAX_DEFAULT_MATMUL_PRECISION`` or a program
says otherwise: left alone, GPUs and TPUs round the factors to 10 or 7 binary digits, which is more than the noise of an
echo. The networks' own layers say what they want themselves, and stay as fast as the device allows
(:mod:`august_jax.models.layers`).
"""

from __future__ import annotations

import os
import re
import sys
import warnings

import jaxlib  # its version alone: four times as fast as to ask importlib.metadata, and no backend is loaded

__version__ = "0.1.0"

UNFUSED_SUMS = "--xla_cpu_experimental_ynn_fusion_type=-reduce"
"""What ``XLA_FLAGS`` is told where the installed jaxlib needs it."""

FUSES_SUMS_WRONGLY = ("0.10.2", "0.11.0")
"""Releases of jaxlib that need :data:`UNFUSED_SUMS`.

Tried without the flag and with it, each release from 0.10.0 to 0.12.0.1 on x86-64 Linux: the reports jax-ml/jax#39103
(a mapped product of matrix and vector, then a sum), #39257 and #40412 (sums of products with 8 and 7 axes), sums of
products that are broadcast again, and 200 random sums of products with 1 to 8 axes.

    0.10.0, 0.10.1                      all right without the flag
    0.10.2                              rows of another place in the first and the fourth kind and in one in five of the
                                        random sums; the second and the third end the process
    0.11.0                              the second ends the process, as do two of the random sums; one of them is wrong
    0.11.1, 0.11.2, 0.12.0, 0.12.0.1    all right without the flag

With the flag all come out right in all of these releases, and all of them know it. It is set in none that does without:
XLA ends the process at a flag that it does not know, as a later release may not.
"""


WAITS_IN_ITS_POOL = (0, 11, 2)
"""Releases of jaxlib before this one run a batched QR, LU, Cholesky, eigen- or singular value decomposition on a CPU
in a thread of XLA's pool, which waits there for others of the same pool to do parts of it. As many of them at once as
there are threads, in one program or in several, wait for ever. Seen in 0.10.2 with two threads, not in 0.12.0.1."""

LEAST_THREADS = 6
"""More than decompositions that stand beside each other here: an estimate's and its statistics', in a step and in the
stream that makes the next batch. No more than that, because LAPACK has threads of its own in each of them."""


ALL_DIGITS = "highest"
"""Of products of matrices: all digits of their numbers, on any device."""


def xla_flags(release: str, flags: str) -> str:
    """``XLA_FLAGS`` as a process with this jaxlib needs it.

    Args:
        release: of the installed jaxlib, e.g. "0.10.2".
        flags: the variable's present value; empty where it is not set.

    Returns:
        ``flags`` with :data:`UNFUSED_SUMS` after it where the release needs that. ``flags`` as it is where it sets the
        same flag itself, and where it names a file, which XLA takes for the whole value (:func:`names_a_file`).
    """
    needed = release in FUSES_SUMS_WRONGLY and not names_a_file(flags)
    if not needed or UNFUSED_SUMS.partition("=")[0] in flags:
        return flags
    return f"{flags} {UNFUSED_SUMS}".strip()


def names_a_file(flags: str) -> bool:
    """Whether XLA reads its flags from a file: it does where ``XLA_FLAGS`` starts with something other than a dash."""
    return bool(flags.strip()) and not flags.lstrip().startswith("-")


def _set_xla_flags() -> None:
    release, flags = jaxlib.__version__, os.environ.get("XLA_FLAGS", "")
    wanted = xla_flags(release, flags)
    if wanted != flags:
        os.environ["XLA_FLAGS"] = wanted
    elif release in FUSES_SUMS_WRONGLY and names_a_file(flags) and not _file_says_so(flags):
        warnings.warn(
            f"XLA_FLAGS names the file {flags!r}, which does not say {UNFUSED_SUMS}; add that line to it: "
            f"jaxlib {release} fuses some sums wrongly on CPUs (august doctor tries them)",
            RuntimeWarning,
            stacklevel=3,
        )


def threads_wanted(release: str, cores: int) -> int | None:
    """Threads that XLA's pool needs on a CPU with this jaxlib; None where those that it takes by itself do.

    Args:
        release: of the installed jaxlib, e.g. "0.10.2".
        cores: that this process may run on, of each of which the pool has a thread.
    """
    waits = tuple(int(part) for part in re.findall(r"\d+", release)[:3]) < WAITS_IN_ITS_POOL
    return LEAST_THREADS if waits and cores < LEAST_THREADS else None


def _set_threads() -> None:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = threads_wanted(jaxlib.__version__, cores)
    if wanted and not {"PJRT_NPROC", "NPROC"} & os.environ.keys():
        os.environ["PJRT_NPROC"] = str(wanted)


def _file_says_so(path: str) -> bool:
    try:
        with open(path, encoding="utf-8", errors="replace") as file:
            return UNFUSED_SUMS.partition("=")[0] in file.read()
    except OSError:
        return True  # XLA ends the process and names the file


def _set_precision() -> None:
    if "JAX_DEFAULT_MATMUL_PRECISION" in os.environ:
        return
    os.environ["JAX_DEFAULT_MATMUL_PRECISION"] = ALL_DIGITS
    jax = sys.modules.get("jax")
    if jax is not None and jax.config.jax_default_matmul_precision is None:  # it has read the variable already
        jax.config.update("jax_default_matmul_precision", ALL_DIGITS)


_set_xla_flags()
_set_threads()
_set_precision()
