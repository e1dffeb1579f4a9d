"""Processor: results do not depend on the register width, and machine code is made for the processor's features."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
from llvmlite import binding

from flockenv.behaviours import Alignment, Cohesion, Separation
from flockenv.envs.world import World
from flockenv.geometry.space import Plane, Torus
from flockenv.jit import cpu, pipeline
from flockenv.jit.decorators import kernel
from flockenv.jit.intrinsics import unaliased
from flockenv.jit.pipeline import Whole
from flockenv.model.group import Group
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Effect, Gravitation
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load_scene
from flockenv.tasks import TASKS, Task
from flockenv.tasks.observations import ray_directions, shorten_free_paths
from tests.catalogue import everything

ROOT = Path(__file__).parent.parent
CONFIGS = ROOT / "configs" / "scenes"


def flock(agents: int, dtype: str, **sight: Any) -> Scene:
    rules = (Separation(weight=1.5, radius=1, **sight), Alignment(weight=1, radius=2), Cohesion(weight=1, radius=2))
    edge = float(np.sqrt(agents))
    return Scene(
        dimension=2, space=Torus(size=(edge, edge)), effects=rules, dt=0.05, dtype=dtype,
        groups=(Group(count=agents, max_speed=3.0, max_force=4.0, spawn=Spawn(speed=(1.0, 2.0))),),
    )  # fmt: skip


def heavy(agents: int, *more: Effect) -> Scene:
    """Return a scene of mutual gravitation; far agents act in groups, which must not depend on the register width."""
    return Scene(
        dimension=2, space=Plane(), effects=(Gravitation(constant=1, softening=0.1, opening=0.5), *more), dt=0.01,
        groups=(Group(count=agents, spawn=Spawn(low=(0, 0), high=(30, 30))),),
    )  # fmt: skip


def stepped(scene: Scene, steps: int) -> dict[str, Any]:
    after = scene.step(scene.start(seed=3), steps=steps)
    return {"x": after.x, "v": after.v, "alive": after.alive}


def played(task: Task, decisions: int = 12) -> dict[str, Any]:
    world = World(task, 3)
    world.reset(0)
    rng = np.random.default_rng(0)
    steps = [world.step(rng.uniform(-1, 1, (3, world.learners, world.action_size))) for _ in range(decisions)]
    seen = {name: np.stack([getattr(step, name) for step in steps]) for name in ("observation", "reward", "terms")}
    return {**seen, "x": world.state.x, "v": world.state.v}


CASES: dict[str, Callable[[], dict[str, Any]]] = {
    "few": lambda: stepped(flock(37, "float32", fov=270), 7),
    "many, reordered in memory": lambda: stepped(flock(20_003, "float32", nearest=4), 3),
    "far groups and neighbours": lambda: stepped(heavy(3000, Separation(weight=1, radius=0.5)), 2),
    "all forms": lambda: stepped(everything(3), 7),
    "cloth.yaml": lambda: stepped(load_scene(CONFIGS / "cloth.yaml"), 5),
    "task bottleneck": lambda: played(TASKS["bottleneck"]()),
}


def write(folder: str) -> None:
    """Run all cases and save their results; called in a process of its own."""
    for case, play in CASES.items():
        np.savez(Path(folder) / f"{case}.npz", **play(), register=cpu.REGISTER)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return the results of a process for registers of 64 bytes, and of another for those of 32 bytes."""
    found = tmp_path_factory.mktemp("wide"), tmp_path_factory.mktemp("narrow")
    for folder, size in zip(found, ("64", "32"), strict=True):
        program = f"from tests.test_cpu import write; write({str(folder)!r})"
        environment = {**os.environ, "FLOCKENV_REGISTER": size}
        done = subprocess.run(
            [sys.executable, "-W", "ignore", "-c", program], env=environment, cwd=ROOT, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
    return found


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_results_are_equal_in_registers_of_64_and_32_bytes(case: str, folders: tuple[Path, Path]) -> None:
    found = []
    for folder in folders:
        with np.load(folder / f"{case}.npz") as arrays:
            found.append(dict(arrays))
    assert [one.pop("register") for one in found] == [64, 32]
    wide, narrow = found
    for name, values in wide.items():
        np.testing.assert_array_equal(values, narrow[name], err_msg=name)


# --- detected features ----------------------------------------------------------------------------------------------


def test_register_width_of_16_bytes_is_refused() -> None:
    environment = {**os.environ, "FLOCKENV_REGISTER": "16"}
    done = subprocess.run(
        [sys.executable, "-c", "import flockenv.scene"], env=environment, capture_output=True, text=True
    )
    assert done.stderr.rstrip().endswith(
        "ValueError: FLOCKENV_REGISTER = '16': must be 32 or 64 (bytes of a register), or empty"
    )


@pytest.mark.parametrize(
    ("settings", "found"),
    [({"NUMBA_CPU_NAME": "generic"}, "32 False False"), ({"NUMBA_CPU_FEATURES": "+avx2,-avx512f"}, "32 True False"),
     ({"NUMBA_CPU_FEATURES": "+avx2,+avx512f"}, "64 True True")],
)  # fmt: skip
def test_numba_s_settings_override_detected_features(settings: dict[str, str], found: str) -> None:
    program = "from flockenv.jit.cpu import *; print(REGISTER, *(name in FEATURES for name in ('avx2', 'avx512f')))"
    environment = {name: value for name, value in os.environ.items() if name != "FLOCKENV_REGISTER"} | settings
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
    assert done.stdout.strip() == found, done.stderr


# --- generated code -------------------------------------------------------------------------------------------------


def code(part: Callable[..., None], *arguments: Any, apart: bool = True) -> tuple[str, str]:
    """Return the optimised LLVM code and the machine code of an entry point that calls a part of a kernel."""
    inner: Any = kernel(part)

    def entry(x: Any, y: Any) -> None:
        unaliased()
        inner(x, y)

    def overlapping(x: Any, y: Any) -> None:
        inner(x, y)

    own = entry if apart else overlapping
    made: Any = numba.njit(own, pipeline_class=Whole, error_model="numpy", fastmath={"contract"}, _nrt=False)
    made(*arguments)
    return next(iter(made.inspect_llvm().values())), next(iter(made.inspect_asm().values()))


def many_sums() -> Callable[..., None]:
    """Return a loop with more running sums than any processor has registers."""
    made: dict[str, Any] = {"np": np}
    sums = "\n".join(f"            y[np.uint64({16 * k}) + l] += x[j] * y[np.uint64(640) + l]" for k in range(40))
    source = f"def run(x, y):\n    for j in range(len(x)):\n        for l in range(np.uint64(16)):\n{sums}"
    exec(source, made)  # noqa: S102  # forty similar lines
    return made["run"]  # type: ignore[no-any-return]


@pytest.mark.skipif("avx" not in cpu.FEATURES, reason="registers of 16 bytes always lie within a line")
def test_stack_is_aligned_to_the_register_width() -> None:
    """Otherwise spilled registers may straddle two cache lines, which depends on the process."""
    x, y = np.arange(5, dtype=np.float32), np.ones(656, np.float32)
    left, machine = code(many_sums(), x, y)
    np.testing.assert_array_equal(y, [*[11] * 640, *[1] * 16])
    assert '"stackrealign"' in left
    assert re.search(r"and\w\s+\$-(32|64), %rsp", machine)


def short_loop(x: Any, y: Any) -> None:
    """Square rows of eight numbers; the compiler cannot know that y and x do not overlap."""
    for k in range(x.shape[0]):
        for l in range(np.uint64(8)):  # noqa: E741  # the name of the lane in kernels
            y[k, l] = x[k, l] * x[k, l]


@pytest.mark.skipif(binding.llvm_version_info[0] not in pipeline.LLVMS, reason="option not set: see pipeline.LLVMS")
def test_short_loops_are_vectorised(monkeypatch: pytest.MonkeyPatch) -> None:
    """The LLVM option for it is set once while an entry point and its parts compile, and reset afterwards."""
    options: list[str] = []
    set_option = pipeline.binding.set_option
    monkeypatch.setattr(
        pipeline.binding, "set_option", lambda name, option: (options.append(option), set_option(name, option))
    )
    x = np.full((5, 8), 3, np.float32)
    y = x.copy()
    left, _ = code(short_loop, x, y, apart=False)
    np.testing.assert_array_equal(y, 9)
    assert re.search(r"fmul [\w ]*<\d+ x float>", left)
    assert options == [f"--vectorizer-min-trip-count={count}" for count in (4, 16)]


def test_block_ways_stores_without_a_mask() -> None:
    def shorten(row: Any, table: Any) -> None:
        shorten_free_paths(
            row, 0, 16, table, (np.float32(1.0), np.float32(0.5)), (np.float32(1), np.float32(0)), 0.4, 6.0
        )

    row = np.ones(16, np.float32)
    _, machine = code(shorten, row, np.array(ray_directions(16), np.float32))
    assert 0 < row.min() < row.max() == 1.0
    assert not re.search(r"vmaskmovps\s+%[xy]mm\d+, %[xy]mm\d+, [-\w]*\(", machine)
