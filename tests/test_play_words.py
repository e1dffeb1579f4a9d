"""Controls and sentences of the playground: made of the records' own texts, and read back as the same records."""

from __future__ import annotations

import warnings
from collections import Counter
from pathlib import Path

import pytest
from pydantic import Field

from flockenv.core.errors import key_path, parse_key_path
from flockenv.physics.effects import EFFECTS, Effect
from flockenv.play.controls import controls_of, facts_of, titles_of, with_restarts
from flockenv.play.gallery import entries, read_entry
from flockenv.play.record_paths import value_at, with_value
from flockenv.play.scene_lane import SceneLane
from flockenv.play.sentences import read_words, scene_of, sentences_of, words_of
from flockenv.render.palette import PAPER, ROLE_COLOURS, rgb
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene
from flockenv.tasks import TASKS

ROOT = Path(__file__).resolve().parent.parent
SCENES = sorted((ROOT / "configs" / "scenes").glob("*.yaml"))

QUICK = ("boids", "fireworks", "rope_on_ball", "vortex")
"""Scenes that are quickly built again for each of their values."""


def scene_from(path: Path) -> Scene:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return load_scene(path)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_every_sentence_reads_back_as_its_record(path: Path) -> None:
    scene = scene_from(path)
    sentences = sentences_of(scene)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        again = scene_of((each.path, each.text) for each in sentences)
    assert again == scene
    assert sentences_of(again) == sentences


def test_sentences_are_english() -> None:
    sentences = {each.path: each for each in sentences_of(scene_from(ROOT / "configs" / "scenes" / "boids.yaml"))}
    assert sentences["effects[0]"].text == "Keep away from neighbours within 2 m, weight 1.5 N m."
    assert sentences["effects[1]"].text == (
        "Match the mean velocity of neighbours within 4 m, weight 0.6 kg/s, field of view 270 degrees."
    )
    assert sentences["groups[0]"].text.startswith("300 agents, radius 0.15 m, max speed 3 m/s, max force 4 N, ")
    assert sentences["effects[0]"].removable and not sentences["space"].removable


@pytest.mark.parametrize(
    "path",
    [pytest.param(path, marks=() if path.stem in QUICK else pytest.mark.slow) for path in SCENES],
    ids=lambda path: path.stem,
)
def test_every_value_in_a_sentence_is_a_value_of_the_scene(path: Path) -> None:
    scene = scene_from(path)
    values = [part for sentence in sentences_of(scene) for part in sentence.parts if part.path is not None]
    assert values
    for part in values:
        with_value(scene, str(part.path), value := value_at(scene, str(part.path)))
        number = isinstance(value, (int, float)) and not isinstance(value, bool)
        assert float(part.text) == value if number else part.text


def test_no_two_effects_begin_alike() -> None:
    beginnings = Counter(_beginning(effect) for effect in EFFECTS.values())
    assert [text for text, count in beginnings.items() if count > 1] == []


def _beginning(effect: type[Effect]) -> str:
    from flockenv.play.sentences import _template

    return _template(effect).lower()


def test_words_become_a_record() -> None:
    assert read_words("Keep away from neighbours within 3 m, weight 2.") == {
        "kind": "separation", "radius": 3, "weight": 2,
    }  # fmt: skip
    assert read_words("keep away from neighbours within 3, group 1, weight 2 N m, obstacles hide agents") == {
        "kind": "separation", "radius": 3, "group": 1, "weight": 2, "occluded": True,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Kep away from neighbours within 3 m", "no sentence begins like this"),
        ("Linear drag, rat 3", "names no value, did you mean `rate`"),
        ("Linear drag, rate 3 kg/s, rate 4 kg/s", "rate is given twice"),
        ("Linear drag, rate 3 kg/s and so on", "is not understood"),
        ("Linear drag, rate ", "names no value"),
        ("x" * 300_000, "characters"),
    ],
)
def test_words_that_mean_nothing_are_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message) as refused:
        read_words(text)
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 400


def test_an_effect_without_texts_of_its_own_has_a_sentence() -> None:
    class Twirl(Effect):
        """Turn around the axis with `speed`, F = s n: for this test."""

        kind: str = "twirl"
        speed: float = Field(gt=0, description="s, m/s, of the rim")
        left: bool = Field(default=False, description="True if it turns to the left")

    del EFFECTS["twirl"]
    words = "".join(
        f"{part.text} {part.unit}".strip(" ") if part.path else part.text for part in words_of(Twirl(speed=2))
    )
    assert words == "Turn around the axis with 2 m/s"
    assert read_words(f"{words}, it turns to the left.", [Twirl]) == {"kind": "twirl", "speed": 2, "left": True}


def test_units_and_ranges_come_from_the_fields() -> None:
    facts = {name: facts_of(EFFECTS[kind], name) for kind, name in (
        ("separation", "radius"), ("separation", "weight"), ("fluctuation", "strength"), ("attraction", "softening"),
        ("metabolism", "rate"), ("springs", "stiffness"), ("vicsek", "noise"),
    )}  # fmt: skip
    assert [facts[name].unit for name in ("radius", "softening", "rate", "stiffness")] == ["m", "m", "1/s", "N/m"]
    assert facts["strength"].unit == "N s^(1/2)"
    assert (facts["radius"].low, facts["radius"].above) == (0, True)


