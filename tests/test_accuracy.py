"""Accuracy against cost: measured orders, references, the cheapest method for a tolerance, and refusals."""

from __future__ import annotations

import json
import math
import multiprocessing
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import Separation
from flockenv.cli.main import main
from flockenv.jobs.local_engine import LocalEngine
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Effect, Fluctuation, Swing, Tether
from flockenv.physics.integrators import RK4, Integrator, methods_of
from flockenv.scene import Group, Scene
from flockenv.studies.accuracy import (
    SUITE,
    Problem,
    Report,
    Results,
    add_times,
    chaos,
    measure,
    measure_errors,
    select_problems,
    usual_methods,
)
from flockenv.studies.accuracy import problem as problems
from flockenv.studies.accuracy import reference as references
from flockenv.studies.accuracy.plots import draw_precision, write_precision
from flockenv.studies.accuracy.results import Curve, Point, measured_order
from flockenv.studies.accuracy.table import cheapest_lines, columns, headlines, rows

ORIGIN = (0.0, 0.0)
TINY = """\
groups: [{count: 3, spawn: {low: [0, 0], high: [1, 1], speed: [1, 2]}}]
effects: [{kind: drag, rate: 0.4}]
dt: 0.02
"""


def one(name: str) -> Problem:
    return select_problems([name])[0]


def body(effect: Effect, **group: Any) -> Scene:
    return Scene(groups=(Group(count=1, spawn=Spawn(low=ORIGIN, high=ORIGIN), **group),), effects=(effect,))


def sprung(
    stiffness: float, seconds: float, steps: tuple[int, ...] = (512, 1024), across: float = 0.0, **group: Any
) -> Problem:
    """Return the problem of a body of 1 kg on a spring, released at 1 m."""
    scene = body(Tether(centre=ORIGIN, stiffness=stiffness), **group)
    return Problem.of(scene, seconds, steps, motion=([[1.0, 0.0]], [[0.0, across]]))


def swinging(angle: float, seconds: float, steps: tuple[int, ...] = (512, 1024)) -> Problem:
    """Return the problem of a pendulum released at an angle; its period for small angles is 1 s."""
    scene = body(Swing(centre=ORIGIN, strength=4 * math.pi**2))
    return Problem.of(scene, seconds, steps, motion=([[angle, 0.0]], [[0.0, 0.0]]))


FEW = methods_of(["semi_implicit_euler", "velocity_verlet", "rk4", "dormand_prince"])
"""One method of each order, because each compiles a kernel."""


@pytest.fixture(scope="module")
def damped() -> Report:
    """Return the report of a few methods on a damped oscillator, each timed once."""
    return measure(one("damped"), FEW, repetitions=1)


METHODS = methods_of(["semi_implicit_euler", "velocity_verlet", "rk4"])

# --- orders -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_orders_and_evaluations_are_the_declared_ones_for_smooth_forces() -> None:
    damped = measure(one("damped"), repetitions=0)
    steady = {method.kind for method in usual_methods() if not method.adaptive}
    assert len(steady) >= 8
    for kind in steady:
        curve = damped.curve(kind)
        assert curve.used == 6, kind
        assert curve.order == pytest.approx(curve.declared, abs=0.2), kind
    assert {curve.declared for curve in damped.curves} == {1, 2, 4, 5}
    assert_evaluations(damped, usual_methods())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["forced", "kepler", "projectile", "quadratic_fall", "tracer", "boids"])
def test_orders_are_the_declared_ones_on_every_smooth_problem(name: str) -> None:
    """One method of each order: tests/test_methods.py measures every method on problems like these."""
    report = measure(one(name), METHODS, repetitions=0)
    assert {curve.declared for curve in report.curves} == {1, 2, 4}
    for curve in report.curves:
        assert curve.order == pytest.approx(curve.declared, abs=0.25), curve.method


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bar", "sheet", "jelly", "altitudes", "drop"])
def test_orders_are_the_declared_ones_for_bonds_finite_elements_and_liquids(name: str) -> None:
    report = measure(one(name), methods_of(["rk4"]), repetitions=0)
    assert report.curve("rk4").order == pytest.approx(4, abs=0.25)


