"""Kernels are code: none is loaded from a folder or a file that another user can change."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import stat
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from flockenv.jit.checked_store import Store
from flockenv.jit.private_folder import NotPrivateError, ensure_private, first_private, read_private

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="no owners and modes here")
as_root = pytest.mark.skipif(getattr(os, "geteuid", lambda: 1)() != 0, reason="only root can act as two users")

STRANGER, VICTIM = 54321, 54322
"""User ids that no system assigns."""

USE = '''
from flockenv.scene.yaml_io import load_scene
scene = load_scene("""
dimension: 2
space: {kind: torus, size: [9, 9]}
groups: [{count: 3}]
effects: [{kind: drag, rate: 1}]
dt: 0.1
""")
print(scene.run(scene.start(0), 5).pos.tolist())
'''

FOLDER_AS_VICTIM = f"""
import os
from flockenv.jit.cache_folder import cache_folder
os.setgid({VICTIM})
os.setuid({VICTIM})
found = cache_folder()
print(found, oct(os.lstat(found).st_mode & 0o7777), os.lstat(found).st_uid)
"""


def run(code: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if k not in ("FLOCKENV_CACHE", "XDG_CACHE_HOME")}
    return subprocess.run(
        [sys.executable, "-c", code], env={**environment, **variables}, capture_output=True, text=True, timeout=300
    )


def world_writable(folder: Path) -> None:
    folder.mkdir()
    folder.chmod(0o777)


def of_a_stranger(folder: Path) -> None:
    folder.mkdir(mode=0o755)
    os.chown(folder, STRANGER, STRANGER)


def a_link(folder: Path) -> None:
    real = folder.with_name("real")
    real.mkdir(mode=0o700)
    folder.symlink_to(real)


def a_file(folder: Path) -> None:
    folder.write_text("")


BAD: list[object] = [world_writable, a_link, a_file, pytest.param(of_a_stranger, marks=as_root)]


@pytest.mark.parametrize("make", BAD)
def test_a_folder_that_others_can_change_is_refused_in_one_line(make: Callable[[Path], None], tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    make(folder)
    with pytest.raises(NotPrivateError, match=r"\A[^\n]*cache: .*\Z"):
        ensure_private(folder)


@pytest.mark.parametrize("make", BAD)
def test_a_bad_flockenv_cache_is_refused_and_nothing_in_it_runs(make: Callable[[Path], None], tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    make(folder)
    done = run(USE, FLOCKENV_CACHE=str(folder))
    assert done.returncode == 1 and done.stdout == ""
    assert f"FLOCKENV_CACHE = {folder}" in done.stderr.splitlines()[-1]
    assert make is a_file or not list(folder.iterdir())


@pytest.mark.parametrize(("mode", "allowed"), [(0o777, False), (0o1777, True), (0o755, True)])
def test_parent_folders_may_be_writable_by_others_if_they_are_sticky(mode: int, allowed: bool, tmp_path: Path) -> None:
    above = tmp_path / "above"
    above.mkdir()
    above.chmod(mode)
    if allowed:
        assert stat.S_IMODE(ensure_private(above / "cache").stat().st_mode) == 0o700
    else:
        with pytest.raises(NotPrivateError, match=r"above: other users can replace.*0777"):
            ensure_private(above / "cache")


@as_root
def test_a_parent_folder_of_another_user_is_refused(tmp_path: Path) -> None:
    of_a_stranger(tmp_path / "above")
    with pytest.raises(NotPrivateError, match=f"above: belongs to user {STRANGER}"):
        ensure_private(tmp_path / "above" / "cache")


def test_parents_behind_a_symbolic_link_are_also_checked(tmp_path: Path) -> None:
    world_writable(tmp_path / "open")
    (tmp_path / "open" / "home").mkdir(mode=0o700)
    (tmp_path / "way").symlink_to(tmp_path / "open" / "home")
    with pytest.raises(NotPrivateError, match="open: other users can replace"):
        ensure_private(tmp_path / "way" / "cache")
    (tmp_path / "open").chmod(0o755)
    assert ensure_private(tmp_path / "way" / "cache").is_dir()


def test_new_folders_are_private_under_any_umask(tmp_path: Path) -> None:
    before = os.umask(0)
    try:
        folder = ensure_private(tmp_path / "new" / "deeper" / "cache")
        Store(folder).write("a", b"data")
    finally:
        os.umask(before)
    modes = [stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "new", folder, folder / "a")]
    assert modes == [0o755, 0o700, 0o600]


def linked(path: Path) -> None:
    (path.parent / "other").write_text("data")
    path.symlink_to(path.parent / "other")


def shared(path: Path) -> None:
    path.write_text("data")
    path.chmod(0o666)


def strange(path: Path) -> None:
    path.write_text("data")
    os.chown(path, STRANGER, STRANGER)


def pipe(path: Path) -> None:
    os.mkfifo(path)


@pytest.mark.parametrize("make", [linked, shared, pipe, Path.mkdir, pytest.param(strange, marks=as_root)])
def test_only_plain_files_of_this_user_are_read(make: Callable[[Path], None], tmp_path: Path) -> None:
    make(tmp_path / "file")
    with pytest.raises(NotPrivateError, match="file: "):
        read_private(tmp_path / "file")


class Payload:
    """An object whose unpickling writes a file."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.write_text, (self.marker, "executed")


