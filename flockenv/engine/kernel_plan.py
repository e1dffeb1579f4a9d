"""KernelPlan: which laws make up a scene, and what follows from that for its kernel.

Which effects interact with neighbours, through how many different `sights`, which numbers are sorted with each agent
(`fields`: those that laws read), where each running number lies in the scratch of lanes (`slots`), and the numbers that
the kernel is passed (`parameters`). Plans of sections are made from parts, and scratch is allocated for them.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.engine.fields_read import OF_PAIRS, names_read
from flockenv.engine.obstacle_sets import ObstacleSets
from flockenv.engine.parameters import NumberPlan, pack_numbers
from flockenv.geometry.shapes.cells import MOST_FOUND
from flockenv.geometry.space import Space
from flockenv.jit import cpu
from flockenv.jit.cpu import LINE
from flockenv.physics.effects.effect import LAWS, Effect, Sight
from flockenv.physics.integrators.integrator import Integrator
from flockenv.physics.integrators.single_stage import OneStage

__all__ = ["KernelPlan", "Look", "flatten_effects"]


class Look(NamedTuple):
    """The query for what is near every agent, for observations and rewards: the nearest few, in all directions."""

    radius: float  # m
    agents: int = 0  # number of nearest agents
    obstacles: int = 0  # number of obstacles with the nearest surfaces


@dataclass(frozen=True)
class KernelPlan(ObstacleSets):
    """Which laws make up a scene: all that its kernel depends on."""

    dimension: int
    space: Space
    effects: tuple[Effect, ...]
    """In the order of `flatten_effects`: behaviours lie before the effect that combines their forces."""
    integrator: Integrator
    dtype: str = "float64"
    sorts: bool = True
    """True if there are enough agents to sort them by cell; a smaller scene has no code for it."""
    look: Look | None = None
    """The query of a task, which uses the same cell list."""
    crowded: bool = False
    """True if there are enough agents for distant groups of them to be treated as one."""
    oriented: bool = False
    """True if agents keep a heading (and an up vector) of their own."""
    turns: bool = False
    """True if the turn rate of some agents is limited."""
    leans: bool = False
    """True if some agents lean into their turns."""
    starts: tuple[int, ...] = ()
    """The first agent of each group, and N: values only, code does not depend on them."""
    shapes: tuple[Any, ...] = field(default=(), compare=False)
    """Obstacles that are not in the state: code depends on their forms, and on whether any of them moves."""
    circles: tuple[Any, ...] = field(default=(), compare=False)
    """Obstacles that come before them: circles of the state, at the places that they have when it is made."""
    stepped: bool = True
    """True if steps are made; else accelerations are computed, also of agents whose position is not finite."""
    touching: float = field(default=math.inf, compare=False)
    """m, slightly more than the sum of the two largest radii: agents further apart do not touch."""
    tables: tuple[NDArray[np.float64], ...] = field(default=(), compare=False)
    """The lookup table of each tabled effect, in order: also values only."""

    @functools.cached_property
    def width(self) -> int:
        """Lanes of a block: agents that one vector register holds.

        With far laws it is 16 on any processor: a tree is made of blocks, so results depend on the width.
        """
        return 16 if self.far else cpu.REGISTER // self.itemsize

    @property
    def masks(self) -> bool:
        """True if comparisons yield mask registers (AVX-512): repeating a comparison then costs nothing."""
        return cpu.REGISTER == LINE

    @property
    def keyed(self) -> bool:
        """True if lists of the nearest agents are kept as keys; see query_keys."""
        return self.look is not None and self.look.agents > 1 and not self.sorts and self.itemsize == 4

    @property
    def itemsize(self) -> int:
        """Bytes of a number."""
        return int(np.dtype(self.dtype).itemsize)

    @functools.cached_property
    def pairs(self) -> list[tuple[int, Effect]]:
        """The effects with a pair law, and their indices."""
        return [(k, e) for k, e in enumerate(self.effects) if e.pair_law is not None]

    @functools.cached_property
    def bond_effects(self) -> list[tuple[int, Effect]]:
        """The effects with a law of bonds, and their indices."""
        return [(k, e) for k, e in enumerate(self.effects) if e.bond_law is not None]

    @property
    def keeps_bonds(self) -> bool:
        """True if bonds of some effect keep a number, see State.bonds."""
        return any(e.bond_keep_law is not None for _, e in self.bond_effects)

    @property
    def place_of_bonds(self) -> int:
        """Which array of State.frame_and_inner is State.bonds; -1: none."""
        return bool(self.frame_rows) + bool(self.inner) if self.keeps_bonds else -1

    @functools.cached_property
    def group_effects(self) -> list[tuple[int, Effect]]:
        """The effects with a law about a group as one, and their indices."""
        return [(k, e) for k, e in enumerate(self.effects) if e.group_law is not None]

    @functools.cached_property
    def far(self) -> list[tuple[int, Effect]]:
        """The effects with a law about all agents, and their indices."""
        return [(k, e) for k, e in enumerate(self.effects) if e.far_law is not None]

    @functools.cached_property
    def tree_effects(self) -> list[tuple[int, Effect]]:
        """Those of `far` that treat distant groups as one."""
        return [(k, e) for k, e in self.far if self.crowded and e.parameters()["opening"] != 0]

    @property
    def has_far_bond_force(self) -> bool:
        """True if some law leaves forces in `far_bond_force`."""
        return bool(self.far or self.bond_effects)

    @property
    def flows(self) -> bool:
        """True if a medium carries agents."""
        return any(e.flow_law is not None for e in self.effects)

    @functools.cached_property
    def sights(self) -> list[Sight]:
        """The different sights of pair laws; laws with the same sight share the test."""
        return list(dict.fromkeys(self.sight_of(e) for _, e in self.pairs))

    def sight_of(self, effect: Effect) -> Sight:
        """Return which agents the pair law of an effect sees: a contact law, only those that can touch."""
        sight = effect.sight
        assert sight is not None, f"{type(effect).__name__} has a pair law and no sight"
        return sight._replace(radius=min(sight.radius, self.touching)) if effect.contact else sight

    @functools.cached_property
    def parting(self) -> bool:
        """True if agents in the same position are handled in a pass of their own, and all others without reading ties.

        This requires that every law that reads ties has an `apart_law` for agents elsewhere, and that all pair laws are
        sums.
        """
        readers = [e for _, e in self.pairs if "tie" in names_read(e, OF_PAIRS)]
        sums = not any(e.pair_start or e.contact for _, e in self.pairs)
        others = any("tie" in names_read(e, ("apart_law", "finish_law")) for e in readers)
        return sums and bool(readers) and all(e.apart_law for e in readers) and not others

    @property
    def looks_ahead(self) -> bool:
        """True if the distance of the next candidate is computed early, so that more operations are in flight.

        In small scenes, where a block visits all candidates in a row, with several pair laws, and with enough
        registers.
        """
        return self.parting and self.masks and not self.sorts and self.dimension == 2 and len(self.pairs) > 1

    @property
    def trusts(self) -> bool:
        """True if every agent has a finite position whenever forces are computed, unless a step has failed already.

        This holds if a step computes forces once. Then a law that vanishes at a distance needs no mask. 0 times a NaN
        offset is NaN, so a neighbour at NaN sends an agent to NaN in that step; `step_world` records step by step which
        agent was first.
        """
        return self.stepped and self.one_stage

    @property
    def spreads(self) -> bool:
        """True if a NaN position reaches every neighbour within one step."""
        return self.trusts and (bool(self.group_effects) or any(effect.vanishes for effect in self.effects))

    @functools.cached_property
    def counted_sights(self) -> list[int]:
        """The sights whose agents are counted (not of contact laws: these are evaluated for few candidates)."""
        if any(effect.averages and effect.contact for effect in self.effects):
            raise TypeError("an effect with `contact` counts no agents: it cannot have `averages`")
        return sorted({self.sights.index(self.sight_of(e)) for _, e in self.pairs if e.averages})

    @property
    def reach(self) -> float:
        """The largest radius within which any law looks for neighbours, m."""
        return max((sight.radius for sight in self.sights), default=0.0)

    @functools.cached_property
    def _numbers(self) -> tuple[list[float], NumberPlan]:
        return pack_numbers(self)

    def parameters(self) -> list[float]:
        """Return every number that the kernel is passed; tables follow."""
        return self._numbers[0]

    @property
    def number_plan(self) -> NumberPlan:
        """Where each of `parameters` lies."""
        return self._numbers[1]

    @property
    def count(self) -> int:
        """How many numbers the kernel is passed."""
        return len(self.parameters()) + sum(map(len, self.tables))

    def packed_numbers(self, in_place: bool = False) -> NDArray[Any]:
        """Return `parameters()` and the tables behind them, in the scene's precision, as the kernel is passed them.

        in_place: True if the circles of all worlds are where the scene has them, so that the grid over them holds.
        """
        every: list[Any] = [self.parameters(), self.shape_table[0], *self.cells.values(), *self.tables]
        numbers = np.concatenate(every).astype(self.dtype)
        if self.number_plan.circles >= 0 and not in_place:
            numbers[self.number_plan.circles + 2] = 0
        return numbers

    def numbers_of(self, effect: Effect) -> dict[str, Any]:
        """Return the numbers and vectors that the laws of an effect are passed, by name."""
        return {**effect.parameters(), **effect.members(self.starts)}

    def names_of(self, effect: Effect) -> list[str]:
        """Return the field names of the record that the laws of an effect are passed."""
        more = ["table"] * effect.tabled + ["counted"] * (effect.count_law is not None)
        return [*self.numbers_of(effect), *more]

    @functools.cached_property
    def combined(self) -> dict[int, int]:
        """The behaviours whose forces another effect combines, each with the index of that effect."""
        found: dict[int, int] = {}
        for k, effect in enumerate(self.effects):
            found |= dict.fromkeys(range(k - len(effect.components), k), k)
        return found

    def target(self, k: int) -> str:
        """Return the target of effect k: a behaviour's own force, the steering force, or the external force."""
        return f"w{k}_" if k in self.combined else "s" if self.effects[k].steering else "f"

    def pair_target(self, k: int) -> str:
        """Return the target of effect k's pair law: as `target`, or an input of its obstacle fold or keep law."""
        effect = self.effects[k]
        return f"n{k}_" if effect.obstacle_start is not None or effect.keep_law is not None else self.target(k)

    @functools.cached_property
    def inner(self) -> tuple[str, ...]:
        """Names of the inner states of every agent: all that some effect keeps."""
        return tuple(dict.fromkeys(name for effect in self.effects for name in effect.keeps))

    @property
    def keeping(self) -> list[tuple[int, Effect]]:
        """The effects that keep inner states, and their indices."""
        return [(k, e) for k, e in enumerate(self.effects) if e.keeps]

    @property
    def counters(self) -> int:
        """How many counters all effects have; they lie in the scratch array `counters`."""
        return sum(effect.counters for effect in self.effects if effect.count_law)

    @property
    def aims(self) -> bool:
        """True if some effect has an aim law: a desired direction."""
        return any(e.aim_law is not None for e in self.effects)

    @functools.cached_property
    def law_names(self) -> set[str]:
        """Every name in the code of all laws."""
        return set().union(*(names_read(e, LAWS) for e in self.effects))

    @property
    def bounces(self) -> bool:
        """True if bodies bounce off the walls of the space."""
        return self.space.bounce_law is not None

    @property
    def sweeps(self) -> bool:
        """True if any law or query looks for neighbours."""
        return bool(self.pairs) or (self.look is not None and self.look.agents > 0)

    @functools.cached_property
    def targets(self) -> list[str]:
        """The targets of pair laws: steering force, external force, behaviour forces, inputs of folds and keep laws."""
        found = {self.pair_target(k) for k, _ in self.pairs}
        names = ("s", "f", *(f"w{k}_" for k in self.combined), *(f"n{k}_" for k, _ in self.pairs))
        return [name for name in names if name in found]

    @property
    def pair_force_size(self) -> int:
        """How many numbers of a block lie in `pair_force`: a vector of each agent for each target."""
        return self.dimension * len(self.targets) * self.width

    def pair_force_at(self, target: str) -> int:
        """Return where in a block of `pair_force` the sum of pair laws for a target lies."""
        return self.targets.index(target) * self.dimension * self.width

    @property
    def one_stage(self) -> bool:
        """True if the method evaluates accelerations once, and then advances every coordinate independently."""
        return isinstance(self.integrator, OneStage)

    @property
    def saved_size(self) -> int:
        """Numbers of every agent that are saved in `saved`.

        For a method of one stage its acceleration; else its old position, and its old velocity if bodies bounce.
        """
        return self.dimension * (2 if self.bounces and not self.one_stage else 1)

    @functools.cached_property
    def fields(self) -> list[str]:
        """The fields that are sorted with each agent: those that pair laws read, by the names in their code."""
        names = set().union(*(names_read(e, OF_PAIRS) for _, e in self.pairs))
        if any(sight.fov < 360 for sight in self.sights):
            names.add("heading")
        if any(sight.group is not None for sight in self.sights):
            names.add("who")
        facing = "heading" in names
        needed = {"x": True, "v": "vel" in names or (facing and not self.oriented)}
        needed |= {"d" if self.oriented else "h": facing, "t": "tie" in names, "a": self.aims and "aim" in names}
        rows = [f"{letter}{k}" for letter, need in needed.items() if need for k in range(self.dimension)]
        rows += [name for name in ("who", "radius", "mass", "max_speed", "max_force", "desired_speed") if name in names]
        return rows + [f"inner{k}" for k in range(len(self.inner)) if "inner" in names]

    @functools.cached_property
    def sorted_fields(self) -> list[str]:
        """The `fields` that lie side by side in scratch or in records: all but rarely read ties."""
        seldom = self.sorts and self.parting
        return [name for name in self.fields if not (seldom and name[0] == "t")]

    @property
    def seen_fields(self) -> list[str]:
        """The fields that are sorted with each agent for the query of the nearest."""
        return [f"x{k}" for k in range(self.dimension)]

    @property
    def rows(self) -> int:
        """Rows that scratch needs for the numbers of listed agents, or of a block's own agents."""
        return max(len(self.sorted_fields) if self.pairs else 0, self.dimension if self.look else 0, 1)

    @property
    def numbers(self) -> int:
        """How many numbers a record of an agent has: a place, and all fields but headings."""
        kinds = [self.sorted_fields] * bool(self.pairs) + [self.seen_fields] * bool(self.look)
        return 1 + max((sum(name[0] != "h" for name in fields) for fields in kinds), default=0)

    @property
    def confines(self) -> bool:
        """True if all agents are moved into a periodic box when a call begins, so that no query has to wrap them.

        Only if accelerations are evaluated once per step: a stage of a method may lie outside.
        """
        return self.space.periodic and self.arranges and self.one_stage

    @property
    def arranges(self) -> bool:
        """True if agents of a large world may be reordered by tile during a call.

        Not if places matter: bonds refer to partners by place, and far laws and groups visit agents in their order.
        """
        return self.sorts and bool(self.pairs) and not self.has_far_bond_force and not self.group_effects

    @property
    def tracks_home_tiles(self) -> bool:
        """True if reordered agents that have left their tiles are tracked: if the grid is the same in every step."""
        return self.arranges and self.space.periodic

    @property
    def frame_vectors(self) -> list[str]:
        """The vectors of an agent's frame: its heading, and in 3-D its up vector."""
        return ["facing", "above"][: self.dimension - 1] if self.oriented else []

    @property
    def frame_numbers(self) -> list[str]:
        """Further numbers of an agent's body, by `Body`'s names, which not every scene needs."""
        paced = "desired_speed" in self.law_names
        return ["max_turn_rate"] * self.turns + ["banking"] * self.leans + ["desired_speed"] * paced

    @property
    def frame_rows(self) -> int:
        """Coordinates of the vectors of a frame, which a state holds for each agent."""
        return self.dimension * len(self.frame_vectors)

    @property
    def reordered_fields(self) -> list[str]:
        """The data that move with an agent when agents are reordered: an array, and the axis of a vector."""
        vectors = [
            "pos",
            "vel",
            "requested_force",
            *self.frame_vectors,
            *(["tie"] if "t0" in self.sorted_fields else []),
        ]
        vector = [f"{name} {k}" for name in vectors for k in range(self.dimension)]
        inner = (f"inner{k}" for k in range(len(self.inner)))
        return [*vector, "mass", "radius", "max_speed", "max_force", *self.frame_numbers, *inner, "ident"]

    @property
    def reordered_size(self) -> int:
        """How many numbers move with a reordered agent, in whole cache lines."""
        one = LINE // self.itemsize
        return -(-len(self.reordered_fields) // one) * one

    @functools.cached_property
    def slots(self) -> dict[str, int]:
        """Where each running number lies in the scratch of lanes."""
        d, look = self.dimension, self.look or Look(0.0)
        runs = [(f"c{k}_", e.sums(d)) for k, e in self.pairs]
        runs += [(f"near{q}_", sight.nearest or 0) for q, sight in enumerate(self.sights)]
        runs += [(f"many{q}_", 1) for q in self.counted_sights]
        runs += [(f"o{k}_", e.fold_size(d) if e.obstacle_start else 0) for k, e in enumerate(self.effects)]
        runs += [(f"g{name}", d) for name in self.targets]
        runs += [(f"group{k}_", 1 + 3 * d) for k, _ in self.group_effects]
        runs += [("bond", d * bool(self.bond_effects)), ("far", d * bool(self.far))]
        edges = [k for k, e in enumerate(self.effects) if e.obstacle_start and e.obstacle_edges]
        runs += [(f"ahead{k}_", 2) for k in edges]
        runs += [("found", -(-MOST_FOUND // self.width) * bool(self.gridded_forms))]
        runs += [("reach", int(bool(self.bounded_forms or self.gridded_forms))), ("here", int(self.parting))]
        runs += [("next", (d + 1) * self.looks_ahead)]
        runs += [("square", look.agents + self.keyed), ("place", look.agents)]
        runs += [("gap", look.obstacles), ("which", look.obstacles)]
        if self.sweeps and self.sorts:
            runs += [("inside", d * self.space.periodic), ("home", 1), ("mine", self.rows)]
        names = [f"{name}{j}" for name, many in runs for j in range(many)]
        return {name: place for place, name in enumerate([*names, "bad"])}


def flatten_effects(effects: Sequence[Effect]) -> tuple[Effect, ...]:
    """Return effects with the behaviours that each combines before it: each has laws and numbers of its own."""
    return tuple(each for effect in effects for each in (*effect.components, effect))
