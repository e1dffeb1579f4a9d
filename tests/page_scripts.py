"""Scripts in pages of docs/: the blocks of a tutorial, saved and run in an empty folder.

They run with this Python and this checkout, or with FLOCKENV_PYTHON, a Python in which flockenv is installed:
`FLOCKENV_PYTHON=x/bin/python python -m tests.page_scripts docs/quickstart.md` runs one page, or one section of it.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

__all__ = ["ROOT", "blocks_of", "numbers", "python_of", "run_page", "run_python", "section_of"]

ROOT = Path(__file__).resolve().parent.parent
INSTALLED = os.environ.get("FLOCKENV_PYTHON")
PYTHON = INSTALLED or sys.executable
NUMBER = r"-?\d+\.?\d*(?:e-?\d+)?"
BLOCK = re.compile(r"^```(python|yaml|sh)\n(.*?)^```", re.DOTALL | re.MULTILINE)
SAVED = re.compile(r"`([\w.]+\.yaml)`[^`]*\Z")
"""The file name that the text before a YAML block gives it."""

PROGRAMS = {
    "python": '#!/bin/sh\nexec "{python}" "$@"\n',
    "flockenv": """#!{python}
import subprocess, sys
from urllib.request import urlopen
from flockenv.cli.main import main
if sys.argv[1] != "play" or "--no-browser" in sys.argv:
    sys.exit(main(sys.argv[1:]))
with subprocess.Popen([*sys.argv, "--no-browser", "--port", "0"], stdout=subprocess.PIPE, text=True) as server:
    try:
        print(line := server.stdout.readline(), end="")
        urlopen(line.split()[0], timeout=60).read()
    finally:
        server.terminate()
""",
}
"""What a page calls by name, as it is in an environment with flockenv. A playground is read in place of a browser, and
then ended, as it would otherwise go on."""


def blocks_of(text: str) -> list[tuple[str, str]]:
    """Return the blocks of a page or section that are run or saved, as (language, text)."""
    return BLOCK.findall(text)


def section_of(text: str, title: str) -> str:
    """Return the section of a page under a heading; the page, if the title is empty."""
    if not title:
        return text
    return text.split(f"\n## {title}\n")[1].split("\n## ")[0]


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
    return _run([PYTHON, "-W", "error::UserWarning", "tutorial.py"], folder, more)


def run_page(text: str, folder: Path) -> tuple[list[str], list[str]]:
    """Run a tutorial: save its YAML files, run its commands, then its Python blocks as one script.

    In this checkout the folder has its `configs`. Return the lines that the commands print, and those of the script.
    """
    if not INSTALLED:
        (folder / "configs").symlink_to(ROOT / "configs")
    programs = folder / "programs"
    programs.mkdir()
    for name, program in PROGRAMS.items():
        (programs / name).write_text(program.format(python=PYTHON))
        (programs / name).chmod(0o755)
    for match in BLOCK.finditer(text):
        if match[1] == "yaml":
            saved = SAVED.search(text[: match.start()].rstrip())
            assert saved is not None, f"a YAML block without a file name before it:\n{match[2]}"
            (folder / saved[1]).write_text(match[2], encoding="utf-8")
    commands = "".join(block for language, block in blocks_of(text) if language == "sh")
    printed = _run(["/bin/sh", "-ec", commands], folder, str(programs)) if commands else []
    script = python_of(text)
    return printed, run_python(script, folder, more=str(programs)) if script else []


def _run(command: list[str], folder: Path, more: str = "") -> list[str]:
    path = os.pathsep.join(filter(None, (more, os.environ.get("PATH", ""))))
    env = {**os.environ, "PYTHONPATH": "" if INSTALLED else str(ROOT), "PATH": path}
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=600, env=env)
    assert done.returncode == 0, done.stderr + done.stdout
    return done.stdout.splitlines()


if __name__ == "__main__":
    page, *title = sys.argv[1:]
    with tempfile.TemporaryDirectory() as empty:
        for lines in run_page(section_of(Path(page).read_text(encoding="utf-8"), "".join(title)), Path(empty)):
            for line in lines:
                print(line)
