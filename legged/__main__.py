"""`python -m legged` is the `legged` command."""

import sys

from legged.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
