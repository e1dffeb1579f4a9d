"""Make a virtual environment per client, install the client and flockenv there, let it play, and run docs/clients.md.

`python -m tests.clients sb3 torchrl`, or without names all of them. Ends with the log of docs/clients.md.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
import venv
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CLIENTS = sorted(path.stem.removeprefix("play_") for path in HERE.glob("play_*.py"))


PAGE = (ROOT / "docs" / "clients.md").read_text(encoding="utf-8")
SECTIONS = {
    "agilerl": "AgileRL", "cleanrl": "CleanRL", "rllib": "RLlib", "sb3": "Stable-Baselines3, sb3-contrib", "sbx": "sbx",
    "skrl": "skrl", "tianshou": "Tianshou", "torchrl": "TorchRL", "wandb": "Weights & Biases",
}  # fmt: skip
"""Sections of the page with code; rl_zoo3 has a command and settings there, sb3_contrib no more than its ids."""


def page_code(client: str) -> list[str]:
    """Return the programs of the page's section about a client."""
    if client not in SECTIONS:
        return []
    section = re.split(r"^##+ ", PAGE.split(f"# {SECTIONS[client]}\n")[1], maxsplit=1, flags=re.MULTILINE)[0]
    return re.findall(r"^```python\n(.*?)```", section, re.DOTALL | re.MULTILINE)


def head(client: str) -> dict[str, Any]:
    """Return what a script's head says that it needs: dependencies, and a file of constraints, if it takes any."""
    text = (HERE / f"play_{client}.py").read_text(encoding="utf-8")
    lines = re.search(r"^# /// script\n((?:# .*\n)+)# ///$", text, re.MULTILINE)
    assert lines, f"play_{client}.py has no head"
    return tomllib.loads("".join(line[2:] for line in lines[1].splitlines(keepends=True)))


def source(folder: Path) -> Path:
    """Return a copy of what the package is built from: pip would leave build/ and egg-info in the repository."""
    shutil.copytree(ROOT / "flockenv", folder / "flockenv", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "configs" / "scenes", folder / "configs" / "scenes")
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    return folder


def installed(client: str, folder: Path) -> Path:
    """Return the Python of a new virtual environment that has what the script needs, and flockenv."""
    venv.create(folder / "venv", with_pip=True)
    python = folder / "venv" / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    needs = head(client)
    constraints = needs.get("tool", {}).get("flockenv", {}).get("constraints")
    limits = ["-c", str(ROOT / constraints)] if constraints else []
    packages = [str(source(folder / "source")), *needs["dependencies"]]
    subprocess.run([python, "-m", "pip", "install", "-q", *limits, *packages], check=True)
    return python


def play(client: str, python: Path, steps: int) -> Iterator[dict[str, Any]]:
    """Yield the rows that a script prints, a line of JSON each, as they come; RuntimeError at its end if it failed."""
    command = [str(python), str(HERE / f"play_{client}.py"), str(steps)]
    with subprocess.Popen(command, cwd=tempfile.gettempdir(), stdout=subprocess.PIPE, text=True) as script:
        assert script.stdout
        yield from (json.loads(line) for line in script.stdout if line.startswith('{"client"'))
    if script.returncode:
        raise RuntimeError(f"{' '.join(command)} ended with {script.returncode}")


def run_page(client: str, python: Path) -> int:
    """Run the programs of the page in an empty folder each; return their number, RuntimeError if one failed."""
    programs = page_code(client)
    for program in programs:
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "page.py").write_text(program, encoding="utf-8")
            done = subprocess.run([python, "page.py"], cwd=folder, env={**os.environ, "WANDB_MODE": "offline"})
        if done.returncode:
            raise RuntimeError(f"the code of docs/clients.md, {SECTIONS[client]}, ended with {done.returncode}")
    return len(programs)


def table(rows: list[dict[str, Any]]) -> str:
    """Return the log: what each client played, and how many steps of each environment."""
    envs = sorted({row["env"] for row in rows}, reverse=True)
    lines = [["client", "what", "lines", *envs], ["---"] * (3 + len(envs))]
    for kind in dict.fromkeys((row["client"], row["what"], str(row["lines"])) for row in rows):
        same = [row for row in rows if (row["client"], row["what"], str(row["lines"])) == kind]
        steps = {row["env"]: f"{row['steps']:,}" for row in same}
        lines.append([*kind, *(steps.get(env, "") for env in envs)])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def main() -> None:
    """Play the clients that are named, one after another; exit 1 if one of them failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.clients", description=__doc__)
    parser.add_argument("clients", nargs="*", default=CLIENTS, metavar="CLIENT", help=", ".join(CLIENTS))
    parser.add_argument("--steps", type=int, default=10_000, help="of each environment (default: 10000)")
    parser.add_argument("--python", type=Path, help="a Python that has the client and flockenv: nothing is installed")
    asked = parser.parse_args()
    python = asked.python and asked.python.absolute()  # scripts run in another folder; a link is the environment's own
    unknown = [name for name in asked.clients if name not in CLIENTS]
    if unknown:
        parser.error(f"{unknown[0]!r} is unknown; allowed: {', '.join(CLIENTS)}")
    rows, failed = [], []
    for client in asked.clients:
        with tempfile.TemporaryDirectory() as folder:
            try:
                has_it = python or installed(client, Path(folder))
                for row in play(client, has_it, asked.steps):
                    print("{client}, {what}, {env}: {steps:,} steps in {seconds} s".format(**row), file=sys.stderr)
                    rows.append(row)
                print(f"{client}: {run_page(client, has_it)} programs of docs/clients.md ran", file=sys.stderr)
            except (OSError, RuntimeError, subprocess.CalledProcessError) as error:
                failed.append(f"{client}: {error}")
    print(table(rows))
    if failed:
        sys.exit("\n".join(failed))


if __name__ == "__main__":
    main()
