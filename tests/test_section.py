"""Sections: the cache key of an entry point covers all that its machine code depends on, and nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent

LAWS = """
from flockenv.jit.decorators import law

@law
def doubled(x):
    return 2 * x

@law
def squared(x):
    return x * x

def times(k):
    @law
    def multiplied(x):
        return k * x
    return multiplied
"""

PROGRAM = """
import sys
import numpy as np
from numba.core import event
from flockenv.jit.section import entry_of
import users_laws

@entry_of
def over(law, times):
    def each(numbers):
        for k in range(len(numbers)):
            for _ in range(times):
                numbers[k] = law(numbers[k])
    return each

class Count(event.Listener):
    compiled = 0
    def on_start(self, event):
        self.compiled += 1
    def on_end(self, event):
        pass

count = Count()
event.register("numba:compile", count)
for law in (users_laws.doubled, users_laws.squared, users_laws.times(5), users_laws.times(7)):
    for times in (1, 2):
        numbers = np.array([3.0])
        over(law, times)(numbers)
        print(numbers[0], end=" ")
print(count.compiled > 0)
"""


def run(folder: Path, laws: str = LAWS, **environment: str) -> str:
    """Return what the program prints: a number for each plan, and whether anything was compiled."""
    (folder / "users_laws.py").write_text(laws)
    env = {**os.environ, "FLOCKENV_CACHE": str(folder / "cache"), "PYTHONPATH": f"{folder}:{ROOT}", **environment}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=env, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_each_plan_has_its_own_code_which_the_next_process_reuses(tmp_path: Path) -> None:
    assert run(tmp_path) == "6.0 12.0 9.0 81.0 15.0 75.0 21.0 147.0 True"
    assert run(tmp_path) == "6.0 12.0 9.0 81.0 15.0 75.0 21.0 147.0 False"


def test_an_edited_law_is_recompiled_and_the_old_one_stays_cached(tmp_path: Path) -> None:
    run(tmp_path)
    assert run(tmp_path, LAWS.replace("2 * x", "5 * x")) == "15.0 75.0 9.0 81.0 15.0 75.0 21.0 147.0 True"
    assert run(tmp_path) == "6.0 12.0 9.0 81.0 15.0 75.0 21.0 147.0 False"


def test_sections_also_run_in_plain_python(tmp_path: Path) -> None:
    assert run(tmp_path, NUMBA_DISABLE_JIT="1") == "6.0 12.0 9.0 81.0 15.0 75.0 21.0 147.0 False"


def test_an_edited_law_without_a_file_is_recompiled(tmp_path: Path) -> None:
    """The module has no source file, as in a notebook, and the law keeps its name."""
    imports = "from flockenv.jit.section import entry\nfrom flockenv.jit.decorators import law\n"
    cell = imports + "@law\ndef f(x): return {} * x\nprint(entry(f)(3.0))"
    env = {**os.environ, "FLOCKENV_CACHE": str(tmp_path)}
    for factor in (2, 5, 2):
        done = subprocess.run(
            [sys.executable, "-c", cell.format(factor)], cwd=ROOT, env=env, capture_output=True, text=True, check=True
        )
        assert done.stdout == f"{3.0 * factor}\n"


def test_plain_python_uses_one_thread() -> None:
    """Although two are set: the barrier's counter is not atomic in plain Python."""
    env = {**os.environ, "NUMBA_DISABLE_JIT": "1", "FLOCKENV_THREADS": "2"}
    code = "from flockenv.jit.thread_pool import threads, usable_threads; print(threads(), usable_threads())"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, env=env, capture_output=True, text=True, check=True)
    assert done.stdout == "2 1\n"


@pytest.mark.slow
def test_damaged_code_in_the_cache_is_recompiled(tmp_path: Path) -> None:
    run(tmp_path)
    for path in (tmp_path / "cache").glob("*.nbc"):
        path.write_bytes(path.read_bytes()[:-9])
    assert run(tmp_path) == "6.0 12.0 9.0 81.0 15.0 75.0 21.0 147.0 True"
