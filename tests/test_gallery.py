"""The gallery: every behaviour has a demo, and the page in docs agrees with the behaviours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flockenv.behaviours import BEHAVIOURS, Separation
from flockenv.cli.gallery import page, run_demo
from flockenv.cli.main import main
from flockenv.scene.yaml_io import load_scene

DOCS = Path(__file__).resolve().parent.parent / "docs"


@pytest.mark.parametrize("kind", BEHAVIOURS)
def test_the_demo_of_every_behaviour_contains_it(kind: str) -> None:
    demo = BEHAVIOURS[kind].demo
    assert demo is not None, f"{kind} needs a demo, the YAML text of a small scene"
    scene = load_scene(demo)
    assert kind in {effect.kind for effect in scene.parts.effects}
    assert scene.agents <= 30


@pytest.mark.slow
@pytest.mark.parametrize("kind", BEHAVIOURS)
def test_every_behaviour_changes_the_motion_in_its_demo(kind: str) -> None:
    run = run_demo(BEHAVIOURS[kind])
    others = tuple(effect.idle_copy() if effect.kind in (kind, "steer") else effect for effect in run.scene.effects)
    without = run.scene.with_effects(*others).run(run.first, int(run.step[-1]))
    assert np.abs(run.last.pos - without.pos).max() > 0.1


def test_the_page_in_docs_is_up_to_date() -> None:
    """If this fails, run `flockenv gallery --out docs/behaviours.md --force`."""
    assert (DOCS / "behaviours.md").read_text(encoding="utf-8") == page(BEHAVIOURS, "behaviours")
    assert {path.stem for path in (DOCS / "behaviours").glob("*.png")} == set(BEHAVIOURS)


@pytest.mark.slow
def test_the_command_writes_a_page_and_its_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for kind in [kind for kind in BEHAVIOURS if kind != "separation"]:
        monkeypatch.delitem(BEHAVIOURS, kind)
    assert main(["gallery", "--out", "page.md"]) == 0
    assert "1 behaviours in page.md" in capsys.readouterr().out
    text = Path("page.md").read_text()
    for part in ("### separation", "page/separation.png", "N m", "weight", "Keep away"):
        assert part in text
    with Image.open("page/separation.png") as picture:
        assert (picture.width, picture.mode) == (360, "P")  # few colours: a third of the bytes
    assert main(["gallery", "--out", "page.md"]) == 2


def test_a_behaviour_without_a_demo_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Separation, "demo", None)
    with pytest.raises(ValueError, match=r"^separation: has no demo"):
        run_demo(Separation)
