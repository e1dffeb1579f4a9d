"""Accuracy of whole scenes: references include constraints, births and deaths, and estimate their own errors."""

from __future__ import annotations

import itertools
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.cli.main import main
from flockenv.physics.integrators import methods_of
from flockenv.scene import Group, Scene
from flockenv.scene.yaml_io import load_scene
from flockenv.studies.accuracy import Problem, Report, Results, measure, select_problems
from flockenv.studies.accuracy.paths import Path as Way
from flockenv.studies.accuracy.paths import count_unmatched, distances, reach
from flockenv.studies.accuracy.plots import draw_precision
from flockenv.studies.accuracy.reference import _convergence, _step_counts, find_reference, reference_by_own_steps
from flockenv.studies.accuracy.table import errors, headlines

BALL = """\
dimension: 2
space: {kind: plane}
groups: [{count: 1, mass: 1, radius: 0.1, spawn: {low: [0, 1], high: [0, 1]}}]
obstacles: [{kind: half_space, point: [0, 0], direction: [0, 1]}]
effects: [{kind: gravity}]
constraints: [{kind: collisions, restitution: 0.8}]
dt: 0.02
"""
ROD = """\
groups:
  - network: {kind: rope, links: 1, start: [0, 0], end: [1, 0], pinned: [start]}
    mass: 1
    radius: 0.05
effects: [{kind: gravity}]
constraints: [{kind: rods, group: 0}]
dt: 0.01
"""
EMITTER = """\
groups: [{count: 60, mass: 1, radius: 0.05}]
effects: [{kind: gravity}, {kind: drag, rate: 0.5}]
population:
  - {kind: emitter, place: {kind: point, at: [0, 0]}, rate: 37, speed: [5, 6], direction: [0, 1], spread: 20}
  - {kind: leaving, low: [-9, -0.1], high: [9, 9]}
dt: 0.025
"""
AGEING = """\
groups: [{count: 40, alive: 8, mass: 1, radius: 0.05, spawn: {low: [0, 0], high: [4, 4], speed: [1, 2]}}]
effects: [{kind: tether, centre: [2, 2], stiffness: 4}]
population:
  - {kind: ageing, lifetime: 0.62}
  - {kind: emitter, place: {kind: point, at: [2, 1]}, rate: 9.3, speed: [1, 1]}
dt: 0.025
"""
FEW = methods_of(["semi_implicit_euler", "velocity_verlet", "rk4"])


def of(text: str, seconds: float, steps: tuple[int, ...], **more: Any) -> Problem:
    return Problem.of(load_scene(text), seconds, steps, **more)


def bounced(t: float, height: float, e: float) -> float:
    """Return the height at time t of a ball dropped from `height`, with restitution e."""
    g, up = 9.81, math.sqrt(2 * 9.81 * height)
    fall = math.sqrt(2 * height / g)
    if t < fall:
        return height - g * t * t / 2
    t, up = t - fall, e * up
    while t > 2 * up / g:
        t, up = t - 2 * up / g, e * up
    return up * t - g * t * t / 2


# --- references -------------------------------------------------------------------------------------------------------


def test_the_reference_of_a_bouncing_ball_includes_the_floor() -> None:
    """In free fall it would be 3.9 m below the floor after a second."""
    problem = of(BALL, 1.0, (50, 100, 200))
    found = find_reference(problem)
    assert found.kind == "event-exact steps"
    for t, (_, height) in zip(problem.times, found.path.pos[:, 0], strict=True):
        assert height == pytest.approx(0.1 + bounced(t, 0.9, 0.8), abs=1e-9)
    assert found.reach < 0.9
    assert found.error < 1e-9


@pytest.mark.slow
def test_order_1_is_distinguished_from_rounding_on_the_bouncing_ball() -> None:
    """Under constant gravity an impact is found exactly on the parabola: only the Euler methods have an error."""
    report = measure(of(BALL, 1.0, (50, 100, 200, 400)), FEW, repetitions=0)
    euler = report.curve("semi_implicit_euler")
    assert euler.order == pytest.approx(1, abs=0.05)
    assert all(report.trusts(point) for point in euler.points)
    for kind in ("velocity_verlet", "rk4"):
        assert not any(report.trusts(point) for point in report.curve(kind).points)
        assert max(point.error or 0.0 for point in report.curve(kind).points) < 1e-9
    assert any("event-exact" in line and "collisions" in line for line in headlines(report))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bounces", "rod"])
