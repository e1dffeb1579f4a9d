"""Patches of numba while kernels compile: the machine code stays the same, and numba is restored afterwards."""

from __future__ import annotations

import gc
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from llvmlite.binding import get_host_cpu_features
from numba import config
from numba.core import event
from numba.core.compiler import run_frontend

from flockenv.jit.decorators import kernel, law
from flockenv.jit.intrinsics import unaliased
from flockenv.jit.numba_patches import front_end, lowering
from flockenv.jit.pipeline import Whole
from flockenv.jit.progress import unapplied_patches
from flockenv.maths.vectors import add, dot, scale

ROOT = Path(__file__).resolve().parent.parent
TRIED = "0.68.1"
"""The version of numba that the patches were tested with; configs/constraints.txt pins it in CI."""


def now() -> list[Any]:
    return [vars(trick.owner)[trick.name] for trick in front_end.PATCHES]


@pytest.mark.skipif(numba.__version__ != TRIED, reason="patches were tested with another version of numba")
def test_every_patch_applies_to_the_tested_version_of_numba() -> None:
    front_end._replacements.cache_clear()
    assert len(front_end._replacements()) == len(front_end.PATCHES)
    lowering.is_brief.cache_clear()
    assert lowering.is_brief()
    before = now()
    with front_end.apply_patches():
        assert all(new is not old for new, old in zip(now(), before, strict=True))


@pytest.fixture
def cleared_caches() -> Iterator[None]:
    """Clear the caches of the patches that apply, before and after a test."""
    caches = (front_end.is_known_source, front_end._replacements, lowering.is_brief)
    for function in caches:
        function.cache_clear()
    yield
    for function in caches:
        function.cache_clear()


def test_a_numba_with_other_source_code_is_not_patched(monkeypatch: pytest.MonkeyPatch, cleared_caches: None) -> None:
    monkeypatch.setattr(front_end, "digest", lambda owner, name: "")
    before = now()
    with front_end.apply_patches():
        assert all(new is old for new, old in zip(now(), before, strict=True))
    assert machine_code(Whole) == machine_code(None)
    assert len(unapplied_patches()) == len(front_end.PATCHES) + 1


def test_a_patch_for_other_source_code_is_named(monkeypatch: pytest.MonkeyPatch, cleared_caches: None) -> None:
    trick, digest = front_end.PATCHES[0], front_end.digest
    monkeypatch.setattr(
        front_end, "digest", lambda owner, name: "" if (owner, name) == trick.reads[0][:2] else digest(owner, name)
    )
    assert unapplied_patches() == (trick.title,)


def test_each_patch_has_its_own_title_and_other_names_are_refused(
    monkeypatch: pytest.MonkeyPatch, cleared_caches: None
) -> None:
    titles = [each.title for each in front_end.PATCHES]
    assert len(set(titles)) == len(titles)
    monkeypatch.setenv(front_end.LEFT_OUT, "lowring")
    with pytest.raises(ValueError, match=r"^FLOCKENV_NUMBA_ALONE: 'lowring': unknown, did you mean `lowering`"):
        front_end._replacements()


def test_the_page_leaves_out_patches_that_exist(monkeypatch: pytest.MonkeyPatch, cleared_caches: None) -> None:
    given = re.findall(rf"{front_end.LEFT_OUT}=([\w.,]+)", (ROOT / "docs" / "engine.md").read_text(encoding="utf-8"))
    assert len(given) == 2
    for value in given:
        monkeypatch.setenv(front_end.LEFT_OUT, value)
        front_end._replacements.cache_clear()
        front_end._replacements()


@pytest.mark.parametrize("left_out", ["all", "one"])
def test_an_environment_variable_leaves_patches_out(
    left_out: str, monkeypatch: pytest.MonkeyPatch, cleared_caches: None
) -> None:
    first, *others = (each.title for each in front_end.PATCHES)
    monkeypatch.setenv(front_end.LEFT_OUT, "all" if left_out == "all" else f"{first},lowering")
    assert len(front_end._replacements()) == (0 if left_out == "all" else len(others))
    assert not lowering.is_brief()
    assert machine_code(Whole) == machine_code(None)


