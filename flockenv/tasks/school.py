"""School: fish survive and feed among other fish, patches of food that regrow, and hunters."""

from __future__ import annotations

import functools
import math
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv import steering
from flockenv.geometry.space import Box
from flockenv.jit.decorators import Vec, kernel
from flockenv.maths.counter_rng import smooth, uniform
from flockenv.maths.vectors import add, dot, norm, scale, sub, unit
from flockenv.model.snapshot import Mark
from flockenv.model.state import State
from flockenv.physics.effects.effect import in_view
from flockenv.scene import Group, Scene
from flockenv.steering import arbitration, motivation
from flockenv.tasks.layout import Layout, Slot, slots_of
from flockenv.tasks.observations import clip, position_of, velocity_of
from flockenv.tasks.task import Frame, Task

__all__ = ["School"]

_TRIES = 64
_GAIN = 5.0  # kg/s: a scripted fish reaches its desired velocity within 0.2 s
_MARGIN = 0.5  # m, distance that scripted agents keep from walls
_ESCAPE, _SCHOOL, _NEED = 0.4, 0.15, 0.5  # fear above which they flee, and school; hunger above which they eat
_CALM, _CONTENT = 0.1, 0.3  # the intention ends when fear, or hunger, falls by this below its threshold
HUNGER, FEAR, FOOD, EATEN, INTENT, FATE = range(6)
"""Rows of the memory: hunger, 0 to 1; fear, 0 to 1; food of a patch; food eaten in this step; index of INTENTIONS; fate
of a fish in this step: 0, CAUGHT or STARVED. Food is in the unit of `capacity`."""

CAUGHT, STARVED = 1, 2


@kernel
def spawn(p: Any, frame: Frame) -> None:
    """Place fish at random, food patches apart from each other, hunters `start_distance` m from all fish; at rest."""
    frame.vel[:, :] = 0.0
    frame.memory[:, :] = 0.0
    fish, foes, n = int(p.fish), int(p.fish + p.hunters), frame.pos.shape[1]
    for i in range(n):
        edge = 2.5 if i >= foes else 1.0
        for t in range(_TRIES):
            for k in range(2):
                frame.pos[k, i] = edge + (p.size - 2.0 * edge) * uniform(frame.key, t, i, k)
            if i >= foes:
                clear = _is_clear(frame, i, foes, i, p.size / (1.0 + p.patches))
            elif i >= fish:
                clear = _is_clear(frame, i, 0, fish, p.start_distance)
            else:
                clear = _is_clear(frame, i, 0, i, 4.0 * frame.radius[i])
            if clear:
                break
        if i < foes:
            frame.memory[HUNGER, i] = p.start_hunger * (0.5 + uniform(frame.key, 0, i, 2))
        else:
            frame.memory[FOOD, i] = p.capacity


@kernel
def _is_clear(frame: Frame, i: int, first: int, end: int, distance: float) -> bool:
    """Return True if agent i is at least `distance` m from the agents [first, end)."""
    for j in range(first, end):  # noqa: SIM110  # there are no generators in compiled code
        if norm(_offset_to(frame, i, j)) < distance:
            return False
    return True


@kernel
def _offset_to(frame: Frame, i: int, j: int) -> Vec:
    """Return the offset of agent j from agent i, m."""
    return sub(position_of(frame, j), position_of(frame, i))


@kernel
def _sees(p: Any, frame: Frame, i: int, j: int) -> bool:
    """Return True if fish i sees agent j: within sight, and not in the blind angle behind it."""
    to = _offset_to(frame, i, j)
    square = dot(to, to)
    inside: bool = square < p.sight * p.sight and in_view(p.cone, unit(velocity_of(frame, i)), to, square)
    return inside


@kernel
def _next_visible(
    p: Any, frame: Frame, i: int, first: int, end: int, previous: int, previous_distance: float
) -> tuple[int, float]:
    """Return the next nearest agent of [first, end) that fish i sees, after `previous`, and its distance; or -1."""
    least, nearest = np.inf, -1
    for j in range(first, end):
        distance = norm(_offset_to(frame, i, j))
        later = distance > previous_distance or (distance == previous_distance and j > previous)
        if j != i and frame.alive[j] and later and distance < least and _sees(p, frame, i, j):
            least, nearest = distance, j
    return nearest, least