def test_closed_forms_agree_with_the_scenes_own_steps(name: str) -> None:
    known = select_problems([name])[0]
    exact, own = find_reference(known), reference_by_own_steps(known, 16)
    assert exact.kind == "closed form"
    assert exact.error == 0
    off = np.abs(known.distances(exact.path, own.path)).max()
    assert off <= max(own.error, 1e-9)


@pytest.mark.slow
def test_the_reference_of_a_pendulum_includes_its_rod() -> None:
    """By the suite's closed form, a pendulum released level returns after one period, 4 K(1/2) sqrt(l/g)."""
    report = measure(of(ROD, 0.8, (40, 80, 160, 320)), FEW, repetitions=0)
    assert report.reference == "own steps"
    assert "rods" in report.note
    assert report.reach < 2.01  # in free fall 3.1 m
    assert report.curve("rk4").order == pytest.approx(2, abs=0.3)


@pytest.mark.slow
def test_the_reference_of_newtons_cradle_includes_its_constraints() -> None:
    problem = Problem.of(load_scene(Path("configs/scenes/newtons_cradle.yaml")), 0.6, (600, 1200), name="cradle")
    report = measure(problem, methods_of(["velocity_verlet"]), repetitions=0, finer=8)
    assert report.reference == "event-exact steps"
    assert 0.1 < report.reach < 1.5  # 1.8 m in free fall
    assert all(point.error is not None and point.error < 0.02 for point in report.curves[0].points)


@pytest.mark.slow
@pytest.mark.parametrize("text", [EMITTER, AGEING], ids=["emitter", "ageing"])
def test_agents_that_are_born_and_die_are_compared_by_identity(text: str) -> None:
    report = measure(of(text, 1.0, (80, 160, 320, 640)), FEW, repetitions=0)
    assert report.reference == "own steps"
    assert "births and deaths" in report.note
    assert report.energy.startswith("not compared")
    for curve in report.curves:
        assert curve.order == pytest.approx(1, abs=0.35), curve.method  # births happen outside the method
        assert all(point.error is not None and point.error < 0.3 for point in curve.points)
        assert all(point.unmatched <= 4 for point in curve.points)


def test_paths_are_matched_by_identity_and_not_by_slot() -> None:
    one = Way(np.array([[[0.0, 0], [5.0, 0], [9.0, 9]]]), np.zeros((1, 3, 2)), np.array([[7, 8, -1]]))
    two = Way(np.array([[[5.0, 1], [0.5, 0], [3.0, 3]]]), np.zeros((1, 3, 2)), np.array([[8, 7, 11]]))
    minus = np.subtract
    np.testing.assert_array_equal(distances(one, two, minus), [[0.5, 1.0, np.nan]])
    assert count_unmatched(one, two) == 1
    later = Way(np.concatenate([one.pos, one.pos + 2]), np.zeros((2, 3, 2)), np.array([[7, 8, -1], [8, -1, 7]]))
    assert reach(later, np.zeros((3, 2)), minus) == pytest.approx(math.hypot(11, 11))


def test_the_error_of_a_reference_is_estimated_by_richardson_extrapolation() -> None:
    for order in (1.0, 2.0, 4.0):
        ends = {ratio: 0.3 * (ratio / 8) ** order for ratio in (1.0, 2.0, 3.3, 3.9, 4.0)}
        apart = {ratio: end - ends[1] for ratio, end in ends.items() if ratio > 1}
        converges, error = _convergence(ends[4] - ends[2], apart, 1e-15)
        assert converges.endswith(f"order {order:.1f}")
        assert ends[1] <= error <= 15.001 * ends[1]
        if order == 1:
            assert error == pytest.approx(ends[1])


@pytest.mark.parametrize(
    ("before", "apart", "largest", "words"),
    [
        (1e-3, {2: 2e-3, 3.6: 1e-3, 4: 2e-3}, 2e-3, "jumps"),
        (0.0, {2: 1e-3, 3.6: 0.0, 4: 1e-3}, 1e-3, "jumps"),  # a jump in the finest run alone
        (1e-3, {2: 0.0, 3.6: 0.0, 4: 1e-3}, 1e-3, "jumps"),
        (9.8e-4, {2: 9e-8, 3.6: 2e-4, 4: 9.8e-4}, 9.8e-4, "jumps"),  # order 13.4
        (36e-8, {2: 9e-8, 3.6: 5e-4, 4: 45e-8}, 5e-4, "jumps"),  # order 2, which a further run does not confirm
        (0.0, {2: 0.0, 3.6: 5e-4, 4: 0.0}, 5e-4, "jumps"),
        (1e-14, {2: 3e-14, 3.6: 1e-14, 4: 2e-14}, 3e-14, "rounding"),
        (0.0, {2: 0.0, 4: 0.0}, 0.0, "rounding"),
    ],
)
def test_an_order_that_is_an_accident_is_not_believed(
    before: float, apart: dict[float, float], largest: float, words: str
) -> None:
    converges, error = _convergence(before, apart, 1e-12)
    assert converges.endswith(words)
    assert error == 2 * largest


