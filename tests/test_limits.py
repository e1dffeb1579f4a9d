"""Under every method, agents do not exceed max_speed, do not vanish, and do not act when dead."""

from __future__ import annotations

import numpy as np
import pytest

from flockenv.envs.world import World
from flockenv.geometry.shapes import Circle
from flockenv.geometry.space import Box, Torus
from flockenv.model.spawn import Spawn
from flockenv.physics.integrators import INTEGRATORS
from flockenv.scene import Group, Scene
from flockenv.tasks import Pursuit

HERE = Spawn(low=(4, 4), high=(5, 5))


QUICK = ("semi_implicit_euler",)


@pytest.mark.parametrize(
    "kind", [kind if kind in QUICK else pytest.param(kind, marks=pytest.mark.slow) for kind in sorted(INTEGRATORS)]
)
def test_no_method_lets_an_agent_exceed_max_speed(kind: str) -> None:
    walker = Group(count=1, max_speed=2, max_force=10, spawn=HERE)
    scene = Scene(groups=(walker,), dt=0.1, integrator=INTEGRATORS[kind]())
    state, fastest = scene.start(0), 0.0
    for _ in range(20):
        after = scene.step(state, drive=np.full((1, 1, 2), 100.0))
        fastest = max(fastest, float(np.linalg.norm(after.pos - state.pos)) / scene.dt)
        state = after
    assert fastest == pytest.approx(2.0, rel=1e-9)


def test_a_learner_does_not_exceed_its_max_speed() -> None:
    task = Pursuit(size=200)
    world = World(task)
    world.reset(3)
    for _ in range(30):
        before = world.state.pos[0, 0].copy()
        world.step(np.array([[[1.0, 0.0]]]))
        assert np.linalg.norm(world.state.pos[0, 0] - before) <= task.pursuer_speed * task.control_dt * (1 + 1e-9)


def test_the_walls_of_a_box_do_not_hide_a_divergence() -> None:
    scene = Scene(space=Box(size=(20, 20)), groups=(Group(count=1, mass=1e-150, spawn=HERE),))
    with pytest.raises(FloatingPointError, match="world 0, agent 0"):
        scene.step(scene.start(0), drive=np.full((1, 1, 2), 1e200))


def test_dead_agents_do_not_move() -> None:
    scene = Scene(space=Box(size=(20, 20)), groups=(Group(count=2, spawn=Spawn(speed=(1, 1))),))
    state = scene.start(0)
    state.alive[0, 1] = False
    after = scene.run(state, 10)
    np.testing.assert_array_equal(after.pos[0, 1], state.pos[0, 1])
    assert np.linalg.norm(after.pos[0, 0] - state.pos[0, 0]) > 0.1


def test_no_agent_starts_in_the_periodic_image_of_an_obstacle() -> None:
    scene = Scene(space=Torus(size=(20, 20)), groups=(Group(count=300),), obstacles=(Circle(centre=(0, 0), radius=4),))
    gaps = np.linalg.norm(scene.space.displacement(scene.start(1).pos[0], np.zeros(2)), axis=1)
    assert gaps.min() >= 4.1
