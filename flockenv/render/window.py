"""Window: frames on a screen, for render_mode="human". Only this file needs pygame, imported with the first window."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Window"]


class Window:
    """A window that shows frames at a steady rate. After it is closed, by close() or by the user, show() does nothing.

    A process has one window, which all objects of this class share. Raises ImportError without pygame-ce, and
    RuntimeError without a display, in one line with the remedy. title: of the window.
    """

    def __init__(self, title: str = "flockenv") -> None:
        # Otherwise pygame prints a greeting to stdout.
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        try:
            import pygame
        except ImportError:
            raise ImportError(
                "render_mode='human' needs pygame-ce: pip install 'flockenv[render]' (or use render_mode='rgb_array')"
            ) from None
        self._pygame: Any = pygame
        self._title = title
        self._size: tuple[int, int] | None = None
        self._open = True
        self._start()
        self._clock = pygame.time.Clock()

    @property
    def is_open(self) -> bool:
        """True if frames are still shown."""
        return self._open

    def show(self, frame: NDArray[np.uint8], fps: float) -> None:
        """Show a frame (H, W, 3) uint8 and wait until 1/fps s have passed since the last one."""
        if not (math.isfinite(fps) and fps > 0.0):
            raise ValueError(f"fps: must be above 0, got {fps}")
        if frame.ndim != 3 or frame.shape[2] != 3 or frame.dtype != np.uint8:
            raise ValueError(f"frame: must be uint8 of shape (height, width, 3), got {frame.dtype} {frame.shape}")
        if not self._open:
            return
        size = (frame.shape[1], frame.shape[0])
        if size != self._size or not self._pygame.display.get_init():
            self._start()
            self._pygame.display.set_mode(size)
            self._pygame.display.set_caption(self._title)
            self._size = size
        surface = self._pygame.display.get_surface()
        self._pygame.surfarray.blit_array(surface, frame.swapaxes(0, 1))
        self._pygame.display.flip()
        self._clock.tick(fps)
        if any(event.type == self._pygame.QUIT for event in self._pygame.event.get()):
            self.close()

    def close(self) -> None:
        """Close the window; may be called twice."""
        if self._open:
            self._open = False
            self._pygame.display.quit()

    def _start(self) -> None:
        # Not pygame.init(), which also opens sound and joysticks, and keeps a core busy.
        try:
            self._pygame.display.init()
        except self._pygame.error as error:
            raise RuntimeError(
                f"render_mode='human' found no display ({error}); use 'rgb_array', or set SDL_VIDEODRIVER=dummy"
            ) from None