def test_distances_that_pass_into_rounding_keep_their_order() -> None:
    apart = {ratio: 3e-14 * (ratio**4 - 1) for ratio in (2, 3.3, 3.6, 4)}
    converges, error = _convergence(3e-14 * (4**4 - 2**4), apart, 1e-12)
    assert converges.endswith("order 2.8")
    assert error == pytest.approx(1e-12)


@pytest.mark.parametrize("many", [4, 8, 12, 48, 256, 1280])
def test_steps_of_further_runs_end_at_other_times(many: int) -> None:
    counts = _step_counts(16 * many, 16)
    assert [16 * many / n for n in counts[:3]] == [1, 2, 4]
    assert all(n % 16 == 0 and 1 < 16 * many / n < 4 for n in counts[3:])
    assert all(math.gcd(n // 16, many) == 1 for n in counts[3:])
    assert len(set(counts)) == len(counts) == (4 if many == 4 else 6)


SLOWLY = [pytest.param(each, marks=pytest.mark.slow) for each in ("impulses", "back_up", "project")]


@pytest.mark.slow
@pytest.mark.parametrize("response", ["earliest", *SLOWLY])
def test_the_error_of_a_reference_with_impacts_is_not_understated(response: str) -> None:
    """The response `impulses` delays an impact to the end of a step, which often is the same one in half the steps."""
    for height, e in itertools.product((0.8, 1.0, 1.3, 1.68, 1.94), (0.5, 0.69, 0.8)):
        text = BALL.replace("low: [0, 1], high: [0, 1]", f"low: [0, {height}], high: [0, {height}]")
        problem = of(text.replace("restitution: 0.8", f"restitution: {e}, response: {response}"), 1.0, (20, 40))
        found = find_reference(problem)
        exact = [0.1 + bounced(t, height - 0.1, e) for t in problem.times]
        off = np.abs(found.path.pos[:, 0, 1] - exact).max()
        assert off <= found.error, (height, e, found.note)
        assert found.error < (3e-2 if response == "impulses" else 1e-11)


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_chaotic_scene_is_refused_with_a_horizon_to_try() -> None:
    """Balls collide in a box: every impact multiplies a difference by the free path over the radius."""
    balls = """\
space: {kind: box, size: [3, 3], restitution: 1}
groups: [{count: 20, radius: 0.15, spawn: {low: [0, 0], high: [3, 3], spacing: 0.6, jitter: 0.1, speed: [4, 4]}}]
constraints: [{kind: collisions, restitution: 1}]
dt: 0.02
"""
    with pytest.raises(ValueError, match=r"chaotic.*e-fold in [\d.]+ s.*try [\d.]+ s") as caught:
        measure(of(balls, 6.0, (300, 600)), FEW, repetitions=0)
    assert "\n" not in str(caught.value)
    shorter = float(str(caught.value).split("try ")[1].split(" s")[0])
    assert 0 < shorter < 6
    steps = round(shorter / 0.02)
    report = measure(of(balls, shorter, (steps, 2 * steps)), FEW[1:2], repetitions=0, finer=4)
    assert report.rate > 0.5


@pytest.mark.parametrize(
    ("more", "text"),
    [
        ("effects: [{kind: fluctuation, strength: 1}]", r"effects\[0\] fluctuation: kicks at random.*weak error"),
        ("population: [{kind: decay, rate: 1}]", r"population\[0\] decay: agents die by draws of every step.*weak"),
        (
            "population: [{kind: crowding, radius: 1, most: 2, rate: 1}]",
            r"population\[0\] crowding: agents die by draws of every step",
        ),
    ],
)
def test_random_draws_in_every_step_are_refused_in_one_line(more: str, text: str) -> None:
    with pytest.raises(ValueError, match=text) as caught:
        of(f"groups: [{{count: 3, spawn: {{low: [0, 0], high: [1, 1]}}}}]\n{more}\n", 1.0, (8, 16))
    assert "\n" not in str(caught.value)


def test_a_map_from_step_to_step_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match="vicsek: is a map from step to step") as caught:
        Problem.of(load_scene(Path("configs/scenes/vicsek.yaml")), 4.0, (4, 8))
    assert "\n" not in str(caught.value)


# --- tables, pictures and commands ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ball() -> Report:
    return measure(of(BALL, 0.5, (25, 50, 100, 200)), methods_of(["semi_implicit_euler", "rk4"]), repetitions=0)


def test_errors_near_that_of_the_reference_are_marked(ball: Report) -> None:
    heads, rows = errors(ball)
    assert heads == ("method", "25 steps", "50 steps", "100 steps", "200 steps")
    euler, rk4 = rows
    assert not any(cell.endswith("?") for cell in euler[1:])
    assert all(cell.endswith("?") for cell in rk4[1:])
    figure = draw_precision([ball])
    hollow = [line for line in figure.axes[1].lines if line.get_markerfacecolor() == "white"]
    assert len(hollow) == 1
    assert any("event-exact steps" in text.get_text() for axes in figure.axes for text in axes.texts)
    assert any("(1.0)" in text.get_text() for text in figure.legends[0].get_texts())


def test_a_picture_states_that_no_method_arrives(ball: Report) -> None:
    nowhere = [
        curve.model_copy(
            update={"points": tuple(p.model_copy(update={"error": None}) for p in curve.points), "order": None}
        )
        for curve in ball.curves
    ]
    figure = draw_precision([ball, ball.model_copy(update={"curves": tuple(nowhere)})])
    assert "no method arrives in these steps" in [text.get_text() for text in figure.axes[3].texts]


@pytest.mark.slow
def test_each_scene_on_the_command_line_gets_a_report_or_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("ball.yaml").write_text(BALL)
    Path("kicked.yaml").write_text(BALL.replace("{kind: gravity}", "{kind: fluctuation, strength: 1}"))
    options = "--seconds 0.4 --methods rk4 --steps 20,40 --repetitions 0 --out all.json".split()
    assert main(["accuracy", "ball.yaml", "kicked.yaml", *options]) == 0
    out = capsys.readouterr().out
    assert "against: event-exact steps" in out
    assert out.count("kicked.yaml: effects[0] fluctuation: kicks at random") == 1
    assert [r.name for r in Results.model_validate_json(Path("all.json").read_text()).reports] == ["ball"]
    assert main(["accuracy", "kicked.yaml", *options[:-2]]) == 2
    assert capsys.readouterr().err.count("\n") == 1


REASONS = ("at random", "map from step", "chaotic", "no reference", "too long", "no agent lives")

OF_EACH_KIND = (
    "boids", "bouncing_balls", "cloth", "dice", "draped_cloth", "fire", "fireworks", "fish", "fountain", "jelly",
    "pressed_adaptive", "vicsek", "wind",
)  # fmt: skip
"""Shipped scenes that together have each kind of constraint, of population and of method."""
SHIPPED = {
    path.stem: path
    for path in sorted([*Path("configs/scenes").glob("*.yaml"), *Path("configs/crowds").glob("*.yaml")])
    if "\ngroups:" in path.read_text()
}


def test_the_scenes_that_are_tried_have_every_kind_that_a_shipped_one_has() -> None:
    def kinds(scene: Scene) -> set[str]:
        return {each.kind for each in (*scene.constraints, *scene.population, scene.integrator)}

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # steps as published, in configs/crowds
        missing = {name: kinds(load_scene(path)) for name, path in SHIPPED.items()}
    tried = set[str]().union(*(missing.pop(name) for name in OF_EACH_KIND))
    assert {name: more for name, found in missing.items() if (more := found - tried)} == {}


def at_most_60(group: Group) -> Group:
    """Return the group with fewer agents, if they are not the nodes of a network."""
    if group.network is not None:
        return group
    alive = None if group.alive is None else min(group.alive, 60)
    return group.model_copy(update={"count": min(group.count, 60), "alive": alive})


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::flockenv.core.warnings.CoarseContactWarning")  # steps as published
@pytest.mark.parametrize("name", OF_EACH_KIND)
def test_every_kind_of_scene_has_a_reference_or_one_line_with_the_reason(name: str) -> None:
    """Four steps of a scene are too few for a measurement; the test checks that none fails, with its own method."""
    scene = load_scene(SHIPPED[name])
    scene = scene.model_copy(update={"groups": tuple(map(at_most_60, scene.groups))})
    try:
        problem = Problem.of(scene, 4 * scene.dt, (4, 8), name=name)
        report = measure(problem, methods_of([scene.integrator.kind]), repetitions=0, finer=4)
    except ValueError as reason:
        assert "\n" not in str(reason)
        assert any(word in str(reason) for word in REASONS)
        return
    acts = problem.after_steps
    assert report.reference in (("event-exact steps", "own steps") if acts else ("DOP853", "own steps"))
    assert all(word in report.note for word in acts.split(", ") if word)
    draw_precision([report])
