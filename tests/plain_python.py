"""Run small scenes and tasks, by machine code or in plain Python, and write their results to a file.

`NUMBA_DISABLE_JIT=1 python -m tests.plain_python ended.npz`; test_plain_python.py compares the two.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.envs.world import World
from flockenv.physics.integrators import INTEGRATORS
from flockenv.scene import Scene
from flockenv.scene.yaml_io import ConfigError, load_scene
from flockenv.tasks import TASKS
from tests.catalogue import EFFECTS, scene_of, scene_under

ROOT = Path(__file__).resolve().parent.parent
TIES = {
    "journey, 2-D": "waits end with a step, and grid points are equally far: rounding decides their order",
    "path_follow": "it begins on a vertex of the path: rounding decides which piece is nearest",
}
"""Cases in which rounding changes more than the last digits; they run, but are not compared."""
STEPS, DECISIONS, MOST_AGENTS = 3, 4, 60


def cases() -> Iterator[tuple[str, Any]]:
    """Yield scenes of each effect, behaviour and method, shipped scenes (constraints, populations), tasks, a world."""
    for k, row in enumerate(EFFECTS):  # laws are written once for all dimensions
        dimension = sorted(row.dimensions)[k % len(row.dimensions)]
        yield f"{row.name}, {dimension}-D", scene_under(row, dimension)
    drag = next(row.effect for row in EFFECTS if row.name == "drag")
    for kind, method in INTEGRATORS.items():
        yield kind, scene_of(drag, dt=0.02, integrator=method())
    for path in sorted((ROOT / "configs" / "scenes").glob("*.yaml")):
        try:
            scene = load_scene(path)
        except ConfigError:
            continue
        if scene.agents <= MOST_AGENTS:
            yield path.name, scene
    yield from ((name, kind()) for name, kind in TASKS.items())
    yield "disturbance", make_world(TASKS["herd"](), 3, disturbance=Disturbance(noise=0.1, delay=1, dropped=0.3))


def ended(case: Any) -> NDArray[np.float64]:
    """Return a scene's motion after a few steps, or observations and rewards of a few decisions of a task or world."""
    if isinstance(case, Scene):
        state = case.run(case.start(3), STEPS)
        return np.concatenate([state.x.ravel(), state.v.ravel()]).astype(float)
    world, rng = case if isinstance(case, World) else World(case, 3), np.random.default_rng(0)
    world.reset(0)
    steps = [world.step(rng.uniform(-1, 1, (3, world.learners, world.action_size))) for _ in range(DECISIONS)]
    shown = [each.ravel() for step in steps for each in (step.observation, step.reward)]
    return np.concatenate([*shown, world.state.x.ravel()]).astype(float)


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    np.savez(sys.argv[1], **{name: ended(case) for name, case in cases()})
