"""YAML: reading and writing scenes, round trips, and the messages about invalid files."""

from __future__ import annotations

import io
import json
import math
import os
import re
import warnings
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st
from pydantic import BaseModel, ConfigDict, Field

from flockenv.geometry.space import Box, Torus
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import EFFECTS, Drag
from flockenv.physics.integrators import INTEGRATORS, RK4
from flockenv.scene import Group, Scene
from flockenv.scene.presets import preset
from flockenv.scene.yaml_io import MAX_BYTES, ConfigError, dump, dump_scene, load, load_scene, schema
from flockenv.tasks import TASKS, Task

ROOT = Path(__file__).resolve().parent.parent
SCENES = sorted(p for p in (ROOT / "configs" / "scenes").glob("*.yaml"))

GOOD = """\
dimension: 2
space: {kind: torus, size: [10, 12.5]}
groups:
  - count: 5
effects:
  - {kind: drag, rate: 0.3}
  - kind: separation
    weight: 1.5
    radius: 3
dt: 0.01
"""


class Anything(BaseModel):
    """A record with fields of all plain types, some of which a scene does not have."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    number: float = 0.0
    count: int = 0
    text: str = ""
    switch: bool = False
    numbers: tuple[float, ...] = ()
    words: tuple[str, ...] = ()
    unlimited: float = math.inf
    maybe: Annotated[float, Field(ge=0)] | None = None


def refusal(text: str | Path, model: type[BaseModel] = Scene) -> str:
    with pytest.raises(ConfigError) as caught:
        load(text, model)
    return str(caught.value)


# --- reading ----------------------------------------------------------------------------------------------------------


def test_scene_is_read() -> None:
    scene = load_scene(GOOD)
    assert scene == Scene(
        space=Torus(size=(10, 12.5)),
        groups=(Group(count=5),),
        effects=(Drag(rate=0.3), EFFECTS["separation"](weight=1.5, radius=3)),  # type: ignore[call-arg]
        dt=0.01,
    )


@pytest.mark.parametrize("path", SCENES, ids=lambda p: p.stem)
def test_scenes_in_configs_survive_a_round_trip(path: Path) -> None:
    scene = load_scene(path)
    assert load_scene(dump_scene(scene)) == scene
    assert path.read_text().startswith("# yaml-language-server: $schema=../schema.json\n")


@pytest.mark.parametrize(
    ("written", "value"),
    [
        *[(word, 0.001) for word in ("0.001", "1e-3", "1E-3", "1.0e-3", ".001", "+1e-3", "0.1e-2")],
        *[(word, 1000.0) for word in ("1000", "1e3", "1e+3", "1.e3", "1_000", "1_000.0", "+1000")],
        *[(word, 0.0) for word in ("0", "-0", "0.0", "0e0", "00.0")],
        ("-.5", -0.5),
        ("1e-320", 1e-320),
    ],
)
def test_numbers_are_read_in_all_common_notations(written: str, value: float) -> None:
    assert load(f"number: {written}\n", Anything).number == value


@pytest.mark.parametrize(("written", "value"), [("1e3", 1000), ("1_000", 1000), ("1e22", 10**22), ("-7", -7)])
def test_integers_are_read_in_all_common_notations(written: str, value: int) -> None:
    assert load(f"count: {written}\n", Anything).count == value


@pytest.mark.parametrize(
    "word", ["yes", "no", "on", "off", "y", "N", "NO", "1:30", "0x1F", "2024-01-01", "1.2.3", "e5"]
)
def test_words_are_read_as_text(word: str) -> None:
    """YAML 1.1 reads these as booleans, sexagesimals, hexadecimals and dates."""
    assert load(f"text: {word}\n", Anything).text == word


@pytest.mark.parametrize(("word", "value"), [("true", True), ("True", True), ("false", False), ("FALSE", False)])
def test_booleans_are_read(word: str, value: bool) -> None:
    assert load(f"switch: {word}\n", Anything).switch is value


@pytest.mark.parametrize("word", ["", "~", "null", "Null"])
def test_null_is_read_as_none(word: str) -> None:
    assert load(f"maybe: {word}\nnumber: 1\n", Anything).maybe is None


def test_line_ends_and_byte_order_marks_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "windows.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    assert load_scene(path) == load_scene(GOOD) == load_scene(str(path))


# --- writing ----------------------------------------------------------------------------------------------------------


@given(
    record=st.builds(
        Anything,
        number=st.floats(allow_nan=False, allow_infinity=False),
        count=st.integers(-(10**30), 10**30),
        text=st.text(st.characters(codec="utf-8"), max_size=40),
        switch=st.booleans(),
        numbers=st.lists(st.floats(allow_nan=False, allow_infinity=False), max_size=4).map(tuple),
        words=st.lists(
            st.sampled_from(
                ["no", "1e3", "1_0", "010", ".nan", "~", "", "0x1", "null", "<<", "a: b", "#", "1:30", "True"]
            )
        ).map(tuple),
        maybe=st.none() | st.floats(0, allow_infinity=False),
    )
)
@example(record=Anything(number=5e-324, text="line\nbreak\ttab 'quote' \"quote\" ü 鳥"))
@example(record=Anything(text="\x85\u2028 \ufeff"))
def test_record_survives_a_round_trip(record: Anything) -> None:
    try:
        text = dump(record)
    except ConfigError as error:
        assert "cannot be written as YAML" in str(error)
        assert not record.text.isprintable()  # only control characters cannot be written
    else:
        again = load(text, Anything)
        assert again == record
        assert math.copysign(1, again.number) == math.copysign(1, record.number)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_brief_scene_omits_defaults_and_survives_a_round_trip(path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = load_scene(path)
        text = dump_scene(scene, brief=True)
        assert load_scene(text) == scene
    assert len(text) < len(dump_scene(scene))
    assert "null" not in text


@pytest.mark.parametrize("task", TASKS.values(), ids=TASKS)
def test_brief_task_survives_a_round_trip(task: type[Task]) -> None:
    """Also where a default depends on another value, such as the number of learners on that of agents."""
    for record in (task(), task(control_dt=0.2), task(**dict.fromkeys(task.counts[:1], 3))):
        assert load(dump(record, brief=True) + "\n", task) == record


def test_complete_presets_are_written_by_name() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        people = Group(count=2, mass=80.0, radius=0.3, desired_speed=1.0, spawn=Spawn(low=(0, 0), high=(9, 9)))
        model = preset("helbing_2000")
        whole = Scene(groups=(people,), effects=(Drag(rate=0.1), *model, Drag(rate=0.2)), dt=0.001)
        part = whole.with_effects(*model[1:])
        for scene, by_name in ((whole, True), (part, False)):
            text = dump_scene(scene, ["moussaid_2009", "helbing_2000"])
            assert load_scene(text) == scene
            assert ("preset: helbing_2000" in text) == by_name and ("circular_repulsion" in text) != by_name
    assert [next(iter(e.values())) for e in yaml.safe_load(dump_scene(whole, ["helbing_2000"]))["effects"]] == [
        "drag", "helbing_2000", "drag",
    ]  # fmt: skip


@given(
    dt=st.floats(1e-9, 10),
    rates=st.lists(st.just(0.0) | st.floats(1e-18, 0.03), max_size=3),  # stable at every dt here under every method
    count=st.integers(1, 10**6),
    max_speed=st.none() | st.floats(1e-18, 1e12),
    wall=st.floats(1, 1e4),  # float32 allows no larger spaces
    method=st.sampled_from(sorted(INTEGRATORS)),
)
def test_a_scene_reads_back_exactly(
    dt: float, rates: list[float], count: int, max_speed: float | None, wall: float, method: str
) -> None:
    scene = Scene(
        dimension=3,
        space=Box(size=(wall, wall, 7)),
        groups=(Group(count=count, max_speed=max_speed, spawn=Spawn(heading=(0, 0, -1))),),
        effects=tuple(Drag(rate=rate) for rate in rates),
        integrator=INTEGRATORS[method](),  # type: ignore[call-arg]
        dt=dt,
        dtype="float32",
    )
    again = load_scene(dump_scene(scene))
    assert again == scene
    assert repr(again) == repr(scene)


def test_infinite_default_is_omitted_and_other_infinities_are_refused() -> None:
    assert "unlimited" not in dump(Anything())
    with pytest.raises(
        ConfigError, match=r"^Anything cannot be written as YAML: its text reads back as another record$"
    ):
        dump(Anything(number=math.inf))


def test_other_yaml_readers_read_equal_numbers() -> None:
    """PyYAML's own loader (YAML 1.1) also reads the files that we write."""
    scene = Scene(space=Torus(size=(1e22, 1e16)), groups=(Group(count=3, mass=1e-7),), integrator=RK4(), dt=1e-5)
    assert yaml.safe_load(dump_scene(scene)) == json.loads(scene.model_dump_json())


