"""Scripts in pages of docs/: the blocks of a tutorial, saved and run in an empty folder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

__all__ = ["ROOT", "blocks_of", "numbers", "python_of", "run_page", "run_python"]

ROOT = Path(__file__).resolve().parent.parent
NUMBER = r"-?\d+\.?\d*(?:e-?\d+)?"
BLOCK = re.compile(r"^```(python|yaml|sh)\n(.*?)^```", re.DOTALL | re.MULTILINE)
SAVED = re.compile(r"`([\w.]+\.yaml)`[^`]*\Z")
"""The file name that the text before a YAML block gives it."""

PROGRAMS = {
    "python": '#!/bin/sh\nexec "{python}" "$@"\n',
    "flockenv": "#!{python}\nimport sys\nfrom flockenv.cli.main import main\nsys.exit(main(sys.argv[1:]))\n",
}
"""What a page calls by name, as it is in an environment with flockenv."""


def blocks_of(text: str) -> list[tuple[str, str]]:
    """Return the blocks of a page or section that are run or saved, as (language, text)."""
    return BLOCK.findall(text)


def python_of(text: str) -> str:
    """Return the Python blocks of a page or section, one after another."""
    return "\n".join(block for language, block in blocks_of(text) if language == "python")


def numbers(text: str) -> list[float]:
    """Return all numbers in a text."""
    return [float(number) for number in re.findall(NUMBER, text)]


def run_python(script: str, folder: Path, *, more: str = "") -> list[str]:
    """Run a script in a folder, with warnings of flockenv as errors; return the lines that it prints.

    more: a folder of programs that it may call by name.
    """
    (folder / "tutorial.py").write_text(script, encoding="utf-8")
    return _run([sys.executable, "-W", "error::UserWarning", "tutorial.py"], folder, more)


def run_page(text: str, folder: Path) -> tuple[list[str], list[str]]:
    """Run a tutorial: save its YAML files, run its commands, then its Python blocks as one script.

    Return the lines that the commands print, and those that the script prints.
    """
    programs = folder / "programs"
    programs.mkdir()
    for name, program in PROGRAMS.items():
        (programs / name).write_text(program.format(python=sys.executable))
        (programs / name).chmod(0o755)
    for match in BLOCK.finditer(text):
        if match[1] == "yaml":
            saved = SAVED.search(text[: match.start()].rstrip())
            assert saved is not None, f"a YAML block without a file name before it:\n{match[2]}"
            (folder / saved[1]).write_text(match[2], encoding="utf-8")
    commands = "".join(block for language, block in blocks_of(text) if language == "sh")
    printed = _run(["/bin/sh", "-ec", commands], folder, str(programs)) if commands else []
    return printed, run_python(python_of(text), folder, more=str(programs))


def _run(command: list[str], folder: Path, more: str = "") -> list[str]:
    path = os.pathsep.join(filter(None, (more, os.environ.get("PATH", ""))))
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, check=False, timeout=600,
        env={**os.environ, "PYTHONPATH": str(ROOT), "PATH": path},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr + done.stdout
    return done.stdout.splitlines()
