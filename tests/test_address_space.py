"""A command with too little memory for its imports ends with one line, whichever library fails."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="no other system limits the address space")

COMMANDS = {
    "flockenv": (str(Path(sys.executable).with_name("flockenv")), "run", "none.yaml"),
    "tune": ("-m", "agents.tune", "none.yaml"),
}


def limited(megabytes: int, *command: str) -> subprocess.CompletedProcess[str]:
    def limit() -> None:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (megabytes * 10**6,) * 2)

    return subprocess.run(
        [sys.executable, *command], env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True,
        check=False, timeout=120, preexec_fn=limit,
    )  # fmt: skip


@pytest.mark.parametrize("megabytes", [100, 150, 250, 400, 500])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_with_too_little_address_space_names_memory(name: str, megabytes: int) -> None:
    done = limited(megabytes, *COMMANDS[name])
    start = f"{name}: not enough memory: at least "
    end = f" GB of address space are needed beside Python's own, {megabytes / 1e3:.2g} GB are allowed (ulimit -v)\n"
    assert done.stderr.startswith(start) and done.stderr.endswith(end), done.stderr
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