# --- errors: one line with place, value, allowed values, nearest name -------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        (
            "radius: 3",
            "radus: 3.0",
            "text:9: effects[1].radus = 3.0: unknown key, did you mean `radius`? allowed here: ",
        ),
        ("dt: 0.01", "dtt: 0.01", "text:10: dtt = 0.01: unknown key, did you mean `dt`? allowed here: dimension, "),
        ("dt: 0.01", "wind: 3", "text:10: wind = 3: unknown key; allowed here: dimension, space, groups"),
        (
            "kind: separation",
            "kind: seperation",
            "text:7: effects[1].kind = 'seperation': unknown, did you mean `separation`?",
        ),
        ("kind: separation", "knd: separation", "text:7: effects[1].kind: missing; allowed: alignment, "),
        ("kind: torus", "kind: taurus", "text:2: space.kind = 'taurus': unknown, did you mean `torus`? allowed: box, "),
        (
            "dt: 0.01",
            "integrator: {kind: rk44}",
            "text:10: integrator.kind = 'rk44': unknown, did you mean `rk4`? allowed",
        ),
        ("dt: 0.01", "integrator: rk4", "text:10: integrator = 'rk4': must be a block with kind: "),
        (
            "dt: 0.01",
            "dtype: float46",
            "text:10: dtype = 'float46': unknown, did you mean `float64`? allowed: float64, ",
        ),
        ("dt: 0.01", "dt: 0", "text:10: dt = 0: must be a number > 0 (s, "),
        ("dt: 0.01", "dt: -.01", "text:10: dt = -0.01: must be a number > 0 (s, "),
        ("dt: 0.01", "dt: .nan", "text:10: dt: .nan is not a number that can be used: write a finite one"),
        ("dt: 0.01", "dt: -.INF", "text:10: dt: -.INF is not a number that can be used"),
        ("dt: 0.01", "dt: NaN", "text:10: dt = 'NaN': must be a number > 0, not text (s, "),
        ("dt: 0.01", "dt: '1e-3'", "text:10: dt = '1e-3': must be a number > 0, not text (s, "),
        ("dt: 0.01", "dt: true", "text:10: dt = True: must be a number > 0 (s, "),
        ("dt: 0.01", "dt: 1e999", "text:10: dt: '1e999' is too large or too long for a number"),
        ("dt: 0.01", "dt: 010", "text:10: dt: 010 begins with 0, which some read as octal: write 10"),
        ("dt: 0.01", "dt: [1]", "text:10: dt: must be a number > 0 (s, "),
        ("count: 5", "count: 0", "text:4: groups[0].count = 0: must be an integer >= 1 (number of agents)"),
        ("count: 5", "count: -1", "text:4: groups[0].count = -1: must be an integer >= 1 (number of agents)"),
        ("count: 5", "count: 2.5", "text:4: groups[0].count = 2.5: must be an integer >= 1 (number of agents)"),
        (
            "count: 5",
            "count: 5.0",
            "text:4: groups[0].count = 5.0: must be an integer >= 1: write 5 (number of agents)",
        ),
        (
            "count: 5",
            "count: ten",
            "text:4: groups[0].count = 'ten': must be an integer >= 1, not text (number of agents)",
        ),
        ("count: 5", "mass: 1", "text:4: groups[0]: count: give either a count or a network"),
        ("count: 5", "count: 5\n    mass: 0", "text:5: groups[0].mass = 0: must be a number > 0 (kg)"),
        ("count: 5", "count: 5\n    radius: -1", "text:5: groups[0].radius = -1: must be a number >= 0 (m)"),
        ("rate: 0.3", "rate: -1", "text:6: effects[0].rate = -1: must be a number >= 0 (c, kg/s"),
        ("12.5]", "0]", "text:2: space.size[1] = 0: must be a number > 0"),
        ("12.5]", "1, 2, 3]", "text:2: space.size: must be a list of 2 to 3, each a number > 0, not of 4 (m per axis)"),
        ("dimension: 2", "dimension: 4", "text:1: dimension = 4: unknown; allowed: 2, 3"),
        ("dt: 0.01", "dt: 1\ndt: 2", "text:11: dt: given twice, first on line 10"),
        ("rate: 0.3", "rate: 1, rate: 2", "text:6: effects[0].rate: given twice, first on line 6"),
        ("dt: 0.01", "dt: &x 1", "text:10: dt: anchors and aliases are not read: write the value out"),
        ("dt: 0.01", "dt: *x", "text:10: dt: anchors and aliases are not read: write the value out"),
        ("dt: 0.01", "<<: {dt: 1}", "text:10: '<<': merge keys (<<) are not read: write the values out"),
        ("dt: 0.01", "? [dt]\n: 1", "text:10: the document: a key must be a plain word"),
        ("dt: 0.01", "dt: !!float 1", "text:10: dt: the tag tag:yaml.org,2002:float is not read: write a plain value"),
        ("dt: 0.01", "dt: [1", "text:11: not YAML: "),
        ("dt: 0.01", "dt: 1\n---\ndt: 2", "text: holds more than one document (---)"),
        ("dt: 0.01", "\x1b[2J: 1", "text:10: not YAML text: "),
        ("dt: 0.01", '"\\e[2J": 1', "text:10: '\\x1b[2J' = 1: unknown key; allowed here: "),
        ("radius: 3", "radius: 30", "text:9: effects[1].radius = 30"),  # more than half the torus
        ("dimension: 2", "dimension: 3", "text:2: space.size = (10.0, 12.5)"),
    ],
)
def test_error_is_one_line_with_place_value_and_allowed_values(old: str, new: str, expected: str) -> None:
    message = refusal(GOOD.replace(old, new))
    assert message.startswith(expected)
    assert "\n" not in message


