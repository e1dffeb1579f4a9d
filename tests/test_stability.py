"""The largest stable step: of methods against formulas, of scenes against their linearised equations."""

from __future__ import annotations

import math
import re
import warnings
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from flockenv.behaviours import Separation
from flockenv.core.warnings import UnstableStepWarning
from flockenv.model.divergence import SimulationDiverged
from flockenv.model.networks import Cloth, Jelly, Mesh, Network, Rope
from flockenv.model.scene_view import SceneView
from flockenv.model.spawn import Spawn
from flockenv.model.state import blank
from flockenv.physics.effects import EFFECTS, AngularSprings, Drag, Effect, Elastic, Gravity, Springs, Tether
from flockenv.physics.integrators import INTEGRATORS as REGISTERED
from flockenv.physics.integrators import (
    RK4,
    AdaptiveRK4,
    AveragedVelocity,
    DormandPrince,
    ExplicitEuler,
    ExponentialDrag,
    Heun,
    ImplicitEuler,
    ImplicitMidpoint,
    Integrator,
    Midpoint,
    SemiImplicitEuler,
    VelocityVerlet,
)
from flockenv.scene import Group, Scene
from flockenv.scene.stability import amplification, drag_limit, limit, suggest_dt
from flockenv.scene.yaml_io import load_scene
from flockenv.studies.cost_breakdown import explain
from tests.catalogue import INTEGRATORS, Array

CHAIN = Rope(links=21, length=2.1, pinned=("ends",))  # 20 free masses
TRUE = 2 / (2 * math.sqrt(400 / 0.1) * math.sin(20 * math.pi / 42))
"""s: .0158557."""

HERE = Spawn(low=(0, 0), high=(1, 1))
O2 = (0.0, 0.0)


def network(net: Network, *effects: Effect, method: Integrator | None = None, **fields: Any) -> Scene:
    given: dict[str, Any] = {"dt": 1e-6, "integrator": method or SemiImplicitEuler()} | fields
    return Scene(groups=(Group(network=net, mass=given.pop("each", 0.1)),), effects=effects, **given)


def body(*effects: Effect, method: Integrator | None = None, dt: float = 1e-6, **fields: Any) -> Scene:
    group = Group(**({"count": 1, "spawn": HERE} | fields))
    return Scene(groups=(group,), effects=effects, integrator=method or SemiImplicitEuler(), dt=dt)


# --- methods ----------------------------------------------------------------------------------------------------------


def powers(*coefficients: float) -> Any:
    """Return R(A) = sum of c_k A^k, A = [[0, 1], [-y^2, -z]]: the map of (x, v) in a Runge-Kutta method."""

    def matrix(y: float, z: float) -> Array:
        a = np.array([[0.0, 1.0], [-y * y, -z]])
        return np.asarray(sum(c * np.linalg.matrix_power(a, k) for k, c in enumerate(coefficients)))

    return matrix


MAPS: dict[str, Any] = {
    "explicit_euler": powers(1, 1),
    "midpoint": powers(1, 1, 1 / 2),
    "heun": powers(1, 1, 1 / 2),
    "rk4": powers(1, 1, 1 / 2, 1 / 6, 1 / 24),
    "semi_implicit_euler": lambda y, z: np.array([[1 - y * y, 1 - z], [-y * y, 1 - z]]),
    "averaged_velocity": lambda y, z: np.array([[1 - y * y / 2, 1 - z / 2], [-y * y, 1 - z]]),
    # its second force is that of the predicted velocity (1 - z) v - y^2 x
    "velocity_verlet": lambda y, z: np.array([
        [1 - y * y / 2, 1 - z / 2],
        [-y * y / 2 * (2 - z - y * y / 2), (1 - y * y / 2) * (1 - z / 2) - z / 2 * (1 - z)],
    ]),
}  # fmt: skip
"""Map of (x, v) in one step, h = 1, with x'' = -y^2 x - z v."""

FIXED = tuple(row.method for row in INTEGRATORS if not row.method.adaptive and not row.method.solves)
ZETAS = (0.0, 0.1, 0.5, 1.0, 2.0, 20.0)


