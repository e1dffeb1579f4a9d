"""docs/tutorials and docs/quickstart.md: their files, commands and scripts work, and print what the pages say."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path

import numpy as np
import pytest

from flockenv.scene.yaml_io import load_scene
from tests.page_scripts import ROOT, numbers, run_page

pytestmark = pytest.mark.slow
DOCS = ROOT / "docs"


def played(name: str, folder: Path) -> tuple[list[str], list[str]]:
    """Run a page in an empty folder; return the lines that its commands and its script print."""
    return run_page((DOCS / f"{name}.md").read_text(encoding="utf-8"), folder)


def test_every_tutorial_is_tested_here() -> None:
    source = Path(__file__).read_text(encoding="utf-8")
    for path in DOCS.glob("tutorials/*.md"):
        assert f'played("tutorials/{path.stem}"' in source
    for path in (*DOCS.glob("tutorials/*.md"), DOCS / "quickstart.md"):
        blocks = re.findall(r"^```([^\n]*)\n(.*?)^```", path.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
        assert blocks
        others = [text for language, text in blocks if language not in {"python", "yaml", "sh"}]
        assert [text for text in others if not text.startswith("pip install ")] == []


def test_the_player_of_the_quickstart_succeeds(tmp_path: Path) -> None:
    printed, (line,) = played("quickstart", tmp_path)
    assert any(line.startswith("http://127.0.0.1:") for line in printed)  # of `flockenv play`
    assert (tmp_path / "p.gif").stat().st_size > 1000
    assert numbers(line)[0] > 5
    assert line.endswith("success True")


def test_birds_of_the_page_agree_on_a_direction_only_with_alignment(tmp_path: Path) -> None:
    printed, lines = played("tutorials/own_scene", tmp_path)
    aligned, without = map(float, lines)
    assert aligned > 0.8 > 0.5 > without
    flock = load_scene(tmp_path / "flock.yaml")
    speeds = [np.linalg.norm(scene.run(scene.start(0), 600).vel[0], axis=1).mean() for scene in (
        flock, flock.with_effects(*(each for each in flock.effects if each.kind != "target_speed")),
    )]  # fmt: skip
    assert speeds == [pytest.approx(2.5, abs=0.2), pytest.approx(0.24, abs=0.05)]  # m/s
    assert any("polarisation" in line for line in printed)
    assert (tmp_path / "flock.gif").stat().st_size > 1000


def test_the_trained_policy_of_the_page_plays_and_is_compared(tmp_path: Path) -> None:
    if importlib.util.find_spec("stable_baselines3") is None:
        pytest.skip("needs stable-baselines3: pip install 'flockenv[train]'")
    printed, lines = played("tutorials/training", tmp_path)
    assert (tmp_path / "mine.safetensors").is_file()
    assert any("mine" in line for line in printed) and any("rules" in line for line in printed)
    scores = {line.split(":")[0]: numbers(line)[0] for line in lines[:3]}
    assert scores["rules"] > 5
    assert scores["rules"] > scores["mine"] > scores["random"]
    assert lines[3].startswith("mine - rules: ")
    lead, _, low, high, worlds = numbers(lines[3].partition(":")[2].replace("95 %", "95"))
    assert low <= lead <= high and worlds == 32
    assert lead == pytest.approx(scores["mine"] - scores["rules"], abs=0.02)


def test_the_study_of_the_page_has_a_line_for_its_setting(tmp_path: Path) -> None:
    _, (line,) = played("tutorials/study", tmp_path)
    _, _, random, rules, ppo, ahead, _ = line.split("|")
    assert numbers(random)[0] < 0 < 5 < numbers(rules)[0]
    assert numbers(ppo)[0] > 5
    assert ahead.split()[0].rstrip(":") in {"rules", "policy", "level"}
    assert (tmp_path / "field" / "pursuit.json").is_file()


def test_the_step_limit_and_the_orders_are_those_of_the_page(tmp_path: Path) -> None:
    _, (limit, warned, orders) = played("tutorials/accuracy", tmp_path)
    assert numbers(limit) == [pytest.approx(0.2, abs=0.001)]
    assert warned == "[True]"
    assert {name: round(order) for name, order in eval(orders).items()} == {  # noqa: S307  # a dict that the page prints
        "semi_implicit_euler": 1, "velocity_verlet": 2, "rk4": 4,
    }  # fmt: skip


def test_the_playground_of_the_page_opens_and_ends(tmp_path: Path) -> None:
    if importlib.util.find_spec("websockets") is None:
        pytest.skip("needs websockets: pip install 'flockenv[play]'")
    _, (line,) = played("tutorials/playground", tmp_path)
    assert line == "200 True"