def test_numba_is_restored_after_compilation_and_after_an_error() -> None:
    before = now()
    compiled: Any = numba.njit(pipeline_class=Whole)
    assert compiled(lambda x: x + 1)(2) == 3
    assert all(new is old for new, old in zip(now(), before, strict=True)) and gc.isenabled()
    with pytest.raises(numba.TypingError):
        compiled(lambda x: x + "1")(2)
    assert all(new is old for new, old in zip(now(), before, strict=True)) and gc.isenabled()
    gc.disable()
    try:
        compiled(lambda x: x + 2)(2)
        assert not gc.isenabled()  # it was off before
    finally:
        gc.enable()


@law
def _pull(p: Any, x: tuple[float, float], k: int) -> tuple[float, float]:
    far = dot(x, x)
    force = scale(x, p[0] if far > p[1] else -p[0])
    return add(force, x) if k % 2 == 0 else force


def sample(x: Any, numbers: Any, count: int) -> float:
    context = (x, numbers, count, (x[0], 1.5))
    total = (0.0, 0.0)
    for k in range(context[2]):
        p = (numbers[0], numbers[1], k)
        pulled = _pull(p, (context[0][k], x[k + 1]), k)
        total = add(total, pulled)
        if total[0] > 100.0:
            break
        x[k] = total[1] * context[3][1]
    return total[0] + total[1]


def machine_code(pipeline: Any) -> str:
    """Return the assembly of `sample`, without names that numba numbers and the sizes of texts that hold them."""
    given: Any = {} if pipeline is None else {"pipeline_class": pipeline}
    compiled: Any = numba.njit(error_model="numpy", fastmath={"contract"}, _nrt=False, **given)(sample)
    compiled.compile((numba.float64[::1], numba.float64[::1], numba.int64))
    text = next(iter(compiled.inspect_asm().values()))
    text = re.sub(r"_ZN\w+|[.\w$]*_ZN[^\s,()]+|\.L\w+|\d{10,}|v\d+", "#", text)
    return re.sub(r"(\.size\s+\".*#\", )\d+", r"\1#", text)


def test_the_machine_code_equals_that_of_numba_without_patches() -> None:
    assert machine_code(Whole) == machine_code(None)
    assert machine_code(Whole).count("\n") > 50


def test_variables_of_instructions_are_listed_in_the_order_of_numba() -> None:
    code = run_frontend(sample)
    lines = [line for block in code.blocks.values() for line in block.body]
    assert len(lines) > 50
    theirs = [[each.name for each in line.list_vars()] for line in lines]
    with front_end.apply_patches():
        assert [[each.name for each in line.list_vars()] for line in lines] == theirs


class Heard(event.Listener):
    """Listener that keeps the kinds of all events."""

    def __init__(self) -> None:
        self.kinds: list[tuple[str, bool]] = []

    def on_start(self, event: Any) -> None:
        """Keep the kind."""
        self.kinds.append((event.kind, True))

    def on_end(self, event: Any) -> None:
        """Keep the kind."""
        self.kinds.append((event.kind, False))


def heard_of(kind: str) -> list[tuple[str, bool]]:
    """Return the events of a kind while `sample` compiles."""
    heard = Heard()
    event.register(kind, heard)  # type: ignore[no-untyped-call]
    try:
        machine_code(Whole)
    finally:
        event.unregister(kind, heard)  # type: ignore[no-untyped-call]
    return heard.kinds


@pytest.mark.parametrize("kind", ["numba:run_pass", "numba:llvm_lock"])
def test_a_listener_hears_the_events_of_numba_alone(
    kind: str, monkeypatch: pytest.MonkeyPatch, cleared_caches: None
) -> None:
    machine_code(Whole)  # fills the caches of calls
    ours = heard_of(kind)
    monkeypatch.setenv(front_end.LEFT_OUT, "event.start_event,event.end_event")
    front_end._replacements.cache_clear()
    assert len(front_end._replacements()) == len(front_end.PATCHES) - 2
    assert heard_of(kind) == ours
    assert len(ours) > 50 and ours.count((kind, True)) == ours.count((kind, False))