@pytest.mark.slow
def test_rigid_bodies_turn_to_order_2_under_every_method() -> None:
    """Their constraint turns them after each step, whatever the method."""
    report = measure(one("block"), methods_of(["semi_implicit_euler", "rk4"]), repetitions=0)
    for curve in report.curves:
        assert curve.order == pytest.approx(2, abs=0.1), curve.method
    errors = [[point.error for point in curve.points] for curve in report.curves]
    np.testing.assert_allclose(errors[0], errors[1], rtol=1e-3)


@pytest.mark.slow
def test_a_speed_limit_reduces_every_method_to_order_1() -> None:
    """The scene limits the speed after each step, outside the method.

    The motion has two dimensions: on a line the speed is just held, and a limit one step late is only O(h^2) off.
    """
    problem = sprung(40.0, 0.7, tuple(2**k for k in range(6, 13)), across=1.9, max_speed=2.0)
    report = measure(problem, METHODS, repetitions=0)
    assert report.reference == "own steps"
    assert "speed limit is reached at t = " in report.note
    for curve in report.curves:
        assert curve.order == pytest.approx(1, abs=0.3), curve.method


@pytest.mark.slow
@pytest.mark.parametrize("name", ["boids_cone", "boids_limit"])
def test_view_cones_and_speed_limits_reduce_flocks_to_order_1(name: str) -> None:
    report = measure(one(name), METHODS, repetitions=0)
    assert report.reference == "own steps"
    for curve in report.curves:
        assert curve.order == pytest.approx(1, abs=0.3), curve.method


def test_the_order_is_measured_at_the_finest_points_above_rounding() -> None:
    """Errors have order 2 in the middle: the first steps are too coarse, the last two errors are rounding."""
    errors = [5.0, 0.9, 0.7, 0.5, *(1e-1 * 0.25**k for k in range(6)), 1e-12, 3e-12]
    points = [_point(2**k, error) for k, error in enumerate(errors)]
    order, used = measured_order(points, 1e-9, 1.0)
    assert order == pytest.approx(2)
    assert used == 6
    assert measured_order(points[:4], 1e-9, 1.0) == (None, 3)


def _point(evaluations: int, error: float | None, seconds: float | None = None) -> Point:
    return Point(
        steps=evaluations, dt=1 / evaluations, tolerance=None, evaluations=evaluations, error=error, rms=error,
        along=error, energy=None, momentum=None, seconds=seconds,
    )  # fmt: skip


# --- references -------------------------------------------------------------------------------------------------------


def test_references_agree_with_each_other() -> None:
    """A closed form, DOP853 on the compiled laws, and finer steps of the scene give the same path."""
    known = one("damped")
    exact = references.find_reference(known)
    scipy = references.find_reference(replace(known, exact=None))
    own = references.reference_by_own_steps(known, 64)
    assert [r.kind for r in (exact, scipy, own)] == ["closed form", "DOP853", "own steps"]
    for other in (scipy, own):
        assert np.abs(exact.path.pos - other.path.pos).max() < 1e-11
        assert np.abs(exact.path.vel - other.path.vel).max() < 1e-11
        assert other.error < 1e-10


@pytest.mark.slow
def test_the_reference_of_scipy_takes_time_and_medium_into_account() -> None:
    for name in ("forced", "tracer"):
        known = one(name)
        scipy = references.find_reference(replace(known, exact=None))
        assert scipy.kind == "DOP853"
        assert np.abs(references.find_reference(known).path.pos - scipy.path.pos).max() < 1e-10


def test_a_speed_limit_that_never_acts_leaves_the_better_reference() -> None:
    assert references.find_reference(sprung(40.0, 0.7, max_speed=2.0)).kind == "own steps"
    assert references.find_reference(sprung(40.0, 0.7, max_speed=20.0)).kind == "DOP853"


