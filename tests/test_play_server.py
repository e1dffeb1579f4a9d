"""The server of the playground: what it serves, to which clients, and what it does with messages that no page sends."""

from __future__ import annotations

import base64
import hashlib
import http.client
import json
import logging
import random
import re
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest

websockets = pytest.importorskip("websockets", reason="needs the extra `play`: pip install 'flockenv[play]'")
from websockets.exceptions import ConnectionClosed, InvalidStatus  # noqa: E402
from websockets.sync.client import ClientConnection, connect  # noqa: E402

from flockenv.cli.main import main  # noqa: E402
from flockenv.jit.lock import require_cached  # noqa: E402
from flockenv.model.group import Group  # noqa: E402
from flockenv.model.spawn import Spawn  # noqa: E402
from flockenv.play import fields, messages  # noqa: E402
from flockenv.play.frames import decode_frame  # noqa: E402
from flockenv.play.server import PlayServer  # noqa: E402
from flockenv.play.session import Session  # noqa: E402
from flockenv.scene import Scene  # noqa: E402
from tests.playground import serving  # noqa: E402

HELLO = {"type": "hello", "version": messages.VERSION}


def still_scene(count: int = 3) -> Scene:
    """Return a scene that is never stepped here, so that no kernel is compiled."""
    return Scene(groups=(Group(count=count, radius=0.3, spawn=Spawn(low=(0, 0), high=(9, 9))),), effects=())


@pytest.fixture
def session() -> Session:
    made = Session()
    made.open_scene(still_scene(), "three")
    made.pause()
    return made


@pytest.fixture
def server(session: Session) -> Iterator[PlayServer]:
    with serving(session) as running:
        yield running


def page_of(server: PlayServer, origin: str | None = None, query: str = "", host: str = "") -> ClientConnection:
    where = f"127.0.0.1:{server.port}"
    headers = {"Host": host} if host else None
    return connect(
        f"ws://{where}/ws{query}", origin=origin or f"http://{where}", compression=None, additional_headers=headers
    )


def get(server: PlayServer, path: str = "/", **headers: str) -> http.client.HTTPResponse:
    link = http.client.HTTPConnection("127.0.0.1", server.port, timeout=30)
    link.request("GET", path, headers=headers)
    answer = link.getresponse()
    answer.content = answer.read()  # type: ignore[attr-defined]
    link.close()
    return answer


def ask(page: ClientConnection, message: dict[str, Any], kind: str | None = None) -> Any:
    """Send a message and return the first answer of a kind; frames are bytes, of kind None."""
    page.send(json.dumps(message))
    while True:
        answer = page.recv(60)
        if isinstance(answer, bytes) and kind is None:
            return answer
        if isinstance(answer, str) and (data := json.loads(answer))["type"] == kind:
            return data


def close_code(page: ClientConnection) -> int | None:
    """Read until the server closes the connection; return its code."""
    with suppress(ConnectionClosed):
        while True:
            page.recv(60)
    return page.close_code


def test_the_page_runs_its_own_script_only(server: PlayServer) -> None:
    answer = get(server)
    text, policy = answer.content.decode(), answer.headers["Content-Security-Policy"]  # type: ignore[attr-defined]
    assert answer.status == 200
    assert policy.startswith("default-src 'none';") and "unsafe" not in policy and "frame-ancestors 'none'" in policy
    for tag in ("script", "style"):
        (inside,) = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy and f"{tag}-src 'sha256-{digest}'" in text
    assert "innerHTML" not in text and "eval(" not in text and not re.search(r"https?://|@import", text)


@pytest.mark.parametrize(
    "path",
    ["/etc/passwd", "/../pyproject.toml", "/pictures/../server.py", "/pictures/x.png", "/ws/", "/%2e%2e/x"],
)
def test_nothing_but_the_page_and_its_pictures_is_served(server: PlayServer, path: str) -> None:
    answer = get(server, path)
    assert (answer.status, answer.content) == (404, b"not found\n")  # type: ignore[attr-defined]


