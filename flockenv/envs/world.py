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
from flockenv.model.snapshot import Snapshot
from flockenv.model.state import State
from flockenv.scene import MEMORY_LIMIT
from flockenv.tasks import Task
from flockenv.tasks.play import play_of, tell_of
from flockenv.tasks.play_plan import REFUSED, Decision, Given, Near, Results, Totals, Worlds

__all__ = ["Step", "World"]

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
        """worlds: B >= 1. time_limit: decisions until truncation; None: no limit."""
        if not _whole(worlds) or worlds < 1:
            raise ValueError(f"worlds is {worlds!r}, must be an integer >= 1")
        if time_limit is not None and (not _whole(time_limit) or time_limit < 1):
            raise ValueError(f"time_limit is {time_limit}, must be an integer >= 1 (decisions), or None")
        scene = task.scene
        bytes_ = worlds * (scene.bytes_per_world() + task.learners * 8 * task.layout.size)
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
        self._prepare()

    def _prepare(self) -> None:
        """Make what follows from the task: kernel, scratch, and the constant arguments of each step."""
        scene, task, s = self.task.scene, self.task, self.state
        self._entries = play_of(task), tell_of(task)
        self._enter, self._tell = self._entries
        b, i, real = self.worlds, self.learners, scene.dtype
        self._actions = zeros((b, i, self.action_size), real)
        numbers = (task.parts.packed_numbers(), list(task.parameters().values()), task.table() or (0.0,))
        fields = (
            ((b, i, self.observation_size), np.float32), ((b, i), float), ((len(task.terms), b, i), float),
            ((b, i), bool), ((b,), bool), ((b,), bool), ((b, i), bool),
        )  # fmt: skip
        self._shapes = tuple(shape for shape, _ in fields)  # of a Step, with terms as the first axis
        self._dtypes = tuple(np.dtype(kind) for _, kind in fields)
        self._everywhere = np.ones(b, np.bool_)
        self._untold = tuple(np.empty(shape, kind) for shape, kind in fields[1:])  # results that a reset does not write
        row, size = 4 * math.prod(self._shapes[0][1:]), 4 * math.prod(self._shapes[0])
        self._past = size >= PAST and row <= AT_HAND
        kinds, maker = zip(self._shapes, self._dtypes, strict=True), BufferPool(line=LINE).maker
        self._fresh: tuple[Callable[[], NDArray[Any]], ...] = tuple(
            maker(*kind) if size >= RECYCLE else functools.partial(np.empty, *kind) for kind in kinds
        )
        given = Given(*(np.array(values, real) for values in numbers))
        worlds = Worlds(
            s.x, s.v, s.alive, s.tick, s.obstacle_x, s.obstacle_radius, s.work, s.key, self._memory, self.steps,
            s.frame_and_inner,
        )  # fmt: skip
        self._always = (
            worlds, given, np.dtype(real).type(scene.dt), task.substeps, not task.ends_together, self._past,
            Totals(self._last, self._sums, self._paid),
        )  # fmt: skip
        self._counted = (self.steps, np.array(numbers[1], float), self._last, self._sums)
        self._alone = np.empty((len(task.metric_names), 1))  # metrics of one world
        self._scratch, self._tuners = [self._allocate()], AutoTuners()
        self._hire()

    def _hire(self) -> None:
        """Bind the entry point to its constant arguments, once for each thread, which has its own scratch."""
        self._calls: list[Callable[..., tuple[int, int]]] = [
            functools.partial(self._enter, *self._always, *scratch) for scratch in self._scratch
        ]

    def _allocate(self) -> tuple[Decision, Near, Any]:
        """Return the scratch of one thread: of a decision, of the neighbour query, of a physics step."""
        task, scene, n = self.task, self.task.scene, self.agents
        d, real, look = scene.dimension, scene.dtype, task.look or Look(0.0)
        lanes = PAIR if task.abreast else task.parts.width
        padded = -(-n // lanes) * lanes
        wide: tuple[NDArray[Any], ...] = ()
        if task.abreast:
            beside = zeros(task.abreast * column_distance(self.learners), np.float32)
            own, vel = (2 * d + 1 + task.memory, padded), (d, look.agents, padded)
            wide = (zeros(own, real), zeros(vel, real), zeros((1, look.agents, padded), real), beside)
            wide[2][:] = scene.body.radius[0]  # all agents have it, or it is gathered
        decision = Decision(
            zeros(self._shapes[0][1:] if self._past else (0, 0), np.float32),
            zeros((d, 1, n), real), zeros((d, n), real), zeros((d, n), real), zeros(n, np.bool_),
            zeros(self.action_size * column_distance(self.learners), real if task.abreast else float),
            zeros(len(task.terms) * column_distance(self.learners), real if task.abreast else float), wide,
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
        """Return the attributes that `_prepare` cannot make again."""
        made = (
            "_entries", "_enter", "_tell", "_actions", "_always", "_scratch", "_choices", "_calls", "_counted",
            "_alone", "_shapes", "_dtypes", "_everywhere", "_untold", "_fresh", "_past",
        )  # fmt: skip
        return {name: value for name, value in vars(self).items() if name not in made}

    def __setstate__(self, kept: dict[str, Any]) -> None:
        """Continue from a pickled world."""
        vars(self).update(kept)
        self._prepare()

    def __deepcopy__(self, memo: dict[int, Any]) -> World:
        """Return an independent world that continues from here."""
        new = object.__new__(World)
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
            raise ValueError("into must be writable and contiguous: the observations of a step, no part of them")
        self._seed(seeds, rows)
        observation: Rows = self._fresh[0]() if into is None else into
        begun = self.worlds if into is None else int(np.count_nonzero(rows))
        self._play(False, rows, into is None, begun, 0, Results(observation, *self._untold), self._actions)
        if self._enter is self._entries[0]:
            self._enter = without_dispatch(self._enter)  # argument types do not change after this call
            self._hire()
        for numbers in (self._sums, self._last, self.paid):
            numbers[rows] = 0
        return observation

    def _seed(self, seeds: int | Sequence[int] | None, rows: NDArray[np.bool_]) -> None:
        if seeds is None and self._seeds is None:
            seeds = secrets.randbits(31)
        if seeds is not None:
            given = np.array(self._checked(seeds), np.uint64)
            self._seeds = given if self._seeds is None else np.where(rows, given, self._seeds)
            self._episodes[rows] = 0
        else:
            self._episodes[rows] += np.uint64(1)
        assert self._seeds is not None
        self.state.key[rows] = keys_of(self._seeds[rows], self._episodes[rows])

    def _checked(self, seeds: int | Sequence[int]) -> list[int]:
        """Return one seed per world; ValueError for another number of seeds, or no integers in 0 ... 2^64 - 1."""
        if not (_whole(seeds) or (isinstance(seeds, (Sequence, np.ndarray)) and not isinstance(seeds, (str, bytes)))):
            raise ValueError(f"seeds is {seeds!r}, must be an integer, or a sequence of integers, one for each world")
        several = [seeds + k for k in range(self.worlds)] if isinstance(seeds, (int, np.integer)) else list(seeds)
        if len(several) != self.worlds:
            raise ValueError(f"{len(several)} seeds for {self.worlds} worlds")
        for k, seed in enumerate(several):
            if not _whole(seed) or not 0 <= seed <= MASK:
                raise ValueError(f"seed of world {k} is {seed!r}, must be an integer from 0 to 2^64 - 1")
        return [int(seed) for seed in several]

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
        mine = {
            "steps": self.steps, "paid": self._paid, "memory": self._memory, "sums": self._sums, "last": self._last,
            "seeds": self._seeds, "episodes": self._episodes,
        }  # fmt: skip
        return {**{f"state.{name}": array for name, array in state.items()}, **mine}

    def restore(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Continue from what `arrays` returned for as many worlds of the same task; the next step is equal bit for bit.

        Raises ValueError, with the array that is missing, unknown, or of another shape or type, before any is written;
        RuntimeError before the first reset.
        """
        mine = self.arrays()
        if odd := sorted(mine.keys() ^ arrays.keys()):
            raise ValueError(f"arrays: {odd[0]!r} is {'missing' if odd[0] in mine else 'unknown'}")
        for name, array in arrays.items():
            if (array.shape, array.dtype) != (mine[name].shape, mine[name].dtype):
                expected = f"{mine[name].shape} of {mine[name].dtype}"
                raise ValueError(f"arrays: {name!r} is {array.shape} of {array.dtype}, expected {expected}")
        for name, array in arrays.items():
            mine[name][...] = array

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
        taken = self._taken(actions)
        rows, reward, earned, over, late, success, present = told = Results(*[make() for make in self._fresh])
        limit = _NEVER if self.time_limit is None else min(int(self.time_limit), _NEVER)
        world, who = self._play(True, self._everywhere, terms == "steps", self.worlds, limit, told, taken)
        if world == REFUSED:
            self._refuse(taken)
        if world >= 0:
            raise FloatingPointError(f"world {world}, agent {who}: not finite at t = {self.state.time[world]:g} s")
        return Step(rows, reward, earned.transpose(1, 2, 0), over, late, success, present)

    def _play(
        self, acting: bool, mask: NDArray[np.bool_], everyone: bool, busy: int, limit: int,
        told: Results, actions: NDArray[Any],
    ) -> tuple[int, int]:  # fmt: skip
        """Take a decision in all worlds, or begin those in the mask, by a thread pool if `busy` worlds are enough.

        everyone: observe all worlds in a reset, and write the terms of all in a decision. Returns (world, agent) of the
        first agent that is not finite, or (-1, -1).
        """
        crew, work = min(usable_threads(), busy), busy * self.agents * self.task.substeps
        whole = acting, mask, everyone, acting, 0, self.worlds, actions, limit, told
        if crew <= 1:
            return self._calls[0](*whole)

        def shared() -> tuple[int, int]:
            return self._shared(crew, acting, mask, everyone, limit, told, actions)

        choice = self._tuners.of("deciding" if acting else "beginning", work, crew)
        return choice.run(functools.partial(self._calls[0], *whole), shared, work >= LARGEST)

    def _shared(
        self, crew: int, acting: bool, mask: NDArray[np.bool_], everyone: bool, limit: int,
        told: Results, actions: NDArray[Any],
    ) -> tuple[int, int]:  # fmt: skip
        """Do what `_play` does, with `crew` threads."""
        if crew > len(self._scratch):
            self._scratch += [self._allocate() for _ in range(crew - len(self._scratch))]
            self._hire()
        if acting and self._calls[0](True, mask, everyone, True, 0, 0, actions, limit, told)[0] == REFUSED:
            return REFUSED, 0  # no world moves before all actions are checked
        portions = iter(_portions(self.worlds, crew))  # a thread that is done takes the next chunk

        def several(k: int) -> tuple[int, int]:
            found, call = [], self._calls[k]
            for first, end in portions:
                found.append(call(acting, mask, everyone, False, first, end, actions, limit, told))
            return min((bad for bad in found if bad[0] >= 0), default=(-1, -1))

        bad = [found for found in run_parallel([functools.partial(several, k) for k in range(crew)]) if found[0] >= 0]
        return min(bad, default=(-1, -1))

    def _taken(self, actions: ArrayLike) -> NDArray[Any]:
        """Return the actions in the precision of the scene, the kernel's only type; copied only if necessary."""
        given, kept = np.asarray(actions), self._actions
        if given.shape != kept.shape:
            raise ValueError(f"actions have shape {given.shape}, expected (worlds, learners, numbers) = {kept.shape}")
        if given.dtype == kept.dtype and given.flags.carray:
            return given
        if given.dtype == _SINGLE:  # as spaces sample them; exact in doubles
            kept[...] = given
            return kept
        try:
            with np.errstate(over="ignore"):
                kept[...] = given
            if kept.dtype == _SINGLE and np.isinf(kept).any():  # float32 overflow: the number is beyond 1, not infinite
                exact = given.astype(float)
                kept[...] = np.where(np.isfinite(exact), np.clip(exact, -1, 1), exact)
        except (TypeError, ValueError):
            raise TypeError(f"actions are of type {given.dtype}, expected numbers in [-1, 1]") from None
        return kept

    def _refuse(self, actions: NDArray[Any]) -> NoReturn:
        """Raise ValueError with the first action that is not finite."""
        b, i, k = np.argwhere(~np.isfinite(actions))[0]
        raise ValueError(
            f"action {k} of {self.task.agent_names[i]} in world {b} is {actions[b, i, k]}, must be a number in [-1, 1]"
        )

    # --- metrics and pictures ---------------------------------------------------------------------------------------

    def measure(self) -> dict[str, NDArray[np.float64]]:
        """Return the domain metrics of the episodes so far, each (B,), by name; NaN: no value yet."""
        told = np.empty((len(self.task.metric_names), self.worlds))
        self._tell_of(0, told)
        return dict(zip(self.task.metric_names, told, strict=True))

    def metrics(self, world: int = 0) -> dict[str, float]:
        """Return the domain metrics of one world's episode so far, by name, without those that have no value yet.

        NaN is not used, since two equal infos would then differ.
        """
        self._tell_of(range(self.worlds)[world], self._alone)
        values = self._alone.ravel().tolist()
        return {name: value for name, value in zip(self.task.metric_names, values, strict=True) if value == value}

    def _tell_of(self, first: int, told: NDArray[np.float64]) -> None:
        """Write the metrics of the worlds from `first` on into `told`, (K, B)."""
        self._tell(*self._counted, first, told)
        if self._tell is self._entries[1]:
            self._tell = without_dispatch(self._tell)

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


@functools.cache
def _portions(worlds: int, crew: int) -> tuple[tuple[int, int], ...]:
    """Return the chunks of worlds for `crew` threads: the first world and the one after the last of each chunk.

    Each is a thread's share of half of the rest, so that all threads end at the same time even if some start late.
    """
    least, at, portions = -(-worlds // (LEAST * crew)), 0, []
    while at < worlds:
        end = min(at + max(-(-(worlds - at) // (2 * crew)), least), worlds)
        portions.append((at, end))
        at = end
    return tuple(portions)


def _whole(value: object) -> bool:
    """Return True if it is an integer; False for a bool."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, (bool, np.bool_))
