"""TaskLane: an episode of a task that is played by hand-written rules, policies and a person, in one world."""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.core.errors import nearest, printable
from flockenv.core.record import Record
from flockenv.envs.disturbance import Disturbance, make_world
from flockenv.envs.world import World, first_step
from flockenv.model.snapshot import Snapshot
from flockenv.model.state import digest_arrays
from flockenv.play.edits import (
    AddObstacle,
    Disturb,
    Edit,
    Input,
    MoveAgent,
    MoveObstacle,
    Player,
    RemoveObstacle,
    Set,
)
from flockenv.play.lane import Change, Drawn, Scenery, circles_of, collected_warnings, move_agent
from flockenv.play.record_paths import with_value
from flockenv.players import NAMES, known_name, load_player
from flockenv.players.policy import RandomPolicy
from flockenv.tasks import Task

__all__ = ["NO_FILES", "YOU", "PlayerFiles", "TaskKeyframe", "TaskLane", "players_of"]

YOU = "you"
"""The player that a person is: its actions are those of the last `input`."""


@dataclass(frozen=True)
class PlayerFiles:
    """Player files that edits and links may name; no other file is read. trust_pickle: also load zips among them."""

    names: tuple[str, ...] = ()
    trust_pickle: bool = False

    def load(self, name: str, task: Task, seed: int) -> Any:
        """Return the player of a file or of a shipped name; raise ValueError, in one line, if it cannot play a task."""
        return load_player(name, task, seed, self.trust_pickle)


NO_FILES = PlayerFiles()


def players_of(task: Task, files: PlayerFiles = NO_FILES) -> tuple[str, ...]:
    """Return the names of all players that can steer learners of a task: those that ship, files, and "you"."""
    found = []
    for name in NAMES:
        try:
            with collected_warnings():
                load_player(name, task)
            found.append(name)
        except ValueError:  # it is none for this task
            continue
    return (*found, *files.names, YOU)


@dataclass(frozen=True, eq=False)
class TaskKeyframe:
    """The exact state of a task's lane."""

    record: Task
    tick: int
    arrays: Mapping[str, NDArray[Any]]
    states: Mapping[str, Any]
    players: tuple[str, ...]
    action: NDArray[np.float32]  # of a person
    actions: NDArray[np.float32]  # of the last decision
    disturbance: Disturbance
    stopped: str

    @property
    def nbytes(self) -> int:
        """Bytes of its arrays."""
        return sum(array.nbytes for array in self.arrays.values())


