"""World: B independent worlds of one task, stepped together. Each environment API is a thin layer over it."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
import secrets
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.core.errors import nearest
from flockenv.engine import Look, pack, scratch_record
from flockenv.engine.workspace import Workspace
from flockenv.jit.buffer_pool import BufferPool
from flockenv.jit.cpu import LINE
from flockenv.jit.memory import zeros
from flockenv.jit.section import without_dispatch
from flockenv.jit.simd_rows import PAIR, column_distance
from flockenv.jit.thread_pool import LARGEST, AutoTuners, run_parallel, usable_threads
from flockenv.maths.counter_rng import MASK, keys_of
from flockenv.model import state as states
from flockenv.model.divergence import SimulationDiverged
from flockenv.model.snapshot import Snapshot
from flockenv.model.state import State
from flockenv.scene import MEMORY_LIMIT
from flockenv.tasks import Task
from flockenv.tasks.play import metrics_of, play_of
from flockenv.tasks.play_plan import REFUSED, Constants, Decision, Near, Results, Totals, WorldArrays

__all__ = ["Step", "World", "bytes_per_world", "first_step"]

Rows = NDArray[np.float32]

LEAST = 24
"""The smallest chunk of worlds for a thread is 1 / LEAST of its equal share."""

RECYCLE = 2**18
"""Bytes of observations from which results come from a buffer pool; below, new memory costs less."""

PAST = 2**22
"""Bytes of observations from which they are written with streaming stores, as they do not fit into the caches."""

AT_HAND = 2**17
"""Largest bytes of observations per world for streaming stores: they are made in scratch in a core's cache."""

TERMS = ("steps", "ends")
_NEVER = 2**63 - 1
_SINGLE = np.dtype(np.float32)


class Step(NamedTuple):
    """Results of one decision, in arrays that nothing else references. B worlds, L learners."""

    observation: Rows  # (B, L, O)
    reward: NDArray[np.float64]  # (B, L)
    terms: NDArray[np.float64]  # (B, L, K), reward = sum over K, if written; each term contiguous
    terminated: NDArray[np.bool_]  # (B, L)
    truncated: NDArray[np.bool_]  # (B,) by the time limit
    success: NDArray[np.bool_]  # (B,)
    alive: NDArray[np.bool_]  # (B, L) after the step

    @property
    def ended(self) -> NDArray[np.bool_]:
        """(B,): True if the episode is over, truncated or with all learners terminated."""
        return np.asarray(self.truncated | self.terminated.all(axis=1))