@pytest.mark.slow
def test_a_perturbation_grows_as_the_closed_form_of_a_pendulum() -> None:
    """Near the top the angle of a pendulum, and so any difference of angles, grows as exp(2 pi t)."""
    found = chaos.find_sensitivity(swinging(math.pi, 1.5))
    half = math.exp(2 * math.pi * 1.5) / math.sqrt(8)  # / 2: cosh; / sqrt(2): a change along one of two axes
    assert found.growth == pytest.approx(
        half, rel=1.01 / (2 * math.pi)
    )  # the change of velocity adds sinh / (2 pi), of either sign
    assert chaos.find_sensitivity(one("damped")).growth < 2


@pytest.mark.slow
def test_a_horizon_that_is_too_long_for_a_chaotic_scene_is_refused() -> None:
    with pytest.raises(ValueError, match=r"seconds = 5: too long, because .* try [\d.]+ s") as caught:
        measure(swinging(math.pi - 1e-9, 5.0), METHODS)
    assert "\n" not in str(caught.value)
    shorter = float(str(caught.value).split("try ")[1].split(" s")[0])
    measure(swinging(math.pi - 1e-9, shorter), methods_of(["rk4"]), repetitions=0)


# --- evaluations, energy, momentum ------------------------------------------------------------------------------------


def test_evaluations_are_those_of_the_method(damped: Report) -> None:
    assert_evaluations(damped, FEW)


def assert_evaluations(damped: Report, methods: Sequence[Integrator]) -> None:
    for method in methods:
        points = damped.curve(method.kind).points
        if method.adaptive:
            assert [p.tolerance for p in points] == sorted((p.tolerance for p in points), reverse=True)  # type: ignore[type-var]
            assert all(p.evaluations > p.steps for p in points)
        else:
            assert [p.evaluations for p in points] == [n * method.evaluations for n in one("damped").steps]


@pytest.mark.slow
def test_tolerances_end_once_they_cost_more_than_the_finest_fixed_steps() -> None:
    """If forces jump, a tenth of the tolerance takes ten times the steps, without end."""
    few = replace(one("damped"), steps=(8,))
    (curve,) = measure(few, methods_of(["dormand_prince"]), repetitions=0).curves
    costs = [point.evaluations for point in curve.points]
    assert 1 <= len(costs) < 10
    assert costs[-1] > 4 * 8 and all(cost <= 4 * 8 for cost in costs[:-1])


def test_the_energy_error_of_rk4_has_its_closed_form() -> None:
    """RK4 keeps 1 - y^6/72 + y^8/576 of the energy per step, y = h w."""
    oscillator = one("oscillator")
    report = measure(oscillator, methods_of(["rk4"]), repetitions=0)
    assert report.energy == "kinetic and potential (tether)"
    for point in report.curve("rk4").points[:6]:
        y = oscillator.seconds / point.steps
        assert point.energy == pytest.approx(1 - (1 - y**6 / 72 + y**8 / 576) ** point.steps, rel=1e-2)
        assert point.momentum is None  # a spring to a fixed point does not conserve it


@pytest.mark.slow
def test_a_diverged_run_has_no_error_and_does_not_affect_other_runs() -> None:
    """The coarse steps of h w = 15 diverge, the fine ones do not."""
    problem = sprung(900.0, 20.0, (40, 20480))
    report = measure(problem, methods_of(["explicit_euler", "semi_implicit_euler"]), repetitions=1)
    coarse, fine = report.curve("semi_implicit_euler").points
    assert coarse.error is None and coarse.seconds is None
    assert fine.error is not None and fine.seconds is not None
    assert report.curve("semi_implicit_euler").order is None


@pytest.mark.slow
def test_momentum_is_conserved_by_mutual_separation() -> None:
    spawn = Spawn(low=ORIGIN, high=(4.0, 4.0), speed=(0.5, 1.0))
    scene = Scene(groups=(Group(count=8, spawn=spawn),), effects=(Separation(weight=0.3, radius=50),))
    report = measure(Problem.of(scene, 1.0, (64, 128)), methods_of(["rk4"]), repetitions=0)
    assert all(point.momentum is not None and point.momentum < 1e-13 for point in report.curve("rk4").points)
    assert report.energy == "kinetic"