# --- scripted agents --------------------------------------------------------------------------------------------------


@kernel
def drive(p: Any, frame: Frame, action: Any, force: Any) -> None:
    """Write each learner's action as a force along the tank's axes; others follow `_fish_force` or `_hunter_force`."""
    fish, foes = int(p.fish), int(p.fish + p.hunters)
    for i in range(frame.pos.shape[1]):
        if not frame.alive[i] or i >= foes:
            force[0, i], force[1, i] = 0.0, 0.0
        elif i < action.shape[0]:
            for k in range(2):
                force[k, i] = action[i, k] * frame.max_force[i]
        else:
            own = _fish_force(p, frame, i) if i < fish else _hunter_force(p, frame, i)
            velocity, top = velocity_of(frame, i), np.float64(frame.max_speed[i])
            here = position_of(frame, i)
            low, high = sub(here, (_MARGIN, _MARGIN)), sub((p.size - _MARGIN, p.size - _MARGIN), here)
            inside = scale(steering.contain(low, high, velocity, top, 0.3), _GAIN)
            forces = (inside, _separation(frame, i), own)
            total = arbitration.allocate(forces, np.float64(frame.max_force[i]))
            force[0, i], force[1, i] = total[0], total[1]


@kernel
def _separation(frame: Frame, i: int) -> Vec:
    """Return the separation from agents of the same radius that are nearer than three radii."""
    push: Vec = (0.0, 0.0)
    for j in range(frame.pos.shape[1]):
        to, mine = _offset_to(frame, i, j), frame.radius[i]
        if j != i and frame.alive[j] and frame.radius[j] == mine and norm(to) < 3.0 * mine:
            push = add(push, steering.separate(to, (1.0, 0.0) if j < i else (-1.0, 0.0)))
    return push


@kernel
def _wander(frame: Frame, i: int, time: float, speed: float) -> Vec:
    """Return the force of wandering (Reynolds 1999) at this speed, m/s."""
    velocity = velocity_of(frame, i)
    angle = 2.0 * math.pi * uniform(frame.key, 0, i, 3)
    direction: Vec = (math.cos(angle), math.sin(angle))
    if velocity[0] != 0.0 or velocity[1] != 0.0:
        direction = velocity
    turn: Vec = (0.0, np.float64(smooth(frame.key, time, i, 4)))
    desired = add(steering.wander(turn, direction, speed, 1.0), direction)
    return scale(sub(desired, velocity), 2.0)


@kernel
def _fish_force(p: Any, frame: Frame, i: int) -> Vec:
    """Return the force of a scripted fish by its intention: evade, forage, school, or wander."""
    velocity, top = velocity_of(frame, i), np.float64(frame.max_speed[i])
    fish, foes, intent = int(p.fish), int(p.fish + p.hunters), frame.memory[INTENT, i]
    if intent == motivation.ESCAPE:
        target, distance = _next_visible(p, frame, i, fish, foes, -1, -1.0)
        if target >= 0:
            ahead = min(distance / p.hunter_speed, 0.5)
            to, theirs = _offset_to(frame, i, target), velocity_of(frame, target)
            return scale(steering.evade(to, velocity, theirs, top, ahead), _GAIN)
    if intent == motivation.EAT:
        target, _ = _next_visible(p, frame, i, foes, frame.pos.shape[1], -1, -1.0)
        if target >= 0:
            return scale(steering.arrive(_offset_to(frame, i, target), velocity, top, 1.0), _GAIN)
    if intent == motivation.SCHOOL:
        count = 0.0
        centre: Vec = (0.0, 0.0)
        course: Vec = (0.0, 0.0)
        for j in range(fish):
            if j != i and frame.alive[j] and _sees(p, frame, i, j):
                count += 1.0
                centre, course = add(centre, _offset_to(frame, i, j)), add(course, velocity_of(frame, j))
        if count > 0.0:
            alignment = steering.align(velocity, scale(course, 1.0 / count))
            return add(scale(alignment, 2.0), scale(centre, 1.0 / count))
    return _wander(frame, i, 0.5 * frame.step * p.control_dt, 0.5 * top)