class TaskLane:
    """A task in one world.

    player: of all learners at first, or one for each. files: player files that edits may name.
    """

    def __init__(
        self, task: Task, player: str | Sequence[str] = "rules", seed: int = 0, disturbance: Disturbance | None = None,
        files: PlayerFiles = NO_FILES,
    ) -> None:  # fmt: skip
        self.record, self.seed, self.files = task, seed, files
        self.disturbance = disturbance or Disturbance()
        self.players = (player,) * task.learners if isinstance(player, str) else tuple(player)
        self._policies: dict[str, Any] = {}
        self.notices = self._load(self.players, task)
        self.start()

    def _load(self, names: Sequence[str], task: Task) -> tuple[str, ...]:
        """Load players of a task; return their warnings; raise ValueError, in one line, if one cannot play it."""
        policies: dict[str, Any] = {}
        with collected_warnings() as lines:
            for name in dict.fromkeys(names):
                if name != YOU and known_name(name) is None and name not in self.files.names:
                    allowed = ", ".join((*NAMES, *self.files.names, YOU))
                    hint = nearest(name, (*NAMES, YOU))
                    raise ValueError(f"player {printable(name)}: unknown{hint or ';'} allowed: {allowed}")
                if name != YOU:
                    policies[name] = self.files.load(name, task, self.seed)
        self._policies = policies
        return tuple(lines)

    def start(self, record: Record | None = None) -> None:
        """Begin the episode of this seed again, with another task if given."""
        task = self.record if record is None else record
        assert isinstance(task, Task)
        if record is not None:
            players = (self.players + self.players[-1:] * task.learners)[: task.learners]
            self._load(players, task)
            self.players = players
        self.begun = self.players, self.disturbance
        """Players and disturbance at the start of the episode."""
        self.world = make_world(task, 1, task.horizon, self.disturbance)
        self._observation = self.world.reset(self.seed)
        self.record, self.tick, self.stopped, self.states = task, 0, "", dict[str, Any]()
        self._action = np.zeros(self.world.action_size, np.float32)
        self.actions = np.zeros((task.learners, self.world.action_size), np.float32)
        """Actions of the last decision, (L, A)."""
        self._show_world()

    def _show_world(self) -> None:
        """Let players that see the state, such as planners, see that of the present world."""
        for policy in self._policies.values():
            if hasattr(policy, "watch"):
                policy.watch(self.world)

    @property
    def made_of(self) -> Callable[[], TaskLane]:
        """What makes such a lane, at its start; it can be pickled."""
        return functools.partial(TaskLane, self.record, self.players, self.seed, self.disturbance, self.files)

    @property
    def time(self) -> float:
        """Time of the world, s."""
        return float(self.world.state.time[0])

    @property
    def interval(self) -> float:
        """Time of one decision, s."""
        return self.record.control_dt

    @property
    def returns(self) -> float:
        """Return so far, mean over learners."""
        return float(self.world.paid[0].sum(axis=-1).mean())

    @property
    def observation(self) -> NDArray[np.float32]:
        """What learners observe now, (L, O)."""
        row: NDArray[np.float32] = self._observation[0]
        return row

    @property
    def digest(self) -> str:
        """A digest of the exact state."""
        return digest_arrays({name: array for name, array in self.world.arrays().items() if name != "state.work"})

    def step(self, ticks: int = 1) -> None:
        """Take some decisions, fewer if the episode ends or diverges."""
        for _ in range(ticks):
            if self.stopped:
                return
            actions = self._decide()
            try:
                result = self.world.step(actions[None])
            except FloatingPointError as error:
                self.stopped = str(error)
                return
            self._observation, self.actions = result.observation, actions
            self.tick += 1
            if result.ended[0]:
                outcome = "success" if result.success[0] else "no success"
                self.stopped = f"{outcome} at {self.time:.3g} s"

    def _decide(self) -> NDArray[np.float32]:
        """Return the actions of all learners, (L, A)."""
        actions = np.zeros((len(self.players), self.world.action_size), np.float32)
        for name in dict.fromkeys(self.players):
            mine = np.array([player == name for player in self.players])
            if name == YOU:
                actions[mine] = self._action
            elif isinstance(self._policies[name], RandomPolicy):  # a function of seed and tick: it can go back
                seed = np.random.SeedSequence((self.seed, self.tick)).generate_state(1)[0]
                actions[mine] = RandomPolicy(self.world.action_size, int(seed)).predict(self.observation[mine])[0]
            else:
                begins = np.full(int(mine.sum()), name not in self.states)
                found, self.states[name] = self._policies[name].predict(
                    self.observation[mine], self.states.get(name), begins, deterministic=True
                )
                actions[mine] = found
        return actions

    # --- edits ------------------------------------------------------------------------------------------------------

    def compile(self) -> None:
        """Compile what decisions need, in any thread, before the first one; the state stays as it is."""
        with suppress(FloatingPointError):
            first_step(self.record)
        for name in dict.fromkeys(self.players):
            self._warm_up(name)

    def prepare(self, edit: Edit) -> None:
        """Compile what an edit of the task or of its players needs, so that `apply` is fast; in any thread."""
        if isinstance(edit, Set):
            with collected_warnings():
                task = with_value(self.record, edit.path, edit.value)
            with suppress(FloatingPointError):
                first_step(task)
        elif isinstance(edit, Player):
            self._warm_up(edit.player)

    def _warm_up(self, name: str) -> None:
        """Let a player that ships decide once, which compiles its laws."""
        if known_name(name) is not None:
            with collected_warnings():
                player = self.files.load(name, self.record, self.seed)
            if hasattr(player, "watch"):
                player.watch(self.world)
            count = self.record.learners
            player.predict(self.observation, None, np.ones(count, np.bool_), deterministic=True)

    def would_restart(self, path: str, value: object) -> bool | None:
        """Return True if another value at a path begins the episode again; None if the value is not possible."""
        try:
            with collected_warnings():
                task = with_value(self.record, path, value)
                return self._begun_alike(task) is None
        except ValueError:
            return None

    def apply(self, edit: Edit) -> Change:
        """Apply an edit; raise ValueError, in one line, before anything changes if it is not possible."""
        if isinstance(edit, Set):
            return self._set(edit)
        if isinstance(edit, Player):
            return self._switch(edit)
        if isinstance(edit, Input):
            return self._steer(edit)
        if isinstance(edit, Disturb):
            return self._disturb(edit)
        if isinstance(edit, MoveAgent):
            return self._move(edit)
        if isinstance(edit, (AddObstacle, MoveObstacle, RemoveObstacle)):
            return self._change_obstacle(edit)
        numbers = [name for name, field in type(self.record).model_fields.items() if field.annotation is int]
        raise ValueError(f"{edit.kind}: not in a task, whose world its values describe, such as {', '.join(numbers)}")

    def _set(self, edit: Set) -> Change:
        """Give the task another value: the episode goes on if its start is the same, else it begins again."""
        with collected_warnings() as lines:
            task = with_value(self.record, edit.path, edit.value)
            world = self._begun_alike(task)
        notices = (*lines, *self._load(self.players if world else self.players[:1], task))
        if world is None:
            self.start(task)
            return Change(restarts=True, notices=notices)
        self._take_over(world)
        self.record, self.stopped = task, ""
        return Change(notices=notices)

    def _begun_alike(self, task: Task) -> World | None:
        """Return the world of another task if its episode begins in the same state with rows of the same size."""
        if _shape(task) != _shape(self.record):
            return None  # before anything is compiled
        mine, other = (make_world(each, 1, each.horizon, self.disturbance) for each in (self.record, task))
        mine.reset(self.seed)
        other.reset(self.seed)
        arrays, others = mine.arrays(), other.arrays()
        return other if all(array.tobytes() == others[name].tobytes() for name, array in arrays.items()) else None

    def _take_over(self, world: World) -> None:
        """Go on in another world object of the same state; pending actions of another delay are dropped."""
        arrays = {name: array.copy() for name, array in self.world.arrays().items()}
        own = world.arrays()
        fits = {k: v for k, v in arrays.items() if k in own and own[k].shape == v.shape}
        world.restore({**own, **fits})
        self.world = world
        self._show_world()
        self._observe()

    def _observe(self) -> None:
        """Compute the observations of the present state: a reset of no world changes nothing."""
        self._observation = self.world.reset(mask=np.zeros(1, np.bool_))

    def _switch(self, edit: Player) -> Change:
        count = len(self.players)
        chosen = range(count) if edit.learners == "all" else edit.learners
        if bad := [k for k in chosen if k >= count]:
            raise ValueError(f"learners = {bad[0]}: there are {count} learners, counted from 0")
        players = list(self.players)
        for k in chosen:
            players[k] = edit.player
        notices = self._load(players, self.record)
        changed = {*self.players, *players} if self.players != tuple(players) else set()
        self.players = tuple(players)
        for name in changed:
            self.states.pop(name, None)  # its rows are those of other learners
        self._show_world()
        return Change(in_record=False, notices=notices)

    def _steer(self, edit: Input) -> Change:
        if len(edit.action) != self.world.action_size:
            raise ValueError(f"action: has {len(edit.action)} numbers, must have {self.world.action_size}")
        self._action = np.array(edit.action, np.float32)
        return Change(in_record=False)

    def _disturb(self, edit: Disturb) -> Change:
        disturbance = Disturbance(noise=edit.noise, delay=edit.delay, dropped=edit.dropped)
        world = make_world(self.record, 1, self.record.horizon, disturbance)
        world.reset(self.seed)
        self.disturbance = disturbance
        self._take_over(world)
        return Change(in_record=False)

    def _move(self, edit: MoveAgent) -> Change:
        move_agent(self.record.scene, self.world.state, edit)
        self._observe()
        return Change(in_record=False)

    def _change_obstacle(self, edit: AddObstacle | MoveObstacle | RemoveObstacle) -> Change:
        """Change the round obstacles of the state: those of this episode, not of the task."""
        state = self.world.state
        slots = state.obstacle_radius.shape[1]
        if not slots:
            raise ValueError(f"{edit.kind}: {self.record.name} has no obstacles")
        if isinstance(edit, AddObstacle):
            free = np.flatnonzero(state.obstacle_radius[0] == 0)
            centre, radius = edit.shape.get("centre"), edit.shape.get("radius")
            if edit.shape.keys() - {"kind"} != {"centre", "radius"} or edit.shape.get("kind", "circle") != "circle":
                raise ValueError("shape: must be a circle with centre and radius; a task has no other obstacles")
            if not len(free):
                raise ValueError(f"shape: all {slots} obstacles are there; remove one first")
            self._place_obstacle(int(free[0]), centre, radius)
        elif edit.index >= slots or state.obstacle_radius[0, edit.index] == 0:
            raise ValueError(f"index = {edit.index}: there is no such obstacle")
        elif isinstance(edit, MoveObstacle):
            self._place_obstacle(edit.index, edit.centre, float(state.obstacle_radius[0, edit.index]))
        else:
            state.obstacle_radius[0, edit.index] = 0
        self._observe()
        return Change(in_record=False)

    def _place_obstacle(self, slot: int, centre: Any, radius: Any) -> None:
        from flockenv.geometry.shapes import Circle

        circle, d = Circle(centre=centre, radius=radius), self.record.scene.dimension
        if len(circle.centre) != d:
            raise ValueError(f"centre = {circle.centre}: must have {d} numbers")
        self.world.state.obstacles.centre[0, slot] = circle.centre
        self.world.state.obstacle_radius[0, slot] = circle.radius

    # --- keyframes and pictures -------------------------------------------------------------------------------------

    def keep(self) -> TaskKeyframe:
        """Return the exact state."""
        arrays = {name: array.copy() for name, array in self.world.arrays().items()}
        return TaskKeyframe(
            self.record, self.tick, arrays, copy.deepcopy(self.states), self.players, self._action, self.actions,
            self.disturbance, self.stopped,
        )  # fmt: skip

    def restore(self, keyframe: TaskKeyframe) -> None:
        """Go to a keyframe of this lane."""
        if (keyframe.record, keyframe.disturbance) != (self.record, self.disturbance):
            self.world = make_world(keyframe.record, 1, keyframe.record.horizon, keyframe.disturbance)
            self.world.reset(self.seed)
        if (keyframe.record, keyframe.players) != (self.record, self.players):
            self._load(keyframe.players, keyframe.record)
        self.record, self.disturbance, self.players = keyframe.record, keyframe.disturbance, keyframe.players
        self.world.restore(keyframe.arrays)
        self.states = copy.deepcopy(dict(keyframe.states))
        self._action, self.actions = keyframe.action, keyframe.actions
        self.tick, self.stopped = keyframe.tick, keyframe.stopped
        self._show_world()
        self._observe()

    @property
    def drawn(self) -> Drawn:
        """What a frame shows now."""
        state = self.world.state
        low, high = self.record.view(state, 0)
        d, kept = len(state.x), len(state.frame) > 0
        aim = state.frame[:d, 0] if kept else state.v[:, 0]
        return Drawn(self.time, state.x[:, 0], state.v[:, 0], aim, state.alive[0], low, high, None, None)

    @property
    def scenery(self) -> Scenery:
        """What stands around the agents now."""
        task, state = self.record, self.world.state
        low, high = task.view(state, 0)
        marks = task.marks(state, self.world.arrays()["memory"], 0)
        return Scenery(circles_of(state), task.scene.view.outlines(low, high, self.time), marks)

    def snapshot(self) -> Snapshot:
        """Return the world at this instant."""
        return self.world.snapshot()


def _shape(task: Task) -> tuple[object, ...]:
    """Return the sizes of all arrays of a task's world, and the numbers that its kernels are compiled for."""
    counts = tuple(task.parameters()[name] for name in task.counts)
    sizes = task.learners, task.agents, task.obstacle_slots, task.memory, task.layout.size, task.action_layout.size
    return *sizes, counts, task.dtype, task.scene.parts.inner, task.scene.parts.frame_rows
