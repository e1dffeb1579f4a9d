"""Paths at which files may be written, and paths that are refused."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest
from typer.main import get_command

from flockenv.cli.main import app, main
from flockenv.core.output_paths import valid_file, valid_path


@pytest.fixture(autouse=True)
def in_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Work in one folder; the folder for temporary files is another one."""
    (tmp_path / "here").mkdir()
    (tmp_path / "temporary").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))


@pytest.mark.parametrize("name", ["x.gif", "a/b/c/x.gif", "./x.gif", "ü 鳥.gif", "..x.gif", "a..b/x.gif", "conx.gif"])
def test_a_path_below_the_current_folder_is_allowed_and_nothing_is_created(name: str) -> None:
    assert valid_file(name, [".gif"]) == (Path.cwd() / name).resolve()
    assert list(Path.cwd().iterdir()) == []


def test_a_path_below_the_temporary_folder_is_allowed() -> None:
    path = Path(tempfile.gettempdir()) / "deep" / "x.gif"
    assert valid_file(str(path), [".gif"]) == path


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("", "must be a name without control characters"),
        ("  ", "must be a name without control characters"),
        ("a\0b", "must be a name without control characters"),
        ("a\x1b[2J", "must be a name without control characters"),
        ("a\u202eb", "must be a name without control characters"),
        ("../x", "must not go up with '..'"),
        ("a/../../x", "must not go up with '..'"),
        ("/etc/x", "must lie below"),
        ("/", "must lie below"),
        ("~/x/" + "y" * 201, "too long: at most 200 bytes per name"),
        ("ü" * 101, "too long: at most 200 bytes per name"),
        ("a/" * 600, "too long: at most 200 bytes per name and 1000 characters in all"),
        ("CON", "'CON' is a reserved name"),
        ("a/lpt1.txt/b", "'lpt1.txt' is a reserved name"),
    ],
)
def test_an_invalid_path_is_refused_in_one_line(name: str, message: str) -> None:
    with pytest.raises(ValueError, match="--out") as caught:
        valid_path(name)
    assert message in str(caught.value)
    assert str(caught.value).isprintable() and len(str(caught.value)) < 500


def test_symbolic_links_are_resolved_before_the_check(tmp_path: Path) -> None:
    Path("outside").symlink_to("/usr")
    Path("inside").symlink_to(tmp_path / "here")
    with pytest.raises(ValueError, match="must lie below"):
        valid_path("outside/x")
    assert valid_path("inside/x") == tmp_path / "here" / "x"


def test_a_file_in_place_of_a_folder_is_refused() -> None:
    Path("file").write_text("")
    with pytest.raises(ValueError, match=r"--out 'file/x\.gif': '.*file' is not a folder"):
        valid_file("file/x.gif", [".gif"])


@pytest.mark.skipif(os.name == "nt" or os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_without_write_permission_is_refused() -> None:
    Path("closed").mkdir(mode=0o500)
    with pytest.raises(ValueError, match="cannot be written to"):
        valid_path("closed/x")


def test_a_folder_that_os_access_denies_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(ValueError, match="cannot be written to"):
        valid_path("x")


def test_existing_files_are_overwritten_only_with_force() -> None:
    Path("x.gif").write_text("mine")
    Path("folder.gif").mkdir()
    with pytest.raises(ValueError, match=r"--out 'x\.gif': exists already; --force overwrites it"):
        valid_file("x.gif", [".gif"])
    assert valid_file("x.gif", [".gif"], force=True).read_text() == "mine"
    with pytest.raises(ValueError, match="is a folder"):
        valid_file("folder.gif", [".gif"], force=True)


def test_the_suffix_must_be_an_allowed_one() -> None:
    assert valid_file("x.GIF", [".gif", ".png"]).name == "x.GIF"
    with pytest.raises(ValueError, match=r"--to 'x\.gfi': must end in \.gif or \.png, did you mean `\.gif`\?"):
        valid_file("x.gfi", [".gif", ".png"], option="--to")
    with pytest.raises(ValueError, match=r"--out 'x': must end in \.gif$"):
        valid_file("x", [".gif"])


def test_an_existing_file_with_the_suffix_of_beside_is_refused() -> None:
    Path("numbers.json").write_text("mine")
    for name in ("numbers.png", "numbers.json"):
        with pytest.raises(ValueError, match=r"numbers\.json': exists already"):
            valid_file(name, [".png", ".json"], beside=".json")
        assert valid_file(name, [".png", ".json"], force=True, beside=".json").name == name
    Path("folder.json").mkdir()
    with pytest.raises(ValueError, match=r"folder\.json': is a folder"):
        valid_file("folder.png", [".png"], force=True, beside=".json")


def test_a_folder_beside_a_page_may_exist_but_a_file_may_not() -> None:
    assert valid_file("page.md", [".md"], beside="").name == "page.md"
    Path("page").mkdir()
    assert valid_file("page.md", [".md"], beside="").name == "page.md"
    Path("other").write_text("mine")
    with pytest.raises(ValueError, match=r"--out 'other\.md': 'other' beside it is a file, must be a folder"):
        valid_file("other.md", [".md"], force=True, beside="")


WRITING = {
    "run": (["run", "tiny.yaml", "--out"], "x.npz"),
    "render": (["render", "tiny.yaml", "--out"], "x.gif"),
    "render a task": (["render", "pursuit", "--out"], "x.html"),
    "measure": (["measure", "tiny.yaml", "--json"], "x.json"),
    "measure pictures": (["measure", "tiny.yaml", "--out"], "x"),
    "accuracy": (["accuracy", "--suite", "--out"], "x.png"),
    "compare": (["compare", "--out"], "x"),
    "stress": (["stress", "--out"], "x.json"),
    "experiment": (["experiment", "none.yaml", "--out"], "x.png"),
    "gallery": (["gallery", "--out"], "x.md"),
    "validate": (["validate", "--out"], "x.md"),
    "validate scenes": (["validate", "--scenes"], "x"),
}


@pytest.mark.parametrize(("words", "name"), WRITING.values(), ids=WRITING)
@pytest.mark.parametrize(
    ("folder", "fault"),
    [("/proc/none/", "must lie below"), ("tiny.yaml/", "is not a folder"), ("a/../", "must not go up")],
)
def test_an_output_path_that_is_not_allowed_is_refused_at_once(
    words: list[str], name: str, folder: str, fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path("tiny.yaml").write_text("space: {kind: torus, size: [9, 9]}\ngroups: [{count: 2}]\ndt: 0.01\n")
    before = sorted(Path().iterdir())
    assert main([*words, folder + name]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and fault in captured.err
    assert sorted(Path().iterdir()) == before


def test_every_command_with_an_output_path_is_tested_above() -> None:
    commands = getattr(get_command(app), "commands", {})
    writing = {name for name, command in commands.items() if any("--out" in p.opts for p in command.params)}
    assert writing == {words[0] for words, _ in WRITING.values()}
