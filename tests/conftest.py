"""What every test runs under."""

import os

# Nothing here may need a display.
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