def plant_plan(folder: Path, marker: Path) -> None:
    """Replace each stored description of a kernel by that of another, `planted`, with a valid digest."""
    for path in folder.glob("*.plan"):
        data = json.loads(Store(folder).read(path.name) or b"")
        Store(folder).write(path.name, json.dumps(["planted", *data[1:]]).encode())


def plant_code(folder: Path, marker: Path) -> None:
    """Replace all machine code by a pickle that writes the marker, with a valid digest; also that of `planted`."""
    for path in folder.glob("*.nbc"):
        for name in (path.name, f"planted_{path.name.rpartition('_')[2]}"):
            Store(folder).write(name, pickle.dumps(Payload(marker)))


def plant_lock(folder: Path, marker: Path) -> None:
    """Replace each lock by a link, so that locking creates or opens the marker."""
    for path in (folder / "locks").iterdir():
        path.unlink()
        path.symlink_to(marker)


def is_used(folder: Path, marker: Path) -> bool:
    """Return True if a process has used something planted in a folder."""
    return marker.exists() or any(folder.rglob("planted_*.lock"))


@pytest.fixture(scope="module")
def compiled(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return a folder with the compiled kernels of USE, and what USE prints."""
    folder = tmp_path_factory.mktemp("compiled")
    folder.chmod(0o700)
    done = run(USE, FLOCKENV_CACHE=str(folder))
    assert done.returncode == 0, done.stderr
    assert {path.suffix for path in folder.iterdir()} == {".plan", ".nbc", ""}, "plant every kind of file that is read"
    assert [path.name for path in folder.iterdir() if not path.suffix] == ["locks"] and any(
        (folder / "locks").iterdir()
    )
    return folder, done.stdout


PLANTS = [plant_plan, plant_code, plant_lock]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "used"), [pytest.param(plant_plan, True, marks=pytest.mark.slow), (plant_code, True), (plant_lock, False)]
)
def test_what_is_planted_in_a_folder_of_ones_own_is_used_but_for_a_linked_lock(
    plant: Callable[[Path, Path], None], used: bool, compiled: tuple[Path, str], tmp_path: Path
) -> None:
    """What the next test plants works. A folder of one's own is trusted; only a link in place of a lock is refused."""
    folder, marker = tmp_path / "cache", tmp_path / "marker"
    shutil.copytree(compiled[0], folder)
    plant(folder, marker)
    for path in folder.glob("*.nbc") if plant is plant_lock else ():
        path.unlink()  # a lock is only used if there is no machine code
    assert not is_used(folder, marker)
    done = run(USE, FLOCKENV_CACHE=str(folder))
    assert is_used(folder, marker) == used
    assert used or done.stdout == compiled[1]


RARELY = [pytest.param(a_link, marks=pytest.mark.slow), pytest.param(of_a_stranger, marks=[as_root, pytest.mark.slow])]


@pytest.mark.slow
@pytest.mark.parametrize("make", [world_writable, *RARELY])
def test_nothing_planted_in_the_temporary_folder_is_used(
    make: Callable[[Path], None], compiled: tuple[Path, str], tmp_path: Path
) -> None:
    temporary, marker = tmp_path / "tmp", tmp_path / "marker"
    temporary.mkdir()
    temporary.chmod(0o1777)
    folder = temporary / f"flockenv-{os.geteuid()}"
    make(folder)
    own = shutil.copytree(compiled[0], tmp_path / "own")
    for plant in PLANTS:
        plant(own, marker)
    for path in own.iterdir():
        path.rename(folder / path.name)
    first, second = (run(USE, HOME="/dev/null", TMPDIR=str(temporary)) for _ in range(2))
    assert not is_used(temporary, marker)
    assert first.returncode == 0 and first.stdout == second.stdout == compiled[1]
    for done in (first, second):
        assert len(done.stderr.splitlines()) == 1 and str(folder) in done.stderr
    fresh = [each for each in temporary.iterdir() if each.name.startswith(folder.name + "-")]
    assert len(fresh) == 1 and stat.S_IMODE(fresh[0].lstat().st_mode) == 0o700  # the second process reuses the first's


@as_root
def test_cache_folder_never_returns_the_folder_of_another_user(request: pytest.FixtureRequest) -> None:
    with_root = Path(tempfile.mkdtemp())  # other users cannot enter that of pytest
    request.addfinalizer(lambda: shutil.rmtree(with_root))
    with_root.chmod(0o1777)
    for name in (f"flockenv-{VICTIM}", f"flockenv-{VICTIM}-0000"):
        of_a_stranger(with_root / name)
    first, second = (run(FOLDER_AS_VICTIM, HOME="/dev/null", TMPDIR=str(with_root)) for _ in range(2))
    found, mode, owner = first.stdout.split()
    assert first.stdout == second.stdout
    assert (mode, owner) == ("0o700", str(VICTIM))
    assert Path(found).parent == with_root and not found.endswith((f"-{VICTIM}", "-0000"))


def test_without_any_private_folder_the_error_is_one_line(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    with pytest.raises(OSError, match=r"\Ano folder for compiled kernels .*other users can replace[^\n]*\Z"):
        first_private(tmp_path / "home" / "flockenv", tmp_path, "flockenv-1")
    assert not list(tmp_path.glob("flockenv-1-*"))