# --- the cheapest method ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [1e-1, 1e-3, 1e-5, 1e-8])
def test_the_cheapest_point_is_the_one_of_least_cost_in_the_table(damped: Report, tolerance: float) -> None:
    for by in ("evaluations", "seconds"):
        good = [
            getattr(point, by)
            for curve in damped.curves
            for k, point in enumerate(curve.points)
            if all(p.error is not None and p.error <= tolerance for p in curve.points[k:])
        ]
        measured = damped.cheapest(tolerance, by, interpolate=False)  # type: ignore[arg-type]
        assert measured is not None
        assert measured.cost == min(good) and measured.error <= tolerance and not measured.interpolated
    between = damped.cheapest(tolerance)
    assert between is not None
    assert between.cost <= min(p.evaluations for c in damped.curves for p in c.points if (p.error or 1) <= tolerance)


def test_an_interpolated_point_reaches_its_error_at_its_cost(damped: Report) -> None:
    choice = damped.curve("rk4").cheapest_choice(3e-5)
    assert choice is not None and choice.interpolated
    problem = one("damped")
    steps = math.ceil(problem.seconds / choice.dt)
    found = measure(replace(problem, steps=(steps,)), methods_of(["rk4"]), repetitions=0).curves[0].points[0]
    assert found.error is not None and found.error < 1.1 * 3e-5
    assert choice.cost == pytest.approx(found.evaluations, rel=0.1)


def test_a_coarse_point_that_is_right_by_chance_is_not_taken() -> None:
    errors = (1e-9, 1e-2, None, 1e-3, 1e-4)
    curve = Curve(
        method="rk4", declared=4, order=None, used=0, points=tuple(_point(2**k, e, 1.0) for k, e in enumerate(errors))
    )
    choice = curve.cheapest_choice(1e-3, interpolate=False)
    assert choice is not None and choice.cost == 8
    assert curve.cheapest_choice(1e-5) is None
    unknown = curve.cheapest_choice(1e-2)
    assert unknown is not None and not unknown.interpolated  # not from a diverged point


def test_errors_below_the_floor_are_refused(damped: Report) -> None:
    with pytest.raises(ValueError, match="tolerance = 1e-14 m: must be finite and >="):
        damped.cheapest(1e-14)
    assert cheapest_lines(damped, [1e-14])[0].startswith("to 1e-14 m: errors below")
    assert rows(damped, [1e-14])[0][3:5] == ["-", "-"]


EVALUATIONS: dict[str, dict[float, tuple[int | None, ...]]] = {
    "oscillator": {
        1e-1: (8192, 512, 512, 2048, 512),
        1e-3: (None, 32768, 4096, 16384, 2048),
        1e-6: (None, None, 131072, None, 8192),
    },
    "pendulum": {1e-2: (None, 2048, 256, 1024, 512), 1e-6: (None, None, 32768, 65536, 2048)},
    "kepler": {1e-2: (None, 8192, 2048, 4096, 1024), 1e-6: (None, None, 262144, 262144, 8192)},
}
"""Evaluations, in powers of two, that reach an error in m, by method. Velocity Verlet needs 262144 steps for 1e-6 m on
the Kepler orbit (4.5e-7 m). None: more than 2^18 = 262144."""

TABULATED = ("explicit_euler", "semi_implicit_euler", "velocity_verlet", "midpoint", "rk4")


