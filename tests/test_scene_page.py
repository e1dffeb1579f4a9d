"""docs/scene_files.md: its scenes run, its keys are those of records, trajectories have the arrays it lists.

Also the defaults of docs/collisions.md, and the numbers of docs/scenes.md.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from flockenv.cli.main import main
from flockenv.model.network import Network
from flockenv.model.networks import Blocks, Cloth, Jelly, Mesh, Rope
from flockenv.physics.constraints import CONSTRAINTS
from flockenv.physics.effects import EFFECTS
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs/scene_files.md").read_text(encoding="utf-8")
COLLISIONS = (ROOT / "docs/collisions.md").read_text(encoding="utf-8")
EXAMPLE, CLOTH = re.findall(r"^```yaml\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)


def test_the_agents_of_the_example_walk_along_the_corridor() -> None:
    scene = load_scene(EXAMPLE)
    state = scene.run(scene.start(0), 100)
    assert state.vel[0, :, 0].mean() > 0.5
    assert not scene.run(state, 2400).alive.any()  # all have left after 50 s


def test_the_cloth_of_the_page_drapes_over_its_ball() -> None:
    scene = load_scene(CLOTH)
    state = scene.run(scene.start(0), 200)
    assert 0.3 < np.linalg.norm(state.pos[0] - 0.5, axis=1).min() < 0.32
    assert state.pos[0, :, 2].min() < 0.5 < 0.8 < state.pos[0, :, 2].max()


def rows_of(page: str, header: str) -> dict[str, str]:
    """Return the rows of a table by the names in their first cell: the text of the other cells."""
    table = page.partition(f"| {header} |")[2].partition("\n\n")[0]
    return dict(re.findall(r"^\| `(\w+)` \|(.*)", table, re.MULTILINE))


def test_the_page_lists_every_key_of_networks_and_their_effects() -> None:
    kinds = {each.model_fields["kind"].default: each for each in (Rope, Cloth, Jelly, Mesh, Blocks)}
    networks, effects = rows_of(PAGE, "network | keys"), rows_of(PAGE, "effect | acts on")
    assert networks.keys() == kinds.keys()
    for kind, row in networks.items():
        assert set(kinds[kind].model_fields) - {"kind", *Network.model_fields} <= set(re.findall(r"`(\w+)`", row)), kind
    for kind, row in effects.items():
        assert set(EFFECTS[kind].model_fields) - {"kind", "group"} <= set(re.findall(r"`(\w+)`", row)), kind
    for place in re.findall(r"`(\w+)`", networks["cloth"].split("|")[1]):
        assert place in Cloth(cells=(2, 2), sides=(1, 1)).places


def test_the_defaults_of_the_page_of_collisions_are_those_of_the_constraints() -> None:
    rows = rows_of(COLLISIONS, "constraint | defaults")
    assert rows.keys() == {"collisions", "face_collisions", "rigid_bodies"}
    for kind, row in rows.items():
        found = {name: yaml.safe_load(value) for name, value in re.findall(r"`(\w+): ([\w.]+)`", row)}
        every = {name: field.default for name, field in CONSTRAINTS[kind].model_fields.items() if name != "kind"}
        assert found == {name: default for name, default in every.items() if default is not None}


def test_the_jelly_loses_volume_for_a_moment_and_the_paper_its_springs() -> None:
    page = (ROOT / "docs/scenes.md").read_text(encoding="utf-8")
    jelly, paper = load_scene("jelly_on_stairs"), load_scene("torn_paper")
    network = jelly.groups[0].network
    assert network is not None

    def volume(time: float) -> float:
        corners = jelly.run(jelly.start(0), round(time / jelly.dt)).pos[0][network.elements(3)]
        return float(np.linalg.det(corners[:, 1:] - corners[:, :1]).sum())

    assert [f"to {100 * volume(0.6) / volume(0):.0f} % at 0.6 s"] == re.findall(r"to \d+ % at [\d.]+ s", page)
    assert volume(0.8) / volume(0) > 0.95
    torn = paper.run(paper.start(0), round(1.2 / paper.dt))
    (broken,) = re.findall(r"counts (\d+) after 1.2 s", page)
    assert np.isinf(torn.bonds).sum(axis=1) == pytest.approx([int(broken)], rel=0.05)


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