@pytest.mark.parametrize("effect", ["kind: pulsing_wind", "kind: steer, behaviours: [{kind: fly_by_night}]"])
def test_an_unknown_word_out_of_many_gets_the_five_nearest_and_not_all(effect: str) -> None:
    """The name of an own effect is near no kind, and all kinds are 1,000 characters."""
    message = refusal(GOOD.replace("effects:\n", f"effects:\n  - {{{effect}}}\n"))
    found = re.search(r"kind = '\w+': unknown; the nearest of (\d+): ((?:\w+, ){4}\w+)$", message)
    assert found is not None, message
    assert int(found[1]) > 30


def test_billion_agents_are_refused_with_an_estimate_of_memory() -> None:
    for count in ("1e9", "1000000000", "1e30"):
        message = refusal(GOOD.replace("count: 5", f"count: {count}"))
        assert message.startswith("text:3: groups: 1,000,000,000")
        assert "GiB" in message and "\n" not in message


def test_up_to_five_errors_are_listed_one_per_line() -> None:
    bad = GOOD.replace("dt: 0.01", "dt: 0").replace("count: 5", "count: 0")
    assert [line.split(" ")[0] for line in refusal(bad).splitlines()] == ["text:4:", "text:10:"]
    flood = GOOD + "".join(f"key{k}: 1\n" for k in range(9))
    assert [line.split(" ")[0] for line in refusal(flood).splitlines()] == [
        *(f"text:{k}:" for k in (11, 12, 13, 14, 15)),
        "text:",
    ]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("\n", "text: empty"),
        ("# nothing\n", "text: empty"),
        ("---\n", "text: empty, not a block of `key: value`"),
        ("- 1\n- 2\n", "text: a list or a word, not a block of `key: value`"),
        ("word\nword", "text: a list or a word, not a block of `key: value`"),
        ("a: " + "[" * 50 + "]" * 50, "text:1: nested more than 32 deep"),
        ("a: " + "[" * 900, "text:1: nested more than 32 deep"),
        (  # PyYAML 6.0.4 has a limit of 1,000 of its own
            "a: " + "[" * 100_000,
            ("text:1: nested more than 32 deep", "text:1: not YAML: exceeded maximum nesting depth"),
        ),
        ("a: " + "9" * 5000, "text:1: a: '9999"),
        ("a: \ud800", "text:1: not YAML text: surrogates not allowed"),
        ("a: \0", "text:1: not YAML text: "),
    ],
)
def test_text_without_keys_and_values_is_refused(text: str, expected: str | tuple[str, ...]) -> None:
    message = refusal(text)
    assert message.startswith(expected)
    assert "\n" not in message and len(message) < 300


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", ": empty"),
        (GOOD.encode("utf-16"), ": UTF-16 text; save it as UTF-8"),
        (GOOD.encode("utf-16-be"), ": binary data, not YAML text"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", ": binary data, not YAML text"),
        (b"text: \xfcber", ": not UTF-8 text: byte 6 is 0xfc"),
        (b"#" * (MAX_BYTES + 1), f": larger than {MAX_BYTES} bytes, the most that is read"),
    ],
)
def test_file_that_is_not_utf_8_text_is_refused(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "scene.yaml"
    path.write_bytes(content)
    assert refusal(path) == f"{path}{expected}"


def test_missing_file_is_refused_with_the_nearest_name(tmp_path: Path) -> None:
    (tmp_path / "boids.yaml").write_text(GOOD)
    missing = tmp_path / "biods.yaml"
    assert refusal(missing) == f"{missing}: no such file, did you mean `boids.yaml`?"
    assert refusal(tmp_path) == f"{tmp_path}: no such file (it is a folder)"
    assert refusal("/dev/zero") == "/dev/zero: no such file (it is a device)"
    assert refusal("a\0b") == "a\\x00b: no such file"
    assert refusal("a\nb.yaml", Anything).startswith("text: a list or a word")  # a line break: text, not a name
    assert refusal("x" * 300).endswith("x: cannot be read: File name too long")


def test_scene_is_read_from_a_pipe_or_standard_input(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(GOOD.encode())))
    assert load_scene("-") == load_scene(GOOD)
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(b"dt: fast")))
    assert refusal("-").startswith("standard input:")
    reading, writing = os.pipe()
    with os.fdopen(writing, "w") as pipe:
        pipe.write(GOOD)
    try:
        assert load_scene(Path(f"/dev/fd/{reading}")) == load_scene(GOOD)
    finally:
        os.close(reading)


