"""Train a policy: python train.py --task anymal_c_flat."""

import sys

from legged.cli.train import main

if __name__ == "__main__":
    sys.exit(main())
