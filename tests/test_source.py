"""What is written for a scene: its names, and what is written in another order."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.config import load_scene
from flockenv.integrators import SemiImplicitEuler
from flockenv.scene import Group, Scene
from flockenv.space import Plane, Torus
from flockenv.spawn import Spawn
from flockenv.sweep import Parts, scene_source
from tests.test_config import SCENES


def assigned(node: ast.AST, loops: bool) -> set[str]:
    """Every name that a piece of a source gives to something, within its loops too or not."""
    found = {node.id} if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) else set()
    for part in ast.iter_child_nodes(node):
        if loops or not isinstance(part, ast.For):
            found |= assigned(part, loops)
    return found


def loop(nodes: list[ast.stmt], over: str) -> ast.For:
    """The first of these statements that is a loop over this name."""
    return next(n for n in nodes if isinstance(n, ast.For) and isinstance(n.target, ast.Name) and n.target.id == over)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_what_agents_respond_by_gives_new_meaning_to_no_name_of_a_step(path: Path) -> None:
    """Both are one function, by a method of one stage: `far` was infinite for one and a way to a wall for the other."""
    tree = ast.parse(scene_source(replace(load_scene(path).parts, integrator=SemiImplicitEuler())))
    whole = next(node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == "step_world")
    step = loop(whole.body, "step_")
    part = loop(step.body, "begin")
    mine = assigned(loop(part.body, "block"), loops=True)
    theirs = {argument.arg for argument in whole.args.args}.union(
        *(assigned(node, loops=False) for node in (whole, step, part))
    )
    assert {"s", "f", "a"} <= mine
    assert {"until", "time", "nobody", "step_"} <= theirs
    assert not mine & theirs


@pytest.mark.skipif(not Parts(2, Plane(), (), SemiImplicitEuler()).masks, reason="only with AVX-512")
@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("agents", [17, 95])  # from 96 on they are sorted by cell
def test_working_out_the_next_candidate_early_moves_no_bit(
    agents: int, dtype: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What lies behind the last one of a row is read, and looked at by nobody; some are dead, two are in one place."""
    rules = (Separation(weight=1, radius=1, fov=270), Alignment(weight=1, radius=2), Cohesion(weight=1, radius=3))
    group = Group(count=agents, spawn=Spawn(low=(0, 0), high=(6, 6), speed=(1, 2)))

    def moved(ahead: bool) -> tuple[Any, Any, Any]:
        scene = Scene(groups=(group,), effects=rules, space=Torus(size=(6, 6)), dtype=dtype)
        if not ahead:
            monkeypatch.setattr(Parts, "looks_ahead", False)
        assert scene.parts.looks_ahead == ahead
        state = scene.start(0, worlds=2)
        state.alive[1, ::3] = False
        state.x[:, 0, 3] = state.x[:, 0, 1]
        after = scene.step(state, steps=20)
        return after.pos, after.vel, after.work

    for one, other in zip(moved(ahead=True), moved(ahead=False), strict=True):
        np.testing.assert_array_equal(one, other)
