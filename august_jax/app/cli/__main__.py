"""``python -m august_jax.app.cli``: the command line where the script ``august`` is not on the path."""

import sys

from august_jax.app.cli import main

if __name__ == "__main__":
    sys.exit(main())
