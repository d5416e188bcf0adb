"""Shared by all tests: a private cache, so that no test reads or leaves files in the user's own."""

import os
import tempfile

os.environ.setdefault("AUGUST_CACHE", tempfile.mkdtemp(prefix="august-cache-"))
os.environ.setdefault("MPLBACKEND", "Agg")
# Most of the suite's time is compilation; code that runs once need not be fast.
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_backend_optimization_level=0"
