"""Tables: numbers that the laws of an effect look up; a table of another length compiles nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.behaviours.steer import Steer
from flockenv.engine import step_of
from flockenv.model.spawn import Spawn
from flockenv.scene import Group, Scene
from flockenv.scene import scene as scenes
from flockenv.steering.arbitration import Blend
from tests.catalogue import users_module

LOOKUP = """
from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np

from flockenv.physics.effects import Effect, Me
from flockenv.jit.decorators import Law, Vec, law
from flockenv.maths.vectors import axis, scale


@law
def looked_up(p: Any, me: Me) -> Vec:
    return scale(axis(me.pos, int(p.along)), p.weight * p.table[len(p.table) - 1 - int(me.who)])


class Lookup(Effect):
    \"\"\"Push agent i along an axis with the i-th number of a table, from its end.\"\"\"

    kind: Literal["lookup"] = "lookup"
    weight: float = 1.0
    along: int = 0
    values: tuple[float, ...]
    steering: ClassVar[bool] = True
    tabled: ClassVar[bool] = True
    own_law: ClassVar[Law | None] = looked_up

    def parameters(self) -> dict[str, float]:
        return {"weight": self.weight, "along": float(self.along)}

    def table(self, scene: Any) -> Any:
        return np.array(self.values) * scene.groups[0].mass
"""


@pytest.fixture
def lookup(tmp_path: Path) -> Any:
    with users_module(tmp_path, LOOKUP, "lookups") as module:
        yield module.Lookup


def scene_with(*effects: Any, **fields: Any) -> Scene:
    spawn = Spawn(low=(0, 0), high=(1, 1), speed=(0.0, 0.0))
    return Scene(groups=(Group(count=3, mass=2.0, spawn=spawn),), effects=effects, dt=0.5, **fields)


def test_every_law_looks_up_its_own_table(lookup: Any) -> None:
    """An effect and two behaviours, with tables of different lengths, each in reverse order of the agents."""
    first, second = lookup(values=(9.0, 3.0, 2.0, 1.0)), lookup(values=(30.0, 20.0, 10.0), along=1, weight=0.5)
    third = lookup(values=(7.0, 5.0, 4.0, 4.0), along=1)
    scene = scene_with(first, Steer(behaviours=(second, third), arbitration=Blend()))
    found = scene.acceleration(scene.start(0))[0]
    np.testing.assert_allclose(found[:, 0], [1, 2, 3])
    np.testing.assert_allclose(found[:, 1], [5 + 4, 10 + 4, 15 + 5])


def test_another_table_compiles_nothing(lookup: Any) -> None:
    short, long = (scene_with(lookup(values=tuple(range(n)))) for n in (3, 500))
    assert step_of(short.parts) is step_of(long.parts)
    moved = [scene.step(scene.start(0)).vel[0, :, 0] for scene in (short, long)]
    np.testing.assert_allclose(moved, [[1.0, 0.5, 0.0], [249.5, 249.0, 248.5]])


def test_tables_beyond_the_integers_of_float32_are_refused(lookup: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(scenes, "EXACT", 1000)
    assert scene_with(lookup(values=(1.0,) * 2000)).agents == 3
    with pytest.raises(ValueError, match=r"effects: 2,0\d\d numbers: float32 counts exactly"):
        scene_with(lookup(values=(1.0,) * 2000), dtype="float32")


def test_a_scene_without_tables_has_no_numbers_of_tables(lookup: Any) -> None:
    scene = scene_with()
    assert scene.parts.tables == ()
    assert len(scene.parts.packed_numbers()) == len(scene.parts.parameters())
