"""The flocking model of DECLARATION.md, as a flockenv scene with an effect of its own."""

from typing import Any, ClassVar, Literal

from flockenv.geometry.space import Torus
from flockenv.jit.decorators import Law, Vec, law, like
from flockenv.maths.vectors import add, scale, sub, unit
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Effect
from flockenv.physics.effects.effect import Me, Other, Sight
from flockenv.physics.integrators import SemiImplicitEuler
from flockenv.scene import Group, Scene

SMALL = {"birds": 200, "extent": 100.0, "visual_distance": 5.0}
LARGE = {"birds": 400, "extent": 150.0, "visual_distance": 15.0}


@law
def steered_by(p: Any, me: Me, other: Other) -> Vec:
    """Return what one neighbour adds: cohere, separate and match, each times its factor."""
    near = other.square < p.separation * p.separation
    offset = p.cohere_factor - p.separate_factor if near else p.cohere_factor
    return add(scale(other.offset, offset), scale(other.vel, p.match_factor / p.speed))


@law
def turned(p: Any, me: Me, sums: Vec) -> Vec:
    """Return the force that turns the velocity in one step: v' = speed unit(v / speed + mean of the sums)."""
    one = like(sums[2], 1.0)
    share = one / (sums[2] if sums[2] > one else one)
    then = unit(add(scale(me.vel, one / p.speed), scale((sums[0], sums[1]), share)))
    return scale(sub(scale(then, p.speed), me.vel), me.mass)


class Flocking(Effect):
    """The three rules as a map from step to step: exact in one step of dt = 1 by an Euler method."""

    kind: Literal["declared_flocking"] = "declared_flocking"
    visual_distance: float
    speed: float = 1.0
    cohere_factor: float = 0.03
    separation: float = 1.0
    separate_factor: float = 0.015
    match_factor: float = 0.05
    pair_law: ClassVar[Law | None] = steered_by
    finish_law: ClassVar[Law | None] = turned
    averages: ClassVar[bool] = True  # the number of neighbours follows the sums

    @property
    def sight(self) -> Sight:
        """All neighbours within the visual distance."""
        return Sight(self.visual_distance)

    def sums(self, dimension: int) -> int:
        """Return how many numbers are summed: a vector's."""
        return dimension


def flocking_model(birds: int, extent: float, visual_distance: float) -> Scene:
    """Return the scene: 64-bit floats, a periodic square, birds of speed 1 in random places and directions."""
    group = Group(count=birds, radius=0.0, spawn=Spawn(speed=(1.0, 1.0)))
    return Scene(
        space=Torus(size=(extent, extent)),
        groups=(group,),
        effects=(Flocking(visual_distance=visual_distance),),
        integrator=SemiImplicitEuler(),
        dt=1.0,
        dtype="float64",
    )


def run_model(scene: Scene, seed: int, steps: int = 100, worlds: int = 1) -> State:
    """Start a model, or several at once, and run it."""
    return scene.run(scene.start(seed, worlds=worlds), steps)
