"""Show images in the window of ``render_mode="human"``."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from pixelbrax_jax.extras import needs_extra

_DRIVER = "SDL_VIDEODRIVER"


class Window:
    """A window that shows at most ``fps`` images per second."""

    def __init__(self, title: str, fps: int) -> None:
        """Import pygame, or raise an ImportError; ``show`` opens the window."""
        with needs_extra("human", "render_mode='human' needs pygame"):
            import pygame
        self._pygame, self._title, self._fps = pygame, title, fps
        self._screen: Any = None
        self._clock: Any = None
        self.closed = False
        """Whether the user has closed the window."""

    def __reduce__(self) -> Any:
        """Pickle or copy as a window that is not open."""
        return Window, (self._title, self._fps)

    def show(self, image: np.ndarray) -> None:
        """Show an (H, W, 3) uint8 image; raise an OSError if the window cannot be opened."""
        pygame = self._pygame
        if self._screen is None:
            try:
                pygame.display.init()
                pygame.display.set_caption(self._title)
                self._screen = pygame.display.set_mode((image.shape[1], image.shape[0]))
            except pygame.error as error:
                raise OSError(
                    f"cannot open a window ({error}); correct or unset "
                    f"{_DRIVER if _DRIVER in os.environ else 'DISPLAY'}, or write a file with "
                    "pixelbrax play --gif FILE, or use render_mode='rgb_array'."
                ) from error
            self._clock = pygame.time.Clock()
        # pygame counts columns first.
        pygame.surfarray.blit_array(self._screen, image.swapaxes(0, 1))
        pygame.event.pump()
        # Peek, because the events belong to the caller's program.
        self.closed = self.closed or bool(pygame.event.peek(pygame.QUIT))
        pygame.display.flip()
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close the window."""
        if self._screen is not None:
            self._pygame.display.quit()
            self._screen = None
