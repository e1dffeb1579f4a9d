"""`looks_ahead`: the distance of the next candidate is computed before the present one is finished."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.engine import KernelPlan
from flockenv.geometry.space import Plane, Torus
from flockenv.model.spawn import Spawn
from flockenv.physics.integrators import SemiImplicitEuler
from flockenv.scene import Group, Scene


@pytest.mark.slow
@pytest.mark.skipif(not KernelPlan(2, Plane(), (), SemiImplicitEuler()).masks, reason="only with AVX-512")
@pytest.mark.parametrize("dtype", ["float32", pytest.param("float64", marks=pytest.mark.slow)])
@pytest.mark.parametrize("agents", [17, 95])  # from 96 on they are sorted by cell
def test_computing_the_next_distance_early_changes_no_bits(
    agents: int, dtype: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Numbers behind the last candidate of a row are read but not used; some agents are dead, two are in one place."""
    rules = (Separation(weight=1, radius=1, fov=270), Alignment(weight=1, radius=2), Cohesion(weight=1, radius=3))
    group = Group(count=agents, spawn=Spawn(low=(0, 0), high=(6, 6), speed=(1, 2)))

    def moved(ahead: bool) -> tuple[Any, Any, Any]:
        scene = Scene(groups=(group,), effects=rules, space=Torus(size=(6, 6)), dtype=dtype)
        if not ahead:
            monkeypatch.setattr(KernelPlan, "looks_ahead", False)
        assert scene.parts.looks_ahead == ahead
        state = scene.start(0, worlds=2)
        state.alive[1, ::3] = False
        state.x[:, 0, 3] = state.x[:, 0, 1]
        after = scene.step(state, steps=20)
        return after.pos, after.vel, after.work

    for one, other in zip(moved(ahead=True), moved(ahead=False), strict=True):
        np.testing.assert_array_equal(one, other)