def test_controls_cover_a_scene_and_can_be_set() -> None:
    scene = scene_from(ROOT / "configs" / "scenes" / "boids.yaml")
    controls = {each.path: each for each in controls_of(scene)}
    weight = controls["effects[0].weight"]
    assert (weight.title, weight.unit, weight.kind, weight.value, weight.low) == ("weight", "N m", "number", 1.5, 0)
    assert controls["integrator"].kind == "variant" and "rk4" in controls["integrator"].choices
    assert controls["space.size[1]"].title == "size y" and controls["effects[0].occluded"].kind == "switch"
    assert controls["dtype"].choices == ("float64", "float32")
    for control in controls.values():
        if control.kind == "number" and control.value is not None:
            assert control.low is not None and control.high is not None and control.low < control.high
            assert control.low <= control.value <= control.high
            with_value(scene, control.path, control.value)


PURE = set(
    "aim anisotropy apart appetite arrival_reward attraction axis calm capacity capture_reward caught_cost cells "
    "collision_cost content coulomb counts death_cost direction error escape factor fear friction goal_reward haste "
    "heading hungry inertia jitter lasting level lost_cost meal need opacity opening out_reward poisson price ratio "
    "ready rest restitution school share spread start start_hunger stretch success_reward touch_cost weight "
    "winding strain yield_strain break_strain tolerance particles".split()
)
"""Fields whose values are ratios, factors, directions, counts, indices, amounts from 0 to 1, or rewards of events."""

VARYING = {("appearance", "over"), ("vortex", "strength"), ("vortex", "maximum"), ("source", "strength"),
           ("source", "maximum"), ("sink", "strength"), ("sink", "maximum"), ("avoid_obstacles", "strength"),
           ("wander", "strength"), ("forage", "strength"), ("pressure", "density"), ("viscosity", "density"),
           ("surface_tension", "density")}  # fmt: skip
"""Fields whose unit depends on another field or the dimension, and slopes."""

SMALL_WORDS = set("a an the of to from by in on at with within for and or as is are per between into".split())


@pytest.mark.parametrize("name", [entry.name for entry in entries()])
def test_every_value_has_a_noun_as_title_a_description_and_a_unit(name: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        record = read_entry(name)
    titles = titles_of(record)
    for title in titles.values():
        assert title and title.split()[-1].lower() not in SMALL_WORDS, title
    for control in controls_of(record):
        *above, field = parse_key_path(control.path)
        field, above = (field, above) if isinstance(field, str) else (above[-1], above[:-1])
        owner = key_path(tuple(above))
        assert owner in titles, control.path
        assert control.title and control.title.split()[-1].lower() not in SMALL_WORDS, control.path
        assert control.description not in ("", control.title), control.path
        if control.kind == "number" and not control.unit and field not in PURE:
            kind = getattr(value_at(record, owner), "kind", owner.split(".")[-1]) if owner else ""
            assert (kind, field) in VARYING, (control.path, control.description)


def test_titles_name_the_parts_of_a_world() -> None:
    titles = titles_of(scene_from(ROOT / "configs" / "scenes" / "fish.yaml"))
    assert titles["space"] == "space: box" and titles["groups[0].spawn"] == "group 1, spawn: uniform"
    assert titles["effects[7].behaviours[0]"] == "effect 8, behaviour 1: contain"


def test_a_scene_without_words_of_its_own_is_described_by_its_rules() -> None:
    from flockenv.play.gallery import _words

    assert _words("groups: [{count: 3, spawn: {low: [0, 0], high: [9, 9]}}]\neffects: [{kind: drag, rate: 2}]\n") == (
        "3 agents, spawn (placed at random from (0, 0) m to (9, 9) m). Linear drag, rate 2 kg/s."
    )


def test_controls_of_tasks_have_units() -> None:
    for task in TASKS.values():
        controls = {each.path: each for each in controls_of(task())}
        assert controls["control_dt"].unit == "s" and controls["horizon"].kind == "integer"


def test_controls_say_what_begins_the_world_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if a scene was open before in which no other value of a field could be tried: speeds from 0 to 0."""
    monkeypatch.setattr("flockenv.play.controls._known", {})
    still = SceneLane(load_scene("groups: [{count: 3, spawn: {low: [0, 0], high: [9, 9]}}]\n"))
    assert {each.path: each for each in with_restarts(controls_of(still.record), still)}[
        "groups[0].spawn.speed[0]"
    ].restarts is None
    lane = SceneLane(scene_from(ROOT / "configs" / "scenes" / "boids.yaml"))
    controls = {each.path: each for each in with_restarts(controls_of(lane.record), lane)}
    assert controls["groups[0].count"].restarts and controls["groups[0].spawn.speed[0]"].restarts
    assert controls["effects[0].weight"].restarts is False and controls["groups[0].max_speed"].restarts is False


def _luminance(colour: str) -> float:
    """Return the relative luminance of a colour (WCAG 2.2)."""
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (each / 255 for each in rgb(colour))]
    return sum(weight * c for weight, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


@pytest.mark.parametrize("theme", [0, 1])
@pytest.mark.parametrize("ground", ["page", "paper"])
def test_words_of_the_page_have_the_contrast_of_wcag_aa(ground: str, theme: int) -> None:
    behind = _luminance(PAPER[ground][theme])
    for name, pair in {**{part: PAPER[part] for part in ("ink", "faint")}, "accent": ROLE_COLOURS["evader"]}.items():
        low, high = sorted((behind, _luminance(pair[theme])))
        assert (high + 0.05) / (low + 0.05) >= 4.5, name
