"""Videos: frames of an MP4 and a WebP are those that were drawn, at the right times."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from flockenv.cli.main import main
from flockenv.render.video import write_mp4, write_webp

TINY = """\
space: {kind: torus, size: [9, 9]}
groups: [{count: 4, spawn: {speed: [1, 2]}}]
effects: [{kind: drag, rate: 0.5}]
dt: 0.01
"""


pytestmark = [  # imageio-ffmpeg leaves its pipes to the garbage collector
    pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
]


@pytest.fixture(autouse=True)
def _no_pipes_are_left() -> Iterator[None]:
    yield
    gc.collect()


def film(count: int, height: int = 60, width: int = 90) -> list[NDArray[np.uint8]]:
    """Return frames that get brighter, in each of which a white bar is further to the right."""
    frames = np.empty((count, height, width, 3), np.uint8)
    for k in range(count):
        frames[k] = 20 * k
        frames[k, :, 10 * k : 10 * k + 10] = 255
    return list(frames)


def decoded(path: Path) -> tuple[dict[str, object], NDArray[np.uint8]]:
    """Return what an MP4 says of itself, and its frames (N, H, W, 3)."""
    imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg")
    reader = imageio_ffmpeg.read_frames(str(path))
    about = next(reader)
    width, height = about["size"]
    return about, np.array([np.frombuffer(each, np.uint8).reshape(height, width, 3) for each in reader])


def test_an_mp4_has_the_frames_and_their_rate(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    frames = film(6)
    assert write_mp4(tmp_path / "a.mp4", iter(frames), 12.5) == 6
    about, found = decoded(tmp_path / "a.mp4")
    assert about["fps"] == 12.5 and about["codec"] == "h264" and found.shape == (6, 60, 90, 3)
    assert np.abs(found.astype(int) - np.array(frames)).mean() < 4


def test_a_frame_of_odd_size_is_padded_by_its_edge(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    write_mp4(tmp_path / "a.mp4", film(3, 61, 91), 10)
    _, found = decoded(tmp_path / "a.mp4")
    assert (
        found.shape == (3, 62, 92, 3) and np.abs(found[:, :61, :91].astype(int) - np.array(film(3, 61, 91))).mean() < 4
    )


def test_a_webp_has_the_frames_and_its_total_duration_is_right(tmp_path: Path) -> None:
    assert write_webp(tmp_path / "a.webp", iter(film(6)), 30) == 6
    durations = []
    with Image.open(tmp_path / "a.webp") as picture:
        assert picture.size == (90, 60) and picture.info["loop"] == 0
        for k, frame in enumerate(film(6)):
            picture.seek(k)
            assert np.abs(np.asarray(picture.convert("RGB")).astype(int) - frame).mean() < 8
            durations.append(picture.info["duration"])
    assert sum(durations) == 200 and set(durations) == {33, 34}


@pytest.mark.parametrize("write", [write_mp4, write_webp])
def test_without_a_frame_there_is_no_file(write: object, tmp_path: Path) -> None:
    if write is write_mp4:
        pytest.importorskip("imageio_ffmpeg")
    assert callable(write)
    with pytest.raises(ValueError, match="at least one"):
        write(tmp_path / "a.bin", [], 10)
    assert not list(tmp_path.iterdir())


def test_the_command_writes_videos_and_names_the_package_that_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("tiny.yaml").write_text(TINY)
    options = ("render", "tiny.yaml", "--duration", "0.2", "--size", "80")
    assert main([*options, "--out", "a.webp"]) == 0
    with Image.open("a.webp") as picture:
        assert getattr(picture, "n_frames", 1) == 6
    pytest.importorskip("imageio_ffmpeg")
    assert main([*options, "--out", "a.mp4"]) == 0 and len(decoded(Path("a.mp4"))[1]) == 6
    capsys.readouterr()
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert main([*options, "--out", "b.mp4"]) == 2
    assert "pip install 'flockenv[video]'" in capsys.readouterr().err and not Path("b.mp4").exists()
