"""Floors: what no program on this machine beats, from operations and bytes that are counted.

Counted is what a task cannot be done without, however it is written: every pair is measured once, every
number that is shown is made and written once, every weight of a network is multiplied once. Operations are done at the
pace of independent ones (pace.c, compiled here by gcc), bytes go at the bandwidth to memory, both measured just before;
the slower of the two is the floor. Small work (choosing the nearest, random numbers,
sorting, calls) is not counted: no program reaches its floor.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from benchmarks.measure import Bench, Floor, number
from flockenv.geometry.space import Torus
from flockenv.jit.thread_pool import run_parallel
from flockenv.model.state import State
from flockenv.scene import Scene
from flockenv.tasks import Task

__all__ = ["FLAGS", "Machine", "Work", "compile_sources", "machine", "of_decisions", "of_learning", "of_scene"]

FLAGS = ("-O3", "-march=native", "-shared", "-fPIC")
CACHED = 2**20  # bytes: what is no larger need not come from memory in every call
ROUNDS = 1_000_000  # of pace.c a call
SECONDS = 0.25  # s, each of both is measured for
DIVIDING = ("separation",)  # kinds of effects whose pair law divides


@dataclass(frozen=True)
class Work:
    """What one item (an agent's step, a decision) cannot be done without."""

    operations: float  # of lanes of vectors, a multiply-add as one
    bytes: float  # to and from memory
    dtype: str  # of the operations
    why: str  # what was counted, in words


@dataclass(frozen=True)
class Machine:
    """The limits of this machine, on a number of cores at once."""

    pace: dict[tuple[str, int], float]  # operations/s by dtype and threads
    bandwidth: dict[int, float]  # bytes/s to and from memory, by threads

    @classmethod
    def measure(cls, pace: ctypes.CDLL, threads: Sequence[int]) -> Machine:
        """Measure it, at best of some tries: independent operations, and adding to 128 MB a thread in place."""
        arrays = [np.ones(2**25, np.float32) for _ in range(max(threads))]  # not zeros: those are not in memory yet

        def bandwidth(k: int) -> float:
            return _total_rate([lambda a=a: (np.add(a, 1.0, out=a), 2 * a.nbytes)[1] for a in arrays[:k]])

        def operations(dtype: str, k: int) -> float:
            run = getattr(pace, f"operations_{dtype}")
            run.restype = ctypes.c_long
            return _total_rate([lambda: run(ctypes.c_long(ROUNDS))] * k)

        return cls(
            {(dtype, k): operations(dtype, k) for dtype in ("float32", "float64") for k in threads},
            {k: bandwidth(k) for k in threads},
        )

    def floor(self, work: Work, threads: int = 1) -> Floor:
        """Return the floor of some work on a number of threads."""
        pace, bandwidth = self.pace[work.dtype, threads], self.bandwidth[threads]
        why = (
            f"{work.why}: {number(work.operations)} operations at {pace / 1e9:.0f} G/s, "
            f"{number(work.bytes)} bytes at {bandwidth / 1e9:.0f} GB/s"
        )
        return Floor.from_counts(work.operations, work.bytes, pace, bandwidth, why)

    def text(self) -> str:
        """Return what was measured, in a sentence."""
        paces = ", ".join(
            f"{pace / 1e9:.0f} G operations/s in {dtype} on {k} thread{'s' * (k > 1)}"
            for (dtype, k), pace in self.pace.items()
        )
        widths = ", ".join(f"{width / 1e9:.0f} GB/s on {k}" for k, width in self.bandwidth.items())
        return f"Floors: counted operations and bytes (benchmarks/floors.py) at {paces}; {widths}; the slower of both."


def _total_rate(jobs: Sequence[Callable[[], float]]) -> float:
    """Return how much is done per second by jobs that run at the same time and say how much they do."""
    rates, until = [0.0], perf_counter() + SECONDS
    while (began := perf_counter()) < until:
        done = sum(run_parallel(jobs))
        rates.append(done / (perf_counter() - began))
    return max(rates)


@contextmanager
def compile_sources(bench: Bench, *names: str) -> Iterator[list[ctypes.CDLL] | None]:
    """Compile sources of this folder for as long as the block lasts; say in a note why that fails, and give None."""
    with tempfile.TemporaryDirectory() as folder:
        found = None
        try:
            if shutil.which("gcc") is None:
                raise OSError("there is no gcc")
            found = [_compile(name, Path(folder)) for name in names]
        except (OSError, subprocess.CalledProcessError) as error:
            last = (getattr(error, "stderr", "") or str(error)).strip().splitlines()[-1]
            bench.note(f"no {' and no '.join(f'{name}.c' for name in names)}: {last}")
        yield found


def _compile(name: str, folder: Path) -> ctypes.CDLL:
    """Compile a source; subprocess.CalledProcessError or OSError where that fails."""
    library, source = folder / f"{name}.so", Path(__file__).with_name(f"{name}.c")
    subprocess.run(["gcc", *FLAGS, "-o", str(library), str(source), "-lm"], check=True, capture_output=True, text=True)
    return ctypes.CDLL(str(library))


def machine(bench: Bench, *threads: int) -> Machine | None:
    """Measure what this machine does at most and say so in a note; None, and why, where there is no gcc."""
    with compile_sources(bench, "pace") as libraries:
        if libraries is None:
            return None
        found = Machine.measure(libraries[0], threads or (1,))
    bench.note(found.text())
    bench.extra["machine_at_most"] = {
        "operations_per_second": {f"{dtype}, {k} threads": pace for (dtype, k), pace in found.pace.items()},
        "bytes_per_second": found.bandwidth,
    }
    return found


# --- counting -------------------------------------------------------------------------------------------------------


def of_scene(scene: Scene, start: State, steps: int = 1) -> Work:
    """Count a step of an agent: pairs that it meets from `start` on, their laws, moving it; `steps` are a call."""
    after = scene.step(start)
    worlds, _, d = start.shape
    alive = int(start.alive.sum())
    pairs = (after.count_of("pairs") - start.count_of("pairs")) / alive
    on_torus = isinstance(scene.space, Torus)
    each, law = _pair_operations(d, on_torus and pairs >= alive / worlds - 1), 0.0
    for _, effect in scene.parts.pairs:
        seeing = d + 1 if effect.sight.fov < 360 else 0  # along the heading; in view?
        summed = effect.sums(d) + effect.averages
        law += 1 + summed + seeing + (effect.kind in DIVIDING)  # within its radius?
    law += sum(d + 2 for effect in scene.parts.effects if effect.far_law is not None)  # a root, a division, a sum
    calls = steps if worlds > 1 else 1  # a world of a batch stays in the caches for a call
    moved = 4 * d * np.dtype(scene.dtype).itemsize  # positions and velocities, read and written
    why = f"{number(each + law if pairs else 0)} operations for each of {number(pairs)} candidates, moving"
    return Work(
        pairs * (each + law) + _motion_operations(d, on_torus),
        _bytes_from_memory(moved / calls, alive),
        scene.dtype,
        why,
    )


def of_decisions(task: Task, worlds: int = 1) -> Work:
    """Count a decision of a learner: each agent and obstacle is read once, moved, and observed."""
    scene = task.scene
    d, on_torus, each = scene.dimension, isinstance(scene.space, Torus), task.agents / task.learners
    others, obstacles = _pair_operations(d, on_torus), _pair_operations(d, on_torus) + 1  # from its surface
    looking = task.agents * others + task.obstacle_slots * obstacles
    moving = each * task.substeps * _motion_operations(d, on_torus)
    motion = each * 4 * d * np.dtype(scene.dtype).itemsize
    row_bytes = 4 * (task.layout.size + task.action_layout.size) + 8 + 2  # float32, and a reward, and two flags
    bytes_ = _bytes_from_memory(row_bytes + motion, worlds * task.learners)
    seen = f"{task.agents} agents and {task.obstacle_slots} obstacles looked at"
    why = f"{seen}, {task.layout.size} numbers shown, moving"
    return Work(looking + moving + task.layout.size, bytes_, scene.dtype, why)


def of_learning(policy: Any, epochs: int, decision: Work) -> Work:
    """Count a step of PPO: a pass forward through actor and critic, per epoch another and two back, and the decision.

    Back through the first layers there is one, to their weights alone. A row is written once and read in every epoch.
    """
    import torch

    layers = [layer for layer in policy.modules() if isinstance(layer, torch.nn.Linear)]
    forward = sum(layer.in_features * layer.out_features for layer in layers)
    seen = max(layer.in_features for layer in layers if layer.in_features not in {e.out_features for e in layers})
    first = sum(layer.in_features * layer.out_features for layer in layers if layer.in_features == seen)
    operations = forward + epochs * (3 * forward - first) + decision.operations
    why = f"{forward:,} weights once, {epochs} times forward and back; a decision"
    return Work(operations, decision.bytes + 4 * seen * epochs, "float32", why)


def _pair_operations(d: int, images: bool) -> float:
    """Count the operations for one neighbour: offset, square, test for itself; nearest image on a torus."""
    return 2 * d + 1 + 3 * d * images


def _motion_operations(d: int, on_torus: bool) -> float:
    """Count a substep of motion: velocity and position, and back into the torus."""
    return 2 * d + 3 * d * on_torus


def _bytes_from_memory(each: float, items: float) -> float:
    """Return bytes of an item; none where all items fit the caches."""
    return each if each * items > CACHED else 0.0
