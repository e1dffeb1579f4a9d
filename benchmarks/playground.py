"""What a picture of the playground costs, and how many there are a second: `python -m benchmarks.playground`.

5,000 boids and 100,000 particles. First in turns, on their own: a tick of physics, the encoding of a frame, and a frame
asked for and received at a socket of `flockenv play`. Then, with Chromium and playwright, the page itself while the
world plays: frames and pictures a second as the page counts them, the time of drawing, and after how many frames the
page sees that a slider was moved. Last, with --minutes N, the memory of the server while it plays and is scrubbed.
"""

from __future__ import annotations

import json
import math
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Origin

from benchmarks.measure import Bench, Contestant, Out, Quick, Rounds, command_line, quartiles
from flockenv.play.frames import decode_frame, encode_frame
from flockenv.play.messages import VERSION
from flockenv.play.record_paths import with_value
from flockenv.play.room import Room
from flockenv.play.scene_lane import SceneLane
from flockenv.scene import Scene
from flockenv.scene.yaml_io import dump_scene, load_scene
from tests.playground import browsing

__all__ = ["Client", "Server", "World", "playing_server", "visiting", "world"]

SCENES = Path(__file__).resolve().parent.parent / "configs" / "scenes"
PROGRAM = (sys.executable, "-c", "from flockenv.cli.main import main; raise SystemExit(main())")
WAIT = 300.0  # s, for a server that compiles
RATE = 60.0  # frames a second that are due
MOVES = 20  # of a slider


class World(NamedTuple):
    """A scene that ships, with more agents at the same density."""

    name: str
    agents: int
    path: str  # of a number that acts at once

    @property
    def title(self) -> str:
        """Its name in tables."""
        return f"{self.agents:,} {self.name}"


WORLDS = (World("boids", 5_000, "effects[1].weight"), World("particles", 100_000, "effects[0].rate"))


def world(which: World) -> Scene:
    """Return a scene that ships with another number of agents, in a space that grows with it."""
    scene = load_scene(SCENES / f"{which.name}.yaml")
    longer = (which.agents / scene.agents) ** (1 / scene.dimension)
    scene = with_value(scene, "space.size", tuple(x * longer for x in scene.space.size))  # type: ignore[union-attr]
    return with_value(scene, "groups[0].count", which.agents)


