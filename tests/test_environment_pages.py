"""Pages of the environments: every index of an observation, every reward term, the spaces, and the film."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from flockenv.envs.table import ENVIRONMENTS
from flockenv.tasks import TASKS
from tests.page_scripts import ROOT

FILMED = dict.fromkeys(("pursuit", "crossing"), "rules, PPO and a hybrid of both")
"""Tasks whose films were drawn, and the players in them."""


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Return the page of each task, as the extension of the site makes them where these films are drawn."""
    docs = tmp_path_factory.mktemp("docs")
    shutil.copy(ROOT / "docs" / "results.json", docs)
    (docs / "generated" / "films").mkdir(parents=True)
    for name in FILMED:
        (docs / "generated" / "films" / f"{name}.gif").touch()
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs" / "_ext"))
        import environment_pages

        return {Path(name).name: text for name, text in environment_pages.pages(docs, False).items()}


def rows_below(heading: str, page: str) -> list[list[str]]:
    """Return the cells of the rows of the first table below a heading."""
    text = page.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = re.findall(r"^\| (.*) \|$", text, re.MULTILINE)
    return [re.split(r" (?<!\\)\| ", line) for line in lines[2:]]


@pytest.mark.parametrize("name", TASKS)
def test_every_index_of_an_action_and_an_observation_is_on_the_page_once(pages: dict[str, str], name: str) -> None:
    (info,) = (each for each in ENVIRONMENTS.values() if each.task_type().name == name)
    single, page = info.task_type()(**info.single), pages[name]
    wanted = {"Action space": single.action_layout.size, "Observation space": single.layout.size}
    if info.team:
        wanted["As a team"] = info.task_type()(**info.parallel).layout.size
    for heading, size in wanted.items():
        found: list[int] = []
        for where, _, meaning, *_ in rows_below(heading, page):
            first, _, last = where.partition("-")
            found += range(int(first), int(last or first) + 1)
            assert meaning, f"{heading}: {where} has no meaning"
        assert found == [*range(size)], heading
    for heading in ("Action space", "Observation space"):
        assert re.search(rf"^\| {heading} \| `Box\(.*, \({wanted[heading]},\), float32\)` \|$", page, re.MULTILINE)
    assert f'gymnasium.make("{info.id}")' in page


@pytest.mark.parametrize("name", TASKS)
def test_every_reward_term_is_on_the_page_with_its_factor_and_meaning(pages: dict[str, str], name: str) -> None:
    """And every argument that ends in _reward or _cost is the factor of one term."""
    task = TASKS[name]()
    rows = rows_below("Rewards", pages[name])
    assert [term for term, *_ in rows] == [f"`{term}`" for term in task.terms]
    factors = [key for key in type(task).model_fields if key.endswith(("_reward", "_cost"))]
    assert sorted(factor for _, factor, _ in rows) == sorted(f"`{key}` = {getattr(task, key):g}" for key in factors)
    assert all(meaning for *_, meaning in rows)
    assert "Write the" not in pages[name]


@pytest.mark.parametrize("name", TASKS)
def test_a_page_has_a_film_or_says_why_not(pages: dict[str, str], name: str) -> None:
    top = pages[name].split("\n## ")[0]
    players = re.findall(rf"from left to right: (.*)\]\(\.\./films/{name}\.gif\)", top)
    assert players == ([FILMED[name]] if name in FILMED else [])
    assert ("was built without films" in top) == (name not in FILMED)
    assert "No hybrid of rules and policy" not in top, "every task has one"


@pytest.mark.parametrize("filmed", [True, False])
def test_a_page_names_a_missing_hybrid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, filmed: bool) -> None:
    """As of a new task."""
    monkeypatch.syspath_prepend(str(ROOT / "docs" / "_ext"))
    import environment_pages
    import films

    film = tmp_path / "generated" / "films" / "mine.gif"
    film.parent.mkdir(parents=True)
    if filmed:
        film.touch()
    assert films.hybrid_of("mine") is None
    assert all(films.hybrid_of(task) is not None for task in TASKS)
    top = environment_pages._film(tmp_path, "mine")
    assert "No hybrid of rules and policy was trained in mine" in top
    assert ("left to right: rules and PPO]" in top) == filmed
