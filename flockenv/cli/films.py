"""Films of tasks for `flockenv render`: an episode of each player in the same world, and the files of pictures."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from flockenv.cli.terminal import progress_bar

if TYPE_CHECKING:
    from flockenv.envs.disturbance import Disturbance
    from flockenv.model.snapshot import Snapshot
    from flockenv.render import Panel
    from flockenv.tasks import Task

__all__ = ["Shutter", "film_episodes", "write_picture"]

TRAIL = 25
"""Past frames of which a PNG shows the positions of each agent."""

MOST_PARTS = 8
"""Instants in a frame, of which a picture with motion blur is the mean."""


def film_episodes(
    task: Task, players: Sequence[str], seed: int, trust_pickle: bool, disturbance: Disturbance
) -> tuple[list[Panel], float]:
    """Return an episode of the same world per player, as panels, and the frames per second."""
    from flockenv.envs.disturbance import make_world
    from flockenv.evaluation import rollout
    from flockenv.players import load_player
    from flockenv.render import Panel

    disturbance.check(task)
    policies = [load_player(player, task, seed, trust_pickle) for player in players]
    panels, make = [], functools.partial(make_world, disturbance=disturbance)
    with progress_bar("playing", len(players) * task.horizon, "decisions") as progress:
        for k, (player, policy) in enumerate(zip(players, policies, strict=True)):

            def show(done: int, most: int, before: int = k * task.horizon) -> None:
                progress(before + done)

            episode = rollout(task, policy, 1, seed, record=0, progress=show, make_world=make)
            assert episode.recording is not None  # requested with record=0
            outcome, film = "success" if episode.success[0] else "no success", episode.recording
            title = Path(player).stem if len(players) > 1 else film.snapshots[0].title
            shots = [dataclasses.replace(shot, title=title) for shot in film.snapshots]
            panels.append(Panel(Path(player).stem, shots, film.returns.tolist(), outcome))
    return panels, 1.0 / task.control_dt


@dataclasses.dataclass(frozen=True)
class Shutter:
    """Motion blur: a picture is the mean of the last `open` of the `parts` instants that a film has for each frame."""

    parts: int = 1
    open: int = 1

    @classmethod
    def of(cls, share: float, steps: int) -> Shutter:
        """Return the shutter that is open for a share of a frame of some time steps; 0: no blur.

        Raises ValueError, in one line, if a frame has one step, so that nothing is known between two frames.
        """
        if share == 0:
            return cls()
        if steps < 2:
            raise ValueError(f"--shutter {share:g}: each frame of this scene is one time step, so there is no blur")
        parts = min(range(2, min(steps, MOST_PARTS) + 1), key=lambda n: (steps % n, -n))  # the frame keeps its steps
        return cls(parts, max(2, round(share * parts)))


def write_picture(
    path: Path, panels: Sequence[Panel], title: str, fps: float, size: int, shutter: Shutter | None = None
) -> None:
    """Write films side by side: an HTML replay, a PNG of the end, a GIF, MP4 or WebP; size: width, pixels.

    fps: frames per second; the films have an instant for each part of a frame of the shutter (default: one, no blur).
    """
    import numpy as np

    from flockenv.render import Group, write_gif, write_png, write_replay
    from flockenv.render.gif import MOST_FPS
    from flockenv.render.video import write_mp4, write_webp

    films, shutter = [panel.snapshots for panel in panels], shutter or Shutter()
    if path.suffix.lower() == ".html":
        write_replay(path, [Group(title, list(panels))], title)
    elif path.suffix.lower() == ".png":
        rate, width = fps * shutter.parts, size // len(films)
        ends = [
            [_draw_frame(film[: len(film) - k], width, rate, shutter) for k in range(min(shutter.open, len(film)))]
            for film in films
        ]
        write_png(path, np.hstack([_mean(pictures) for pictures in ends]))
    elif path.suffix.lower() in (".mp4", ".webp"):
        write = write_mp4 if path.suffix.lower() == ".mp4" else write_webp
        write(path, _draw_frames(films, size // len(films), fps, shutter), fps)
    else:
        stride = math.ceil(fps / MOST_FPS)
        frames = _draw_frames([film[::stride] for film in films], size // len(films), fps / stride, shutter)
        write_gif(path, frames, fps / stride)


def _mean(pictures: Sequence[Any]) -> Any:
    """Return the mean of pictures, (height, width, 3) uint8."""
    import numpy as np

    return pictures[0] if len(pictures) == 1 else np.rint(np.mean(pictures, axis=0)).astype(np.uint8)


def _draw_frame(snapshots: Sequence[Snapshot], size: int, rate: float, shutter: Shutter) -> Any:
    """Draw the last snapshot, with the paths that lead to it; rate: snapshots per second."""
    from flockenv.render import draw

    behind = max(
        TRAIL * shutter.parts, 1 + math.ceil(rate * max((look.trail for look in snapshots[-1].looks), default=0.0))
    )
    return draw(snapshots[-1], size=size, trails=snapshots[-behind:-1])


def _draw_frames(films: Sequence[Sequence[Snapshot]], size: int, fps: float, shutter: Shutter) -> Iterator[Any]:
    """Draw films side by side, a picture per frame, and show how far that is; the first frame is sharp."""
    from flockenv.render.gif import side_by_side

    count = max(map(len, films))
    shown = [k for k in range(count) if k == 0 or -k % shutter.parts < shutter.open]
    with progress_bar("drawing", len(shown), "frames") as progress:
        pictures = []
        for done, picture in enumerate(side_by_side(films, size, fps * shutter.parts, shown)):
            pictures.append(picture)
            if shown[done] % shutter.parts == 0:
                yield _mean(pictures)
                pictures.clear()
            progress(done)
