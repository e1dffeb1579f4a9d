"""Hard cases of cloth and liquids: bullets against solid faces, stiff triangles, a spring torn apart, a drop."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flockenv.geometry.mesh_checks import first_piercing
from flockenv.geometry.shapes import HalfSpace
from flockenv.model.networks import Cloth, Rope
from flockenv.model.spawn import Spawn
from flockenv.model.surface import faces_of
from flockenv.physics.constraints import Collisions, FaceCollisions
from flockenv.physics.constraints.face_mesh import edges_of
from flockenv.physics.effects import Bending, Gravity, Membrane, Pressure, Springs, SurfaceTension, Viscosity
from flockenv.physics.integrators import Integrator, LinearlyImplicitEuler
from flockenv.scene import Group, Scene
from flockenv.studies.stress.setup import energy_of_a_fall, start_with
from flockenv.studies.trial_log import Case, Value

__all__ = ["SHEETS"]

G = 9.81
FRAME = 1 / 60  # s


def bullets(method: Integrator) -> Value:
    """Check that none of 16 bullets of 1 g passes a pinned sheet, at 100 m/s: 0.2 m in a step."""
    cloth = Cloth(cells=(6, 6), edges=((1, 0, 0), (0, 1, 0)), pinned=("border",))
    sheet = Group(network=cloth, mass=0.01, radius=0.01)
    group = Group(count=16, mass=0.001, radius=0.01, spawn=Spawn(low=(0, 0, 1), high=(1, 1, 2)))
    scene = Scene(
        dimension=3, groups=(sheet, group), effects=(Springs(stiffness=200.0, damping=0.02),), integrator=method,
        constraints=(FaceCollisions(thickness=0.005),), dt=0.002,
    )  # fmt: skip
    start = scene.start(0)
    pos, vel = np.array(start.pos[0]), np.zeros_like(start.pos[0])
    aims = np.moveaxis(np.mgrid[:4, :4], 0, -1).reshape(-1, 2)
    pos[-16:, :2], pos[-16:, 2], vel[-16:, 2] = 0.17 + 0.21 * aims, 0.5 + 0.07 * np.arange(16), -100.0
    end = scene.run(start_with(scene, pos, vel), 100)
    lowest = float(end.pos[0, :-16, 2].min())
    passed = int((end.pos[0, -16:, 2] < lowest - 0.01).sum())
    note = f"{end.count_of('impacts')} impacts, {end.count_of('unsolved') + end.count_of('stopped')} unsolved"
    return Value(passed, passed == 0, note)


def triangles(stretch: float, steps: int = 20) -> Callable[[Integrator], Value]:
    """Return the trial of a sheet of 200 triangles that swings down from its edge at 60 frames a second."""

    def trial(method: Integrator) -> Value:
        cloth = Cloth(cells=(10, 10), edges=((1, 0, 0), (0, 1, 0)), pinned=("top",))
        forces = Membrane(stretch=stretch, shear=stretch / 4), Bending(stiffness=stretch * 1e-5)
        scene = Scene(
            dimension=3, groups=(Group(network=cloth, mass=1 / 121),), integrator=method, dt=FRAME,
            effects=(*forces, Gravity(acceleration=(0.0, 0.0, -G))),
        )  # fmt: skip
        _, most = energy_of_a_fall(scene, steps)
        return Value(most, most <= 1.05, f"energy at most {most:.3g} of the work of gravity")

    return trial


def torn(method: Integrator) -> Value:
    """Check the energy that remains after two bodies tear their spring: m u^2 - k (b L)^2 / 2, within 2 %.

    They part at u = 2 m/s each; the spring of 100 N/m and 1 m breaks at a strain of 0.2, after 2 J of 4 J are stored.
    """
    rope = Rope(links=1, length=1.0)
    scene = Scene(
        groups=(Group(network=rope, mass=1.0),), effects=(Springs(stiffness=100.0, break_strain=0.2),),
        integrator=method, dt=5e-4,
    )  # fmt: skip
    end = scene.run(start_with(scene, [[0.0, 0.0], [1.0, 0.0]], [[-2.0, 0.0], [2.0, 0.0]]), 400)
    left, broken = 0.5 * float((end.vel**2).sum()), bool(np.isinf(end.bonds).all())
    off = abs(left / (2.0**2 - 0.5 * 100.0 * 0.2**2) - 1)
    return Value(off, broken and off <= 0.02, f"{left:.4g} J remain of 4 J; {'broken' if broken else 'whole'}")


def stretched_for_good(method: Integrator) -> Value:
    """Check the rest length, m, of a spring of 1 m that starts at 1.4 m and yields at a strain of 0.1, after 2 s.

    It is 1.4 / 1.1 once it has yielded; the elastic swing that remains does not change it.
    """
    rope = Rope(links=1, length=1.0, stretch=1.4)
    scene = Scene(
        groups=(Group(network=rope, mass=1.0),), effects=(Springs(stiffness=100.0, yield_strain=0.1),),
        integrator=method, dt=5e-4,
    )  # fmt: skip
    end = scene.run(scene.start(0), 4000)
    rest, long = float(end.bonds[0, 0]), float(np.linalg.norm(end.pos[0, 1] - end.pos[0, 0]))
    off = abs(rest / (1.4 / 1.1) - 1)
    return Value(off, off <= 0.01, f"{rest:.5g} m at rest, {long:.4g} m long then")


def folded(method: Integrator) -> Value:
    """Count the looks, of 40 in 1 s, at which a sheet pierces itself that falls on its edge and folds."""
    cloth = Cloth(cells=(4, 14), edges=((0.3, 0, 0), (0, 0.12, 1)), origin=(0, 0, 0.03))
    scene = Scene(
        dimension=3, groups=(Group(network=cloth, mass=0.005, radius=0.005),), integrator=method, dt=0.0025,
        effects=(
            Springs(stiffness=100.0, shear=30.0, bend=0.02, damping=0.02), Gravity(acceleration=(0.0, 0.0, -G)),
        ),
        obstacles=(HalfSpace(point=(0, 0, 0), direction=(0, 0, 1)),),
        constraints=(Collisions(agents=False), FaceCollisions(thickness=0.01, friction=0.3)),
    )  # fmt: skip
    state, faces, pierced = scene.start(0), faces_of(scene), 0
    for _ in range(40):
        state = scene.run(state, 10)
        pierced += first_piercing(state.pos[0], edges_of(faces), faces) is not None
    note = f"{state.count_of('impacts')} impacts, {state.count_of('unsolved') + state.count_of('stopped')} unsolved"
    return Value(pierced, pierced == 0, note)


def drop(method: Integrator) -> Value:
    """Check that a drop keeps its momentum for 4 s: 40 agents in an oblong, shaken, that drift."""
    effects = (
        Pressure(strength=0.75, density=1.0, radius=1.35),
        Viscosity(viscosity=0.2, density=1.0, radius=2.4),
        SurfaceTension(tension=3.0, density=1.0, radius=2.4),
    )
    group = Group(count=40, spawn=Spawn(low=(0, 0), high=(1, 1)))
    scene = Scene(groups=(group,), effects=effects, integrator=method, dt=0.02)
    near = np.moveaxis(np.mgrid[:10, :4], 0, -1).reshape(-1, 2)
    start = start_with(scene, near + 0.1 * np.random.default_rng(1).normal(size=(40, 2)), [[0.3, -0.2]] * 40)
    end = scene.run(start, 200)
    off = float(np.abs((end.vel - start.vel).sum(axis=1)).max() / np.abs(end.vel).sum())
    return Value(off, off <= 1e-12, f"{off:.2g} of the sum of all momenta")


def incline(method: Integrator) -> Value:
    """Check a sheet on an incline of 30 degrees for 2 s at 60 frames a second: it sticks, or slides as a body would.

    With friction 0.7 > tan 30 deg it must not move; with m = 0.3 it slides (sin - m cos) g t^2 / 2 = 4.7 m, within 2 %.
    """
    slope = np.radians(30.0)
    down, up = np.array((np.cos(slope), 0.0, -np.sin(slope))), np.array((np.sin(slope), 0.0, np.cos(slope)))
    cloth = Cloth(cells=(5, 5), origin=tuple(0.02 * up), edges=(tuple(down), (0.0, 1.0, 0.0)))
    group = Group(network=cloth, mass=0.01, radius=0.02)
    expected, off, note = 0.5 * G * (np.sin(slope) - 0.3 * np.cos(slope)) * 2.0**2, 0.0, []
    for friction in (0.7, 0.3):
        scene = Scene(
            dimension=3, groups=(group,), integrator=method, dt=FRAME,
            effects=(Springs(stiffness=1e3, damping=0.05), Gravity(acceleration=(0.0, 0.0, -G))),
            obstacles=(HalfSpace(point=(0, 0, 0), direction=tuple(up)),),
            constraints=(Collisions(friction=friction, restitution=0.0, agents=False),),
        )  # fmt: skip
        start = scene.start(0)
        slid = float(((scene.run(start, 120).pos - start.pos)[0] @ down).mean())
        off = max(off, abs(slid - (expected if friction == 0.3 else 0.0)) / expected)
        note.append(f"{slid:.4g} m with friction {friction:g}")
    return Value(off, off <= 0.02, "slides " + ", ".join(note))


SHEETS = (
    Case("N47", "16 bullets at a sheet", "none passes", bullets),
    Case("N48 3", "triangle cloth, k = 1e3 N/m", "E <= 1.05 work, or refused", triangles(1e3)),
    Case("N48 6", "triangle cloth, k = 1e6 N/m", "E <= 1.05 work, or refused", triangles(1e6)),
    Case("N49", "sheet on an incline", "sticks; slides within 2 %", incline, (LinearlyImplicitEuler().kind,)),
    Case("N50", "spring torn apart", "2 J remain +- 2 %", torn),
    Case("N51", "drop of liquid, 4 s", "momentum within 1e-12", drop),
    Case("N53", "spring that yields, 2 s", "1.4 m / 1.1 at rest +- 1 %", stretched_for_good),
    Case("N54", "sheet that folds on a floor, 1 s", "does not pierce itself", folded),
)