@kernel
def _hunter_force(p: Any, frame: Frame, i: int) -> Vec:
    """Return a hunter's force: if hungry, pursue the nearest fish within `hunter_sight`, else wander slowly."""
    least, prey = p.hunter_sight, -1
    for j in range(int(p.fish)):
        distance = norm(_offset_to(frame, i, j))
        if frame.alive[j] and distance < least:
            least, prey = distance, j
    velocity, top = velocity_of(frame, i), np.float64(frame.max_speed[i])
    if frame.memory[INTENT, i] == motivation.EAT and prey >= 0:
        to, theirs = _offset_to(frame, i, prey), velocity_of(frame, prey)
        ahead = min(steering.interception_time(to, theirs, top), 1.0)
        return scale(steering.pursue(to, velocity, theirs, top, ahead), _GAIN)
    return _wander(frame, i, 0.5 * frame.step * p.control_dt, 0.4 * top)


# --- hunger, fear and food --------------------------------------------------------------------------------------------


@kernel
def keep(p: Any, before: Frame, after: Frame) -> None:
    """Update food, captures, hunger, fear and intentions.

    Interactions between two agents are computed for both from the same instant, before any state changes.
    """
    foes, n = int(p.fish + p.hunters), after.pos.shape[1]
    for i in range(n):
        after.memory[EATEN, i], after.memory[FATE, i] = 0.0, 0.0
    for i in range(int(p.fish)):
        if before.alive[i]:
            _eat(p, after, i)
            _update_fear(p, after, i)
    for i in range(foes):
        if before.alive[i]:
            _update_hunger(p, after, i)
    for i in range(foes):
        if before.alive[i]:
            _update_intention(after, i)
    for j in range(foes, n):
        grown = motivation.regrow(np.float64(after.memory[FOOD, j]), p.growth, p.capacity, p.control_dt)
        after.memory[FOOD, j] = grown - after.memory[EATEN, j]


@kernel
def _eat(p: Any, frame: Frame, i: int) -> None:
    """Add what fish i eats of each patch within reach to the counts of the fish and of the patch."""
    hunger = np.float64(frame.memory[HUNGER, i])
    for j in range(int(p.fish + p.hunters), frame.pos.shape[1]):
        if norm(_offset_to(frame, i, j)) < p.reach:
            taken = motivation.bite(np.float64(frame.memory[FOOD, j]), hunger, p.grazing, p.control_dt)
            frame.memory[EATEN, i] += taken
            frame.memory[EATEN, j] += taken


@kernel
def _captures(p: Any, frame: Frame, j: int, i: int) -> bool:
    """Return True if hunter j is hunting and fish i is within its capture distance."""
    return bool(frame.memory[INTENT, j] == motivation.EAT and norm(_offset_to(frame, j, i)) <= p.capture_distance)


@kernel
def _update_fear(p: Any, frame: Frame, i: int) -> None:
    """Update the fear of fish i from the hunters that it sees and its previous fear, and whether it is caught."""
    fear = 0.0
    for j in range(int(p.fish), int(p.fish + p.hunters)):
        if _sees(p, frame, i, j):
            fear += motivation.fright(norm(_offset_to(frame, i, j)), p.fear_distance)
        if _captures(p, frame, j, i):
            frame.memory[FATE, i] = CAUGHT
    frame.memory[FEAR, i] = motivation.update_fear(
        np.float64(frame.memory[FEAR, i]), min(fear, 1.0), p.fear_memory, p.control_dt
    )