@pytest.mark.parametrize("kind", MAPS)
def test_one_step_of_an_oscillator_is_the_map_of_the_textbook(kind: str) -> None:
    method = next(method for method in FIXED if method.kind == kind)
    for y, zeta in ((0.3, 0.0), (1.7, 0.4), (2.5, 3.0)):
        found = amplification(method, np.array([9.0, y]), zeta)[1]
        np.testing.assert_allclose(found, MAPS[kind](y, 2 * zeta * y), rtol=1e-13, atol=1e-12)


@pytest.mark.parametrize("kind", MAPS)
def test_at_the_limit_the_map_begins_to_amplify(kind: str) -> None:
    method = next(method for method in FIXED if method.kind == kind)
    for zeta in ZETAS:
        most = limit(method, zeta)
        for share, stable in ((0.5, True), (0.9999, True), (1.0001, False)):
            y = share * most
            grown = float(np.abs(np.linalg.eigvals(MAPS[kind](y, 2 * zeta * y))).max())
            if most > 0:
                assert (grown < 1 + 1e-9) if stable else (grown > 1 + 1e-9), (zeta, share)
        if most == 0:
            assert all(np.abs(np.linalg.eigvals(MAPS[kind](y, 0.0))).max() > 1 + y**4 / 9 for y in (1e-2, 0.1, 1.0))


@pytest.mark.parametrize("zeta", ZETAS[1:])
def test_limits_of_damped_oscillators_match_the_formulas(zeta: float) -> None:
    """Explicit Euler: h w <= 2 zeta up to critical damping, 2 / (zeta + sqrt(zeta^2 - 1)) beyond."""
    root = math.sqrt(max(zeta * zeta - 1, 0.0))
    euler = 2 * zeta if zeta <= 1 else 2 / (zeta + root)
    assert limit(ExplicitEuler(), zeta) == pytest.approx(euler, rel=1e-4)
    assert limit(SemiImplicitEuler(), zeta) == pytest.approx(2 * (math.sqrt(1 + zeta * zeta) - zeta), rel=1e-5)
    if zeta >= 1:  # the faster of two real rates
        assert limit(RK4(), zeta) == pytest.approx(2.785294 / (zeta + root), rel=1e-5)
        assert limit(Heun(), zeta) == pytest.approx(2 / (zeta + root), rel=1e-5)


def test_limits_of_undamped_oscillators_match_the_table_of_integrators() -> None:
    for row in INTEGRATORS:
        if row.method.stable_at_any_step:
            assert limit(row.method, 0.0) == limit(row.method, 3.0) == drag_limit(row.method) == math.inf
            continue
        assert drag_limit(row.method) == pytest.approx(row.real, rel=1e-4)
        if row.imaginary:
            assert limit(row.method, 0.0) == pytest.approx(row.imaginary, rel=1e-5)
        else:
            assert limit(row.method, 0.0) == 0.0


GROWING = (ExplicitEuler(), AveragedVelocity(), Midpoint(), Heun())
"""Methods whose region of stability touches the imaginary axis at 0 alone."""


