"""Damaged kernel files in the cache are detected, reported once, and rebuilt."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from flockenv.jit.checked_store import Store
from flockenv.jit.private_folder import ensure_private

SCENE = '''
from flockenv.scene.yaml_io import load_scene
scene = load_scene("""
dimension: 2
space: {kind: torus, size: [9, 9]}
groups: [{count: 3}]
effects: [{kind: drag, rate: 1}]
dt: 0.1
""")
print(scene.run(scene.start(0), 5).pos.tobytes().hex())
'''


def run(folder: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "FLOCKENV_CACHE": str(folder)}
    return subprocess.run([sys.executable, "-c", SCENE], env=environment, capture_output=True, text=True, timeout=300)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """Return an undamaged cache folder, and the output of a process that uses it."""
    folder = tmp_path_factory.mktemp("whole") / "cache"
    done = run(folder)
    assert (done.returncode, done.stderr) == (0, "")
    return folder, done.stdout


def flipped(at: float) -> Callable[[bytes], bytes]:
    """Return a function that flips the lowest bit of one byte; `at` is its position as a fraction of the length."""

    def flip(data: bytes) -> bytes:
        changed = bytearray(data)
        changed[int(at * (len(data) - 1))] ^= 1
        return bytes(changed)

    return flip


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "emptied": lambda data: b"",
    "cut to one byte": lambda data: data[:1],
    "cut in the middle": lambda data: data[: len(data) // 2],
    "second half zeroed": lambda data: data[: len(data) // 2] + bytes(len(data) - len(data) // 2),
    "one byte longer": lambda data: data + b"\0",
    "a bit flipped at the beginning": flipped(0),
    "a bit flipped in the middle": flipped(0.5),
    "a bit flipped at the end": flipped(1),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "how",
    [
        "a bit flipped in the middle",
        *(pytest.param(how, marks=pytest.mark.slow) for how in ("emptied", "cut in the middle")),
    ],
)
@pytest.mark.parametrize("kind", ["nbc"])
def test_damaged_file_causes_one_message_and_one_compilation(
    kind: str, how: str, whole: tuple[Path, str], tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(whole[0], tmp_path / "cache"))
    run(folder)  # bytecode contains the path of its source
    (path,) = folder.glob(f"scene_*.{kind}")
    before = path.read_bytes()
    path.write_bytes(DAMAGE[how](before))
    first, second = run(folder), run(folder)
    assert (first.returncode, first.stdout) == (0, whole[1])
    assert first.stderr == f"flockenv: {path}: damaged; rebuilt\n"
    assert (second.returncode, second.stdout, second.stderr) == (0, whole[1], "")
    assert len(path.read_bytes()) > len(before) / 2


@pytest.mark.slow
def test_scene_runs_if_every_file_is_damaged(tmp_path: Path) -> None:
    folder = tmp_path / "cache"
    before = run(folder)
    files = [path for path in folder.iterdir() if path.is_file()]
    for k, path in enumerate(files):
        path.write_bytes(flipped(k / len(files))(path.read_bytes()))
    first, second = run(folder), run(folder)
    assert (first.returncode, first.stdout) == (0, before.stdout)
    assert sorted(first.stderr.splitlines()) == sorted(f"flockenv: {path}: damaged; rebuilt" for path in files)
    assert (second.returncode, second.stdout, second.stderr) == (0, before.stdout, "")


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(ensure_private(tmp_path / "store"))
    store.write("name", bytes(range(256)) * 3)
    return store


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE.keys())
def test_damaged_data_is_never_returned(
    damage: Callable[[bytes], bytes], store: Store, caplog: pytest.LogCaptureFixture
) -> None:
    path = store.folder / "name"
    path.write_bytes(damage(path.read_bytes()))
    assert store.read("name") is None and store.read("name") is None
    assert caplog.messages == [f"flockenv: {path}: damaged; rebuilt"]
    store.write("name", b"new")
    assert store.read("name") == b"new"


def test_flipped_bits_and_truncations_are_detected(store: Store) -> None:
    path = store.folder / "name"
    data = path.read_bytes()
    for at in range(len(data)):
        path.write_bytes(data[:at])
        assert store.read("name") is None
    for bit in range(0, 8 * len(data), 11):
        changed = bytearray(data)
        changed[bit // 8] ^= 1 << bit % 8
        path.write_bytes(changed)
        assert store.read("name") is None
    path.write_bytes(data)
    assert store.read("name") == bytes(range(256)) * 3


def test_data_is_read_only_under_its_own_name(store: Store) -> None:
    shutil.copy(store.folder / "name", store.folder / "other")
    assert store.read("other") is None
    assert store.read("missing") is None


def test_full_disk_is_reported_once_and_leaves_no_files(
    store: Store, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    for name in ("name", "other"):
        store.write(name, b"new")
    (logged,) = caplog.messages
    assert "No space left on device" in logged and str(store.folder) in logged
    assert [path.name for path in store.folder.iterdir()] == ["name"]
    assert store.read("name") == bytes(range(256)) * 3