@kernel
def _update_intention(frame: Frame, i: int) -> None:
    """Update the intention of fish or hunter i."""
    now, hunger = np.float64(frame.memory[INTENT, i]), np.float64(frame.memory[HUNGER, i])
    fear = np.float64(frame.memory[FEAR, i])
    frame.memory[INTENT, i] = motivation.intention(now, hunger, 0.0, fear, _ESCAPE, _SCHOOL, _NEED, _CALM, _CONTENT)


@kernel
def _update_hunger(p: Any, frame: Frame, i: int) -> None:
    """Update the hunger of fish or hunter i: time and effort raise it, food lowers it."""
    hunts = i >= int(p.fish)
    pace = norm(velocity_of(frame, i)) / np.float64(frame.max_speed[i])
    rate = p.hunter_metabolism if hunts else p.metabolism
    hunger = np.float64(frame.memory[HUNGER, i])
    food = np.float64(frame.memory[EATEN, i])
    if hunts:
        for j in range(int(p.fish)):
            food += p.meal if frame.memory[FATE, j] == CAUGHT and _captures(p, frame, i, j) else 0.0
    later = motivation.grow_hunger(hunger, rate, p.effort, pace, p.control_dt)
    frame.memory[HUNGER, i] = max(later - food, 0.0)
    if not hunts and later - food >= 1.0 and frame.memory[FATE, i] == 0.0:
        frame.memory[FATE, i] = STARVED


# --- reward and end ---------------------------------------------------------------------------------------------------


@kernel
def reward(p: Any, at: Any, before: Frame, after: Frame, action: Any, terms: Any) -> None:
    """Write the terms alive, fed, dead; all 0 for a fish that died before this step."""
    for i in range(terms.shape[0]):
        lives = before.alive[i] and after.memory[FATE, i] == 0.0
        terms[i, at.alive] = p.alive_reward * p.control_dt if lives else 0.0
        terms[i, at.fed] = p.fed_reward * (1.0 - after.memory[HUNGER, i]) * p.control_dt if lives else 0.0
        terms[i, at.dead] = -p.death_cost if before.alive[i] and not lives else 0.0


@kernel
def ended(p: Any, at: Any, before: Frame, after: Frame, numbers: Any, over: Any) -> bool:
    """End the learners that are caught or starved; return True while at least half of the learners live."""
    left = 0
    for i in range(int(p.fish)):
        out = not before.alive[i] or after.memory[FATE, i] != 0.0
        after.alive[i] = not out
        if i < over.shape[0]:
            over[i] = out
            left += 0 if out else 1
    return bool(2 * left >= over.shape[0])


@kernel
def measure(p: Any, at: Any, before: Frame, after: Frame, numbers: Any) -> None:
    """Write the learners' share alive; summed hunger of those; food eaten; shares caught and starved in this step.

    Hunger and food are divided by the number of learners.
    """
    learners = int(p.learners)
    for k in range(numbers.shape[0]):
        numbers[k] = 0.0
    for i in range(learners):
        if after.alive[i]:
            numbers[at.alive] += 1.0 / learners
            numbers[at.hunger] += after.memory[HUNGER, i] / learners
        if before.alive[i]:
            numbers[at.eaten] += after.memory[EATEN, i] / learners
            numbers[at.caught] += 1.0 / learners if after.memory[FATE, i] == CAUGHT else 0.0
            numbers[at.starved] += 1.0 / learners if after.memory[FATE, i] == STARVED else 0.0


@kernel
def metrics(p: Any, at: Any, sums: Any, last: Any, steps: int, numbers: Any) -> None:
    """Write the share of learners alive; mean lifetime, s; mean hunger while alive; mean food eaten; shares caught,
    and starved.
    """
    numbers[at.survived], numbers[at.lifetime] = last.alive, sums.alive * p.control_dt
    if sums.alive > 0:
        numbers[at.hunger] = sums.hunger / sums.alive
    numbers[at.eaten], numbers[at.caught], numbers[at.starved] = sums.eaten, sums.caught, sums.starved


# --- observation ------------------------------------------------------------------------------------------------------


