"""A command with too little memory ends with one line that names memory, whichever step or library fails."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest
import typer
from filelock import FileLock

from flockenv.cli import terminal
from flockenv.cli.terminal import describe_error
from flockenv.core import address_space
from flockenv.engine import workspace
from flockenv.jit import section

ROOT = Path(__file__).resolve().parent.parent

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="no other system limits the address space")

FLOCKENV = str(Path(sys.executable).with_name("flockenv"))

COMMANDS = {"flockenv": (FLOCKENV, "run", "none.yaml"), "tune": ("-m", "agents.tune", "none.yaml")}

BIG = """\
dimension: 2
space: {kind: torus, size: [2000, 2000]}
groups: [{count: 200000, max_speed: 2, max_force: 1}]
effects: [{kind: separation, radius: 3, weight: 1}]
dt: 0.05
"""

TRAIN = ("-m", "agents.ppo", str(ROOT / "configs/training/pursuit.yaml"), "--runs", "r", "--out", "p.safetensors")


def limited(megabytes: int, *command: str, folder: Path = ROOT, **more: str) -> subprocess.CompletedProcess[str]:
    def limit() -> None:
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (megabytes * 10**6,) * 2)

    return subprocess.run(
        [sys.executable, *command], env={**os.environ, "PYTHONPATH": str(ROOT), **more}, capture_output=True, text=True,
        check=False, timeout=300, preexec_fn=limit, cwd=folder,
    )  # fmt: skip


def assert_names_memory(done: subprocess.CompletedProcess[str], start: str) -> None:
    assert done.stderr.startswith(start) and done.stderr.endswith(" GB are allowed (ulimit -v)\n"), done.stderr
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)


@pytest.mark.parametrize("megabytes", [100, 150, 250, 400, 500])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_with_too_little_address_space_names_memory(name: str, megabytes: int) -> None:
    done = limited(megabytes, *COMMANDS[name])
    start = f"{name}: not enough memory: at least "
    end = f" GB of address space are needed beside Python's own, {megabytes / 1e3:.2f} GB are allowed (ulimit -v)\n"
    assert done.stderr.startswith(start) and done.stderr.endswith(end), done.stderr
    assert_names_memory(done, start)


RANGE = [700, 740, 780, 820, 860, 900, 940, 980, 1020]
FAST = {700, 860, 1020}


@pytest.mark.slow
@pytest.mark.parametrize("mb", [pytest.param(mb, marks=[] if mb in FAST else pytest.mark.slow) for mb in RANGE])
def test_a_command_that_cannot_compile_its_kernels_names_memory(mb: int, tmp_path: Path) -> None:
    """Below some of these limits LLVM aborted, with and without a C++ exception; at others no thread started."""
    (tmp_path / "big.yaml").write_text(BIG)
    command = FLOCKENV, "run", "big.yaml", "--duration", "1", "--out", "b.npz"
    done = limited(mb, *command, folder=tmp_path, FLOCKENV_CACHE=str(tmp_path / "cache"))
    assert_names_memory(done, "flockenv: not enough memory: ")
    assert sorted(path.name for path in tmp_path.iterdir() if path.name != "cache") == ["big.yaml"]


@pytest.mark.slow
def test_a_command_with_compiled_kernels_names_memory_until_it_has_enough(tmp_path: Path) -> None:
    (tmp_path / "big.yaml").write_text(BIG)
    command = FLOCKENV, "run", "big.yaml", "--duration", "0.1"
    codes = []
    for mb in (20_000, 680, 780, 880, 980):
        done = limited(mb, *command, folder=tmp_path, FLOCKENV_CACHE=str(tmp_path / "cache"))
        codes.append(done.returncode)
        if done.returncode:
            assert_names_memory(done, "flockenv: not enough memory: ")
    assert codes[:2] == [0, 2]


@pytest.mark.parametrize("mb", [720, 920, pytest.param(1130, marks=pytest.mark.slow), 1230])
def test_a_training_with_too_little_address_space_names_memory(mb: int, tmp_path: Path) -> None:
    """On two cores torch cannot be imported with the first two, and its threads cannot start with the others."""
    pytest.importorskip("stable_baselines3")
    done = limited(mb, *TRAIN, folder=tmp_path)
    assert_names_memory(done, "ppo: not enough memory: at least ")
    assert not (tmp_path / "p.safetensors").exists()


def test_a_refusal_to_compile_releases_the_lock_of_the_kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Other processes need not wait for one that has caught the MemoryError and goes on."""
    monkeypatch.setenv("FLOCKENV_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(section, "COMPILING", 2**60)
    triple = section.entry(lambda x: 3 * x)
    with pytest.raises(MemoryError, match=r"^at least 1\.2e\+09 GB of address space are needed to compile a kernel"):
        triple(1.0)
    (lock,) = (tmp_path / "cache" / "locks").iterdir()
    with FileLock(lock, timeout=0):
        pass


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (MemoryError(), "use fewer agents or worlds"),
        (MemoryError("Unable to allocate 3 GiB\nmore"), "Unable to allocate 3 GiB"),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), "Cannot allocate memory"),
        (OSError(errno.ENOMEM, "Cannot allocate memory", "a.npz"), "a.npz: Cannot allocate memory"),
        (RuntimeError("can't start new thread"), "no further thread can be started (ulimit -v, ulimit -u)"),
        (
            RuntimeError("[enforce fail at alloc_cpu.cpp:127] err == 0. DefaultCPUAllocator: can't allocate memory: x"),
            "torch: can't allocate memory: x",
        ),
        (OSError(errno.ENOENT, "No such file"), None),
        (ImportError("x.so: failed to map segment from shared object"), None),  # no limit: another cause
        (RuntimeError("other"), None),
    ],
)
def test_the_cause_of_an_error_for_lack_of_memory_is_one_line(error: Exception, line: str | None) -> None:
    assert address_space.shortage(error) == line
    assert describe_error(error) == (f"not enough memory: {line}", 2) or line is None


