"""Files appear whole or not at all, one alone or several together, despite failures, signals and other writers."""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer

from agents import checkpoint, publish
from flockenv.cli import gallery, validate
from flockenv.core.atomic_files import LEFTOVERS, remove_leftovers, replace_file, write_all_or_none
from flockenv.geometry.space import Torus
from flockenv.jit.checked_store import Store
from flockenv.jit.private_folder import ensure_private
from flockenv.model.group import Group
from flockenv.players.policy import save_policy
from flockenv.scene import Scene
from flockenv.studies.trajectory import record
from flockenv.studies.trial_log import Results

ROOT = Path(__file__).resolve().parent.parent


def files_in(folder: Path) -> dict[str, str]:
    return {path.relative_to(folder).as_posix(): path.read_text() for path in folder.rglob("*") if path.is_file()}


def writes(text: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(text)


def failing(monkeypatch: pytest.MonkeyPatch, error: BaseException, *calls: int) -> None:
    """Make some of the following renames fail: call k for every k of `calls`, counted from 1."""
    replace, count = os.replace, [0]

    def replaced(source: Any, target: Any) -> None:
        count[0] += 1
        if count[0] in calls:
            raise error
        replace(source, target)

    monkeypatch.setattr(os, "replace", replaced)


# --- one file


def test_a_file_is_replaced_as_a_whole_or_not_at_all(tmp_path: Path) -> None:
    path = tmp_path / "file"
    with replace_file(path) as file:
        file.write(b"old")
    with pytest.raises(TypeError), replace_file(path) as file:
        file.writelines((b"half", "text"))  # type: ignore[arg-type]
    assert files_in(tmp_path) == {"file": "old"} and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("ends", [("1", "2"), ("", "")], ids=["long names", "one target"])
def test_two_writers_at_once_do_not_write_into_each_others_file(ends: tuple[str, str], tmp_path: Path) -> None:
    """Their names share the first hundred characters, or are equal."""
    one, other = (tmp_path / f"{'x' * 100}{end}" for end in ends)
    with replace_file(one) as first:
        first.write(b"first, and longer")
        with replace_file(other) as second:
            second.write(b"second")
        assert other.read_text() == "second"
    assert one.read_text() == "first, and longer"
    assert len(list(tmp_path.iterdir())) == len({one, other})


def test_threads_that_write_one_file_leave_the_text_of_one_of_them(tmp_path: Path) -> None:
    target, errors = tmp_path / "file", []

    def write(letter: bytes) -> None:
        try:
            for _ in range(20):
                with replace_file(target) as file:
                    for _ in range(50):
                        file.write(letter * 1000)
        except OSError as error:
            errors.append(error)

    threads = [threading.Thread(target=write, args=(letter,)) for letter in (b"a", b"b", b"c")]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert errors == [] and len(target.read_text()) == 50_000 and len(set(target.read_text())) == 1


def test_a_planted_link_is_not_followed(tmp_path: Path) -> None:
    foreign, target = tmp_path / "foreign", tmp_path / "here" / "file"
    target.parent.mkdir()
    foreign.write_text("theirs")
    target.with_name(f".file.{os.getpid()}.part").symlink_to(foreign)
    target.symlink_to(foreign)
    with replace_file(target) as file:
        file.write(b"mine")
    assert foreign.read_text() == "theirs" and target.read_text() == "mine" and not target.is_symlink()


@pytest.mark.skipif(os.name == "nt", reason="Windows has no modes")
@pytest.mark.parametrize(
    ("mode", "mask", "expected"), [(0o666, 0o022, 0o644), (0o666, 0o077, 0o600), (0o600, 0, 0o600)]
)
def test_permissions_are_those_of_any_new_file(mode: int, mask: int, expected: int, tmp_path: Path) -> None:
    before = os.umask(mask)
    try:
        with replace_file(tmp_path / "file", mode) as file:
            file.write(b"x")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == expected


@pytest.mark.parametrize("name", ["", ".", "gone/file", "a\0b"])
def test_an_invalid_file_name_is_refused_in_one_line(name: str, tmp_path: Path) -> None:
    with pytest.raises((OSError, ValueError), match=r"cannot write|NUL") as caught, replace_file(f"{tmp_path}/{name}"):
        raise AssertionError("must not be reached")
    assert str(caught.value).isprintable() and list(tmp_path.iterdir()) == []


# --- several files


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), KeyboardInterrupt()], ids=["disk", "Ctrl-C"])
@pytest.mark.parametrize("call", [1, 2, 3, 4])
def test_a_failed_rename_leaves_all_files_unchanged(
    call: int, error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_all_or_none(tmp_path, {"a": writes("old a"), "c": writes("old c"), "deep/d": writes("old d")})
    before = files_in(tmp_path)
    failing(monkeypatch, error, call)
    with pytest.raises(type(error), match=f"cannot write '.*{['a', 'b', 'c', 'd'][call - 1]}'|^$"):
        write_all_or_none(tmp_path, {name: writes(f"new {name}") for name in ("a", "b", "c", "deep/d")})
    assert files_in(tmp_path) == before and not any(tmp_path.rglob(LEFTOVERS))


def test_a_file_that_cannot_be_restored_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The third rename fails, and so does the restoring of the first file."""
    write_all_or_none(tmp_path, {name: writes(f"old {name}") for name in "abc"})
    failing(monkeypatch, OSError(5, "Input/output error"), 3, 4)
    with pytest.raises(OSError, match=r"cannot write '.*/c': Input/output error; .* '.*/a' could not be put back"):
        write_all_or_none(tmp_path, {name: writes(f"new {name}") for name in "abc"})
    assert files_in(tmp_path) == {"a": "new a", "b": "old b", "c": "old c"}


def test_files_are_restored_on_a_disk_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def link(*_: Any, **__: Any) -> None:
        raise OSError(1, "Operation not permitted")

    write_all_or_none(tmp_path, {"a": writes("old a"), "b": writes("old b")})
    (tmp_path / "c").symlink_to("a")
    monkeypatch.setattr(os, "link", link)
    failing(monkeypatch, OSError(5, "Input/output error"), 3)
    with pytest.raises(OSError, match="Input/output error"):
        write_all_or_none(tmp_path, {name: writes(f"new {name}") for name in "cab"})
    assert files_in(tmp_path) == {"a": "old a", "b": "old b", "c": "old a"} and (tmp_path / "c").is_symlink()


def test_a_failed_writer_is_reported_and_leaves_nothing(tmp_path: Path) -> None:
    def full(path: Path) -> None:
        with replace_file(path):
            raise OSError(28, "No space left on device")

    def own(_: Path) -> None:
        raise ValueError("own words")

    for fail, message in ((full, f"^cannot write '{tmp_path}/new/b': No space left on device$"), (own, "^own words$")):
        with pytest.raises((OSError, ValueError), match=message):
            write_all_or_none(tmp_path / "new", {"a": writes("a"), "b": fail})
        assert list(tmp_path.iterdir()) == []


def test_a_folder_in_the_place_of_a_file_is_refused_before_a_writer_runs(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    with pytest.raises(IsADirectoryError, match=r"cannot write '.*b': it is a folder"):
        write_all_or_none(tmp_path, {"a": lambda path: pytest.fail("must not be written"), "b": writes("b")})


RENAMED = """
import os, signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background may ignore it
from flockenv.core import signals
signals.begin("toy")
replace = os.replace
def slow(source, target):
    replace(source, target)
    os.kill(os.getpid(), signal.SIGINT)
os.replace = slow
from pathlib import Path
from flockenv.core.atomic_files import write_all_or_none
with signals.handle_signals("toy"):
    write_all_or_none(Path("."), {"a": lambda path: path.write_text("new"), "b": lambda path: path.write_text("new")})
    print("unreached" * (__import__("time").sleep(60) is None))
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such signals")
def test_a_signal_between_two_renames_waits_until_both_are_done(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", RENAMED], cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert done.returncode != 0 and done.stdout == ""
    assert files_in(tmp_path) == {"a": "new", "b": "new"}


def save_a_policy(folder: Path, number: int) -> None:
    tensors = {"action.weight": np.zeros((1, 2), np.float32), "log_std": np.zeros(1, np.float32)}
    tensors["action.bias"] = np.full(1, number, np.float32)
    save_policy(folder / "p.safetensors", tensors, {"activation": "tanh", "steps": number})


def save_a_trajectory(folder: Path, number: int) -> None:
    scene = Scene(space=Torus(size=(9.0, 9.0)), groups=(Group(count=2),), dt=0.01)
    record(scene, number, 0, 1).save(folder / "t.npz")


def publish_a_comparison(folder: Path, number: int) -> None:
    results = json.loads((ROOT / "docs" / "results.json").read_text(encoding="utf-8"))
    for name in ("results", "root/docs"):
        (folder / name).mkdir(parents=True, exist_ok=True)
    results["tasks"]["pursuit"]["players"]["rules"]["mean"] -= number  # another table, and another picture
    (folder / "results" / "results.json").write_text(json.dumps(results))
    (folder / "results" / "comparison.png").write_bytes(b"%d" % number)
    for page in ("README.md", "docs/results.md"):
        if not (folder / "root" / page).exists():
            (folder / "root" / page).write_text("<!-- python -m agents.publish -->\n<!-- end -->")
    publish.main(folder / "results", folder / "root")


WRITTEN_TOGETHER = {"policy": save_a_policy, "trajectory": save_a_trajectory, "comparison": publish_a_comparison}


@pytest.mark.parametrize("error", [OSError(5, "Input/output error"), KeyboardInterrupt()], ids=["disk", "Ctrl-C"])
@pytest.mark.parametrize("save", WRITTEN_TOGETHER.values(), ids=WRITTEN_TOGETHER)
def test_files_that_belong_together_are_replaced_together(
    save: Callable[[Path, int], None], error: BaseException, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = tmp_path / "root" / "docs" if save is publish_a_comparison else tmp_path
    save(tmp_path, 1)
    before = {path: path.read_bytes() for path in written.iterdir() if path.is_file()}
    failing(monkeypatch, error, 2)
    with pytest.raises((type(error), typer.Exit)):
        save(tmp_path, 2)
    assert {path: path.read_bytes() for path in written.iterdir() if path.is_file()} == before
    monkeypatch.undo()
    save(tmp_path, 2)
    assert all(path.read_bytes() != old for path, old in before.items())


# --- leftovers of killed writers

KILLED = """
import os, signal, sys
from flockenv.core.atomic_files import replace_file
with replace_file(sys.argv[1]) as file:
    file.write(b"half")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""


def killed(folder: Path) -> Path:
    """Return the file that a process leaves in a folder if it is killed while it writes there."""
    subprocess.run([sys.executable, "-c", KILLED, str(folder / "file")], check=False, timeout=100)
    (left,) = folder.glob(LEFTOVERS)
    return left


@pytest.mark.skipif(os.name == "nt", reason="Windows has no SIGKILL")
def test_a_store_removes_leftovers_older_than_a_day(tmp_path: Path) -> None:
    folder = ensure_private(tmp_path / "store")
    Store(folder).write("name", b"kept")
    shutil.copytree(folder, other := ensure_private(tmp_path / "other"), dirs_exist_ok=True)
    old, new = killed(other), other / ".abc.tmp"
    new.write_bytes(b"of a process that writes now")
    os.utime(old, times=(time.time() - 2 * 86_400,) * 2)
    assert Store(other).read("name") == b"kept"
    assert sorted(path.name for path in other.iterdir()) == [".abc.tmp", "name"]


def test_only_hidden_temporary_files_of_a_given_age_count_as_leftovers(tmp_path: Path) -> None:
    names = [".flockenv-abc.part", ".x.tmp", ".hidden", "x.tmp", "x.part"]
    for name in names:
        (tmp_path / name).write_text("x")
    remove_leftovers(tmp_path, 3600)
    assert len(files_in(tmp_path)) == 5
    remove_leftovers(tmp_path)
    assert sorted(files_in(tmp_path)) == [".hidden", "x.part", "x.tmp"]
    remove_leftovers(tmp_path / "gone")


# --- folders ----------------------------------------------------------------------------------------------------------


def _gallery(folder: Path) -> None:
    gallery.write_gallery(folder / "page.md")


def _validation(folder: Path) -> None:
    folder.mkdir()
    validate._write(folder / "page.md", Results(findings=()))


def _training(folder: Path) -> None:
    with checkpoint.claim(folder / "run"):
        pass


@pytest.mark.parametrize(
    ("first", "write"),
    [
        ("flockenv.cli.gallery.run_demo", _gallery),
        ("flockenv.studies.validation.plots.write_pictures", _validation),
        ("agents.checkpoint.FileLock", _training),
    ],
)
def test_an_interrupt_before_the_first_file_leaves_no_folder(
    first: str, write: Callable[[Path], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*given: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(first, interrupted)
    with pytest.raises(KeyboardInterrupt):
        write(tmp_path / "new")
    assert [path for path in tmp_path.rglob("*") if path.is_dir() and not any(path.iterdir())] == []
