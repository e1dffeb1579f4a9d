"""Hard cases of solid agents that steer to goals: head-on, at a crossing, across a circle; stalls; chaos repeated."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from flockenv.behaviours import AvoidObstacles, ForceField, Seek, UnalignedAvoidance
from flockenv.behaviours.steer import Steer
from flockenv.geometry.shapes import Block, Circle, Polygon
from flockenv.jit.thread_pool import threads, use_threads
from flockenv.model.spawn import Spawn
from flockenv.physics.constraints import Collisions
from flockenv.physics.integrators import Integrator
from flockenv.scene import Group, Scene
from flockenv.steering.arbitration import Allocation, Blend
from flockenv.studies.stress.solids import Response, batch, cases_by_response, disc_scene, overlap
from flockenv.studies.trial_log import Case, Value

__all__ = ["GATHERINGS"]

R = 0.25
WALL = ((-3.0, -0.6), (-3.0, -2.0), (15.0, -2.0), (15.0, -0.6))
ONE = ("semi_implicit_euler",)
"""Results here depend on steering and response, not on the method: one method is tried."""

# --- N11: each agent's goal is the start of another -------------------------------------------------------------------


def crossing(count: int, circle: float, seconds: float) -> Callable[[Integrator, Response], Value]:
    """Return the trial of `count` agents on a circle with goals at the opposite places: they pass, and hardly overlap.

    They head for their goals, avoid each other (Reynolds' unaligned avoidance, which keeps to the right in an exact
    head-on encounter) and are solid. Agents that do not arrive in time are reported: a deadlock.
    """

    def trial(method: Integrator, response: Response) -> Value:
        scene = Scene(
            groups=(Group(count=count, radius=R, max_force=8.0, spawn=Spawn(low=(0, 0), high=(1, 1))),),
            effects=(UnalignedAvoidance(weight=3.0, radius=4.0, horizon=2.0, margin=0.1),), integrator=method, dt=0.02,
            constraints=(Collisions(response=response, restitution=0.0, friction=0.0),),
        )  # fmt: skip
        angle = 2 * np.pi * np.arange(count) / count
        begin = circle * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        state, deep, arrived = batch(scene, begin[None], 0.0), 0.0, np.full(count, np.inf)
        for k in range(round(seconds / scene.dt)):
            to_goal = -begin - state.pos[0]
            far = np.linalg.norm(to_goal, axis=1)
            arrived[(far < R) & np.isinf(arrived)] = (k + 1) * scene.dt
            if np.isfinite(arrived).all():
                break
            change = 1.3 * to_goal / np.maximum(far, 0.5)[:, None] - state.vel[0]
            state = scene.step(state, drive=(change / 0.5)[None])
            deep = max(deep, overlap(state.pos[0], R) / R)
        there = int(np.isfinite(arrived).sum())
        when = (
            f"after {arrived.max():.1f} s" if there == count else f"deadlock: {count - there} not within {seconds:g} s"
        )
        return Value(deep, deep <= 0.05, f"{there} of {count} there, {when}; overlap {deep:.2%} of R at most")

    return trial


# --- N25: a force field against steering ------------------------------------------------------------------------------


def stalls(method: Integrator) -> Value:
    """Check, with an obstacle dead ahead, that a force field stalls and steering to avoid passes (Reynolds 1988)."""
    ends, offsets = [], []
    for variant in ("force field", "to avoid"):
        scene = _agent_with_goal((Circle(centre=(6, 0), radius=1),), variant, method)
        end = scene.run(scene.start(0).with_motion(np.zeros((1, 1, 2)), np.zeros((1, 1, 2))), 600)
        ends.append(float(end.pos[0, 0, 0]))
        offsets.append(float(np.abs(end.pos[0, 0, 1])))
    holds = ends[0] < 5.0 and offsets[0] == 0.0 and ends[1] > 7.0
    note = (
        f"after 12 s the field is at x = {ends[0]:.2f} m, {offsets[0]:.1g} m aside; "
        f"to avoid at x = {ends[1]:.2f} m of 12"
    )
    return Value(ends[0], holds, note)


def along_a_wall(method: Integrator) -> Value:
    """Compare steering to avoid, with exactly no force across, and a force field, for flight .4 m beside a wall."""
    forces = []
    for variant in ("to avoid", "force field"):
        scene = _agent_with_goal((Polygon(vertices=WALL),), variant, method)
        state = scene.start(0).with_motion(np.array([[[0.0, 0.0]]]), np.array([[[2.0, 0.0]]]))
        worst = 0.0
        for _ in range(200):
            worst = max(worst, float(np.abs(scene.acceleration(state)[0, 0, 1])))
            state = scene.step(state)
        forces.append(worst)
    return Value(forces[0], forces[0] == 0.0, f"across: {forces[0]:g} m/s^2; a field of force {forces[1]:.2g} m/s^2")


def _agent_with_goal(obstacles: tuple[Circle | Polygon, ...], variant: str, method: Integrator) -> Scene:
    """Return an agent with a goal 12 m ahead that avoids obstacles; see configs/experiments/avoidance.yaml."""
    seek = Seek(weight=4, target=(12, 0))
    steer = Steer(behaviours=(AvoidObstacles(weight=12, horizon=1, margin=0.05), seek), arbitration=Allocation())
    if variant == "force field":
        steer = Steer(behaviours=(ForceField(weight=2, range=2), seek), arbitration=Blend())
    group = Group(count=1, radius=0.2, max_speed=2, max_force=12, role="learner", spawn=Spawn(low=(0, 0), high=(0, 0)))
    return Scene(groups=(group,), effects=(steer,), obstacles=obstacles, dt=0.02, integrator=method)


def _with_method(scene: Scene, method: Integrator) -> Scene:
    """Return a scene under another method."""
    return scene.model_copy(update={"integrator": method})


# --- N27: chaos, again ------------------------------------------------------------------------------------------------


def chaos(method: Integrator, response: Response) -> Value:
    """Run 60 discs in a room, in 72 worlds, twice, and by 4 threads: equal bits; and renumbered: time within 1e-9 m."""
    room = Block(centre=(0.0, 0.0), size=(8.0, 8.0), hollow=True)
    scene = disc_scene(method, response, 0.02, count=60, obstacles=(room,), restitution=0.9, pull=(0.0, -1.0))
    rng = np.random.default_rng(0)
    places = np.stack(np.meshgrid(np.arange(8) - 3.5, np.arange(8) - 3.5), axis=-1).reshape(64, 2)[:60]
    pos = places + rng.uniform(-0.3, 0.3, (72, 60, 2))
    vel = rng.normal(size=(72, 60, 2))
    before = threads()
    try:
        ends = []
        for count in (1, 1, 4):
            use_threads(count)
            ends.append(scene.run(batch(scene, pos, vel), 250))
    finally:
        use_threads(before)
    same = all(np.array_equal(ends[0].x, end.x) and np.array_equal(ends[0].v, end.v) for end in ends[1:])
    order = rng.permutation(60)
    one, other, till, off = batch(scene, pos[:1], vel[:1]), batch(scene, pos[:1, order], vel[:1, order]), 0.0, 0.0
    for k in range(250):
        one, other = scene.step(one), scene.step(other)
        off = float(np.abs(one.pos[:, order] - other.pos).max())
        if off > 1e-9:
            break
        till = (k + 1) * scene.dt
    note = f"the same bits: {same}; renumbered within 1e-9 m until {till:.2f} s and {one.count_of('impacts')} impacts"
    return Value(till, same and till >= 1.0, note)


def _crowds() -> Sequence[Case]:
    """Return the cases of N11."""
    cases: list[Case] = []
    for name, count, circle, seconds in (
        ("pair", 2, 4.0, 20.0), ("four", 4, 4.0, 20.0), ("8", 8, 4.0, 40.0), ("16", 16, 5.0, 40.0),
        ("64", 64, 8.0, 60.0),
    ):  # fmt: skip
        title = {"pair": "two head-on", "four": "four at a crossing"}.get(name, f"{name} across a circle")
        bound = "pass or told, overlap 5 % R"
        cases += cases_by_response(f"N11 {name}", title, bound, crossing(count, circle, seconds), methods=ONE)
    return cases


GATHERINGS = (
    *_crowds(),
    Case("N25 ahead", "an obstacle exactly ahead", "field stalls, steering passes", stalls, ONE),
    Case("N25 wall", "flight along a wall", "force across exactly 0", along_a_wall, ONE),
    *cases_by_response("N27", "60 discs again; threads; renumbered", "same bits; 1e-9 m for 1 s", chaos, methods=ONE),
)
