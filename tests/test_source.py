"""What is written for a scene: its names."""

from __future__ import annotations

import ast
from dataclasses import replace
from pathlib import Path

import pytest

from flockenv.config import load_scene
from flockenv.integrators import SemiImplicitEuler
from flockenv.sweep import scene_source
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