@kernel
def observe(p: Any, at: Any, frame: Frame, rows: Any) -> None:
    """Write own velocity, walls, hunger, fear; hunters, food and fish in sight, nearest first.

    The row of a dead fish is 0 but for a hunger of 1; its wall distances of 0 set it apart from any living fish.
    """
    fish, foes, n = int(p.fish), int(p.fish + p.hunters), frame.pos.shape[1]
    for i in range(rows.shape[0]):
        row = rows[i]
        for c in range(row.shape[0]):
            row[c] = 0.0
        if not frame.alive[i]:
            row[at.hunger] = 1.0
            continue
        for k in range(2):
            row[at.velocity + k] = clip(frame.vel[k, i] / p.fish_speed)
            row[at.to_low + k] = clip(frame.pos[k, i] / p.size)
            row[at.to_high + k] = clip((p.size - frame.pos[k, i]) / p.size)
        row[at.hunger], row[at.fear] = frame.memory[HUNGER, i], frame.memory[FEAR, i]
        hunters = (at.hunters, at.hunter_bearing, at.hunter_velocity, at.hunter_closeness, at.hunter_present)
        _write_visible(p, frame, i, fish, foes, int(p.hunters), row, hunters)
        food = (at.food, at.food_bearing, at.food_velocity, at.food_closeness, at.food_amount)
        _write_visible(p, frame, i, foes, n, int(p.food_seen), row, food)
        mates = (at.mates, at.mate_bearing, at.mate_velocity, at.mate_closeness, at.mate_present)
        _write_visible(p, frame, i, 0, fish, int(p.fish_seen), row, mates)


@kernel
def _write_visible(p: Any, frame: Frame, i: int, first: int, end: int, slots: int, row: Any, places: Any) -> None:
    """Write the agents of [first, end) that fish i sees: offset, bearing, velocity, closeness, presence or amount.

    Each of these begins at its index in `places`.
    """
    offset, bearing, velocity, closeness, presence = places
    previous, previous_distance = -1, -1.0
    for s in range(slots):
        index, distance = _next_visible(p, frame, i, first, end, previous, previous_distance)
        if index < 0:
            break
        to, direction = _offset_to(frame, i, index), unit(_offset_to(frame, i, index))
        for k in range(2):
            row[offset + 2 * s + k] = clip(to[k] / p.sight)
            row[bearing + 2 * s + k] = direction[k]
            row[velocity + 2 * s + k] = clip(frame.vel[k, index] / p.hunter_speed)
        row[closeness + s] = max(1.0 - distance / p.near, 0.0)
        row[presence + s] = 1.0 if end < frame.pos.shape[1] else min(frame.memory[FOOD, index] / p.capacity, 1.0)
        previous, previous_distance = index, distance


