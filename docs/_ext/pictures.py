"""Pictures of kinds: trajectories of a small scene, and the error of a method against its step.

They are drawn when the site is built, in plain Python, and kept in docs/generated/pictures/.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
import yaml

from flockenv.model.state import blank
from flockenv.physics.integrators import INTEGRATORS, Adaptive, Integrator
from flockenv.physics.integrators.integrator import SUBSTEPS
from flockenv.render.gif import write_png
from flockenv.render.picture import draw
from flockenv.scene.presets import PRESETS
from flockenv.scene.yaml_io import load_scene
from flockenv.studies.trajectory import record

__all__ = ["demos", "draw_missing", "errors"]

WIDTH = 360
"""Of a picture of trajectories, pixels."""

INSTANTS = 80
"""Approximate number of instants at which a drawn trajectory is sampled."""

SPAN = 2.0
"""s, for which the oscillator x'' = -x of the curves runs from (1, 0)."""


@functools.cache
def demos() -> dict[str, tuple[float, str]]:
    """Return the time, s, and the YAML of the small scene of each kind that no shipped scene shows, and of presets."""
    given = yaml.safe_load(Path(__file__).with_name("demos.yaml").read_text(encoding="utf-8"))
    text = given.pop("presets")
    every = {**given, **{name: {**text, "scene": text["scene"].replace("NAME", name)} for name in PRESETS}}
    return {kind: (float(demo["time"]), demo["scene"]) for kind, demo in every.items()}


def draw_missing(folder: Path) -> None:
    """Draw the picture of each demo and each method that has none in the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for kind, (time, text) in demos().items():
        if not (folder / f"{kind}.png").exists():
            _draw_demo(folder / f"{kind}.png", time, text)
    for kind, method in INTEGRATORS.items():
        if not (folder / f"{kind}.png").exists():
            _draw_errors(folder / f"{kind}.png", method)


def _draw_demo(path: Path, time: float, text: str) -> None:
    scene = load_scene(text)
    steps = round(time / scene.dt)
    run = record(scene, 0, steps, max(1, steps // INSTANTS))
    if run.stopped:
        raise ValueError(f"{path.stem}: its demo stops: {run.stopped}")
    snapshots = list(run.snapshots())
    write_png(path, draw(snapshots[-1], WIDTH, 3, snapshots))


def errors(method: type[Integrator]) -> tuple[list[float], list[float]]:
    """Return steps, s, of adaptive methods mean substeps, and the error of (x, v) with each for x'' = -x after SPAN."""
    tried = (
        [(method(tolerance=10.0**-k), 1) for k in range(2, 9)]
        if issubclass(method, Adaptive)
        else [(method(), 2**k) for k in range(2, 9)]
    )
    found = [_run(each, steps) for each, steps in tried]
    return [step for step, _ in found], [error for _, error in found]


def _run(method: Integrator, steps: int) -> tuple[float, float]:
    """Return the mean length of a substep, s, and the error at the end."""
    state = blank(1, 1, 2, 0, SPAN / steps)
    state.x[0] = 1.0
    for _ in range(steps):
        state = method(lambda x, v, t: -x, state, SPAN / steps)
    taken = max(steps, int(state.work[0, SUBSTEPS]))
    return SPAN / taken, math.hypot(state.x[0, 0, 0] - math.cos(SPAN), state.v[0, 0, 0] + math.sin(SPAN))


def _draw_errors(path: Path, method: type[Integrator]) -> None:
    from matplotlib.figure import Figure

    steps, found = errors(method)
    figure = Figure(figsize=(4.5, 3), dpi=100, layout="constrained")
    axes = figure.add_subplot(xscale="log", yscale="log")
    axes.plot(steps, found, "o-", label=path.stem)
    order = np.array(steps) ** method.order
    axes.plot(steps, found[-1] * order / order[-1], "k--", label=f"order {method.order}")
    axes.set(xlabel="mean substep, s" if issubclass(method, Adaptive) else "step h, s", ylabel="error after 2 s")
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(path)