@pytest.mark.parametrize("host", ["evil.example", "evil.example:{port}", "127.0.0.1", "127.0.0.1:1", "localhost.evil"])
def test_a_foreign_host_gets_nothing(server: PlayServer, host: str, caplog: pytest.LogCaptureFixture) -> None:
    """A name that an attacker's DNS server points to this machine does not open the page."""
    host = host.format(port=server.port)
    assert get(server, Host=host).status == 403
    with pytest.raises(InvalidStatus) as refused:
        page_of(server, host=host)
    assert refused.value.response.status_code == 403
    assert len(caplog.records) == 2 and all(host in record.getMessage() for record in caplog.records)


@pytest.mark.parametrize("origin", ["http://evil.example", "https://127.0.0.1:{port}", "null", "http://127.0.0.1:1"])
def test_a_foreign_origin_gets_nothing(server: PlayServer, origin: str, caplog: pytest.LogCaptureFixture) -> None:
    origin = origin.format(port=server.port)
    assert get(server, Origin=origin).status == 403
    with pytest.raises(InvalidStatus) as refused:
        page_of(server, origin)
    assert refused.value.response.status_code == 403
    assert len(caplog.records) == 2


def test_names_of_the_loopback_are_no_foreign_hosts(server: PlayServer) -> None:
    for name in ("localhost", "127.0.0.1"):
        here = f"{name}:{server.port}"
        assert get(server, Host=here, Origin=f"http://{here}").status == 200


def test_a_server_at_an_address_needs_its_token(session: Session) -> None:
    with serving(session, "127.0.0.1") as server:
        assert len(server.token) >= 32 and server.url.endswith(f"/?token={server.token}")
        assert get(server).status == get(server, "/?token=wrong").status == 403
        assert get(server, f"/?token={server.token}").status == 200
        with pytest.raises(InvalidStatus):
            page_of(server)
        with page_of(server, query=f"?token={server.token}") as page:
            assert ask(page, HELLO, "welcome")["open"] is True


def test_a_page_sees_the_world_and_changes_it(server: PlayServer, session: Session) -> None:
    assert session.room is not None
    lane = session.room.lanes[0]
    with page_of(server) as page, page_of(server) as other:
        room = ask(page, HELLO, "room")
        assert (room["title"], room["lanes"][0]["roles"]) == ("three", [["agent", 3]])
        assert any(control["path"] == "groups[0].radius" for control in room["controls"])
        ask(other, HELLO, "welcome")
        page.send(json.dumps({"type": "edit", "edit": {"kind": "move_agent", "agent": 1, "pos": [2.0, 3.0]}}))
        header, (blocks,) = decode_frame(ask(page, {"type": "frame"}))
        low, high = (np_of(header["lanes"][0][name]) for name in ("low", "high"))
        shown = low - 0.5 * (high - low) + blocks["pos"][:, 1] / 65535 * 2 * (high - low)
        assert shown == pytest.approx([2.0, 3.0], abs=1e-3)
        assert lane.drawn.pos[:, 1].tolist() == [2.0, 3.0]
        wider = {"kind": "set", "path": "groups[0].radius", "value": 0.5}
        assert ask(page, {"type": "edit", "edit": wider}, "room")["lanes"][0]["radius"] == [[0.5, 3]]
        assert ask(other, {"type": "play", "on": False}, "room")["lanes"][0]["radius"] == [[0.5, 3]]