class Server(NamedTuple):
    """A `flockenv play` that runs."""

    url: str
    pid: int

    @property
    def memory(self) -> float:
        """Resident memory, MB; NaN where /proc is missing."""
        status = Path(f"/proc/{self.pid}/status")
        lines = status.read_text().splitlines() if status.is_file() else []
        return next((int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS:")), math.nan)


@contextmanager
def playing_server(scene: Scene) -> Iterator[Server]:
    """Run `flockenv play` of a scene at a free port, until the block is left."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "world.yaml"
        path.write_text(dump_scene(scene))
        command = [*PROGRAM, "play", str(path), "--port", "0", "--no-browser"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None and process.stderr is not None
            line = process.stdout.readline()
            try:
                if not line.startswith("http"):
                    raise RuntimeError(f"flockenv play did not start: {process.stderr.read().strip()}")
                yield Server(line.split()[0], process.pid)
            finally:
                process.send_signal(signal.SIGTERM)
                try:
                    process.wait(30)
                except subprocess.TimeoutExpired:
                    process.kill()


class Client:
    """A page without a browser: it asks and receives."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.send(type="hello", version=VERSION)

    def send(self, **message: Any) -> None:
        """Send a message."""
        self._socket.send(json.dumps(message))

    def frame(self) -> bytes:
        """Ask for a frame and return it."""
        self.send(type="frame")
        while not isinstance(answer := self._socket.recv(WAIT), bytes):
            continue
        return answer

    def tick(self) -> int:
        """Return the tick of the next frame."""
        return int(decode_frame(self.frame())[0]["tick"])

    def play_on(self) -> None:
        """Let time pass, and return when it does: the kernels are compiled."""
        self.send(type="play", on=True)
        first, end = self.tick(), time.monotonic() + WAIT
        while self.tick() == first:
            if time.monotonic() > end:
                raise RuntimeError(f"no step was made in {WAIT:g} s")
            time.sleep(0.02)


@contextmanager
def visiting(url: str) -> Iterator[Client]:
    """Be a page of a server until the block is left."""
    origin = Origin(url.rstrip("/"))
    address = f"ws{origin.removeprefix('http')}/ws"
    with connect(address, origin=origin, compression=None, max_size=None, open_timeout=WAIT) as socket:
        yield Client(socket)


def race_parts(bench: Bench, which: World, scene: Scene, server: Server) -> None:
    """Measure the parts of a frame in turns, while the world of the server stands still."""
    room = Room([SceneLane(scene)])
    room.step(1)
    size, due = len(encode_frame(room)), 1 / (RATE * room.interval)
    with visiting(server.url) as client:
        client.send(type="play", on=False)
        parts = [
            Contestant("physics, a tick", lambda: room.history.advance(1), 1, note=f"{due:.2g} are due per frame"),
            Contestant("encoding a frame", lambda: encode_frame(room), 1, note=f"{size:,} bytes"),
            Contestant("a frame at a socket", client.frame, 1, note="asked for, encoded, sent, received"),
        ]
        bench.race(which.title, parts, baseline="encoding a frame")


WATCH = """seconds => new Promise(done => {
  const take = live.frame, began = performance.now(), pictures = drawn.count, tick = live.header.tick;
  let frames = 0, screen = 0, watched = true;
  const count = () => { if (watched) { screen++; requestAnimationFrame(count); } };
  requestAnimationFrame(count);
  live.frame = function (data) { frames++; return take.call(this, data); };
  setTimeout(() => {
    live.frame = take; watched = false;
    const passed = (performance.now() - began) / 1000;
    live.ask({ type: "measures" });
    setTimeout(() => done({
      frames_per_second: frames / passed, pictures_per_second: (drawn.count - pictures) / passed,
      screen_per_second: screen / passed,
      ticks_per_second: (live.header.tick - tick) / passed, drawing_ms: drawn.ms, round_trip_ms: live.timing.round,
      step_ms: live.timing.step, encoding_ms: live.timing.encode }), 500);
  }, 1000 * seconds);
})"""
"""Counts what the page shows for some seconds, and asks the server for its own times."""

MOVE = """([path, value]) => new Promise(done => {
  const take = live.frame, version = live.header.version, began = performance.now();
  let frames = 0;
  live.frame = function (data) {
    take.call(this, data); frames++;
    if (live.header.version === version && frames < 600) return;
    live.frame = take;
    done([frames, performance.now() - began]);
  };
  live.set(path, value);
})"""
"""Sets a value and counts the frames until one comes from a world that has it."""


def wait_for_page(page: Any, condition: str) -> None:
    """Return when an expression is true in a page; RuntimeError if that takes too long."""
    end = time.monotonic() + WAIT
    while not page.evaluate(condition):
        if time.monotonic() > end:
            raise RuntimeError(f"the page took longer than {WAIT:g} s until {condition}")
        time.sleep(0.1)


def watch_page(page: Any, which: World, value: float, seconds: float) -> dict[str, Any]:
    """Return what the page counts while the world plays, and the delays of a slider."""
    wait_for_page(page, "live.room !== null && live.header.tick !== undefined")
    page.evaluate("live.play(true)")
    wait_for_page(page, "live.header.playing && live.header.tick > 1")
    page.evaluate(WATCH, 2)  # warm
    counted: dict[str, Any] = page.evaluate(WATCH, seconds)
    moves = [page.evaluate(MOVE, [which.path, value * (1 + 0.001 * k)]) for k in range(1, MOVES + 1)]
    frames, delay = zip(*moves, strict=True)
    return {**counted, "slider_frames": quartiles(frames), "slider_ms": quartiles(delay)}


def browse(bench: Bench, which: World, scene: Scene, server: Server, seconds: float) -> None:
    """Measure the page in Chromium, or say why not."""
    import pytest

    value = float(scene.effects[int(which.path[8])].model_dump()[which.path.rsplit(".", 1)[1]])
    try:
        with browsing() as chromium:
            page = chromium.new_page(viewport={"width": 1280, "height": 800})
            page.set_default_timeout(1000 * WAIT)
            page.goto(server.url)
            found = watch_page(page, which, value, seconds)
    except pytest.skip.Exception as reason:
        bench.note(f"{which.title}: no page was measured: {reason}")
        return
    bench.extra.setdefault("pages", {})[which.title] = found
    bench.note(
        f"{which.title}, page of 1280 x 800: {found['frames_per_second']:.1f} frames and "
        f"{found['pictures_per_second']:.1f} pictures a second (the browser asks for "
        f"{found['screen_per_second']:.1f}), {found['ticks_per_second']:.1f} ticks a second; "
        f"drawing {found['drawing_ms']:.1f} ms; a slider acts within {found['slider_frames'][1]:g} frames (median of "
        f"{MOVES})"
    )


def scrub(bench: Bench, which: World, server: Server, minutes: float) -> None:
    """Play, go back and on at random, and record the memory of the server every second."""
    dice, series = random.Random(1), list[float]()  # noqa: S311  # no secret
    with visiting(server.url) as client:
        client.play_on()
        began = time.monotonic()
        while (passed := time.monotonic() - began) < 60 * minutes:
            due = time.monotonic() + 1
            while time.monotonic() < due:
                client.frame()
                time.sleep(1 / RATE)
            if len(series) % 5 == 4:
                client.send(type="seek", tick=dice.randrange(max(client.tick(), 1)))
                client.play_on()
            series.append(server.memory)
    early, late = (statistics.median(part) for part in (series[len(series) // 4 :][:60], series[-60:]))
    bench.extra.setdefault("memory", {})[which.title] = {"seconds": passed, "MB": series}
    bench.note(
        f"{which.title}: memory of the server over {passed / 60:.3g} minutes with {len(series) // 5} jumps in time: "
        f"{early:.0f} MB after a quarter, {late:.0f} MB at the end, at most {max(series):.0f} MB"
    )


def main(
    minutes: Annotated[float, typer.Option(min=0, help="Minutes of play with scrubbing, per world; 0: none.")] = 0.0,
    agents: Annotated[
        float, typer.Option(min=1e-4, max=1, help="Share of the agents, for a trial of this command.")
    ] = 1.0,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure the times of a frame, frames per second in a page, the delay of a slider, and memory."""
    with Bench("playground", quick, rounds, out, unit="per s", scale=1.0) as bench:
        for full in WORLDS:
            which = full._replace(agents=max(16, round(full.agents * agents)))
            scene = world(which)
            with playing_server(scene) as server:
                race_parts(bench, which, scene, server)
                browse(bench, which, scene, server, 3.0 if quick else 10.0)
                if minutes:
                    scrub(bench, which, server, minutes)


if __name__ == "__main__":
    command_line(main)()
