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

__all__ = ["film_episodes", "write_picture"]

TRAIL = 25
"""Past positions of each agent that a PNG shows."""


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


def write_picture(path: Path, panels: Sequence[Panel], title: str, fps: float, size: int) -> None:
    """Write films side by side: an HTML replay, a PNG of the end, a GIF, MP4 or WebP; size: width, pixels."""
    import numpy as np

    from flockenv.render import Group, write_gif, write_png, write_replay
    from flockenv.render.gif import MOST_FPS
    from flockenv.render.video import write_mp4, write_webp

    films = [panel.snapshots for panel in panels]
    if path.suffix.lower() == ".html":
        write_replay(path, [Group(title, list(panels))], title)
    elif path.suffix.lower() == ".png":
        write_png(path, np.hstack([_draw_last_frame(film, size // len(films), fps) for film in films]))
    elif path.suffix.lower() in (".mp4", ".webp"):
        write = write_mp4 if path.suffix.lower() == ".mp4" else write_webp
        write(path, _draw_frames(films, size // len(films), fps), fps)
    else:
        stride = math.ceil(fps / MOST_FPS)
        frames = _draw_frames([film[::stride] for film in films], size // len(films), fps / stride)
        write_gif(path, frames, fps / stride)


def _draw_last_frame(snapshots: Sequence[Snapshot], size: int, fps: float) -> Any:
    from flockenv.render import draw

    behind = max(TRAIL, 1 + math.ceil(fps * max((look.trail for look in snapshots[-1].looks), default=0.0)))
    return draw(snapshots[-1], size=size, trails=snapshots[-behind:-1])


def _draw_frames(films: Sequence[Sequence[Snapshot]], size: int, fps: float) -> Iterator[Any]:
    """Draw the snapshots of several films side by side, and show how far that is."""
    from flockenv.render.gif import side_by_side

    with progress_bar("drawing", max(map(len, films)), "frames") as progress:
        for k, frame in enumerate(side_by_side(films, size, fps)):
            yield frame
            progress(k)
