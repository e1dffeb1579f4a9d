"""Laws of a user that cannot be compiled: one line with the law, its file and line, and the reason."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar, Literal

import pytest
from numba.core.errors import NumbaError, UnsupportedBytecodeError

from flockenv.jit.decorators import Law, Vec, law
from flockenv.jit.law_errors import LawError
from flockenv.maths.vectors import planar
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Effect, Me
from flockenv.scene import Group, Scene


@law
def misspelt(p: Any, me: Me) -> Vec:
    return planar(me.pos, p.psh, p.push)


@law
def undefined(p: Any, me: Me) -> Vec:
    return planar(me.pos, p.push, puhs)  # type: ignore[name-defined]  # noqa: F821


@law
def scalar(p: Any, me: Me) -> Any:
    return p.push


@law
def silent(p: Any, me: Me) -> Any:
    planar(me.pos, p.push, p.push)


@law
def listed(p: Any, me: Me) -> Any:
    return [p.push, p.push]


@law
def opened(p: Any, me: Me) -> Vec:
    with open("file") as file:
        file.read()
    return planar(me.pos, p.push, p.push)


@law
def tripled(x: Any) -> Any:
    return x.three


@law
def helped(p: Any, me: Me) -> Vec:
    return planar(me.pos, tripled(p.push), p.push)


def unmarked(p: Any, me: Me) -> Vec:
    return planar(me.pos, p.push, p.push)


def scene_of(force: Law) -> Scene:
    """Return a scene of one agent with an effect of this law."""

    class Own(Effect):
        kind: Literal["own"] = "own"
        push: float = 1.0
        own_law: ClassVar[Law | None] = force

    return Scene(groups=(Group(count=1, spawn=Spawn(low=(0, 0), high=(1, 1))),), effects=(Own(),), dt=1e-3)


@pytest.mark.parametrize(
    ("force", "line", "reason"),
    [
        (misspelt, "p.psh", r"law 'misspelt': Unknown attribute 'psh' of type Record\(push\)"),
        pytest.param(
            undefined, "def undefined", "law 'undefined': NameError: name 'puhs' is not defined", marks=pytest.mark.slow
        ),
        (scalar, "def scalar", r"law 'scalar' returns float64: .*getitem\(float64, "),
        pytest.param(silent, "def silent", r"law 'silent' returns none: .*getitem\(none, ", marks=pytest.mark.slow),
        (listed, "[p.push, p.push]", "law 'listed': it allocates memory"),
        pytest.param(
            opened, "def opened", "law 'opened' is not compiled: .*with .*is not supported", marks=pytest.mark.slow
        ),
        (helped, "x.three", "law 'helped': Unknown attribute 'three' of type float64"),
        (unmarked, "def unmarked", "law 'unmarked' is not marked @law: "),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_law_that_cannot_be_compiled_is_named_with_its_place_and_the_reason(
    force: Callable[..., Any], line: str, reason: str
) -> None:
    scene = scene_of(force)
    state = scene.start(0)
    with pytest.raises(LawError, match=reason) as caught:
        scene.step(state)
    text = str(caught.value)
    assert "\n" not in text
    assert text.endswith("; run it once with NUMBA_DISABLE_JIT=1 for a debugger")
    found = re.match(r"(.*):(\d+): law ", text)
    assert found is not None
    assert Path(found[1]) == Path(__file__)
    number = int(found[2])
    rows = Path(__file__).read_text().splitlines()[number - 1 : number + 1]  # a decorator comes before its function
    assert any(line in row for row in rows)
    assert isinstance(caught.value.__cause__, (NumbaError, UnsupportedBytecodeError))
    for kind in (TypeError, NumbaError):  # also if it is called again
        with pytest.raises(kind, match=reason):
            scene.step(state)
