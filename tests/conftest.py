"""Shared by all tests: a private cache, so that no test reads or leaves files in the user's own."""

import os
import tempfile

os.environ.setdefault("AUGUST_CACHE", tempfile.mkdtemp(prefix="august-cache-"))
os.environ.setdefault("MPLBACKEND", "Agg")