@pytest.mark.slow
@pytest.mark.parametrize("name", EVALUATIONS)
def test_errors_are_reached_with_the_evaluations_of_the_table(name: str) -> None:
    """Velocity Verlet evaluates forces twice per step, so that drag leaves it order 2; the table counts once."""
    problem = replace(one(name), steps=tuple(2**k for k in range(2, 19)))
    report = measure(problem, methods_of(TABULATED), repetitions=0)
    for tolerance, expected in EVALUATIONS[name].items():
        for kind, evaluations in zip(TABULATED, expected, strict=True):
            twice = 2 if kind == "velocity_verlet" else 1
            points = [p for p in report.curve(kind).points if p.evaluations <= twice * 2**18]
            good = [p.evaluations for p in points if p.error is not None and p.error < tolerance]
            assert min(good, default=None) == (evaluations and twice * evaluations), (kind, tolerance)


# --- reports ----------------------------------------------------------------------------------------------------------


def test_a_report_survives_a_round_trip_through_json(damped: Report) -> None:
    results = Results(reports=(damped,))
    text = results.model_dump_json()
    assert Results.model_validate_json(text) == results
    assert json.loads(text)["reports"][0]["machine"]["cpu"]
    with pytest.raises(ValueError, match="format"):
        Results.model_validate_json(text.replace('"format":1', '"format":2'))


def test_a_report_becomes_headlines_and_a_table(damped: Report) -> None:
    lines = " ".join(headlines(damped))
    assert "closed form" in lines and "median of 1 runs" in lines and "kinetic and potential (tether)" in lines
    table = rows(damped, [1e-2, 1e-4])
    assert all(len(row) == len(columns([1e-2, 1e-4])) for row in table)
    assert [row[0] for row in table] == [curve.method for curve in damped.curves]
    assert len(cheapest_lines(damped, [1e-2, 1e-4])) == 2
    with pytest.raises(ValueError, match="'rk44': was not measured, did you mean `rk4`"):
        damped.curve("rk44")


class _Stop:
    """A progress bar that raises KeyboardInterrupt at a percentage, as Ctrl-C would."""

    def __init__(self, at: int) -> None:
        self.at = at

    def __call__(self, percent: int) -> None:
        if percent >= self.at:
            raise KeyboardInterrupt


@pytest.mark.slow
def test_an_interrupted_measurement_keeps_its_points_so_far() -> None:
    whole = measure(one("damped"), METHODS, repetitions=0)
    early = measure(one("damped"), METHODS, repetitions=0, progress=_Stop(50))
    assert early.stopped == "interrupted"
    done = [point for curve in early.curves for point in curve.points]
    assert 0 < len(done) < sum(len(curve.points) for curve in whole.curves)
    assert early.curves[0] == whole.curves[0]
    late = measure(one("damped"), METHODS, repetitions=4, progress=_Stop(60))
    assert late.stopped == "interrupted"
    assert all(point.seconds is not None for curve in late.curves for point in curve.points)
    assert any("interrupted" in line for line in headlines(late))


def test_a_picture_shows_both_costs_of_every_problem_and_is_reproducible(damped: Report, tmp_path: Path) -> None:
    reports = [damped, damped.model_copy(update={"title": "again", "reach": 0.0})]
    figure = draw_precision(reports)
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert labels == ["wall time of the whole run, s"] * 2 + ["force evaluations"] * 2
    assert len(figure.axes[0].lines) == len(damped.curves)
    for name in ("a.png", "b.png"):
        write_precision(tmp_path / name, [damped])
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    with pytest.raises(ValueError, match="precision: needs at least one problem"):
        draw_precision([damped.model_copy(update={"curves": ()})])


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"seconds": 0.0}, "seconds = 0.0: must be a finite number"),
        ({"seconds": math.nan}, "seconds = nan: must be"),
        ({"steps": ()}, r"steps = \(\): must be integers"),
        ({"steps": (8, 0)}, r"steps = \(8, 0\): must be integers"),
        ({"steps": (8.5,)}, r"steps = \(8.5,\): must be integers"),
        ({"dtype": "float32"}, "dtype = float32: its rounding"),
        ({"effects": (Fluctuation(strength=1.0),)}, r"effects\[0\] fluctuation: kicks at random"),
    ],
)
def test_an_invalid_problem_is_refused(change: dict[str, Any], text: str) -> None:
    scene = sprung(1.0, 1.0).scene
    fields = {name: change.pop(name) for name in ("dtype", "effects") if name in change}
    given: dict[str, Any] = {"seconds": 1.0, "steps": (8, 16)} | change
    with pytest.raises(ValueError, match=text) as caught:
        Problem.of(scene.model_copy(update=fields), **given)
    assert "\n" not in str(caught.value)


