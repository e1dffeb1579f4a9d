"""The lists of tests/catalogue.py are complete: a law without a row fails a test here."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

from flockenv import steering
from flockenv.behaviours.steer import Steer
from flockenv.geometry.space import Space
from flockenv.physics.constraints import CONSTRAINTS
from flockenv.physics.effects import EFFECTS
from flockenv.physics.integrators import INTEGRATORS
from flockenv.steering import arbitration
from flockenv.tasks import TASKS
from tests import catalogue

ROOT = Path(__file__).resolve().parent.parent


def kinds_in(folder: str, attribute: str) -> set[str]:
    """Return the kinds or names that classes in the files of a folder assign in their source."""
    return {
        ast.literal_eval(node.value)
        for path in (ROOT / "flockenv" / folder).glob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.AnnAssign) and node.value and ast.unparse(node.target) == attribute
        if isinstance(node.value, ast.Constant)
    }


def test_every_effect_has_a_row() -> None:
    rows = {row.effect.kind for row in catalogue.EFFECTS}
    ours = {kind for kind, effect in EFFECTS.items() if effect.__module__.startswith("flockenv.")}
    files = kinds_in("physics/effects", "kind") | kinds_in("behaviours", "kind") | {"steer"}
    assert rows == files == ours


def test_every_effect_can_be_idle() -> None:
    assert [row.name for row in catalogue.EFFECTS if row.effect.idle_copy() == row.effect] == []


WITH_GROUPS = [
    (row, name)
    for row in catalogue.FIRST
    for name in ("group", "other", "food")
    if name in type(row.effect).model_fields
]


@pytest.mark.parametrize(("row", "name"), WITH_GROUPS, ids=lambda given: getattr(given, "name", given))
def test_missing_group_is_refused_with_the_name_of_the_field(row: catalogue.EffectRow, name: str) -> None:
    """Otherwise the kernel would read numbers of other groups."""
    assert len(WITH_GROUPS) >= 18
    message = rf"{name} = 2: there are 2 groups, counted from 0$"
    beyond = row.at(2)[0].model_copy(update={name: 2})
    with pytest.raises(ValueError, match=rf"effects\[0\]\.{message}"):
        catalogue.scene_of(beyond).start(0)
    if beyond.steering and not beyond.components:
        with pytest.raises(ValueError, match=rf"effects\[0\]\.behaviours\[0\]\.{message}"):
            catalogue.scene_of(Steer(group=0, behaviours=(beyond,)))


def test_every_integrator_has_a_row() -> None:
    rows = {row.method.kind for row in catalogue.INTEGRATORS}
    assert rows == kinds_in("physics/integrators", "kind") == set(INTEGRATORS)


def test_every_constraint_has_a_row() -> None:
    rows = {row.constraint.kind for row in catalogue.CONSTRAINTS}
    assert rows == kinds_in("physics/constraints", "kind") == set(CONSTRAINTS)


def test_every_task_has_a_row() -> None:
    assert {row.task.name for row in catalogue.TASKS} == kinds_in("tasks", "name") == set(TASKS)


def test_every_behaviour_has_a_row() -> None:
    assert [row.name for row in sorted(catalogue.STEERING, key=lambda row: row.name)] == sorted(steering.__all__)


def test_every_arbitration_has_a_row() -> None:
    assert {law.py_func.__name__ for law in catalogue.ARBITRATION} == {n for n in arbitration.__all__ if n.islower()}
    kinds = {kind for kind, row in arbitration.ARBITRATIONS.items() if row.__module__.startswith("flockenv.")}
    assert {row.kind for row in (*catalogue.ARBITRATIONS, *catalogue.RECALLING)} == kinds


def test_every_space_has_a_row() -> None:
    kinds = {space.model_fields["kind"].default for space in Space.__subclasses__()}
    assert set(catalogue.SPACES) == kinds
    assert all(spaces[d].kind == kind for kind, spaces in catalogue.SPACES.items() for d in (2, 3))


def test_names_of_rows_are_unique() -> None:
    for rows in (catalogue.EFFECTS, catalogue.INTEGRATORS, catalogue.CONSTRAINTS, catalogue.TASKS, catalogue.STEERING):
        names = [row.name for row in rows]
        assert len(set(names)) == len(names)


def compiled_functions() -> Iterator[tuple[str, ast.FunctionDef]]:
    for path in sorted((ROOT / "flockenv").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and {"law", "kernel"} & {ast.unparse(d) for d in node.decorator_list}:
                yield f"{path.stem}.{node.name}", node


def test_no_compiled_law_calls_itself() -> None:
    """numba's disk cache stores such a call without its target; the second process that runs it crashes."""
    laws = dict(compiled_functions())
    assert len(laws) > 100
    calls = {
        name: {ast.unparse(node.func) for node in ast.walk(body) if isinstance(node, ast.Call)}
        for name, body in laws.items()
    }
    assert [name for name, body in laws.items() if body.name in calls[name]] == []
