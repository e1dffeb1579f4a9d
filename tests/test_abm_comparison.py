"""The flocking model contributed to the comparison of ABM frameworks: a step is that of its declaration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tests.catalogue import Array, users_module

ROOT = Path(__file__).parent.parent

COHERE, SEPARATE, MATCH, SEPARATION = 0.03, 0.015, 0.05, 1.0


def declared(pos: Array, vel: Array, extent: float, visual_distance: float) -> tuple[Array, Array]:
    """Return positions and unit velocities after one update of all birds, by the rules of Flocking/DECLARATION.md."""
    heading = pos[None] - pos[:, None]
    heading -= extent * np.round(heading / extent)
    distance = np.hypot(*heading.T).T
    np.fill_diagonal(distance, np.inf)
    seen, near = distance <= visual_distance, distance < SEPARATION
    assert near.any() and not seen.any(axis=1).all(), "birds that are too near, and birds alone"
    cohere, separate = (np.einsum("ij,ijd->id", pairs, heading) for pairs in (seen, near))
    total = COHERE * cohere - SEPARATE * separate + MATCH * (seen @ vel)
    then = vel + total / np.maximum(seen.sum(axis=1), 1)[:, None]
    then /= np.linalg.norm(then, axis=1, keepdims=True)
    return (pos + then) % extent, then


@pytest.mark.slow
def test_a_step_is_that_of_the_declaration_for_all_birds_at_once(tmp_path: Path) -> None:
    text = (ROOT / "release" / "abm" / "Flocking" / "flockenv" / "flocking.py").read_text(encoding="utf-8")
    with users_module(tmp_path, text, "declared_flocking") as model:
        scene = model.flocking_model(**model.SMALL)
        state = scene.start(seed=3)
        for _ in range(3):
            pos, vel = declared(state.pos[0], state.vel[0], model.SMALL["extent"], model.SMALL["visual_distance"])
            state = scene.step(state)
            np.testing.assert_allclose(state.vel[0], vel, atol=1e-12)
            np.testing.assert_allclose(state.pos[0], pos, atol=1e-10)
        birds = np.array([*model.SMALL.values(), *model.LARGE.values()])
        np.testing.assert_array_equal(birds, [200, 100, 5, 400, 150, 15])
        assert model.run_model(scene, 0, worlds=2).tick.tolist() == [100, 100]
