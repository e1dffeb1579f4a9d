"""The gallery: every behaviour shows itself, and the page says what the behaviours say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from flockenv.behaviours import BEHAVIOURS, Separation
from flockenv.cli.gallery import page, shown
from flockenv.cli.main import main
from flockenv.scene.yaml_io import load_scene

DOCS = Path(__file__).resolve().parent.parent / "docs"


@pytest.mark.parametrize("kind", BEHAVIOURS)
def test_every_behaviour_has_a_scene_that_lists_it(kind: str) -> None:
    demo = BEHAVIOURS[kind].demo
    assert demo is not None, f"{kind} needs a demo, the YAML text of a small scene"
    scene = load_scene(demo)
    assert kind in {effect.kind for effect in scene.parts.effects}
    assert scene.agents <= 30


@pytest.mark.slow
@pytest.mark.parametrize("kind", BEHAVIOURS)
def test_somebody_moves_otherwise_than_without_it(kind: str) -> None:
    run = shown(BEHAVIOURS[kind])
    others = tuple(effect.idle() if effect.kind in (kind, "steer") else effect for effect in run.scene.effects)
    without = run.scene.with_effects(*others).run(run.first, int(run.step[-1]))
    assert np.abs(run.last.pos - without.pos).max() > 0.1


def test_the_page_in_docs_is_the_one_of_the_behaviours() -> None:
    """If this fails: flockenv gallery --out docs/behaviours.md --force."""
    assert (DOCS / "behaviours.md").read_text(encoding="utf-8") == page(BEHAVIOURS, "behaviours")
    assert {path.stem for path in (DOCS / "behaviours").glob("*.png")} == set(BEHAVIOURS)


@pytest.mark.slow
def test_a_gallery_is_a_page_and_its_pictures(
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
        assert picture.width == 360
    assert main(["gallery", "--out", "page.md"]) == 2


def test_a_behaviour_without_a_scene_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Separation, "demo", None)
    with pytest.raises(ValueError, match=r"^separation: has no demo"):
        shown(Separation)
