"""Limits of what a page may ask for: a world that starts and steps in a moment, because all pages share one server.

Scenes that the command line names are not limited, and may be changed as long as no change makes them larger.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from flockenv.scene import Scene

__all__ = ["MOST_AGENTS", "MOST_PAIRS", "check_size", "pairs_of"]

MOST_AGENTS: Final = 250_000
"""Most agents, which take some tenths of a second to start."""

MOST_PAIRS: Final = 3e8
"""Most pairs of agents that a step compares, which takes some tenths of a second on one thread."""

FAR: Final = 2_500
"""About how many groups of others each agent is compared with by a law that reaches all agents."""


def check_size(what: str, scene: Scene, seed: int, old: Scene | None = None, pos: NDArray[Any] | None = None) -> None:
    """Raise ValueError, in one line that begins with `what`, for a scene that is too large for a page to ask for.

    old: the scene before a change, and pos, (N, D) m, where its agents are now; None: it is opened.
    """
    if scene.agents > max(MOST_AGENTS, old.agents if old is not None else 0):
        raise ValueError(
            f"{what}: {scene.agents:,} agents; a page may ask for at most {MOST_AGENTS:,}, a file that `flockenv play` "
            "names may have more"
        )
    if scene.agents**2 <= MOST_PAIRS or (old is not None and _decides(scene) == _decides(old)):
        return
    allowed = MOST_PAIRS if old is None or pos is None else max(MOST_PAIRS, pairs_of(old, pos))
    if old is None or pos is None or scene.groups != old.groups:
        pos = scene.start(seed).pos[0]
    pairs = pairs_of(scene, pos)
    if pairs > allowed:
        raise ValueError(
            f"{what}: a step would compare about {pairs:.1e} pairs of agents; a page may ask for at most "
            f"{MOST_PAIRS:.0e}: take fewer agents, shorter radii or a larger space"
        )


def _decides(scene: Scene) -> tuple[Any, ...]:
    """Return all on which the number of pairs depends, besides where agents are."""
    return scene.groups, scene.space, scene.parts.reach, _opening(scene)


def _opening(scene: Scene) -> float | None:
    """Return the least opening of the laws that reach all agents, 0: they compare all pairs; None without one."""
    far = [float(getattr(effect, "opening", 0.0)) for effect in scene.parts.effects if effect.far_law]
    return min(far, default=None)


def pairs_of(scene: Scene, pos: NDArray[Any]) -> float:
    """Return about how many pairs of agents a step compares, if these are at `pos`, (N, D) m.

    Neighbours are looked for in cells of the largest reach and in those around them.
    """
    every, reach, opening = float(len(pos)) ** 2, float(scene.parts.reach), _opening(scene)
    if opening == 0 or not np.isfinite(reach):
        return every
    far = 0.0 if opening is None else FAR * float(len(pos))
    if reach == 0:
        return min(every, far)
    cell = np.floor((pos - pos.min(axis=0)) / reach).astype(np.int64)
    _, counts = np.unique(cell @ np.cumprod([1, *cell.max(axis=0)[:-1] + 1]), return_counts=True)
    near: float = 3.0 ** pos.shape[1] * float((counts.astype(float) ** 2).sum())
    return float(min(every, far + near))
