"""docs/engine.md: the files and functions that it names exist, and its example of a law runs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from flockenv.model.spawn import Spawn
from flockenv.physics.integrators import VelocityVerlet
from flockenv.scene import Group, Scene
from tests.catalogue import users_module

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs/engine.md").read_text(encoding="utf-8")


def test_files_and_functions_named_by_the_page_exist() -> None:
    named = re.findall(r"`(flockenv/[\w/]+\.py)`(?:, `(\w+)`)?", PAGE)
    assert len(named) > 8
    for path, function in named:
        assert f"def {function}" in (ROOT / path).read_text(encoding="utf-8") if function else (ROOT / path).exists()


def test_the_breakpoint_of_the_page_is_in_a_pair_law() -> None:
    path, line = re.search(r"b (\S+):(\d+)", PAGE).groups()  # type: ignore[union-attr]
    text = (ROOT / path).read_text(encoding="utf-8").splitlines()
    law = next(k for k in range(int(line) - 1, 0, -1) if text[k].startswith("def "))
    assert text[law - 1] == "@law" and "me: Me, other: Other" in text[law]


def test_the_law_of_the_page_is_a_wind_that_pulses(tmp_path: Path) -> None:
    """v = push (t + (1 - cos(2 pi t / period)) period / (2 pi)) / (2 m), from rest."""
    example = next(
        block for block in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "class PulsingWind" in block
    )
    with users_module(tmp_path, example) as module:
        group = Group(count=2, mass=2.0, max_speed=100.0, spawn=Spawn(low=(0, 0), high=(1, 1)))
        wind = module.PulsingWind(push=3, period=0.5)
        scene = Scene(groups=(group,), effects=(wind,), integrator=VelocityVerlet(), dt=1e-3)
        state = scene.run(scene.start(0), 900)
    expected = 3 / (2 * 2.0) * (0.9 + (1 - np.cos(2 * np.pi * 0.9 / 0.5)) * 0.5 / (2 * np.pi))
    np.testing.assert_allclose(state.vel[0], [[expected, 0]] * 2, atol=1e-5)