def test_frames_go_on_while_an_edit_is_compiled(
    server: PlayServer, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Messages are answered in order, unless one before them takes long; then that page gets a line about it."""
    assert session.room is not None
    compiled, lane = threading.Event(), session.room.lanes[0]
    monkeypatch.setattr(session.room, "prepare", lambda edit: edit.kind != "set" or compiled.wait(60))
    with page_of(server) as page:
        ask(page, HELLO, "room")
        for value in (0.4, 0.6, 0.7):
            wider = {"kind": "set", "path": "groups[0].radius", "value": value}
            page.send(json.dumps({"type": "edit", "edit": wider}))
        moved = {"kind": "move_agent", "agent": 1, "pos": [2.0, 3.0]}
        page.send(json.dumps({"type": "edit", "edit": moved}))
        assert isinstance(ask(page, {"type": "frame"}), bytes)
        assert lane.drawn.pos[:, 1].tolist() == [2.0, 3.0] and lane.record.groups[0].radius == 0.3
        assert ask(page, {"type": "frame"}, "notice")["busy"] is True
        compiled.set()
        assert ask(page, {"type": "frame"}, "notice")["text"] == ""
        wait_for(lambda: lane.record.groups[0].radius == 0.7)
    assert [made.edit.kind for made in session.room.made].count("set") < 3  # the value between was never set


def test_a_world_is_compiled_beside_its_frames(
    server: PlayServer, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiled, steps = threading.Event(), list[float]()
    assert session.room is not None
    monkeypatch.setattr(session.room, "compile", lambda: compiled.wait(60))
    monkeypatch.setattr(session.room, "advance", lambda: steps.append(0.0))
    with page_of(server) as page:
        ask(page, HELLO, "room")
        page.send(json.dumps({"type": "play", "on": True}))
        assert ask(page, {"type": "frame"}, "notice")["busy"] is True
        page.send(json.dumps({"type": "step", "n": 1}))  # it waits too
        assert isinstance(ask(page, {"type": "frame"}), bytes) and not steps
        compiled.set()
        wait_for(lambda: len(steps) > 0)


def test_frames_and_edits_go_on_while_costs_are_measured(
    server: PlayServer, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    measured = threading.Event()
    assert session.room is not None
    lane = session.room.lanes[0]

    def measure() -> list[Any]:
        return [{"type": "costs", "rows": [], "in time": measured.wait(10)}]

    monkeypatch.setitem(session._long, messages.Costs, lambda message: lambda: measure)
    with page_of(server) as page:
        ask(page, HELLO, "room")
        page.send(json.dumps({"type": "costs"}))
        page.send(json.dumps({"type": "edit", "edit": {"kind": "set", "path": "groups[0].radius", "value": 0.4}}))
        assert isinstance(ask(page, {"type": "frame"}), bytes)
        wait_for(lambda: lane.record.groups[0].radius == 0.4)
        measured.set()
        assert ask(page, {"type": "frame"}, "costs")["in time"] is True


def test_frames_go_on_without_colours_whose_kernel_is_compiled(
    server: PlayServer, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other pages do not wait for it, and the colours come when it is there."""
    compiled = threading.Event()
    original, prepare = fields.colour_of, session.prepare

    def needs(lane: Any, name: str) -> fields.Coloured:
        require_cached("a kernel" if compiled.is_set() else None)
        return original(lane, "speed")

    monkeypatch.setattr("flockenv.play.frames.colour_of", needs)

    def waits(message: Any) -> Any:
        return compiled.wait(60) if message.type == "frame" else prepare(message)

    monkeypatch.setattr(session, "prepare", waits)
    want = {"type": "frame", "want": {"colour": "acceleration"}}

    def colours(frame: bytes) -> bool:
        return "colour" in decode_frame(frame)[0]["lanes"][0]

    with page_of(server) as page, page_of(server) as other:
        for each in (page, other):
            ask(each, HELLO, "room")
        assert not colours(ask(page, want))
        other.send(json.dumps({"type": "edit", "edit": {"kind": "move_agent", "agent": 1, "pos": [2.0, 3.0]}}))
        assert isinstance(ask(other, {"type": "frame"}), bytes)
        assert session.room is not None and session.room.lanes[0].drawn.pos[:, 1].tolist() == [2.0, 3.0]
        assert ask(page, want, "notice")["busy"] is True
        assert not colours(ask(page, want))
        compiled.set()
        assert ask(page, want, "notice")["text"] == ""
        wait_for(lambda: colours(ask(page, want)))


def np_of(numbers: list[float]) -> Any:
    import numpy as np

    return np.array(numbers)


def test_a_refused_edit_is_answered_in_one_line(server: PlayServer) -> None:
    with page_of(server) as page:
        ask(page, HELLO, "room")
        wrong = {"kind": "set", "path": "groups[0].radius", "value": -1.0}
        error = ask(page, {"type": "edit", "edit": wrong}, "error")
        assert "radius" in error["text"] and "\n" not in error["text"] and error["about"] == "edit"
        assert isinstance(ask(page, {"type": "frame"}), bytes)  # the connection goes on


def test_the_text_of_a_scene_is_never_the_name_of_a_file(server: PlayServer) -> None:
    with page_of(server) as page:
        ask(page, HELLO, "room")
        for text in ("pyproject.toml", "/etc/passwd", "-"):
            error = ask(page, {"type": "load", "yaml": text}, "error")["text"]
            assert "root:" not in error and "setuptools" not in error


def test_the_last_page_that_goes_stops_time(server: PlayServer, session: Session) -> None:
    assert session.room is not None
    session.room.set_speed(0.1)
    with page_of(server) as page:
        ask(page, HELLO, "room")
        session.room.playing = True
    with page_of(server) as page:  # the first one is gone by now, as closing waits for the server
        for _ in range(50):
            if not session.room.playing:
                break
            ask(page, HELLO, "welcome")
        assert not session.room.playing


# ---- messages that no page sends


def fuzzed(dice: random.Random) -> str | bytes:
    """Return a message that breaks the protocol."""
    right = json.dumps(dice.choice([HELLO, {"type": "seek", "tick": 3}, {"type": "edit", "edit": {"kind": "set"}}]))
    made: list[Callable[[], str | bytes]] = [
        lambda: dice.randbytes(dice.randint(0, 400)),
        lambda: right[: dice.randint(0, len(right) - 1)],
        lambda: "".join(chr(dice.randint(32, 0x2FFF)) for _ in range(dice.randint(0, 300))),
        lambda: json.dumps({"type": dice.choice([*messages.MESSAGES, "exec", "__class__", ""]), "x\u2028": [1] * 9}),
        lambda: json.dumps({"type": "seek", "tick": dice.choice([-1, 1e300, "1", None, [], 2**70, True])}),
        lambda: json.dumps({"type": "speed", "x": dice.choice([-1, 0, 1e9, "fast", {}])}),
        lambda: '{"type": "speed", "x": NaN}',
        lambda: '{"type": "edit", "edit": ' + "[" * 20_000 + "]" * 20_000 + "}",
        lambda: json.dumps({"type": "edit", "edit": {"kind": [], "path": "groups[0].radius", "value": 2}}),
        lambda: json.dumps({"type": "open", "what": "../" * dice.randint(70, 99)}),
        lambda: json.dumps({"type": "load", "yaml": "x" * 60_001}),
        lambda: json.dumps([HELLO]),
    ]
    return dice.choice(made)()


def send_fuzz(server: PlayServer, dice: random.Random) -> None:
    """Send a message that breaks the protocol, mostly after a right one."""
    with page_of(server) as page:
        if dice.random() < 0.7:
            page.send(json.dumps(HELLO))
        page.send(message := fuzzed(dice))
        assert close_code(page) == 1008, message[:80]


def send_too_early(server: PlayServer, dice: random.Random) -> None:
    """Send a right message before the first one that is due."""
    early = [{"type": "step", "n": 5}, {"type": "seed", "seed": 9}, {"type": "edit", "edit": {"kind": "set"}}]
    with page_of(server) as page:
        page.send(json.dumps(dice.choice(early)))
        assert close_code(page) == 1008


def send_huge(server: PlayServer, dice: random.Random) -> None:
    """Send a message, text or binary, above the limit."""
    size = messages.LARGEST + dice.randint(1, 200_000)
    with page_of(server) as page:
        page.send(dice.choice(["x" * size, b"x" * size]))
        assert close_code(page) == 1009


def come_from_elsewhere(server: PlayServer, dice: random.Random) -> None:
    """Open a socket with a foreign Origin or Host, as a page of another site would."""
    here = f"127.0.0.1:{server.port}"
    origin, host = dice.choice([("http://evil.example", ""), ("null", ""), (f"http://{here}", "evil.example")])
    with pytest.raises(InvalidStatus) as refused:
        page_of(server, origin, host=host)
    assert refused.value.response.status_code == 403


ATTACKS = [send_fuzz] * 7 + [send_too_early, send_huge, come_from_elsewhere]


@pytest.mark.parametrize("count", [30, pytest.param(1000, marks=pytest.mark.slow)])
def test_hostile_messages_end_their_connection_and_nothing_else(
    server: PlayServer, session: Session, count: int, caplog: pytest.LogCaptureFixture
) -> None:
    assert session.room is not None
    dice = random.Random(1)  # noqa: S311  # the same messages every time
    before = (session.room.digests, session.version, session.room.tick)
    for k in range(count):
        caplog.clear()
        attack = ATTACKS[k % len(ATTACKS)]
        attack(server, dice)
        wait_for(lambda: len(caplog.records) > 0)
        assert [record.levelname for record in caplog.records] == ["WARNING"], (k, attack.__name__)
        assert "\n" not in caplog.records[0].getMessage()
    assert (session.room.digests, session.version, session.room.tick) == before
    with page_of(server) as page:
        ask(page, HELLO, "welcome")
        assert isinstance(ask(page, {"type": "frame"}), bytes)


def test_too_many_messages_end_their_connection(
    server: PlayServer, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("flockenv.play.visit.RATE", 1.0)  # a busy machine may be slower than the usual bound
    with page_of(server) as page:
        ask(page, HELLO, "room")
        with suppress(ConnectionClosed):
            for _ in range(200):
                page.send('{"type": "play", "on": false}')
        assert close_code(page) == 1008
    wait_for(lambda: len(caplog.records) == 1)
    assert "messages a second" in caplog.records[0].getMessage()


def wait_for(test: Callable[[], bool]) -> None:
    """Return when something is true; fail after ten seconds."""
    for _ in range(200):
        if test():
            return
        threading.Event().wait(0.05)
    assert test()


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("[]", "message: must be an object with a type"),
        ("nonsense", "message 'nonsense': must be JSON"),
        ('{"type": "sek", "tick": 1}', "message.type = 'sek': unknown.*`?seek"),
        ('{"type": "seek", "tick": 1.5}', "seek.tick"),
        ('{"type": "seek", "tick": 1, "more": 2}', "seek.more"),
        ('{"type": "step", "n": 5000}', "step.n"),
        (b"\x00\x01", "message: must be text, got bytes"),
    ],
)
def test_a_message_is_refused_in_one_line(text: str | bytes, line: str) -> None:
    with pytest.raises(ValueError, match=line) as caught:
        messages.read_message(text)
    assert "\n" not in str(caught.value)


def test_messages_are_read() -> None:
    assert messages.read_message('{"type": "seek", "tick": 7}') == messages.Seek(tick=7)
    want = messages.read_message('{"type": "frame", "want": {"colour": "speed", "scenery": [1, -1]}}')
    assert isinstance(want, messages.Frame) and want.want.scenery == (1, -1)


@pytest.fixture(autouse=True)
def _log_level(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING, "flockenv.play")


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--port", "{taken}"), "--port = {taken}: "), (("--host", "no.such.host.invalid", "--port", "0"), "--host = "),
        (("pursuitt",), "no such task, did you mean `pursuit`"), (("--players", "ppo"), "--players: needs a task"),
        (("pursuit", "--players", "rulez"), "did you mean `rules`"),
    ],
)  # fmt: skip
def test_the_command_refuses_in_one_line(
    arguments: tuple[str, ...], line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        taken = other.getsockname()[1]
        assert main(["play", "--no-browser", *(each.format(taken=taken) for each in arguments)]) == 2
    shown = capsys.readouterr()
    assert line.format(taken=taken) in shown.err and shown.err.count("\n") == 1 and not shown.out
