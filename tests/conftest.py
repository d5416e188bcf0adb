"""Shared by all tests: types checked as the code runs, a private cache, a quick compiler.

Annotations of the package are checked at every call, shapes and dtypes of arrays among them: beartype, through
jaxtyping's import hook. The dimension names of a call must agree: ``Float[Array, "n 3"]`` beside ``Float[Array, "n"]``
is one n. So an annotation that is not true fails the tests, and so does a test that hands a function what its
annotation does not allow; one that tries how the package itself refuses such a value asks for the fixture
``unchecked``. Without beartype, and with ``AUGUST_CHECK_TYPES=0``, nothing is checked.
"""

import gc
import os
import pkgutil
import tempfile
from importlib.util import find_spec
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "august_jax"
UNCHECKED = {"config"}
"""Of the package's parts: configurations check their values themselves, and say it better."""

if os.environ.get("AUGUST_CHECK_TYPES", "1") != "0" and find_spec("beartype"):
    from jaxtyping import install_import_hook

    parts = {part.name for part in pkgutil.iter_modules([str(PACKAGE)])} - UNCHECKED
    install_import_hook([f"august_jax.{part}" for part in sorted(parts)], "typecheck.checked")

# so that no test reads or leaves files in the user's own
os.environ.setdefault("AUGUST_CACHE", tempfile.mkdtemp(prefix="august-cache-"))
# Both workers share what either has compiled, however little it is, and find again what was dropped between modules.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", tempfile.mkdtemp(prefix="august-compiled-"))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("MPLBACKEND", "Agg")
# Two workers on two cores: what LAPACK would do in threads waits for the other worker's.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Most of the suite's time is compilation; code that runs once need not be fast. What is not so asks for `optimized`.
os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")


@pytest.fixture
def optimized():
    """Programs are compiled as for users: a search runs its own so often that it takes a quarter of the time."""
    import jax

    from august_jax.app.compiled import YES

    jax.config.update("jax_disable_most_optimizations", False)
    yield
    before = os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"].lower() in YES  # JAX tells no flag's present value
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture
def unchecked():
    """Types are not checked while this test runs: it hands over wrong ones to see how the package refuses them."""
    from jaxtyping import config

    before = config.jaxtyping_disable
    config.update("jaxtyping_disable", True)
    yield
    config.update("jaxtyping_disable", before)


_MOST_MAPS = 25_000
"""Mappings of memory that a process may hold before its compiled programs are dropped: each takes several, the system
gives 65,530, and a compiler that gets no more ends the process."""


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    """Drop compiled programs between modules where there are many: a whole suite's do not fit one process."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > _MOST_MAPS:
        import jax

        jax.clear_caches()
        gc.collect()
