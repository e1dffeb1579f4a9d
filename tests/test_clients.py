"""Scripts for clients, other libraries that use the environments, and their page, as far as testable without them.

`python -m tests.clients` runs the scripts; it needs the network and many minutes.
"""

from __future__ import annotations

import importlib
import inspect
import re
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml
from stable_baselines3 import PPO

from tests.clients import __main__ as runner
from tests.clients.__main__ import CLIENTS, HERE, PAGE, ROOT, head, page_code

SECTIONS = re.findall(r"^##+ ([^\n]*)\n(.*?)(?=^##|\Z)", PAGE, re.DOTALL | re.MULTILINE)
BLOCKS = [
    (title, code)
    for title, text in SECTIONS
    for code in re.findall(r"^```python\n(.*?)```", text, re.DOTALL | re.MULTILINE)
]


@pytest.mark.parametrize("client", CLIENTS)
def test_script_pins_its_dependencies(client: str) -> None:
    needs = head(client)
    assert needs["dependencies"]
    assert all(re.fullmatch(r"[\w.-]+(\[\w+\])?==[\d.]+", one) for one in needs["dependencies"])
    constraints = needs.get("tool", {}).get("flockenv", {}).get("constraints")
    assert constraints is None or (ROOT / constraints).is_file()
    compile((HERE / f"play_{client}.py").read_text(encoding="utf-8"), client, "exec")


@pytest.mark.parametrize("client", CLIENTS)
def test_page_lists_the_versions_that_scripts_pin(client: str) -> None:
    """Only the client itself is listed, without torch and its other dependencies."""
    pinned = dict(one.split("==") for one in head(client)["dependencies"] if not one.startswith("torch=="))
    for name, version in list(pinned.items())[:1]:
        assert f"| {name.partition('[')[0]} {version} |" in PAGE


@pytest.mark.parametrize(("title", "code"), BLOCKS, ids=[title for title, _ in BLOCKS])
def test_code_on_the_page_runs_if_its_libraries_are_installed(title: str, code: str) -> None:
    program = compile(code, f"docs/clients.md, {title}", "exec")
    needed = {name.partition(".")[0] for name in re.findall(r"^\s*(?:import|from) ([\w.]+)", code, re.MULTILINE)}
    lacking = sorted(name for name in needed if find_spec(name) is None)
    if lacking:
        pytest.skip(f"not installed: {', '.join(lacking)}")
    exec(program, {})  # noqa: S102  # the test runs the page's code


def test_the_code_of_the_page_is_run_by_the_scripts_of_its_clients() -> None:
    ran = [code for client in CLIENTS for code in page_code(client)]
    of_no_client = "Sensor noise, late actions, missed neighbours"
    assert sorted({*ran}) == sorted(code for title, code in BLOCKS if title != of_no_client)
    assert {client for client in CLIENTS if not page_code(client)} == {"rl_zoo3", "sb3_contrib"}


def test_the_hyperparameters_for_rl_zoo_are_arguments_of_its_ppo() -> None:
    assert "../configs/clients/ppo.yml\n:language: yaml" in PAGE
    entries = yaml.safe_load((ROOT / "configs" / "clients" / "ppo.yml").read_text(encoding="utf-8"))
    assert entries.keys() == {f"flockenv/{name}" for name in re.findall(r"\w+-v\d", PAGE.split("| lines |")[1][:99])}
    own = {"n_timesteps", "policy", "n_envs", "normalize"}
    for entry in entries.values():
        assert own < entry.keys() and entry.keys() - own <= inspect.signature(PPO).parameters.keys()


PLAYED = """
import json
print("output of a client")
for env, lines in (("A-v0", 0), ("B-v0", 0), ("B-v0", 2)):
    print(json.dumps({"client": "x 1.0", "what": "all", "env": env, "lines": lines, "steps": 1000, "seconds": 0.1}))
"""
TABLE = """\
| client | what | lines | B-v0 | A-v0 |
| --- | --- | --- | --- | --- |
| x 1.0 | all | 0 | 1,000 | 1,000 |
| x 1.0 | all | 2 | 1,000 |  |
"""


@pytest.mark.parametrize(("end", "code"), [("", 0), ("raise SystemExit(3)", 3), ("import a_package_not_here", 1)])
def test_results_before_a_script_fails_are_in_the_table(
    end: str, code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """--python is given relative to the working folder."""
    (tmp_path / "play_x.py").write_text(PLAYED + end, encoding="utf-8")
    (tmp_path / "python").symlink_to(sys.executable)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(runner, "HERE", tmp_path)
    monkeypatch.setattr(runner, "CLIENTS", ["x"])
    monkeypatch.setattr(sys, "argv", ["tests.clients", "x", "--python", "python"])
    if code:
        with pytest.raises(SystemExit, match=f"^x: .*play_x.py 10000 ended with {code}$"):
            runner.main()
    else:
        runner.main()
    assert capfd.readouterr().out == TABLE


def test_source_for_a_client_is_the_package(tmp_path: Path) -> None:
    copy = runner.source(tmp_path / "source")
    packages = {path.relative_to(ROOT) for path in (ROOT / "flockenv").rglob("*.py")}
    assert packages == {path.relative_to(copy) for path in (copy / "flockenv").rglob("*.py")}
    assert (copy / "pyproject.toml").read_bytes() == (ROOT / "pyproject.toml").read_bytes()
    assert (copy / "setup.py").is_file(), "scenes join the wheel by it"
    assert len(list((copy / "configs" / "scenes").glob("*.yaml"))) > 30


def test_pytest_does_not_collect_the_scripts() -> None:
    assert not list(HERE.glob("test_*.py")) + list(HERE.glob("*_test.py"))
    assert importlib.import_module("tests.clients").__doc__
