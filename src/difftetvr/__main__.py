"""``python -m difftetvr``: the command line."""

import sys

from difftetvr.cli import main

if __name__ == "__main__":
    sys.exit(main())
