"""Inner states of agents, goals and courses, and spreads of a group's numbers."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest
from scipy.spatial import cKDTree

from flockenv.behaviours import Driving
from flockenv.geometry.space import Torus
from flockenv.jit.decorators import Law, law
from flockenv.jit.thread_pool import use_threads
from flockenv.model.distribution import Spread
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Antipode, Course, Effect, Goal, Sight
from flockenv.physics.population import Emitter
from flockenv.physics.population.regions import Point
from flockenv.scene import Group, Scene


@law
def numbered(p: Any, me: Any) -> Any:
    """Return the agent's index as its initial warmth, and a lifetime of 0."""
    return me.who, me.who - me.who


@law
def warmer(p: Any, me: Any, other: Any) -> Any:
    """Return the difference in warmth of a neighbour."""
    return (other.inner.warmth - me.inner.warmth,)


@law
def as_vector(p: Any, me: Any, sums: Any) -> Any:
    """Return the sum as a vector, which is passed to the keep law."""
    return sums[0], sums[0] - sums[0]


@law
def warmed(p: Any, me: Any, received: Any, seconds: float) -> Any:
    """Add the heat from neighbours, and the time step."""
    return me.inner.warmth + p.rate * seconds * received[0], me.inner.lived + seconds


class Warmth(Effect):
    """A toy effect that keeps two numbers; one of them depends on neighbours."""

    kind: str
    rate: float = 0.5
    pair_law: ClassVar[Law | None] = warmer
    finish_law: ClassVar[Law | None] = as_vector
    begin_law: ClassVar[Law | None] = numbered
    keep_law: ClassVar[Law | None] = warmed
    keeps: ClassVar[tuple[str, ...]] = ("warmth", "lived")

    @property
    def sight(self) -> Sight:
        """Neighbours within 1 m in all directions."""
        return Sight(1.0)

    def sums(self, dimension: int) -> int:
        """Return 1: the heat."""
        return 1

    def parameters(self) -> dict[str, Any]:
        """Return the rate."""
        return {"rate": self.rate}


def warm(count: int, size: float) -> Scene:
    group = Group(count=count, radius=0.0, spawn=Spawn(speed=(0.5, 2.0)))
    return Scene(space=Torus(size=(size, size)), dt=0.01, groups=(group,), effects=(Warmth(kind="warmth"),))


@pytest.mark.slow
def test_inner_numbers_do_not_depend_on_threads_calls_or_batches() -> None:
    count, size = 2**14, 90.0
    scene = warm(count, size)
    start = scene.start(3, 2)
    warmth = np.array(scene.inner(start, "warmth"))
    np.testing.assert_array_equal(warmth, np.tile(np.arange(count), (2, 1)))
    state = start
    for _ in range(5):
        for b in range(2):
            near = cKDTree(state.pos[b], boxsize=size).query_pairs(1.0, output_type="ndarray")
            received = np.zeros(count)
            for i, j in ((0, 1), (1, 0)):
                np.add.at(received, near[:, i], warmth[b, near[:, j]] - warmth[b, near[:, i]])
            warmth[b] += 0.5 * 0.01 * received
        state = scene.step(state)
        np.testing.assert_allclose(scene.inner(state, "warmth"), warmth, rtol=1e-12)
    np.testing.assert_allclose(scene.inner(state, "lived"), 0.05, rtol=1e-12)
    use_threads(2)
    try:
        again = scene.step(start, steps=5)  # one call of many steps sorts the agents of a large world
    finally:
        use_threads(1)
    np.testing.assert_array_equal(again.inner, state.inner)
    alone = scene.step(scene.start(4), steps=5)
    np.testing.assert_array_equal(alone.inner[:, 0], state.inner[:, 1])


WALKERS = Group(count=6, radius=0.2, mass=70, desired_speed=1.3, spawn=Spawn(low=(0, 0), high=(4, 4)))


@pytest.mark.slow
def test_the_antipode_of_the_start_is_kept_and_reached() -> None:
    scene = Scene(groups=(WALKERS,), effects=(Antipode(centre=(2, 2)), Driving()), dt=0.02)
    start = scene.start(0)
    end = scene.run(start, 600)
    np.testing.assert_allclose(end.pos, 4 - start.pos, atol=1e-3)
    np.testing.assert_array_equal(scene.inner(end, "goal_x"), 4 - start.pos[..., 0])


@pytest.mark.slow
def test_driving_relaxes_to_the_desired_speed_of_each_agent() -> None:
    group = WALKERS.model_copy(update={"desired_speed": Spread(mean=1.34, sd=0.26, low=0.5)})
    scene = Scene(groups=(group, WALKERS), effects=(Course(group=0, direction=(3, 4)), Driving(tau=0.5)), dt=1e-3)
    state = scene.run(scene.start(1), 500)
    desired = scene.body.desired_speed[:6]
    assert np.ptp(desired) > 0.1
    np.testing.assert_allclose(state.vel[0, :6], desired[:, None] * (0.6, 0.8) * (1 - np.exp(-1)), rtol=2e-3)
    np.testing.assert_array_equal(state.vel[0, 6:], 0)  # no effect gives them an aim