def test_a_timer_of_a_user_measures_events_of_other_kinds_than_locks() -> None:
    timer = event.TimingListener()  # type: ignore[no-untyped-call]
    event.register("numba:run_pass", timer)  # type: ignore[no-untyped-call]
    try:
        machine_code(Whole)
    finally:
        event.unregister("numba:run_pass", timer)  # type: ignore[no-untyped-call]
    assert timer.done and timer.duration > 0.0


def test_without_a_listener_few_events_of_the_lock_of_llvm_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    class Noted(event.Event):
        def __init__(self, kind: str, *args: Any, **kwargs: Any) -> None:
            made.append(kind)
            super().__init__(kind, *args, **kwargs)  # type: ignore[no-untyped-call]

    monkeypatch.setattr(event, "Event", Noted)
    machine_code(None)
    theirs = made.count("numba:llvm_lock")
    made.clear()
    machine_code(Whole)
    assert made.count("numba:llvm_lock") < theirs / 4  # of what precedes and follows our own compilation


def doubled(x: Any) -> None:
    unaliased()
    for k in range(len(x)):
        x[k] = x[k] + x[k]


def test_an_entry_point_may_use_the_widest_registers() -> None:
    compiled: Any = numba.njit(pipeline_class=Whole, _nrt=False)(doubled)
    x = np.arange(100.0)
    compiled(x)
    np.testing.assert_array_equal(x, 2 * np.arange(100.0))
    text = next(iter(compiled.inspect_llvm().values()))
    assert '"prefer-vector-width"="512"' in text
    if not config.CPU_NAME and config.ENABLE_AVX and get_host_cpu_features().get("avx512f"):
        assert "zmm" in next(iter(compiled.inspect_asm().values()))


@kernel
def _item(x: Any, k: int) -> float:
    return x[k]  # type: ignore[no-any-return]


@kernel
def _part(pair: Any, k: int) -> Any:
    return pair[k]


def test_calls_with_different_literals_share_code() -> None:
    compiled: Any = numba.njit(lambda x: _item(x, 0) - _item(x, 1) + _item(x, len(x) - 1), pipeline_class=Whole)
    assert compiled(np.array([5.0, 2.0, 4.0])) == 7.0
    assert len(_item.signatures) == 1


def test_what_needs_a_literal_is_compiled_for_each() -> None:
    compiled: Any = numba.njit(lambda x: x[_part((1, x[0]), 0)] + _part((1, x[0]), 1), pipeline_class=Whole)
    assert compiled(np.array([5.0, 2.0, 4.0])) == 7.0
    assert len(_part.signatures) == 2


PARTS = """
from types import FunctionType
from flockenv.jit.sources import free_values; from flockenv.jit.decorators import python_of
from tests.catalogue import EFFECTS, scene_under

def dispatchers(part):
    if hasattr(part, "signatures"):
        yield part
    function = python_of(part)
    parts = free_values(function) if isinstance(function, FunctionType) else ()
    for inner in part if isinstance(part, tuple) else parts:
        yield from dispatchers(inner)

scene = scene_under(next(row for row in EFFECTS if row.effect.kind == "drag"), 2)
scene.step(scene.start(seed=1))
counts = {python_of(part).__name__: len(part.signatures) for part in set(dispatchers(scene.stepper.move))}
print(counts["respond"], [name for name, count in counts.items() if count > 1])
"""


def test_no_function_of_a_kernel_is_compiled_twice(tmp_path: Path) -> None:
    environment = {**os.environ, "FLOCKENV_CACHE": str(tmp_path)}
    run = subprocess.run([sys.executable, "-c", PARTS], capture_output=True, text=True, cwd=ROOT, env=environment)
    assert (run.returncode, run.stdout) == (0, "1 []\n"), run.stderr