def test_methods_that_touch_the_axis_at_0_alone_have_no_stable_step_without_damping() -> None:
    """The amplitude grows as (h w)^2 or (h w)^4 in every step; slight damping gives a small limit."""
    for row in INTEGRATORS:
        assert (limit(row.method, 0.0) == 0.0) == (row.method in GROWING), row.method.kind
    for zeta in (1e-4, 1e-3):
        assert limit(ExplicitEuler(), zeta) == pytest.approx(2 * zeta, rel=0.02)
        for two_stages in (Heun(), Midpoint()):
            assert limit(two_stages, zeta) == pytest.approx((8 * zeta) ** (1 / 3), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("method", GROWING, ids=lambda method: method.kind)
def test_the_warning_of_an_undamped_spring_gives_the_growth_of_its_amplitude(method: Integrator) -> None:
    """k = 18, m = 2, w = 3. The e-fold time in the warning is that of the amplitude in a run."""
    tether = Tether(centre=O2, stiffness=18.0)
    for dt in (0.00047, 0.02, 0.1):
        with pytest.warns(UnstableStepWarning, match="no step is stable, for nothing damps it") as caught:
            scene = body(tether, method=method, dt=dt, mass=2.0)
        assert "or add damping" in str(caught[0].message)
    found = suggest_dt(scene)
    assert (found.dt, found.effect, found.frequency) == (0.0, "tether", pytest.approx(3.0))
    seconds = float(str(caught[0].message).split("e-fold in ")[1].split(" s")[0])
    start = scene.start(0).with_motion([[[1.0, 0.0]]], [[[0.0, 0.0]]])
    steps = round(min(seconds, 500.0) / scene.dt)
    end = scene.run(start, steps)
    amplitude = math.sqrt(float((end.pos**2).sum() + (end.vel**2).sum() / 9))
    assert math.log(amplitude) == pytest.approx(steps * scene.dt / seconds, rel=0.2)


@pytest.mark.slow
def test_explain_reports_that_no_step_is_stable() -> None:
    tether = Tether(centre=O2, stiffness=18.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnstableStepWarning)
        found = explain(body(tether, method=ExplicitEuler(), dt=0.01, mass=2.0))
        assert found.largest_step == "none is stable with explicit_euler (tether at agent 0), dt = 0.01 s"


def test_the_suggested_step_of_an_undamped_spring_is_the_limit_of_the_method() -> None:
    for method, most in ((SemiImplicitEuler(), 2 / 3), (VelocityVerlet(), 2 / 3), (RK4(), 2.828427 / 3)):
        assert suggest_dt(body(Tether(centre=O2, stiffness=18.0), mass=2.0, method=method)).dt == pytest.approx(
            most, rel=1e-5
        )


def test_drag_that_a_method_integrates_exactly_sets_no_limit() -> None:
    """Drag inside the acceleration sets one."""
    method = ExponentialDrag()
    for drag in (0.1, 1.0, 10.0):
        assert limit(method, 0.0, drag) > 2.0
        assert limit(method, drag) < 2.0
        assert limit(SemiImplicitEuler(), 0.0, drag) == limit(SemiImplicitEuler(), drag)
    assert suggest_dt(body(Drag(rate=100), method=method)).dt == math.inf
    tether = Tether(centre=O2, stiffness=0.0, damping=100)
    assert suggest_dt(body(tether, Drag(rate=100), method=method)).dt == pytest.approx(0.02, rel=1e-4)


# --- scenes -----------------------------------------------------------------------------------------------------------


def derivatives(scene: Scene) -> tuple[Array, Array]:
    """Return K and C of the free agents, linearised at the start: a = -K x - C v."""
    state, free, step = scene.start(0), np.flatnonzero(np.isfinite(scene.body.mass)), 1e-6
    stiffness, damping = [], []
    for i in free:
        for k in range(scene.dimension):
            move = np.zeros(state.shape)
            move[0, i, k] = 1.0
            for out, far, moved in (
                (stiffness, step, lambda s, m=move: state.with_motion(state.pos + s * m, state.vel)),
                (damping, 1.0, lambda s, m=move: state.with_motion(state.pos, state.vel + s * m)),
            ):
                ends = [scene.acceleration(moved(sign * far))[0, free].ravel() for sign in (1, -1)]
                out.append((ends[1] - ends[0]) / (2 * far))
    return np.array(stiffness).T, np.array(damping).T


def linear_limit(method: Integrator, stiffness: Array, damping: Array, drag: float) -> float:
    """Return the smallest h, s, at which one step amplifies the whole linear system; found by taking steps."""
    n = len(stiffness)
    state = blank(1, n, 2 * n, 0, 1.0)  # one initial state per position and velocity, side by side
    state.x[:n, 0], state.v[n:, 0] = np.eye(n), np.eye(n)
    own = drag if method.splits_drag else 0.0
    weight = np.concatenate([np.full(n, math.sqrt(np.abs(stiffness).sum(axis=1).max())), np.ones(n)])

    def grows(h: float) -> bool:
        after = method(lambda x, v, t: -stiffness @ x - damping @ v + own * v, state, h, drag=own)
        matrix = np.concatenate([after.pos[0], after.vel[0]]) * weight[:, None] / weight
        return bool(np.abs(np.linalg.eigvals(matrix)).max() > 1 + 1e-5)

    steps = np.geomspace(1e-5, 1, 40)
    first = next(k for k, h in enumerate(steps) if grows(h))
    low, high = steps[first - 1], steps[first]
    for _ in range(16):
        middle = (low + high) / 2
        low, high = (low, middle) if grows(middle) else (middle, high)
    return float(low)


SHEET = Cloth(cells=(3, 2), sides=(1.0, 0.8), pinned=("corners",))
DAMPED = Rope(links=7, length=0.7, pinned=("ends",))
LINEAR: dict[str, tuple[Network, tuple[Effect, ...], float]] = {
    "chain": (DAMPED, (Springs(stiffness=400),), 0.95),
    "damped chain": (DAMPED, (Springs(stiffness=400, ratio=0.3),), 0.85),
    "damped sheet": (SHEET, (Springs(stiffness=400, ratio=0.3),), 0.3),  # damping is bounded as well
    "hinges": (DAMPED, (AngularSprings(stiffness=2, damping=0.01),), 0.9),
    "bars": (DAMPED, (Elastic(young=1e3, area=0.01, alpha=0.5, beta=1e-3),), 0.9),
    "triangles": (SHEET, (Elastic(young=1e3, thickness=0.1, beta=1e-3),), 0.5),
    "corotated triangles": (SHEET, (Elastic(young=1e3, strain="corotated", thickness=0.1, beta=1e-3),), 0.3),
    "many": (
        SHEET, (
            Springs(stiffness=300, shear=100, bend=50, damping=0.02), Drag(rate=0.5),
            Tether(centre=O2, stiffness=50, damping=0.1),
        ), 0.5,
    ),
}  # fmt: skip
"""Network of .1 kg per mass, effects, and the least share of the true limit that must be suggested."""


@pytest.mark.parametrize(
    "name", [n if n in ("chain", "triangles") else pytest.param(n, marks=pytest.mark.slow) for n in LINEAR]
)
def test_the_suggested_step_is_at_most_the_true_limit_and_not_far_below(name: str) -> None:
    """P02: at least half of the limit; at least about a third if damping is bounded as well."""
    net, effects, least = LINEAR[name]
    stiffness, damping = derivatives(network(net, *effects))
    drag = sum(effect.rate for effect in effects if isinstance(effect, Drag)) / 0.1
    for method in (SemiImplicitEuler(), VelocityVerlet(), RK4(), ExponentialDrag()):
        true = linear_limit(method, stiffness, damping, drag)
        found = suggest_dt(network(net, *effects, method=method))
        assert least * true <= found.dt <= 1.0005 * true, method.kind
        assert found.effect == effects[0].kind


@pytest.mark.parametrize(("shear", "bend", "printed"), [(0.0, 0.0, 3.93), (1000.0, 0.0, 7.80), (1000.0, 1000.0, 9.75)])
def test_the_stiffness_of_a_cloth_matches_the_published_table(shear: float, bend: float, printed: float) -> None:
    """12 x 12 masses: the greatest w^2 m / k is the printed one; the suggestion is .5 to 1 times 2 / w."""
    sheet = Cloth(cells=(11, 11), sides=(1.1, 1.1))
    bonds = Springs(stiffness=1000, shear=shear, bend=bend).bonds((Group(network=sheet, mass=0.1),), 2)
    matrix, points = np.zeros((288, 288)), sheet.rest_points(2)
    for i, (j,), (k, _, _) in zip(bonds.agent, bonds.partner, bonds.number, strict=True):
        offset = points[j] - points[i]
        block = k * np.outer(offset, offset) / (offset @ offset) / 0.1
        matrix[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += block
        matrix[2 * i : 2 * i + 2, 2 * j : 2 * j + 2] -= block
    square = float(np.linalg.eigvalsh(matrix)[-1])
    assert square * 0.1 / 1000 == pytest.approx(printed, abs=0.01)
    found = suggest_dt(network(sheet, Springs(stiffness=1000, shear=shear, bend=bend)))
    assert 0.5 * 2 / math.sqrt(square) <= found.dt <= 2 / math.sqrt(square)
    assert found.effect == "springs"


@pytest.mark.parametrize("method", [SemiImplicitEuler(), RK4()], ids=lambda method: method.kind)
def test_a_chain_is_bounded_just_below_its_limit_and_diverges_just_above(method: Integrator) -> None:
    """P02, N03: k = 400 N/m, m = .1 kg, 20 masses between fixed ends."""
    assert pytest.approx(0.0158557, abs=1e-7) == TRUE
    springs = Springs(stiffness=400, rest=0)  # linear: with rest lengths, energy would go over to other modes
    most = TRUE * limit(method, 0.0) / 2
    suggested = suggest_dt(network(CHAIN, springs, method=method)).dt
    assert 0.5 * most <= suggested <= most
    fast = np.sin(np.arange(22) * 20 * np.pi / 21)  # the fastest mode
    ends = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UnstableStepWarning)
        scenes = [network(CHAIN, springs, method=method, dt=share * most) for share in (0.99, 1.01)]
    for scene in scenes:
        start = scene.start(0)
        start.pos[0, :, 0] += 1e-4 * fast
        ends.append(start)
    held = scenes[0].run(ends[0], 10_000)
    assert np.abs(held.pos[0] - CHAIN.points(2)).max() < 2e-3
    with pytest.raises(SimulationDiverged, match="accelerated by springs"):
        scenes[1].run(ends[1], 100_000)


def test_each_agent_has_its_own_limit() -> None:
    """The agent with the smallest limit sets the step; the effect that is stiffest for this agent is named."""
    light, heavy = Group(count=3, mass=0.1, spawn=HERE), Group(count=4, mass=5.0, spawn=HERE)
    ropes = tuple(Group(network=Rope(links=4, length=0.4), mass=0.1) for _ in range(2))
    masses = Scene(groups=(heavy, light), effects=(Tether(centre=O2, stiffness=40.0),), dt=1e-6)
    found = suggest_dt(masses)
    assert found.dt == pytest.approx(2 / math.sqrt(40 / 0.1), rel=1e-6)
    assert (found.agent, found.frequency, found.effect) == (4, pytest.approx(20.0), "tether")
    # springs of the first group are the stiffest single effect, but both effects of the second add up to more
    effects = Springs(stiffness=100, group=0), Springs(stiffness=90, group=1), AngularSprings(stiffness=0.05, group=1)
    both = suggest_dt(Scene(groups=ropes, effects=effects, dt=1e-6))
    alone = suggest_dt(Scene(groups=ropes, effects=effects[:1], dt=1e-6))
    assert both.agent is not None
    assert both.agent >= 5
    assert both.dt < alone.dt
    hinges = Elastic(young=150, area=0.01), Springs(stiffness=20, group=1), AngularSprings(stiffness=0.03, group=1)
    mixed = suggest_dt(Scene(groups=ropes, effects=hinges, dt=1e-6))
    assert mixed.agent is not None
    assert mixed.agent >= 5
    assert mixed.effect in ("springs", "angular_springs")


def test_the_fastest_of_many_different_agents_sets_the_limit() -> None:
    """All masses differ; only the fastest oscillators are tested."""
    groups = tuple(Group(count=1, mass=10.0 ** (-k / 100), spawn=HERE) for k in range(300))
    scene = Scene(groups=groups, effects=(Tether(centre=O2, stiffness=40.0, damping=2.0),), dt=1e-6)
    mass = 10.0 ** (-299 / 100)
    zeta = 2 / (2 * math.sqrt(40 * mass))
    expected = 2 * (math.sqrt(1 + zeta * zeta) - zeta) / math.sqrt(40 / mass)
    assert suggest_dt(scene).dt == pytest.approx(expected, rel=1e-3)


def test_held_agents_have_no_limit() -> None:
    """Infinite masses give no NaN and no warning, and are never the named agent."""
    all_held = Cloth(cells=(1, 1), sides=(1.0, 1.0), pinned=("corners",))
    for effect in (
        Springs(stiffness=1e6, damping=1, ratio=0.5), AngularSprings(stiffness=1e3, damping=1),
        Elastic(young=1e6, alpha=1, beta=0.1), Drag(rate=1e6), Tether(centre=O2, stiffness=1e6, damping=1),
    ):  # fmt: skip
        assert suggest_dt(network(all_held, effect, dt=0.1)) == (math.inf, None, None, 0.0, 0.0)
    found = suggest_dt(network(CHAIN, Springs(stiffness=400, damping=1)))
    assert found.agent not in (None, 0, 21)
    assert 0 < found.dt < math.inf


# --- checks of a new scene --------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::flockenv.core.warnings.UnstableStepWarning")
def test_scenes_without_stiff_effects_have_no_limit() -> None:
    scene = body(Separation(weight=1.0, radius=1.0), Gravity(acceleration=(0, -9.81)), count=5, dt=100.0)
    assert suggest_dt(scene).dt == math.inf
    assert suggest_dt(body(dt=1e6)).dt == math.inf
    assert suggest_dt(body(Tether(centre=O2, stiffness=0.0), Drag(rate=0.0), dt=1e6)).dt == math.inf


@pytest.mark.parametrize("path", sorted(Path("configs/scenes").glob("*.yaml")), ids=lambda path: path.stem)
def test_shipped_scenes_are_neither_refused_nor_warned_of(path: Path) -> None:
    if path.read_text().startswith("# yaml-language-server") and "groups:" in path.read_text():
        scene = load_scene(path)  # a warning is an error here
        assert scene.dt <= suggest_dt(scene).dt


def test_a_warning_names_the_step_method_effect_agent_and_limit() -> None:
    effects = Gravity(acceleration=(0, -9.81)), Tether(centre=O2, stiffness=100.0), Drag(rate=0.1)
    with pytest.warns(UnstableStepWarning) as caught:
        body(*effects, dt=0.21)
    assert len(caught) == 1
    text = str(caught[0].message)
    for part in ("dt = 0.21 s", "semi_implicit_euler", "tether", "10 rad/s", "0.1 1/s", "agent 0", "0.199 s"):
        assert part in text
    assert "another integrator" not in text
    assert "\n" not in text
    body(*effects, dt=0.19)  # a warning would be an error


BLOCK = Jelly(cells=(2, 2), sides=(1, 1))
SEMI, LINEARLY, FULLY = (
    f", or integrator: {{kind: {kind}}}"
    for kind in ("semi_implicit_euler", "linearly_implicit_euler", "implicit_euler")
)
COSTS = " (it solves equations in each step, which takes far longer; not in tasks)"
STIFF = Springs(stiffness=4e7)  # stable up to 2.357e-5 s: the advice must not be rounded up


class OnlyExplicit(Gravity):
    """An effect that no implicit method accepts."""

    kind: Literal["only_explicit"] = "only_explicit"  # type: ignore[assignment]

    def check(self, scene: SceneView) -> None:
        """Raise ValueError for an implicit method."""
        if scene.integrator.solves:
            raise ValueError("kind: needs an explicit method")


del EFFECTS["only_explicit"]  # other tests are about the effects of the package


@pytest.mark.parametrize(
    ("net", "effects", "method", "alternative"),
    [
        pytest.param(SHEET, (STIFF,), SemiImplicitEuler(), LINEARLY + COSTS, id="springs"),
        pytest.param(SHEET, (STIFF,), VelocityVerlet(), LINEARLY + COSTS, id="verlet"),
        pytest.param(BLOCK, (Elastic(young=1e9),), SemiImplicitEuler(), FULLY + COSTS, id="elastic"),
        pytest.param(BLOCK, (Elastic(young=1e9), Springs(stiffness=1)), RK4(), FULLY + COSTS, id="elastic and springs"),
        pytest.param(SHEET, (Springs(stiffness=1, damping=1e-5),), ExplicitEuler(), SEMI, id="explicit"),
        pytest.param(SHEET, (STIFF, OnlyExplicit(acceleration=(0, 0))), SemiImplicitEuler(), "", id="refused"),
    ],
)
def test_where_dt_is_far_too_long_a_dt_and_a_method_are_recommended_that_work(
    net: Network, effects: tuple[Effect, ...], method: Integrator, alternative: str
) -> None:
    """With either there is no warning, and some steps are finite."""
    text = _advice(net, effects, method)
    found = re.search(r"so take dt <= (\S+) s(.*)$", text)
    assert found is not None, text
    assert found[2] == alternative
    network(net, *effects, method=method, dt=float(found[1]))  # a warning would be an error
    if kind := re.search(r"kind: (\w+)", alternative):
        other = network(net, *effects, method=REGISTERED[kind[1]](), dt=0.02)
        assert np.isfinite(other.run(other.start(0), 3).pos).all()


def _advice(net: Network, effects: tuple[Effect, ...], method: Integrator) -> str:
    """Return the text with which a scene of dt = 0.02 s warns or is refused."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            network(net, *effects, method=method, dt=0.02)
        except ValueError as error:
            return str(error)
    return str(caught[0].message)


@pytest.mark.parametrize("method", [ExplicitEuler(), AveragedVelocity(), Midpoint(), Heun()], ids=lambda m: m.kind)
def test_without_a_stable_step_another_integrator_is_recommended(method: Integrator) -> None:
    tether = Tether(centre=O2, stiffness=1.0)
    with pytest.warns(UnstableStepWarning, match=r"no step is stable.*so take another integrator"):
        body(tether, method=method, dt=0.1)
    with pytest.raises(ValueError, match=r"no step is stable.*so take another integrator"):
        body(tether, method=method, dt=3.0)
    with pytest.warns(UnstableStepWarning) as caught:  # with enough damping there is a limit
        body(Tether(centre=O2, stiffness=1.0, damping=1.0), method=method, dt=1.01 * limit(method, 0.5))
    assert "another integrator" not in str(caught[0].message)
    assert "no step is stable" not in str(caught[0].message)


@pytest.mark.parametrize("method", FIXED, ids=lambda method: method.kind)
def test_a_step_that_must_diverge_is_refused(method: Integrator) -> None:
    """Up to 2.5 times the limit it is only warned of: the bound of frequency may be that far off."""
    tether = Tether(centre=O2, stiffness=100.0)
    with pytest.raises(ValueError, match=f"dt = 1 s: {method.kind} with tether") as caught:
        body(tether, method=method, dt=1.0)
    assert "\n" not in str(caught.value)
    if limit(method, 0.0) > 1:
        with pytest.warns(UnstableStepWarning):
            body(tether, method=method, dt=0.24 * limit(method, 0.0))
        with pytest.raises(ValueError, match="is stable"):
            body(tether, method=method, dt=0.26 * limit(method, 0.0))
    if not method.splits_drag:
        with pytest.warns(UnstableStepWarning, match="drag"):
            body(Drag(rate=1.05 * drag_limit(method)), method=method, dt=1.0)
        with pytest.raises(ValueError, match="drag"):
            body(Drag(rate=10.0), method=method, dt=1.0)


@pytest.mark.parametrize("method", [ImplicitEuler(), ImplicitMidpoint(), AdaptiveRK4(), DormandPrince()])
def test_methods_without_a_limit_are_not_warned_of(method: Integrator) -> None:
    scene = body(Tether(centre=O2, stiffness=1e8), Drag(rate=1e4), method=method, dt=1.0)
    assert suggest_dt(scene).dt == math.inf


@pytest.mark.parametrize("spokes", [6, 20])
def test_a_stable_step_is_never_refused(spokes: int) -> None:
    """The bound of frequency adds up springs of all directions; it is at most sqrt(2 D) times too large."""
    directions = np.random.default_rng(0).normal(size=(spokes, 3))
    ends = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    star = Mesh(
        vertices=((0.0, 0.0, 0.0), *map(tuple, ends.tolist())), pairs=tuple((0, k) for k in range(1, spokes + 1))
    )
    for net in (star, Jelly(cells=(2, 2, 2), sides=(1.0, 1.0, 1.0))):
        make = lambda dt, net=net: network(net, Springs(stiffness=400), dimension=3, dt=dt)  # noqa: E731
        stiffness, _ = derivatives(make(1e-6))
        true = 2 / math.sqrt(float(np.linalg.eigvals(stiffness).real.max()))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UnstableStepWarning)
            make(0.999 * true)  # may be warned of
            assert suggest_dt(make(1e-6)).dt <= true
