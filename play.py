"""Film and export of a policy: `python play.py --task anymal_c_flat`."""

import sys

from legged.cli.play import play

if __name__ == "__main__":
    sys.exit(play.main())