class World:
    """B worlds of one task. World k of seed s equals a single world of seed s + k, bit for bit.

    It never resets by itself. Raises ValueError on actions of a wrong shape, and on actions that are not finite, with
    world and agent, before any state changes; RuntimeError on a step before the first reset.
    """

    def __init__(self, task: Task, worlds: int = 1, time_limit: int | None = None) -> None:
        """Make B = `worlds` >= 1 worlds; `time_limit`: decisions until truncation, None: no limit."""
        if not _is_integer(worlds) or worlds < 1:
            raise ValueError(f"worlds is {worlds!r}, must be an integer >= 1")
        if time_limit is not None and (not _is_integer(time_limit) or time_limit < 1):
            raise ValueError(f"time_limit is {time_limit}, must be an integer >= 1 (decisions), or None")
        scene = task.scene
        if scene.kept_bonds:
            raise ValueError(f"task {task.name}: its scene has springs that yield or break, which no task resets")
        bytes_ = worlds * bytes_per_world(task)
        if bytes_ > MEMORY_LIMIT:
            need = f"{bytes_ / 2**30:.3g} GiB, at most {MEMORY_LIMIT / 2**30:g} allowed"
            raise ValueError(f"worlds is {worlds}: needs about {need}")
        self.task, self.worlds, self.time_limit = task, int(worlds), time_limit
        self.learners, self.agents = task.learners, scene.agents
        self.observation_size, self.action_size = task.layout.size, task.action_layout.size
        # These arrays are bound to the kernel once: write into them, never replace them.
        self.state: Final = states.blank(
            self.worlds, self.agents, scene.dimension, task.obstacle_slots, scene.dt, scene.dtype,
            scene.parts.frame_rows, inner_rows=len(scene.parts.inner),
        )  # fmt: skip
        self.steps: Final = np.zeros(self.worlds, np.int64)
        self._paid: Final = zeros((len(task.terms), self.worlds, self.learners))
        self._memory: Final = zeros((task.memory, self.worlds, self.agents), scene.dtype)
        self._sums: Final = zeros((self.worlds, len(task.measures)))
        self._last: Final = zeros((self.worlds, len(task.measures)))
        self._seeds: NDArray[np.uint64] | None = None
        self._episodes = np.zeros(self.worlds, np.uint64)
        self._compile_and_allocate()

    def _compile_and_allocate(self) -> None:
        """Set all that is derived from the task: kernel, scratch, and the constant arguments of each step."""
        scene, task, s = self.task.scene, self.task, self.state
        self._entries = play_of(task), metrics_of(task)
        self._enter, self._compute_metrics = self._entries
        b, i, real = self.worlds, self.learners, scene.dtype
        self._actions = zeros((b, i, self.action_size), real)
        numbers = (task.parts.packed_numbers(), list(task.parameters().values()), task.table() or (0.0,))
        fields = (
            ((b, i, self.observation_size), np.float32), ((b, i), float), ((len(task.terms), b, i), float),
            ((b, i), bool), ((b,), bool), ((b,), bool), ((b, i), bool),
        )  # fmt: skip
        self._shapes = tuple(shape for shape, _ in fields)  # of a Step, with terms as the first axis
        self._dtypes = tuple(np.dtype(kind) for _, kind in fields)
        self._all_worlds = np.ones(b, np.bool_)
        self._unwritten = tuple(np.empty(shape, kind) for shape, kind in fields[1:])  # a reset does not write these
        row_bytes, total_bytes = 4 * math.prod(self._shapes[0][1:]), 4 * math.prod(self._shapes[0])
        self._streaming = total_bytes >= PAST and row_bytes <= AT_HAND
        shapes_and_types, make = zip(self._shapes, self._dtypes, strict=True), BufferPool(line=LINE).maker
        self._make_results: tuple[Callable[[], NDArray[Any]], ...] = tuple(
            make(*kind) if total_bytes >= RECYCLE else functools.partial(np.empty, *kind) for kind in shapes_and_types
        )
        constants = Constants(*(np.array(values, real) for values in numbers))
        worlds = WorldArrays(
            s.x, s.v, s.alive, s.tick, s.obstacle_x, s.obstacle_radius, s.work, s.key, self._memory, self.steps,
            s.frame_and_inner,
        )  # fmt: skip
        self._constant_arguments = (
            worlds, constants, np.dtype(real).type(scene.dt), task.substeps, not task.ends_together, self._streaming,
            Totals(self._last, self._sums, self._paid),
        )  # fmt: skip
        self._metric_arguments = (self.steps, np.array(numbers[1], float), self._last, self._sums)
        self._metrics_row = np.empty((len(task.metric_names), 1))  # metrics of one world
        self._scratch, self._tuners = [self._allocate()], AutoTuners()
        self._bind_calls()

    def _bind_calls(self) -> None:
        """Bind the entry point to its constant arguments, once for each thread, which has its own scratch."""
        self._calls: list[Callable[..., tuple[int, int]]] = [
            functools.partial(self._enter, *self._constant_arguments, *scratch) for scratch in self._scratch
        ]

    def _allocate(self) -> tuple[Decision, Near, Any]:
        """Return the scratch of one thread: of a decision, of the neighbour query, of a physics step."""
        task, scene, n = self.task, self.task.scene, self.agents
        d, real, look = scene.dimension, scene.dtype, task.look or Look(0.0)
        lanes = PAIR if task.abreast else task.parts.width
        padded = -(-n // lanes) * lanes
        padded_arrays: tuple[NDArray[Any], ...] = ()
        if task.abreast:
            row_columns = zeros(task.abreast * column_distance(self.learners), np.float32)
            own, vel = (2 * d + 1 + task.memory, padded), (d, look.agents, padded)
            padded_arrays = (zeros(own, real), zeros(vel, real), zeros((1, look.agents, padded), real), row_columns)
            padded_arrays[2][:] = scene.body.radius[0]  # the same for all agents; else it is gathered
        decision = Decision(
            zeros(self._shapes[0][1:] if self._streaming else (0, 0), np.float32),
            zeros((d, 1, n), real), zeros((d, n), real), zeros((d, n), real), zeros(n, np.bool_),
            zeros(self.action_size * column_distance(self.learners), real if task.abreast else float),
            zeros(len(task.terms) * column_distance(self.learners), real if task.abreast else float), padded_arrays,
        )  # fmt: skip
        near = [
            zeros(shape, kind)
            for many in (look.agents, look.obstacles)
            for shape, kind in (((many, padded), real), ((many, padded), np.int32), ((padded,), np.int32))
        ]
        space = Workspace.allocate(task.parts, scene.body, pack(task.parts, n, scene.groups))
        places = zeros((d, look.agents, padded), real)
        return decision, Near(*[*near, places]), space.of(0, scratch_record(task.parts))

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes that `_compile_and_allocate` cannot make again."""
        derived = (
            "_entries", "_enter", "_compute_metrics", "_actions", "_constant_arguments", "_scratch", "_tuners",
            "_calls", "_metric_arguments", "_metrics_row", "_shapes", "_dtypes", "_all_worlds", "_unwritten",
            "_make_results", "_streaming",
        )  # fmt: skip
        return {name: value for name, value in vars(self).items() if name not in derived}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a pickled world."""
        vars(self).update(state)
        self._compile_and_allocate()

    def __deepcopy__(self, memo: dict[int, Any]) -> World:
        """Return an independent world that continues from here."""
        new = object.__new__(type(self))
        new.__setstate__({name: copy.deepcopy(value, memo) for name, value in self.__getstate__().items()})
        return new

    # --- episodes ---------------------------------------------------------------------------------------------------

    def reset(
        self, seeds: int | Sequence[int] | None = None, mask: ArrayLike | None = None, into: Rows | None = None
    ) -> Rows:
        """Begin episodes and return observations (B, L, O).

        seeds: an int s gives world k the seed s + k; a sequence gives each its own; None begins the next episode of the
        same seeds (a first reset without seeds draws one from the system). mask (B,): only these worlds are reset.
        into: observations of the last step, into which those of reset worlds are written; None: a new array.
        """
        rows = np.ones(self.worlds, np.bool_) if mask is None else np.array(mask)
        if rows.shape != (self.worlds,) or rows.dtype != np.bool_:
            raise ValueError(f"mask has shape {rows.shape} and type {rows.dtype}, expected ({self.worlds},) bool")
        if self._seeds is None and not rows.all():
            raise RuntimeError("the first reset must begin every world: no mask yet")
        if into is not None and (into.shape, into.dtype) != (self._shapes[0], self._dtypes[0]):
            raise ValueError(f"into has shape {into.shape} and type {into.dtype}, expected {self._shapes[0]} float32")
        if into is not None and not into.flags.carray:
            raise ValueError("into must be writable and contiguous: it takes all observations of a step")
        self._seed(seeds, rows)
        observation: Rows = self._make_results[0]() if into is None else into
        busy = self.worlds if into is None else int(np.count_nonzero(rows))
        self._play(False, rows, into is None, busy, 0, Results(observation, *self._unwritten), self._actions)
        if self._enter is self._entries[0]:
            self._enter = without_dispatch(self._enter)  # argument types do not change after this call
            self._bind_calls()
        for numbers in (self._sums, self._last, self.paid):
            numbers[rows] = 0
        return observation

    def _seed(self, seeds: int | Sequence[int] | None, rows: NDArray[np.bool_]) -> None:
        if seeds is None and self._seeds is None:
            seeds = secrets.randbits(31)
        if seeds is not None:
            new_seeds = np.array(self._check_seeds(seeds), np.uint64)
            self._seeds = new_seeds if self._seeds is None else np.where(rows, new_seeds, self._seeds)
            self._episodes[rows] = 0
        else:
            self._episodes[rows] += np.uint64(1)
        assert self._seeds is not None
        self.state.key[rows] = keys_of(self._seeds[rows], self._episodes[rows])

    def _check_seeds(self, seeds: int | Sequence[int]) -> list[int]:
        """Return one seed per world; ValueError for another number of seeds, or no integers in 0 ... 2^64 - 1."""
        if not (
            _is_integer(seeds) or (isinstance(seeds, (Sequence, np.ndarray)) and not isinstance(seeds, (str, bytes)))
        ):
            raise ValueError(f"seeds is {seeds!r}, must be an integer, or a sequence of integers, one for each world")
        seeds_of_worlds = (
            [seeds + k for k in range(self.worlds)] if isinstance(seeds, (int, np.integer)) else list(seeds)
        )
        if len(seeds_of_worlds) != self.worlds:
            raise ValueError(f"{len(seeds_of_worlds)} seeds for {self.worlds} worlds")
        for k, seed in enumerate(seeds_of_worlds):
            if not _is_integer(seed) or not 0 <= seed <= MASK:
                raise ValueError(f"seed of world {k} is {seed!r}, must be an integer from 0 to 2^64 - 1")
        return [int(seed) for seed in seeds_of_worlds]

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seed of each world; empty before the first reset."""
        return () if self._seeds is None else tuple(self._seeds.tolist())

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays that change during episodes, by name, as views; RuntimeError before the first reset.

        Copies of them and the task are enough to continue from here: see `restore`.
        """
        if self._seeds is None:
            raise RuntimeError("arrays before the first reset: call reset() first")
        state = {each.name: getattr(self.state, each.name) for each in dataclasses.fields(State) if each.name != "dt"}
        own = {
            "steps": self.steps, "paid": self._paid, "memory": self._memory, "sums": self._sums, "last": self._last,
            "seeds": self._seeds, "episodes": self._episodes,
        }  # fmt: skip
        return {**{f"state.{name}": array for name, array in state.items()}, **own}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Restore the result of `arrays` of as many worlds of the same task; the next step is then equal bit for bit.

        Raises ValueError, with the array that is missing, unknown, or of another shape or type, before any is written;
        RuntimeError before the first reset.
        """
        own = self.arrays()
        if mismatch := sorted(own.keys() ^ arrays.keys()):
            raise ValueError(f"arrays: {mismatch[0]!r} is {'missing' if mismatch[0] in own else 'unknown'}")
        for name, array in arrays.items():
            if (array.shape, array.dtype) != (own[name].shape, own[name].dtype):
                expected = f"{own[name].shape} of {own[name].dtype}"
                raise ValueError(f"arrays: {name!r} is {array.shape} of {array.dtype}, expected {expected}")
        for name, array in arrays.items():
            own[name][...] = array

    @property
    def memory(self) -> NDArray[Any]:
        """(B, M, N): the task's memory of each agent, such as hunger; a view."""
        return self._memory.transpose(1, 0, 2)

    @property
    def paid(self) -> NDArray[np.float64]:
        """(B, L, K): reward terms, summed over the episode; a view."""
        return self._paid.transpose(1, 2, 0)

    def step(self, actions: ArrayLike, terms: Literal["steps", "ends"] = "steps") -> Step:
        """Take one decision, of control_dt s, in each world; actions (B, L, A), clipped to [-1, 1].

        terms: written after all "steps", or (faster with many worlds) only for worlds in which a learner ends or the
        time limit is reached ("ends"); those of other worlds are undefined.
        """
        if self._seeds is None:
            raise RuntimeError("step before the first reset: call reset() first")
        if terms not in TERMS:
            raise ValueError(f"terms: {terms!r} is unknown{nearest(str(terms), TERMS)}; allowed: {', '.join(TERMS)}")
        checked = self._check_actions(actions)
        rows, reward, earned, over, late, success, present = results = Results(*[make() for make in self._make_results])
        limit = _NEVER if self.time_limit is None else min(int(self.time_limit), _NEVER)
        world, agent = self._play(True, self._all_worlds, terms == "steps", self.worlds, limit, results, checked)
        if world == REFUSED:
            self._raise_for_action(checked)
        if world >= 0:
            raise self._diverged(world, agent)
        return Step(rows, reward, earned.transpose(1, 2, 0), over, late, success, present)

    def _diverged(self, world: int, agent: int) -> SimulationDiverged:
        step, dt, method = int(self.state.tick[world]) + 1, self.task.dt, self.task.integrator.kind
        reason = "position or velocity is not finite in the decision that begins"
        return SimulationDiverged(world, agent, step, step * dt, None, dt, method, reason)

    def _play(
        self, acting: bool, mask: NDArray[np.bool_], all_worlds: bool, busy: int, limit: int,
        results: Results, actions: NDArray[Any],
    ) -> tuple[int, int]:  # fmt: skip
        """Take a decision in all worlds, or begin those in the mask, by a thread pool if `busy` worlds are enough.

        all_worlds: observe all worlds in a reset, and write the terms of all in a decision. Returns (world, agent) of
        the first agent that is not finite, or (-1, -1).
        """
        threads, work = min(usable_threads(), busy), busy * self.agents * self.task.substeps
        arguments = acting, mask, all_worlds, acting, 0, self.worlds, actions, limit, results
        if threads <= 1:
            return self._calls[0](*arguments)

        def play_shared() -> tuple[int, int]:
            return self._play_threads(threads, acting, mask, all_worlds, limit, results, actions)

        choice = self._tuners.of("deciding" if acting else "beginning", work, threads)
        return choice.run(functools.partial(self._calls[0], *arguments), play_shared, work >= LARGEST)

    def _play_threads(
        self, threads: int, acting: bool, mask: NDArray[np.bool_], all_worlds: bool, limit: int,
        results: Results, actions: NDArray[Any],
    ) -> tuple[int, int]:  # fmt: skip
        """Do what `_play` does, with several threads."""
        if threads > len(self._scratch):
            self._scratch += [self._allocate() for _ in range(threads - len(self._scratch))]
            self._bind_calls()
        if acting and self._calls[0](True, mask, all_worlds, True, 0, 0, actions, limit, results)[0] == REFUSED:
            return REFUSED, 0  # no world moves before all actions are checked
        chunks = iter(_chunks(self.worlds, threads))  # a thread that is done takes the next chunk

        def play_chunks(k: int) -> tuple[int, int]:
            failures, call = [], self._calls[k]
            for first, end in chunks:
                failures.append(call(acting, mask, all_worlds, False, first, end, actions, limit, results))
            return min((bad for bad in failures if bad[0] >= 0), default=(-1, -1))

        bad = [
            failures
            for failures in run_parallel([functools.partial(play_chunks, k) for k in range(threads)])
            if failures[0] >= 0
        ]
        return min(bad, default=(-1, -1))

    def _check_actions(self, actions: ArrayLike) -> NDArray[Any]:
        """Return the actions in the precision of the scene, the kernel's only type; copied only if necessary."""
        array, buffer = np.asarray(actions), self._actions
        if array.shape != buffer.shape:
            raise ValueError(f"actions have shape {array.shape}, expected (worlds, learners, numbers) = {buffer.shape}")
        if array.dtype == buffer.dtype and array.flags.carray:
            return array
        if array.dtype == _SINGLE:  # as spaces sample them; exact in doubles
            buffer[...] = array
            return buffer
        try:
            with np.errstate(over="ignore"):
                buffer[...] = array
            if (
                buffer.dtype == _SINGLE and np.isinf(buffer).any()
            ):  # float32 overflow: the number is beyond 1, not infinite
                exact = array.astype(float)
                buffer[...] = np.where(np.isfinite(exact), np.clip(exact, -1, 1), exact)
        except (TypeError, ValueError):
            raise TypeError(f"actions are of type {array.dtype}, expected numbers in [-1, 1]") from None
        return buffer

    def _raise_for_action(self, actions: NDArray[Any]) -> NoReturn:
        """Raise ValueError with the first action that is not finite."""
        b, i, k = np.argwhere(~np.isfinite(actions))[0]
        raise ValueError(
            f"action {k} of {self.task.agent_names[i]} in world {b} is {actions[b, i, k]}, must be a number in [-1, 1]"
        )

    # --- metrics and pictures ---------------------------------------------------------------------------------------

    def measure(self) -> dict[str, NDArray[np.float64]]:
        """Return the domain metrics of the episodes so far, each (B,), by name; NaN: no value yet."""
        values = np.empty((len(self.task.metric_names), self.worlds))
        self._write_metrics(0, values)
        return dict(zip(self.task.metric_names, values, strict=True))

    def metrics(self, world: int = 0) -> dict[str, float]:
        """Return the domain metrics of one world's episode so far, by name, without those that have no value yet.

        NaN is not used, since two equal infos would then differ.
        """
        self._write_metrics(range(self.worlds)[world], self._metrics_row)
        values = self._metrics_row.ravel().tolist()
        return {name: value for name, value in zip(self.task.metric_names, values, strict=True) if value == value}

    def _write_metrics(self, first: int, out: NDArray[np.float64]) -> None:
        """Write the metrics of the worlds from `first` on into `out`, (K, B)."""
        self._compute_metrics(*self._metric_arguments, first, out)
        if self._compute_metrics is self._entries[1]:
            self._compute_metrics = without_dispatch(self._compute_metrics)

    def snapshot(self, world: int = 0) -> Snapshot:
        """Return one world at this instant, for pictures."""
        s: State = self.state
        low, high = self.task.view(s, world)
        return Snapshot(
            time=float(s.time[world]), pos=s.pos[world], vel=s.vel[world], alive=s.alive[world],
            heading=s.heading[world] if len(s.frame) else None,
            radius=np.asarray(self.task.scene.body.radius, np.float64), roles=self.task.roles(s, self._memory, world),
            obstacle_centre=s.obstacles.centre[world], obstacle_radius=s.obstacle_radius[world],
            marks=self.task.marks(s, self._memory, world),
            low=np.array(low, np.float64), high=np.array(high, np.float64),
            periodic=self.task.scene.space.periodic, title=type(self.task).__name__,
            outlines=self.task.scene.view.outlines(low, high, float(s.time[world])),
        )  # fmt: skip


def bytes_per_world(task: Task) -> int:
    """Return the memory of one world of a task with its observations, in bytes, before anything is allocated."""
    return task.scene.bytes_per_world() + task.learners * 8 * task.layout.size


def first_step(task: Task) -> None:
    """Reset and step one world of a task, which compiles its kernels, or loads them from the cache folder."""
    world = World(task)
    world.reset(0)
    world.step(np.zeros((1, world.learners, world.action_size)))


@functools.cache
def _chunks(worlds: int, threads: int) -> tuple[tuple[int, int], ...]:
    """Return the chunks of worlds for this many threads: the first world and the one after the last of each chunk.

    Each is a thread's share of half of the rest, so that all threads end at the same time even if some start late.
    """
    least, at, chunks = -(-worlds // (LEAST * threads)), 0, []
    while at < worlds:
        end = min(at + max(-(-(worlds - at) // (2 * threads)), least), worlds)
        chunks.append((at, end))
        at = end
    return tuple(chunks)


def _is_integer(value: object) -> bool:
    """Return True if it is an integer; False for a bool."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.bool_))