def test_unknown_names_are_refused_with_the_nearest_one() -> None:
    with pytest.raises(ValueError, match="methods: 'rk44': unknown, did you mean `rk4`"):
        methods_of(["rk44"])
    with pytest.raises(ValueError, match="problems: 'keppler': unknown, did you mean `kepler`"):
        select_problems(["keppler"])
    with pytest.raises(ValueError, match="repetitions = -1"):
        measure(one("damped"), METHODS, repetitions=-1)


def test_every_problem_of_the_suite_agrees_with_its_closed_form_at_the_start() -> None:
    for name, problem in zip(SUITE, select_problems(), strict=True):
        assert problem.name == name
        assert problem.steps == tuple(sorted(problem.steps)) and len(problem.steps) >= 9
        assert len(problem.times) >= 8
        if problem.exact is not None:
            np.testing.assert_allclose(problem.start.pos[0], problem.exact(0.0)[0], atol=1e-15)
            # the velocity is the derivative of the position, by differences
            h = 1e-5
            moved = (np.subtract(problem.exact(1 + h)[0], problem.exact(1 - h)[0])) / (2 * h)
            drift = moved - problem.exact(1.0)[1]
            if name != "tracer":
                np.testing.assert_allclose(drift, 0.0, atol=1e-6)


# --- the command line -------------------------------------------------------------------------------------------------


@pytest.fixture
def in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.yaml").write_text(TINY)
    return tmp_path


@pytest.mark.slow
def test_accuracy_of_a_scene_on_the_command_line(in_a_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["accuracy", "tiny.yaml", "--methods", "rk4,heun", "--repetitions", "1", "--out", "deep/a.png"]
    assert main(command) == 0
    out = capsys.readouterr().out
    assert "tiny.yaml" in out and "errors against: DOP853" in out and "to 0.0001 m: " in out
    results = Results.model_validate_json((in_a_folder / "deep" / "a.json").read_text())
    (report,) = results.reports
    assert [curve.method for curve in report.curves] == ["rk4", "heun"]
    assert [p.dt for p in report.curves[0].points] == pytest.approx([0.04 / 2**k for k in range(8)])  # 50 = 2 x 25
    assert (in_a_folder / "deep" / "a.png").read_bytes().startswith(b"\x89PNG")
    assert main(command) == 2  # the files exist
    assert main([*command, "--force", "--dts", "0.1,0.05,0.025,0.0125"]) == 0
    (report,) = Results.model_validate_json((in_a_folder / "deep" / "a.json").read_text()).reports
    assert [p.steps for p in report.curves[0].points] == [10, 20, 40, 80]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ("accuracy", "needs either a SCENE or --suite"),
        ("accuracy tiny.yaml --suite", "either a SCENE or --suite"),
        ("accuracy --suite --seconds 2", "--suite: has its own horizons"),
        ("accuracy --suite --problems keppler", "did you mean `kepler`"),
        ("accuracy tiny.yaml --problems kepler", "--problems: needs --suite"),
        ("accuracy tiny.yaml --methods rk44", "did you mean `rk4`"),
        ("accuracy tiny.yaml --steps 8,x", "--steps = '8,x': must be positive numbers"),
        ("accuracy tiny.yaml --steps 8.5", "must be integers"),
        ("accuracy tiny.yaml --steps 8 --dts 0.1", "--steps and --dts"),
        ("accuracy tiny.yaml --dts 0.3", "must be a whole multiple of dt = 0.3 s"),
        ("accuracy tiny.yaml --tolerance 0", "--tolerance = '0': must be positive"),
        ("accuracy tiny.yaml --seconds 0.013", "--seconds = 0.013 s: must be a whole multiple"),
        ("accuracy tiny.yaml --out a.gif", "must end in .json or .png"),
    ],
)
def test_invalid_commands_are_refused_in_one_line(
    in_a_folder: Path, capsys: pytest.CaptureFixture[str], arguments: str, text: str
) -> None:
    assert main(arguments.split()) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and text in message