@pytest.mark.slow
def test_a_goal_on_a_torus_is_reached_at_rest_by_the_shorter_path() -> None:
    walkers = WALKERS.model_copy(update={"count": 1, "spawn": Spawn(low=(9, 5), high=(9.01, 5))})
    scene = Scene(space=Torus(size=(10, 10)), groups=(walkers,), effects=(Goal(target=(1, 5)), Driving()), dt=0.02)
    state = scene.step(scene.start(0), steps=20)
    assert state.vel[0, 0, 0] > 0.5
    state = scene.step(state, steps=800)
    np.testing.assert_allclose(state.pos[0, 0], (1, 5), atol=1e-3)
    np.testing.assert_allclose(state.vel[0, 0], 0, atol=1e-3)


def test_a_born_agent_starts_with_its_own_inner_numbers() -> None:
    group = WALKERS.model_copy(update={"count": 4, "desired_speed": 0.1})
    born = Emitter(group=0, place=Point(at=(1.0, 3.0)), rate=10.0)
    scene = Scene(groups=(group,), effects=(Antipode(centre=(2, 2)), Driving()), population=(born,), dt=0.05)
    state = scene.run(scene.start(0), 10)
    assert state.alive.all()
    np.testing.assert_allclose(scene.inner(state, "goal_x"), 3.0, atol=0.02)
    np.testing.assert_allclose(scene.inner(state, "goal_y"), 1.0, atol=0.02)


def test_a_scene_without_inner_states_has_none() -> None:
    scene = Scene(groups=(WALKERS,), effects=(Course(direction=(1, 0)), Driving()))
    assert scene.start(0).inner.size == 0
    with pytest.raises(ValueError, match="'hunger': no effect of this scene keeps such an inner number"):
        scene.inner(scene.start(0), "hunger")
    kept = Scene(groups=(WALKERS,), effects=(Antipode(centre=(0, 0)), Driving()))
    with pytest.raises(ValueError, match="the state has 0 inner numbers, but effects of this scene keep goal_x"):
        kept.step(scene.start(0))


def test_spreads_have_the_given_moments_and_bounds() -> None:
    share = (np.arange(10_000) + 0.5) / 10_000
    normal = Spread(mean=1.34, sd=0.26).at(share)
    assert abs(normal.mean() - 1.34) < 1e-3
    assert abs(normal.std() - 0.26) < 1e-3
    cut = Spread(mean=1.34, sd=0.26, low=1.2, high=1.4).at(share)
    assert cut.min() >= 1.2
    assert cut.max() <= 1.4
    group = Group(count=500, mass=Spread(low=60, high=100), radius=Spread(low=0.1875, high=0.3125))
    np.testing.assert_allclose(group.radii * 320, group.masses(2))  # mass and radius use the same draw
    for zero in (Spread(low=0, high=0), Spread(mean=0, sd=0)):
        for name in ("mass", "desired_speed"):
            with pytest.raises(ValueError, match=r"must be a number > 0|must be above 0"):
                Group(count=2, **{name: zero})
    haste = Group(count=5, desired_speed=Spread(low=1, high=2), haste=1.3)
    np.testing.assert_allclose(haste.max_speeds, 1.3 * haste.desired_speeds)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"low": 2.0, "high": 1.0}, "low = 2: must not be above high = 1"),
        ({"mean": 2.0}, "mean and sd go together"),
        ({"low": 2.0}, "low: give low and high, or mean and sd"),
        ({"low": -1.0, "high": 1.0}, "low = -1: must be at least 0"),
        ({"mean": 3.0, "sd": 1.0, "high": 2.0}, "mean = 3: must lie between low and high"),
    ],
)
def test_invalid_spreads_are_refused(given: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Spread(**given)


def test_missing_speeds_and_zero_directions_are_refused() -> None:
    with pytest.raises(ValueError, match=r"groups\[0\].desired_speed = None: must be given, in m/s"):
        Scene(groups=(Group(count=1, spawn=Spawn(low=(0, 0), high=(1, 1))),), effects=(Driving(),))
    with pytest.raises(ValueError, match=r"direction = \(0.0, 0.0\): leads nowhere"):
        Scene(groups=(WALKERS,), effects=(Course(direction=(0, 0)), Driving()))
    with pytest.raises(ValueError, match=r"haste = 1\.3: needs a desired_speed"):
        Group(count=1, haste=1.3)
