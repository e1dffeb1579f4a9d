"""docs/scene_files.md: its scene runs, its keys are those of a scene, trajectories have the arrays it lists."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from flockenv.cli.main import main
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs/scene_files.md").read_text(encoding="utf-8")
(EXAMPLE,) = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


def test_the_agents_of_the_example_walk_along_the_corridor() -> None:
    scene = load_scene(EXAMPLE)
    state = scene.run(scene.start(0), 100)
    assert state.vel[0, :, 0].mean() > 0.5


def test_the_page_lists_every_key_of_a_scene() -> None:
    table = PAGE.partition("## Keys")[2].partition("\n\nEntries")[0]
    assert re.findall(r"^\| `(\w+)`", table, re.MULTILINE) == list(Scene.model_fields)


def test_a_trajectory_has_the_arrays_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("corridor.yaml").write_text(EXAMPLE, encoding="utf-8")
    assert main("run corridor.yaml --duration 0.2 --out walk.npz".split()) == 0
    text = PAGE.partition("`.npz` file with")[2].partition("```")[0]
    with np.load("walk.npz") as walk:
        assert set(re.findall(r"`(\w+)`", text)) | {"scene"} == set(walk)
        assert walk["pos"].shape == walk["vel"].shape == (*walk["time"].shape, 40, 2)
    assert Path("walk.json").is_file()


def test_the_environment_variables_of_the_page_are_read() -> None:
    code = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "flockenv").rglob("*.py"))
    assert all(f'"{name}"' in code for name in re.findall(r"^\| `(FLOCKENV_\w+)", PAGE, re.MULTILINE))
