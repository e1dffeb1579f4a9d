"""Records are values: a changed copy is derived and checked again, and a plain copy is the record itself."""

from __future__ import annotations

import copy
import pickle

import pytest

from flockenv.behaviours import Separation
from flockenv.geometry.space import Box
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Drag
from flockenv.scene import Group, Scene
from flockenv.tasks import Pursuit

SCENE = Scene(space=Box(size=(10, 10)), groups=(Group(count=3),), effects=(Drag(rate=0.5),))


def test_a_changed_copy_recomputes_derived_values() -> None:
    assert len(SCENE.parts.effects) == 1  # cached on the original
    other = SCENE.with_effects(Drag(rate=0.5), Separation(weight=1, radius=1))
    assert len(other.parts.effects) == 2
    assert len(other.parts.parameters()) > len(SCENE.parts.parameters())


def test_a_changed_copy_is_checked_like_a_new_one() -> None:
    with pytest.raises(ValueError, match=r"dt = -1"):
        SCENE.model_copy(update={"dt": -1})


@pytest.mark.slow
def test_copies_are_the_record_itself() -> None:
    SCENE.step(SCENE.start(0))
    assert copy.copy(SCENE) is SCENE
    assert copy.deepcopy(SCENE) is SCENE


def test_pickles_hold_only_fields_and_compare_equal() -> None:
    SCENE.step(SCENE.start(0))
    again = pickle.loads(pickle.dumps(SCENE))
    assert again == SCENE
    assert hash(again) == hash(SCENE)
    assert "stepper" in vars(SCENE)
    assert not {"stepper", "view"} & vars(again).keys()


@pytest.mark.parametrize(("call", "line"), [
    (lambda: Drag(rate=-1), "Drag: rate = -1"),
    (lambda: Drag(rat=1), "did you mean `rate`"),
    (lambda: Pursuit(pursuer=2), "did you mean `pursuers`"),
    (lambda: Pursuit(control_dt=0.1, dt=0.03), "whole multiple"),
    (lambda: Scene(groups=(Group(count=10**9),), space=Box(size=(1, 1))), "GiB"),
])  # fmt: skip
def test_errors_are_one_line_with_the_field_or_a_suggestion(call, line) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=r".") as caught:
        call()
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_scenes_that_have_run_can_be_compared() -> None:
    """Derived values, which include arrays, are cached in the record and do not affect equality."""
    group = Group(count=3, spawn=Spawn(low=(0, 0), high=(1, 1)))
    one, other = (Scene(groups=(group,), effects=(Drag(rate=0.5),), dt=0.1) for _ in range(2))
    for scene in (one, other):
        scene.step(scene.start(0))
    assert one == other
    assert hash(one) == hash(other)
    assert one != other.model_copy(update={"dt": 0.2})
    assert one != 1
