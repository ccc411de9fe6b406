"""``python -m pixelbrax_gym.cli``."""

import sys

from pixelbrax_gym.cli import main

if __name__ == "__main__":
    sys.exit(main())