@pytest.mark.parametrize(
    "tag",
    [
        "!!python/object/apply:os.mkdir [{}]",
        "!!python/name:os.mkdir {}",
        "!!python/object/new:os.mkdir [[{}]]",
        "!x {}",
    ],
)
@pytest.mark.parametrize("place", ["{}\n", "a: {}\n", "{}: 1\n", "a: [1, {}]\n"])
def test_yaml_tags_run_no_code(tmp_path: Path, tag: str, place: str) -> None:
    marker = tmp_path / "made"
    message = refusal(place.format(tag.format(marker)))
    assert "\n" not in message
    assert not marker.exists()


def test_nested_aliases_are_refused() -> None:
    bomb = "a: &a [x, x]\n" + "".join(f"{b}: &{b} [*{a}, *{a}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True))
    assert refusal(bomb) == "text:1: a: anchors and aliases are not read: write the value out"


@pytest.mark.parametrize(
    "text",
    [
        "\n".join(f"k{k}: 1" for k in range(20_000)),
        "a: [" + "1," * 50_000 + "]\n",
        "effects:\n" + "  - {kind: dra, rate: 1.5}\n" * 5_000,
        "a: " + "{a: " * 100_000,
        '"' + "\\u0041" * 100_000 + '": 1\n',
    ],
    ids=["keys", "numbers", "blocks", "depth", "escapes"],
)
def test_error_about_a_large_file_is_short(text: str) -> None:
    assert len(refusal(text)) < 2000


@given(
    st.text(st.characters(), max_size=60) | st.text("[]{}:,-&*!|>'\"%@`#? \n\t0123456789.eE_yntrualse~", max_size=60)
)
@example("a: 1_")
@example("a: _1")
@example("\t: -")
def test_any_text_is_read_or_refused_with_a_config_error(text: str) -> None:
    try:
        load(text + "\n", Anything)
    except ConfigError as error:
        assert all(line.isprintable() for line in str(error).splitlines())


def test_value_that_fits_no_member_of_a_union_is_one_error() -> None:
    class Wave(BaseModel):
        kind: Literal["wave"] = "wave"
        height: float

    class Choice(BaseModel):
        value: int | Wave | tuple[float, float]

    assert len(refusal("value: word\n", Choice).splitlines()) == 1


# --- the schema -------------------------------------------------------------------------------------------------------


def test_schema_in_configs_is_current() -> None:
    """To update the file: flockenv schema > configs/schema.json."""
    assert json.loads((ROOT / "configs" / "schema.json").read_text()) == schema()


def test_schema_contains_every_effect_and_integrator() -> None:
    text = json.dumps(schema())
    kinds: list[Any] = [*EFFECTS, *INTEGRATORS]
    assert all(f'"{kind}"' in text for kind in kinds)
