"""The scripts that other libraries play by, and the page about them: what can be checked without those libraries.

`python -m tests.clients` plays; it needs the network and many minutes.
"""

from __future__ import annotations

import importlib
import re
from importlib.util import find_spec

import pytest

from tests.clients.__main__ import CLIENTS, HERE, ROOT, head

PAGE = (ROOT / "docs" / "clients.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^## ([^\n]*)\n[^#]*?```python\n(.*?)```", PAGE, re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("client", CLIENTS)
def test_a_script_pins_what_it_needs(client: str) -> None:
    needs = head(client)
    assert needs["dependencies"]
    assert all(re.fullmatch(r"[\w.-]+(\[\w+\])?==[\d.]+", one) for one in needs["dependencies"])
    constraints = needs.get("tool", {}).get("flockenv", {}).get("constraints")
    assert constraints is None or (ROOT / constraints).is_file()
    compile((HERE / f"play_{client}.py").read_text(encoding="utf-8"), client, "exec")


@pytest.mark.parametrize("client", CLIENTS)
def test_the_log_has_the_versions_that_the_scripts_pin(client: str) -> None:
    """In the row of the client; torch comes with all of them, and what comes with a client is not named."""
    pinned = dict(one.split("==") for one in head(client)["dependencies"] if not one.startswith("torch=="))
    for name, version in list(pinned.items())[:1]:
        assert f"| {name.partition('[')[0]} {version} |" in PAGE


@pytest.mark.parametrize(("title", "code"), BLOCKS, ids=[title for title, _ in BLOCKS])
def test_the_code_on_the_page_runs_where_its_library_is_here(title: str, code: str) -> None:
    program = compile(code, f"docs/clients.md, {title}", "exec")
    needed = {name.partition(".")[0] for name in re.findall(r"^\s*(?:import|from) ([\w.]+)", code, re.MULTILINE)}
    lacking = sorted(name for name in needed if find_spec(name) is None)
    if lacking:
        pytest.skip(f"not installed: {', '.join(lacking)}")
    exec(program, {})  # noqa: S102  # that is the point


def test_no_test_run_collects_the_scripts() -> None:
    assert not list(HERE.glob("test_*.py")) + list(HERE.glob("*_test.py"))
    assert importlib.import_module("tests.clients").__doc__
