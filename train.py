"""Training of a policy: `python train.py --task anymal_c_flat`."""

import sys

from legged.cli.train import train

if __name__ == "__main__":
    sys.exit(train.main())