def test_ctrl_c_on_the_command_line_keeps_the_finished_problems(
    in_a_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def impatient(problem: Problem, methods: Any, repetitions: int, **more: Any) -> Report:
        if problem.name != "damped":
            raise KeyboardInterrupt
        return measure(problem, methods, repetitions)

    monkeypatch.setattr("flockenv.studies.accuracy.measure", impatient)
    command = ["accuracy", "--suite", "--problems", "damped,oscillator", "--methods", "rk4", "--repetitions", "0"]
    assert main([*command, "--out", "a.json"]) == 130
    text = capsys.readouterr()
    last = "flockenv: interrupted; results so far are shown\n"
    assert "Damped oscillator" in text.out and text.err == last
    (report,) = Results.model_validate_json(Path("a.json").read_text()).reports
    assert report.name == "damped"
    assert main([*command, "--out", "b.png"]) == 130
    assert capsys.readouterr().err == f"flockenv: interrupted; drawing b.png, Ctrl-C again ends it\n{last}"


def test_ctrl_c_before_the_first_run_ends_writes_one_line_and_no_file(
    in_a_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def impatient(problem: Problem, methods: Any, repetitions: int, **more: Any) -> Report:
        return measure(problem, methods, repetitions, progress=_Stop(0))

    monkeypatch.setattr("flockenv.studies.accuracy.measure", impatient)
    command = ["accuracy", "--suite", "--problems", "damped", "--methods", "rk4", "--repetitions", "0"]
    assert main([*command, "--out", "a.png"]) == 130
    text = capsys.readouterr()
    assert text.out == "" and text.err.splitlines()[-1] == "flockenv: interrupted"
    assert not list(Path().glob("a.*"))


@pytest.mark.parametrize("bad", ["damped", "oscillator", "kepler"])
def test_a_problem_without_a_reference_does_not_stop_the_others(
    bad: str, in_a_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def measured(problem: Problem, methods: Any, repetitions: int, **more: Any) -> Report:
        if problem.name == bad:
            raise ValueError("no reference\nfor another reason")
        return measure(problem, methods, repetitions)

    monkeypatch.setattr("flockenv.studies.accuracy.measure", measured)
    command = ["accuracy", "--suite", "--methods", "rk4", "--repetitions", "0", "--out", "a.json", "--problems"]
    names = ["damped", "oscillator", "kepler"]
    assert main([*command, ",".join(names)]) == 0
    assert f"{bad}: no reference (and 1 more)\n" in capsys.readouterr().out
    reports = Results.model_validate_json(Path("a.json").read_text()).reports
    assert [report.name for report in reports] == [name for name in names if name != bad]
    assert main([*command, bad, "--force"]) == 2, "an error if it is the only problem"
    assert capsys.readouterr().err.startswith("flockenv: no reference")


def test_finished_problems_are_written_before_the_next_one_begins(
    in_a_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A signal during compilation ends the process: reports written only at the end would be lost."""
    kept: list[list[str]] = []

    def watched(problem: Problem, methods: Any, repetitions: int, **more: Any) -> Report:
        file = Path("new/a.json")
        known = Results.model_validate_json(file.read_text()).reports if file.exists() else ()
        kept.append([report.name for report in known])
        return measure(problem, methods, repetitions)

    monkeypatch.setattr("flockenv.studies.accuracy.measure", watched)
    command = ["accuracy", "--suite", "--problems", "damped,oscillator", "--methods", "rk4", "--repetitions", "0"]
    assert main([*command, "--out", "new/a.json"]) == 0
    assert kept == [[], ["damped"]]


def without_times(report: Report) -> dict[str, Any]:
    """Return a report as plain data without its times and the machine."""
    content = report.model_dump(exclude={"machine", "repetitions"})
    for curve in content["curves"]:
        for point in curve["points"]:
            del point["seconds"]
    return content


def test_times_are_added_to_errors_that_were_measured_before() -> None:
    problem, methods = replace(one("damped"), steps=(8, 16, 32, 64, 128)), methods_of(["rk4", "heun"])
    whole = measure(problem, methods, 2)
    [(name, errors)] = measure_errors({"a": problem}, methods, None, LocalEngine(1))
    assert name == "a" and isinstance(errors, Report)
    assert all(point.seconds is None for curve in errors.curves for point in curve.points)
    timed = add_times(errors, problem, methods, 2)
    assert all((point.seconds or 0) > 0 for curve in timed.curves for point in curve.points)
    assert without_times(timed) == without_times(whole) and timed.repetitions == 2
    stopped = add_times(errors, problem, methods, 2, progress=_Stop(60))
    assert stopped.stopped == "interrupted" and without_times(stopped)["curves"] == without_times(whole)["curves"]


@pytest.mark.slow
def test_errors_measured_as_jobs_are_the_same_and_times_are_measured_when_no_job_runs(
    in_a_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    alone: list[bool] = []

    def watched(*arguments: Any) -> Report:
        alone.append(not multiprocessing.active_children())
        return add_times(*arguments)

    monkeypatch.setattr("flockenv.studies.accuracy.add_times", watched)
    (in_a_folder / "float32.yaml").write_text(f"{TINY}\ndtype: float32\n")
    command = ["accuracy", "tiny.yaml", "float32.yaml", "--methods", "rk4,heun", "--repetitions", "1"]
    for processes in "12":
        assert main([*command, "--processes", processes, "--out", f"{processes}.json"]) == 0
        assert "float32.yaml: dtype = float32: its rounding would hide" in capsys.readouterr().out
    one_process, two = (Results.model_validate_json(Path(f"{n}.json").read_text()).reports for n in "12")
    assert list(map(without_times, two)) == list(map(without_times, one_process)) and len(two) == 1
    assert all((point.seconds or 0) > 0 for curve in two[0].curves for point in curve.points)
    assert alone == [True]


def test_ctrl_c_while_jobs_run_shows_the_errors_that_are_known(
    in_a_folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def impatient(problems: Any, methods: Any, finer: Any, engine: Any) -> Iterator[tuple[str, Report | ValueError]]:
        yield "damped", measure(problems["damped"], methods, 0)
        raise KeyboardInterrupt

    monkeypatch.setattr("flockenv.studies.accuracy.measure_errors", impatient)
    command = ["accuracy", "--suite", "--problems", "oscillator,damped", "--methods", "rk4", "--out", "a.json"]
    assert main([*command, "--processes", "2"]) == 130
    text = capsys.readouterr()
    assert "Damped oscillator" in text.out and text.err == "flockenv: interrupted; results so far are shown\n"
    (report,) = Results.model_validate_json(Path("a.json").read_text()).reports
    assert report.name == "damped" and report.repetitions == 0


def test_times_of_comparison_are_steps_of_every_run() -> None:
    scene = sprung(1.0, 1.0).scene
    for steps, instants in (((8, 16), 8), ((10, 25), 5), ((7,), 7), ((34,), 2), ((256, 512), 16)):
        assert len(Problem.of(scene, 2.0, steps).times) == instants
    assert Problem.of(scene, 2.0, (8,)).times[-1] == 2.0
    assert problems.INSTANTS == 16


@pytest.mark.slow
def test_implicit_methods_are_measured_only_if_named() -> None:
    usual: tuple[Integrator, ...] = usual_methods()
    assert not any(method.solves for method in usual) and RK4() in usual
    report = measure(replace(one("damped"), steps=(16, 32, 64, 128)), methods_of(["implicit_midpoint"]), repetitions=1)
    assert report.curves[0].order == pytest.approx(2, abs=0.2)
