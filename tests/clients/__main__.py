"""Make a virtual environment per client, install the client and flockenv there, and let it play.

`python -m tests.clients sb3 torchrl`, or without names all of them. Ends with the log of docs/clients.md.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import tomllib
import venv
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
CLIENTS = sorted(path.stem.removeprefix("play_") for path in HERE.glob("play_*.py"))


def head(client: str) -> dict[str, Any]:
    """Return what a script's head says that it needs: dependencies, and a file of constraints, if it takes any."""
    text = (HERE / f"play_{client}.py").read_text(encoding="utf-8")
    lines = re.search(r"^# /// script\n((?:# .*\n)+)# ///$", text, re.MULTILINE)
    assert lines, f"play_{client}.py has no head"
    return tomllib.loads("".join(line[2:] for line in lines[1].splitlines(keepends=True)))


def installed(client: str, folder: Path) -> Path:
    """Return the Python of a new virtual environment that has what the script needs, and flockenv."""
    venv.create(folder, with_pip=True)
    python = folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    needs = head(client)
    constraints = needs.get("tool", {}).get("flockenv", {}).get("constraints")
    limits = ["-c", str(ROOT / constraints)] if constraints else []
    subprocess.run([python, "-m", "pip", "install", "-q", *limits, str(ROOT), *needs["dependencies"]], check=True)
    return python


def play(client: str, python: Path, steps: int) -> list[dict[str, Any]]:
    """Return the rows that a script prints, one line of JSON each; RuntimeError if it fails."""
    command = [str(python), str(HERE / f"play_{client}.py"), str(steps)]
    done = subprocess.run(command, cwd=tempfile.gettempdir(), stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{client}: {' '.join(command)} ended with {done.returncode}")
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"client"')]


def table(rows: list[dict[str, Any]]) -> str:
    """Return the log: what each client played, and how many steps of each environment."""
    envs = sorted({row["env"] for row in rows}, reverse=True)
    lines = [["client", "what", "lines", *envs], ["---"] * (3 + len(envs))]
    for client, what, count in dict.fromkeys((row["client"], row["what"], row["lines"]) for row in rows):
        steps = {row["env"]: f"{row['steps']:,}" for row in rows if (row["client"], row["what"]) == (client, what)}
        lines.append([client, what, str(count), *(steps.get(env, "") for env in envs)])
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def main() -> None:
    """Play the clients that are named, one after another; exit 1 if one of them failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.clients", description=__doc__)
    parser.add_argument("clients", nargs="*", default=CLIENTS, metavar="CLIENT", help=", ".join(CLIENTS))
    parser.add_argument("--steps", type=int, default=10_000, help="of each environment (default: 10000)")
    parser.add_argument("--python", type=Path, help="a Python that has the client and flockenv: nothing is installed")
    asked = parser.parse_args()
    unknown = [name for name in asked.clients if name not in CLIENTS]
    if unknown:
        parser.error(f"{unknown[0]!r} is unknown; allowed: {', '.join(CLIENTS)}")
    rows, failed = [], []
    for client in asked.clients:
        with tempfile.TemporaryDirectory() as folder:
            try:
                rows += play(client, asked.python or installed(client, Path(folder)), asked.steps)
            except (RuntimeError, subprocess.CalledProcessError) as error:
                failed.append(f"{client}: {error}")
    print(table(rows))
    if failed:
        sys.exit("\n".join(failed))


if __name__ == "__main__":
    main()