CALLS = """
import resource, sys
from flockenv.core.address_space import shortage

def deeper():
    return deeper()

sys.setrecursionlimit(10**7)
with open("/proc/self/statm") as file:
    size = int(file.read().split()[0]) * resource.getpagesize()
hard = resource.getrlimit(resource.RLIMIT_AS)[1]
resource.setrlimit(resource.RLIMIT_AS, (size + 2**21, hard))
try:
    deeper()
except (MemoryError, SystemError) as raised:
    error = raised
print(shortage(error))
"""


def test_a_call_without_memory_for_its_frame_lacks_memory() -> None:
    """CPython 3.11 raises SystemError there, "error return without exception set"."""
    done = subprocess.run([sys.executable, "-c", CALLS], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.endswith(" GB are allowed (ulimit -v)\n"), done.stdout


def test_a_library_that_cannot_be_loaded_under_a_limit_lacks_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(address_space, "_limit", lambda: ", 0.70 GB are allowed (ulimit -v)")
    error = ImportError("x.so: failed to map segment from shared object")
    assert address_space.shortage(error) == f"{error}, 0.70 GB are allowed (ulimit -v)"


def test_a_program_that_runs_out_of_memory_anywhere_ends_with_one_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    app = typer.Typer(pretty_exceptions_enable=False)

    @app.command()
    def main() -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(sys, "argv", ["ppo"])
    monkeypatch.setattr(terminal.signals, "handle_signals", lambda name: nullcontext())
    with pytest.raises(SystemExit) as end:
        terminal.run_program("ppo", app)
    assert end.value.code == 2
    text = "ppo: not enough memory: no further thread can be started (ulimit -v, ulimit -u)\n"
    assert capsys.readouterr().err == text


def test_scratch_that_cannot_be_mapped_is_a_memory_error() -> None:
    with pytest.raises(MemoryError, match=r"^Unable to allocate [\d,]+ MB of scratch for the steps of a world$"):
        workspace._memory(2**60)