class School(Task):
    """Fish with one shared policy (or one among scripted fish) live in a tank with patches of food and hunters.

    Hunger grows with time and effort. A fish within `reach` of a patch eats of it; the patch regrows logistically. The
    view angle of a fish is `fov`, 300 degrees by default. A hungry hunter pursues the nearest fish; it is faster than a
    fish, but turns more slowly. A fed hunter does not pursue until it is hungry again. A fish that is caught or starves
    terminates; the others go on. Success: at least half of the learners live. Hunger and fear follow Tu and Terzopoulos
    (1994; see flockenv.steering.motivation); scripted fish are their state machine: flee, school, forage, wander.
    """

    name: ClassVar[str] = "school"
    terms: ClassVar[tuple[str, ...]] = ("alive", "fed", "dead")
    metric_names: ClassVar[tuple[str, ...]] = ("survived", "lifetime", "hunger", "eaten", "caught", "starved")
    measures: ClassVar[tuple[str, ...]] = ("alive", "hunger", "eaten", "caught", "starved")
    memory: ClassVar[int] = 6
    keeps: ClassVar[bool] = True

    fish: int = Field(default=8, ge=1, le=64, description="number of fish")
    learners: int = Field(
        default_factory=lambda given: given.get("fish", 8), ge=1,
        description="number of learners (default of the task: all); the others are scripted",
    )  # fmt: skip
    hunters: int = Field(default=1, ge=1, le=8, description="number of hunters")
    patches: int = Field(default=4, ge=1, le=16, description="number of food patches")
    horizon: int = Field(default=400, ge=1, description="decisions until the time limit (truncation)")
    size: float = Field(default=24.0, gt=10, description="m, edge of the tank")
    start_distance: float = Field(
        default=6.0, ge=0, description="m, least distance between hunters and fish at the start"
    )
    fish_speed: float = Field(default=2.0, gt=0, description="m/s")
    fish_force: float = Field(default=8.0, gt=0, description="N; the mass is 1 kg")
    hunter_speed: float = Field(default=2.4, gt=0, description="m/s")
    hunter_force: float = Field(default=2.5, gt=0, description="N; the mass is 1 kg")
    hunter_sight: float = Field(
        default=12.0, gt=0, description="m, range within which a hunter sees fish, in all directions"
    )
    hunter_metabolism: float = Field(
        default=0.04, ge=0, description="1/s, rate of hunger of a hunter at rest; it hunts above 0.5"
    )
    meal: float = Field(default=0.8, ge=0, le=1, description="by how much a caught fish lowers a hunter's hunger")
    capture_distance: float = Field(default=0.5, gt=0, description="m between centres, for a capture")
    sight: float = Field(default=10.0, gt=0, description="m, range within which a fish sees others and food")
    fov: float = Field(default=300.0, gt=0, le=360, description="degrees, full view angle of a fish")
    near: float = Field(default=5.0, gt=0, description="m, range within which closeness is not 0")
    food_seen: int = Field(default=3, ge=1, le=16, description="number of patches seen, nearest first")
    fish_seen: int = Field(default=3, ge=0, le=16, description="number of other fish seen, nearest first")
    start_hunger: float = Field(
        default=0.4, gt=0, le=0.6, description="mean hunger at the start, drawn within +-50 %; 0 full, 1 starved"
    )
    metabolism: float = Field(default=0.02, ge=0, description="1/s, rate of hunger of a fish at rest")
    effort: float = Field(
        default=0.02, ge=0, description="1/s, extra rate of hunger at top speed; proportional to speed squared"
    )
    reach: float = Field(default=1.0, gt=0, description="m, a fish eats within this distance of a patch's centre")
    grazing: float = Field(default=0.5, ge=0, description="1/s, share of a patch that a fish with hunger 1 eats")
    growth: float = Field(default=0.25, ge=0, description="1/s, growth rate of food")
    capacity: float = Field(default=1.5, gt=0, description="food of a full patch; 1 feeds a fish from starved to full")
    fear_distance: float = Field(default=1.0, gt=0, description="m, distance within which the fear of a hunter is 1")
    fear_memory: float = Field(default=2.0, gt=0, description="s, time constant with which fear decays")
    alive_reward: float = Field(default=0.5, ge=0, description="per s")
    fed_reward: float = Field(default=0.5, ge=0, description="per s at hunger 0; falls linearly to 0 at hunger 1")
    death_cost: float = Field(default=10.0, ge=0, description="once, when caught or starved")

    @model_validator(mode="after")
    def _check_sizes(self) -> School:
        """Raise ValueError for more learners than fish, a start distance above half the tank, or too much grazing."""
        if self.learners > self.fish:
            raise ValueError(f"learners = {self.learners}: there are only {self.fish} fish")
        if self.start_distance > self.size / 2:
            raise ValueError(f"start_distance = {self.start_distance:g}: at most size / 2 = {self.size / 2:g} m")
        if self.grazing * self.control_dt * self.fish > 1:
            raise ValueError(
                f"grazing = {self.grazing:g}: {self.fish} fish could eat more than there is within one decision; "
                f"at most {1 / (self.control_dt * self.fish):g} 1/s is allowed"
            )
        return self

    @property
    def agents(self) -> int:
        """N: fish, hunters and food patches."""
        return self.fish + self.hunters + self.patches

    @property
    def agent_names(self) -> tuple[str, ...]:
        """fish_0 ..."""
        return tuple(f"fish_{i}" for i in range(self.learners))

    @property
    def ends_together(self) -> bool:
        """True for one learner: several leave one by one."""
        return self.learners == 1

    @functools.cached_property
    def scene(self) -> Scene:
        """A walled square, in which only the agents' own forces act."""
        fish: dict[str, Any] = {"radius": 0.2, "max_speed": self.fish_speed, "max_force": self.fish_force}
        groups = [Group(count=self.learners, role="learner", **fish)]
        if self.fish > self.learners:
            groups.append(Group(count=self.fish - self.learners, role="flockmate", **fish))
        groups.append(
            Group(
                count=self.hunters, radius=0.4, max_speed=self.hunter_speed, max_force=self.hunter_force, role="pursuer"
            )
        )
        groups.append(Group(count=self.patches, radius=0.1, max_speed=1.0, max_force=0.0))
        return Scene(
            space=Box(size=(self.size, self.size)),
            groups=tuple(groups),
            integrator=self.integrator,
            dt=self.dt,
            dtype=self.dtype,
        )

    def parameters(self) -> dict[str, float]:
        """Return the fields, and the numbers derived from them."""
        ahead = math.cos(math.radians(self.fov / 2))
        return super().parameters() | {"cone": ahead * abs(ahead)}

    @functools.cached_property
    def layout(self) -> Layout:
        """The observation; axes are the tank's, offsets relative to the fish; zeros for empty slots."""
        fear = "min(fear_distance / distance, 1) of the hunters in sight; it fades without them"
        slots = [
            Slot("velocity", (2,), self.fish_speed, "m/s", "own velocity (x, y)"),
            Slot("to_low", (2,), self.size, "m", "distance to the walls at x = 0 and y = 0", low=0.0),
            Slot("to_high", (2,), self.size, "m", "distance to the walls at x = size and y = size", low=0.0),
            Slot("hunger", (), 1.0, "1", "0 full, 1 starved", low=0.0),
            Slot("fear", (), 1.0, "1", fear, low=0.0),
        ]
        last = {
            "hunters": ("present", 1.0, "1", "1 for each one, 0 for an empty slot"),
            "food": ("amount", self.capacity, "fish", "food left in that patch"),
            "mates": ("present", 1.0, "1", "1 for each one, 0 for an empty slot"),
        }
        counts = {"hunters": self.hunters, "food": self.food_seen, "mates": self.fish_seen}
        near = "1 - distance / near; 0 for a distance above near"
        for name, (what, unit_, of, meaning) in last.items():
            n, one = counts[name], name.removesuffix("s")
            slots += slots_of(
                name,
                Slot(name, (n, 2), self.sight, "m", f"offsets of the {name} in sight, nearest first"),
                Slot(f"{one}_bearing", (n, 2), 1.0, "1", "unit vectors towards them"),
                Slot(f"{one}_velocity", (n, 2), self.hunter_speed, "m/s", "their velocities"),
                Slot(f"{one}_closeness", (n,), 1.0, "1", near, low=0.0),
                Slot(f"{one}_{what}", (n,), unit_, of, meaning, low=0.0),
            )
        return Layout(tuple(slots))

    @functools.cached_property
    def action_layout(self) -> Layout:
        """A force along the tank's axes."""
        meaning = "force (x, y) / max_force, shortened to length 1"
        return Layout((Slot("force", (2,), self.fish_force, "N", meaning),))

    def marks(self, state: State, memory: NDArray[np.float64], world: int) -> tuple[Mark, ...]:
        """Return a mark at each patch, with an area proportional to its food."""
        first = self.fish + self.hunters
        return tuple(
            Mark("goal", state.pos[world, j], np.zeros(2), self._drawn_radius(float(memory[FOOD, world, j])))
            for j in range(first, self.agents)
        )

    def own_success(self, state: State, memory: NDArray[Any], alive: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
        """Return whether each learner lives, (B, L)."""
        return alive

    def _drawn_radius(self, amount: float) -> float:
        """Return the radius at which a patch is drawn, m."""
        return self.reach * math.sqrt(min(max(amount / self.capacity, 0.01), 1.0))
