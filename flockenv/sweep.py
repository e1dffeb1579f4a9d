"""The sweep: composes the laws of a scene into one small source file, which numba compiles once and keeps.

What is written depends only on which laws there are, in which space, dimension and integrator, and which of them see
the same neighbours; numbers are arguments. A law that is not listed leaves no trace: no branch, no buffer, no query.

Agents go side by side in blocks of 16 lanes (8 in float64: what a vector register holds), and every array of a world
lies in such blocks: the 16 first coordinates of a block, its 16 second ones, and so on. So a loop over the lanes has a constant length and constant offsets, and the
compiler makes it straight vector code; running sums lie in one small scratch array and stay in vector registers.
"""

from __future__ import annotations

import builtins
import functools
import inspect
import sys
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from flockenv.effects.base import Effect, Sight
from flockenv.integrators.base import Integrator
from flockenv.neighbours import FEWEST_AGENTS
from flockenv.space import Space

__all__ = ["SHARED", "Look", "Parts", "look_source", "scene_source"]

_READ = (
    "mass, radius, max_speed, max_force, living, want, felt, sorted_, records, order, cell, start, offset, bounds, "
    "tally, sync, tie, number, lanes, ranges"
)
SHARED = f"pos, vel, origin, stages, {_READ}"
"""Scratch of one world in progress, in order; see scene.Workspace. The last two belong to one thread."""

CONTEXT = f"obstacle_x, obstacle_radius, work, params, b, n, present, first, end, rank, team, {_READ}"
"""What an acceleration is given beside positions and velocities, in order."""


class Look(NamedTuple):
    """What is near every agent, for observations and rewards: the nearest few, all around."""

    radius: float  # m
    agents: int = 0  # so many of the nearest agents
    obstacles: int = 0  # so many of the obstacles whose surface is nearest


@dataclass(frozen=True)
class Parts:
    """Which laws make up a scene: all that the source depends on."""

    dimension: int
    space: Space
    effects: tuple[Effect, ...]
    integrator: Integrator
    dtype: str = "float64"
    look: Look | None = None
    """What a task shows its agents, found by the same query."""

    @property
    def width(self) -> int:
        """Lanes of a block: agents that one vector register of 64 bytes holds."""
        return 64 // np.dtype(self.dtype).itemsize

    @functools.cached_property
    def pairs(self) -> list[tuple[int, Effect]]:
        """The effects with a pair law, and their numbers."""
        return [(k, e) for k, e in enumerate(self.effects) if e.pair_law is not None]

    @functools.cached_property
    def sights(self) -> list[Sight]:
        """The different ways in which pair laws look around; laws that see the same share the test."""
        return list(dict.fromkeys(_sight(e) for _, e in self.pairs))

    @property
    def reach(self) -> float:
        """The largest distance at which any law looks for neighbours, m."""
        return max((sight.radius for sight in self.sights), default=0.0)

    def parameters(self) -> list[float]:
        """Every number that the kernel is given, in the order in which the source reads them."""
        values = [*self.space.extent(self.dimension), self.reach]
        for sight in self.sights:
            values += [sight.radius**2, view_of(sight.fov)]
        for effect in self.effects:
            values.extend(effect.parameters().values())
        return values + ([self.look.radius, self.look.radius**2] if self.look else [])

    @property
    def sweeps(self) -> bool:
        """Does anybody ask who is near whom?"""
        return bool(self.pairs) or (self.look is not None and self.look.agents > 0)

    @functools.cached_property
    def targets(self) -> list[str]:
        """What pair laws add to: what agents want, what acts on them, or both."""
        return [name for name, steering in (("s", True), ("f", False)) if any(e.steering is steering for _, e in self.pairs)]

    @functools.cached_property
    def fields(self) -> list[str]:
        """What is sorted of each agent, a row each: what the pair laws read, found from the names in their code."""
        names = set().union(*(_names(e) for _, e in self.pairs)) if self.pairs else set()
        if any(sight.fov < 360 for sight in self.sights):
            names.add("heading")
        d = self.dimension
        per_axis = [("x", True), ("v", bool({"vel", "heading"} & names)), ("h", "heading" in names), ("t", "tie" in names)]
        rows = [f"{letter}{k}" for letter, needed in per_axis if needed for k in range(d)]
        return rows + [name for name in ("who", "radius", "mass", "max_speed", "max_force") if name in names]

    @property
    def seen_fields(self) -> list[str]:
        """What is sorted of each agent to find the nearest."""
        return [f"x{k}" for k in range(self.dimension)]

    @property
    def rows(self) -> int:
        """Rows of sorted agents that scratch must have."""
        return max(len(self.fields) if self.pairs else 0, self.dimension if self.look else 0, 1)

    @property
    def numbers(self) -> int:
        """Numbers of a record that scratch must have."""
        kinds = [self.fields] * bool(self.pairs) + [self.seen_fields] * bool(self.look)
        return max((len(record_of(fields)) for fields in kinds), default=1)

    @functools.cached_property
    def slots(self) -> dict[str, int]:
        """Where in the scratch of lanes each running number lies."""
        found: dict[str, int] = {}
        for k, e in self.pairs:
            for j in range(e.sums(self.dimension)):
                found[f"c{k}_{j}"] = len(found)
        for q, sight in enumerate(self.sights):
            for j in range(sight.nearest or 0):
                found[f"near{q}_{j}"] = len(found)
        for k, e in enumerate(self.effects):
            for j in range(e.folded(self.dimension) if e.obstacle_law else 0):
                found[f"o{k}_{j}"] = len(found)
        for name in self.targets:
            for j in range(self.dimension):
                found[f"g{name}{j}"] = len(found)
        if self.look:
            lists = (("square", self.look.agents), ("place", self.look.agents), ("gap", self.look.obstacles), ("which", self.look.obstacles))
            for name, many in lists:
                for j in range(many):
                    found[f"{name}{j}"] = len(found)
        return found | {"bad": len(found)}


def record_of(fields: list[str]) -> list[str]:
    """Return what is written of an agent when it is put into its cell; headings follow from velocities."""
    return [f for f in fields if f[0] != "h" and f != "who"] + ["who"]


def _sight(effect: Effect) -> Sight:
    sight = effect.sight
    assert sight is not None, f"{type(effect).__name__} has a pair law and no sight"
    return sight


def view_of(fov: float) -> float:
    """Return cos(fov / 2) |cos(fov / 2)|, what `in_view` compares; fov in degrees."""
    import math

    cosine = math.cos(math.radians(fov) / 2.0)
    return cosine * abs(cosine)


def _names(effect: Effect) -> set[str]:
    """Return every name in the code of an effect's pair laws and of the laws that they call."""
    module = vars(sys.modules[type(effect).__module__])
    todo = [module[law] for law in (effect.pair_law, effect.finish_law) if law]
    seen: set[int] = set()
    names: set[str] = set()
    while todo:
        python = todo.pop().py_func
        if id(python) in seen:
            continue
        seen.add(id(python))
        names |= set(python.__code__.co_names)
        called: list[Any] = [python.__globals__.get(name) for name in python.__code__.co_names]
        modules = [m for m in called if inspect.ismodule(m)]
        called += [getattr(m, name, None) for m in modules for name in python.__code__.co_names]
        todo += [f for f in called if hasattr(f, "py_func")]
    return names


def scene_source(parts: Parts) -> str:
    """Return the source of a scene's kernel: `accelerate` and `step_world` of one world, `step` of all."""
    names = ", ".join(type(e).__name__ for e in parts.effects) or "no effects"
    title = f"{parts.dimension}-D {parts.space.kind}, {parts.integrator.kind}; {names}"
    blocks = [
        f'"""{title}. Generated by flockenv.sweep; safe to delete."""',
        _imports(parts),
        *(_parameter_tuple(k, e) for k, e in enumerate(parts.effects)),
        _accelerate(parts),
        _method(parts.integrator),
        _step_world(parts),
        _step(parts),
    ]
    return "\n".join(blocks)


def _imports(parts: Parts) -> str:
    lines = [
        "from collections import namedtuple",
        "import numpy as np",
        "from numba import njit",
        "from flockenv.effects.base import Me, Other, in_view",
        "from flockenv.kernels import finite, like, unaliased, wait_for_team",
        "from flockenv.neighbours import candidates, count_cells, place_of, row_of",
        f"from flockenv.space import {parts.space.offset_law} as offset_to, {parts.space.confine_law} as confine",
        "from flockenv.vec import add, dot, exact_dot, limit, norm, scale, sub, unit, zero",
        _method_imports(parts.integrator),
    ]
    for k, effect in enumerate(parts.effects):
        for slot in ("own_law", "pair_law", "finish_law", "obstacle_start", "obstacle_law", "obstacle_finish"):
            name = getattr(effect, slot)
            if name is not None:
                lines.append(f"from {type(effect).__module__} import {name} as {slot}_{k}")
    options = 'dict(fastmath={"contract"}, error_model="numpy", nogil=True, _nrt=False)'
    return "\n".join(lines) + f"\n\nFAST = {options}\n"


def _parameter_tuple(k: int, effect: Effect) -> str:
    return f'P{k} = namedtuple("P{k}", {" ".join(effect.parameters()) or "_"!r})'


def _method_imports(integrator: Integrator) -> str:
    """Import what the integrator's `advance` calls in its own module."""
    python = integrator.advance().py_func
    names = [name for name in python.__code__.co_names if name in python.__globals__ and name not in dir(builtins)]
    return f"from {python.__module__} import {', '.join(names)}" if names else "# the method needs nothing else"


def _method(integrator: Integrator) -> str:
    """Return the text of the integrator's `advance` with this scene's `accelerate` in the place of its argument.

    (numba can pass a compiled function as an argument, but does not cache a function that does.)
    """
    text = inspect.getsource(integrator.advance().py_func)
    text = text[text.index("def advance(") :].replace("def advance(acceleration: Any, ", "def advance(", 1)
    for annotation in (": Any", ": float", ": int"):
        text = text.replace(annotation, "")
    return "\n@njit(forceinline=True, **FAST)\n" + text.replace("acceleration(", "accelerate(")


# --- small pieces of text ---------------------------------------------------------------------------------------------


def _vector(template: str, dimension: int) -> str:
    """Write a tuple: `#` stands for the axis number."""
    return "(" + ", ".join(template.replace("#", str(k)) for k in range(dimension)) + ",)"


def _lane(parts: Parts, array: str, k: int) -> str:
    """Write coordinate k of lane l of the block that begins at `base`."""
    return f"{array}[base + np.uint64({k * parts.width}) + l]"


def _lanes_of(parts: Parts, array: str) -> str:
    return "(" + ", ".join(_lane(parts, array, k) for k in range(parts.dimension)) + ")"


def _indented(lines: list[str], indent: int) -> str:
    return "\n".join(" " * indent + line for block in lines for line in block.splitlines())


def _read_parameters(parts: Parts) -> list[str]:
    d = parts.dimension
    lines = [f"size = {_vector('params[#]', d)}", f"reach = params[{d}]"]
    at = d + 1
    for q in range(len(parts.sights)):
        lines.append(f"within{q}, view{q} = params[{at}], params[{at + 1}]")
        at += 2
    for k, effect in enumerate(parts.effects):
        count = len(effect.parameters())
        values = ", ".join(f"params[{at + j}]" for j in range(count)) or "params[0]"
        lines.append(f"p{k} = P{k}({values})")
        at += count
    return lines


class _Slots:
    """Writes places in the scratch of lanes by name."""

    def __init__(self, parts: Parts) -> None:
        self.slots, self.width = parts.slots, parts.width

    def __call__(self, name: str) -> str:
        return f"lanes[np.uint64({self.slots[name] * self.width}) + l]"

    def all(self, prefix: str) -> list[str]:
        return [self(name) for name in self.slots if name.startswith(prefix)]


# --- accelerate -------------------------------------------------------------------------------------------------------


def _accelerate(parts: Parts) -> str:
    d = parts.dimension
    felt = [
        f"{name} = add({name}, {_vector(f'felt[i * np.uint64({d * len(parts.targets)}) + np.uint64({d * t}) + np.uint64(#)]', d)})"
        for t, name in enumerate(parts.targets)
    ]
    me = ["i = row + l", f"x, v = {_lanes_of(parts, 'pos')}, {_lanes_of(parts, 'vel')}", _me_alone()]
    return f'''

@njit(forceinline=True, **FAST)
def accelerate(context, pos, vel, acc):
    """Acceleration of this thread's agents of one world, m/s^2, from the frozen present."""
    {CONTEXT} = context
{_indented(_read_parameters(parts), 4)}
    if rank == 0:
        work[b, 0] += 1
{_indented(_pairs(parts), 4)}
    for block in range(first, end):
        base, row = np.uint64(block * {d * parts.width}), np.uint64(block * {parts.width})
{_indented(_obstacles(parts, me), 8)}
        for l in range(np.uint64({parts.width})):
{_indented(me, 12)}
            o = zero(x)
            s, f = {_lanes_of(parts, "want")}, o
{_indented(_own(parts), 12)}
{_indented(felt, 12)}
            s = limit(s, max_force[i])
            # a choice, not a factor of 0: a law may be infinite where the dead and the lanes beyond the last agent lie
            here, share = living[i] > o[0], like(o[0], 1.0) / mass[i]
{_indented([f"{_lane(parts, 'acc', k)} = (s[{k}] + f[{k}]) * share if here else o[{k}]" for k in range(d)], 12)}
'''


def _me_alone() -> str:
    return "me = Me(like(mass[i], i), x, v, unit(v), mass[i], radius[i], max_speed[i], max_force[i], zero(x))"


def _own(parts: Parts) -> list[str]:
    """Write the laws of one agent by itself, and what the folds over the obstacles came to."""
    lines, slot = [], _Slots(parts)
    for k, effect in enumerate(parts.effects):
        to = "s" if effect.steering else "f"
        if effect.own_law is not None:
            lines.append(f"{to} = add({to}, own_law_{k}(p{k}, me))")
        if effect.obstacle_law is not None:
            lines.append(f"{to} = add({to}, obstacle_finish_{k}(p{k}, me, ({', '.join(slot.all(f'o{k}_'))},)))")
    return lines


def _obstacles(parts: Parts, me: list[str]) -> list[str]:
    """Write the folds over the obstacles, all of them in one pass; nothing if no law asks for obstacles."""
    slot = _Slots(parts)
    asking = [(k, slot.all(f"o{k}_")) for k, e in enumerate(parts.effects) if e.obstacle_law is not None]
    if not asking:
        return []
    starts, meets = [], []
    for k, slots in asking:
        starts.append(f"found = obstacle_start_{k}(p{k}, me)")
        starts += [f"{s} = found[{j}]" for j, s in enumerate(slots)]
        meets.append(f"found = obstacle_law_{k}(p{k}, me, it, ({', '.join(slots)},))")
        meets += [f"{s} = found[{j}]" for j, s in enumerate(slots)]
    d = parts.dimension
    return [
        "if rank == 0 and block == first:",
        "    work[b, 3] += n * obstacle_radius.shape[1]",
        f"for l in range(np.uint64({parts.width})):",
        _indented(me + starts, 4),
        "for m in range(obstacle_radius.shape[1]):",
        "    rho = obstacle_radius[b, m]",
        "    if rho > 0:",
        f"        place = {_vector('obstacle_x[#, b, m]', d)}",
        f"        for l in range(np.uint64({parts.width})):",
        _indented(me, 12),
        "            to = offset_to(size, x, place)",
        "            it = Other(like(rho, m), to, dot(to, to), zero(x), rho, zero(x))",
        _indented(meets, 12),
    ]


# --- pairs ------------------------------------------------------------------------------------------------------------


def _pairs(parts: Parts) -> list[str]:
    """Write the query and the one sweep that all pair laws share; nothing at all if there is none."""
    if not parts.pairs:
        return []
    return [
        "# one query per instant, one sweep for all pair laws",
        "if rank == 0:",
        "    work[b, 1] += 1",
        *_query(parts, parts.fields, "reach"),
        *_blocks(parts, [*_clear(parts), *_select_nearest(parts), *_sum_up(parts)]),
        "tally[rank] = met",
        "wait_for_team(sync, team)  # what is felt was written by others",
        "if rank == 0:",
        "    for r in range(team):",
        "        work[b, 2] += tally[r]",
    ]


def _query(parts: Parts, fields: list[str], reach: str) -> list[str]:
    """Write how the living are sorted, with these fields of each."""
    return [
        f"periodic, shape = {parts.space.periodic}, (0, 0, 0)",
        "wait_for_team(sync, team)  # positions are everybody's",
        f"if n >= {FEWEST_AGENTS}:",
        "    shape = count_cells(",
        f"        pos, living, first, end, {parts.width}, rank, team, sync, bounds, size, {reach}, periodic, n,",
        "        cell, start, offset,",
        "    )",
        "nx = shape[0]",
        "if nx == 0:",
        _indented(_fill(parts, fields), 4),
        "else:",
        _indented(_sort(parts, fields), 4),
        "wait_for_team(sync, team)",
    ]


_ARRAYS = {"x": "pos", "v": "vel", "t": "tie"}


def _value(parts: Parts, field: str, place: str) -> str:
    """Write what a field of agent i is; `place` is where its first coordinate lies."""
    if field[1:].isdigit():
        array = _ARRAYS[field[0]]
        return f"{array}[{place} + {int(field[1:]) * parts.width}]"
    return "like(mass[0], i)" if field == "who" else f"{field}[i]"


def _derived(parts: Parts, fields: list[str], at: str) -> list[str]:
    """Write the rows of sorted agent `at` that follow from others: headings."""
    d, row = parts.dimension, {f: k for k, f in enumerate(fields)}
    lines = []
    if "h0" in row:
        lines.append("h = unit((" + ", ".join(f"sorted_[{row[f'v{k}']}, {at}]" for k in range(d)) + "))")
        lines += [f"sorted_[{row[f'h{k}']}, {at}] = h[{k}]" for k in range(d)]
    return lines


def _fill(parts: Parts, fields: list[str]) -> list[str]:
    """Write how the living are listed by number, for brute force: by one of a team."""
    d, row = parts.dimension, {f: k for k, f in enumerate(fields)}
    direct = [f"sorted_[{r}, at] = {_value(parts, f, 'place')}" for f, r in row.items() if f[0] != "h"]
    lanes = [
        f"sorted_[{r}, i] = " + (_lane(parts, _ARRAYS[f[0]], int(f[1:])) if f[1:].isdigit() else _value(parts, f, ""))
        for f, r in row.items()
        if f[0] != "h"
    ]
    return [
        "if rank == 0:",
        "    if present == n:",
        f"        for block in range((n + {parts.width - 1}) // {parts.width}):",
        f"            base, row = np.uint64(block * {d * parts.width}), np.uint64(block * {parts.width})",
        f"            for l in range(np.uint64({parts.width})):",
        "                i = row + l",
        "                order[i] = i",
        _indented(lanes + _derived(parts, fields, "i"), 16),
        "    else:",
        "        at = 0",
        "        for i in range(n):",
        "            if living[i] > 0:",
        f"                place = place_of(i, {d}, {parts.width})",
        "                order[at] = i",
        _indented(direct + _derived(parts, fields, "at"), 16),
        "                at += 1",
    ]


def _sort(parts: Parts, fields: list[str]) -> list[str]:
    """Write how agents are put into their cells: as whole records first, so that each is one distant place in memory."""
    d, record = parts.dimension, record_of(fields)
    row = {f: k for k, f in enumerate(fields)}
    place = []
    if parts.space.periodic:
        inside = _vector(f"pos[place + # * {parts.width}]", d)
        place.append(f"inside, _ = confine(size, radius[i], {inside}, {inside})")
    for j, f in enumerate(record):
        wrapped = parts.space.periodic and f[0] == "x" and f[1:].isdigit()
        place.append(f"records[to, {j}] = " + (f"inside[{f[1:]}]" if wrapped else _value(parts, f, "place")))
    spread = [f"sorted_[{row[f]}, at] = records[at, {j}]" for j, f in enumerate(record) if f in row]
    return [
        f"for i in range(first * {parts.width}, min(end * {parts.width}, n)):",
        "    c = cell[i]",
        "    if c >= 0:",
        f"        to, place = np.int64(offset[rank, c]), place_of(i, {d}, {parts.width})",
        "        offset[rank, c] = to + 1",
        _indented(place, 8),
        "wait_for_team(sync, team)",
        "for at in range(present * rank // team, present * (rank + 1) // team):",
        f"    i = np.int64(records[at, {record.index('who')}])",
        "    order[at] = i",
        _indented(spread + _derived(parts, fields, "at"), 4),
    ]


def _blocks(parts: Parts, lines: list[str]) -> list[str]:
    """Write the loop over this thread's blocks of sorted agents: [at, upto) is one, and `found` ranges may be near it."""
    return [
        "met, line, spot = 0, 0, 0",
        "if nx == 0:",
        f"    blocks = (present + {parts.width - 1}) // {parts.width}",
        f"    at, stop = blocks * rank // team * {parts.width}, min(blocks * (rank + 1) // team * {parts.width}, present)",
        "else:  # whole rows of cells, so that blocks are the same for any number of threads",
        "    rows = shape[1] * shape[2]",
        "    while line < rows and start[line * nx] * team < present * rank:",
        "        line += 1",
        "    until = line",
        "    while until < rows and start[until * nx] * team < present * (rank + 1):",
        "        until += 1",
        "    at, stop = np.int64(start[line * nx]), np.int64(start[until * nx])",
        "while at < stop:",
        "    found = 1",
        "    if nx == 0:",
        f"        upto = min(at + {parts.width}, present)",
        "        ranges[0, 0], ranges[0, 1], ranges[0, 2] = 0, present, 1",
        "    else:",
        "        line = row_of(at, start, line, nx)",
        f"        upto = min(at + {parts.width}, np.int64(start[(line + 1) * nx]))",
        "        found, spot = candidates(at, upto, line, max(spot, line * nx), shape, start, periodic, ranges)",
        "    block = np.uint64(at)",
        *_indented_list(lines, 4),
        "    at = upto",
    ]


def _sum_up(parts: Parts) -> list[str]:
    """Write how a block meets its candidates, and what its sums come to."""
    d, slot = parts.dimension, _Slots(parts)
    results = [f"g{name}{j}" for name in parts.targets for j in range(d)]
    return [
        "for r in range(found):",
        "    met += (ranges[r, 1] - ranges[r, 0]) * (upto - at)",
        *_indented_list(_meet_range(parts, parts.fields, _meet(parts)), 4),
        f"for l in range(np.uint64({parts.width})):",
        _indented(_finish(parts), 4),
        "for l in range(np.uint64(upto - at)):",
        f"    i = np.int64(order[block + l]) * {len(results)}",
        _indented([f"felt[i + {j}] = {slot(name)}" for j, name in enumerate(results)], 4),
    ]


def _indented_list(lines: list[str], indent: int) -> list[str]:
    return [" " * indent + line for block in lines for line in block.splitlines()]


def _clear(parts: Parts) -> list[str]:
    """Write how a block's running numbers begin."""
    slot = _Slots(parts)
    zeros = [f"{s} = 0" for k, _ in parts.pairs for s in slot.all(f"c{k}_")]
    far = [f"{s} = np.inf" for q in range(len(parts.sights)) for s in slot.all(f"near{q}_")]
    return [f"for l in range(np.uint64({parts.width})):", _indented(zeros + far, 4)]


def _candidate(parts: Parts, fields: list[str]) -> list[str]:
    """Write candidate j as the laws see it."""
    row = {f: k for k, f in enumerate(fields)}
    d = parts.dimension

    def vector(letter: str) -> str:
        if f"{letter}0" not in row:
            return "xj"
        return "(" + ", ".join(f"sorted_[{row[f'{letter}{k}']}, j]" for k in range(d)) + ")"

    scalar = {name: f"sorted_[{row[name]}, j]" if name in row else "reach" for name in ("who", "radius")}
    return [
        f"xj = {vector('x')}",
        f"vj, tj, aj, rj = {vector('v')}, {vector('t')}, {scalar['who']}, {scalar['radius']}",
    ]


def _me(parts: Parts, fields: list[str]) -> str:
    """Write the agent in lane l of a block as the laws see it; what no law reads is left out."""
    row = {f: k for k, f in enumerate(fields)}

    def vector(letter: str) -> str:
        if f"{letter}0" not in row:
            letter = "x"
        return "(" + ", ".join(f"sorted_[{row[f'{letter}{k}']}, block + l]" for k in range(parts.dimension)) + ")"

    def scalar(name: str) -> str:
        return f"sorted_[{row[name]}, block + l]" if name in row else "reach"

    numbers = ", ".join(scalar(name) for name in ("mass", "radius", "max_speed", "max_force"))
    return f"me = Me({scalar('who')}, {vector('x')}, {vector('v')}, {vector('h')}, {numbers}, {vector('t')})"


def _seen(parts: Parts, q: int) -> str:
    sight = parts.sights[q]
    text = f"other & (square < within{q})"
    return text + (f" & in_view(view{q}, me.heading, to, square)" if sight.fov < 360 else "")


def _select_nearest(parts: Parts) -> list[str]:
    """Write the pass that finds how far each topological sight reaches: its k smallest squares, kept in order."""
    topological = [(q, s.nearest) for q, s in enumerate(parts.sights) if s.nearest is not None]
    if not topological:
        return []
    slot, keep = _Slots(parts), []
    for q, count in topological:
        keep.append(f"far = square if {_seen(parts, q)} else like(square, np.inf)")
        for j in range(count):
            place = slot(f"near{q}_{j}")
            keep += [f"near = {place}", f"{place} = far if far < near else near", "far = near if far < near else far"]
    return ["for r in range(found):", *_indented_list(_meet_range(parts, parts.fields, keep), 4)]


def _meet(parts: Parts) -> list[str]:
    """Write what one candidate adds to the sums of the lanes that see it."""
    slot, lines = _Slots(parts), []
    for q, sight in enumerate(parts.sights):
        cut = f" & (square <= {slot(f'near{q}_{sight.nearest - 1}')})" if sight.nearest else ""
        lines.append(f"seen{q} = {_seen(parts, q)}{cut}")
    for k, effect in parts.pairs:
        q = parts.sights.index(_sight(effect))
        lines.append(f"says = pair_law_{k}(p{k}, me, it)")
        # A sum of a choice: of a choice between sums LLVM makes a masked store, and the sum stays in memory. The other
        # choice is -0, which x + -0 leaves as it is for every x: so this becomes one masked addition.
        lines += [f"{s} += says[{j}] if seen{q} else o" for j, s in enumerate(slot.all(f"c{k}_"))]
    return lines


def _meet_range(parts: Parts, fields: list[str], lines: list[str]) -> list[str]:
    """Write the loop over the candidates of range r. Only around the edge of a periodic box are images sought."""
    square = "exact_dot(to, to)" if any(s.nearest for s in parts.sights) else "dot(to, to)"
    wrapped, plain = "offset_to(size, me.pos, xj)", "sub(xj, me.pos)"

    def loop(offset: str) -> list[str]:
        return [
            "for j in range(np.uint64(ranges[r, 0]), np.uint64(ranges[r, 1])):",
            *_indented_list(_candidate(parts, fields), 4),
            "    own, o = np.int32(j - block), like(reach, -0.0)",
            f"    for l in range(np.uint64({parts.width})):",
            _indented([_me(parts, fields), "other = own != number[l]", f"to = {offset}", f"square = {square}"], 8),
            "        it = Other(aj, to, square, vj, rj, tj)",
            _indented(lines, 8),
        ]

    if not parts.space.periodic:
        return loop(plain)
    return ["if ranges[r, 2] > 0:", *_indented_list(loop(wrapped), 4), "else:", *_indented_list(loop(plain), 4)]


def _finish(parts: Parts) -> list[str]:
    """Write what a block's sums come to."""
    slot, d = _Slots(parts), parts.dimension
    lines = [_me(parts, parts.fields)] + [f"{name} = zero(me.pos)" for name in parts.targets]
    for k, effect in parts.pairs:
        to = "s" if effect.steering else "f"
        lines.append(f"{to} = add({to}, finish_law_{k}(p{k}, me, ({', '.join(slot.all(f'c{k}_'))},)))")
    return lines + [f"{slot(f'g{name}{j}')} = {name}[{j}]" for name in parts.targets for j in range(d)]


# --- a step -----------------------------------------------------------------------------------------------------------


def look_source(parts: Parts) -> str:
    """Return the source of `look`: what is near every agent of a world, by the query that pair laws use."""
    if parts.look is None:
        return ""
    at = len(parts.parameters()) - 2
    return f'''
@njit(forceinline=True, **FAST)
def look(
    x_, alive, obstacle_x, obstacle_radius, b, params,
    near_square, near_who, near_count, obstacle_gap, obstacle_who, obstacle_count, {SHARED},
):
    """Write, for every agent of world b, the nearest agents (K, N) and obstacles (J, N), and how many (N,)."""
    n, rank, team = x_.shape[2], 0, 1
    first, end = 0, (n + {parts.width - 1}) // {parts.width}
    size, reach, within = {_vector("params[#]", parts.dimension)}, params[{at}], params[{at + 1}]
    present = 0
    for i in range(n):
        present += alive[b, i]
        living[i] = alive[b, i]
        near_count[i] = 0
        obstacle_count[i] = 0
    into_blocks(pos, x_, b, n, first, end)
{_indented([*_look_at_agents(parts), *_look_at_obstacles(parts)], 4)}
'''


def _insert(slot: _Slots, near: str, where: str, many: int) -> list[str]:
    """Write how (far, place) is put into the lanes' lists of the nearest, kept in order."""
    lines = []
    for k in range(many):
        a, b = slot(f"{near}{k}"), slot(f"{where}{k}")
        lines += [
            f"near, there = {a}, {b}",
            "closer = far < near",
            f"{a} = far if closer else near",
            f"{b} = place if closer else there",
            "far, place = near if closer else far, there if closer else place",
        ]
    return lines


def _look_at_agents(parts: Parts) -> list[str]:
    assert parts.look is not None
    slot, many = _Slots(parts), parts.look.agents
    if not many:
        return []
    candidate = "far, place = square if other & (square < within) else like(square, np.inf), like(square, j)"
    lists = [(slot(f"square{k}"), slot(f"place{k}")) for k in range(many)]
    count = [f"count += 1 if {square} < np.inf else 0" for square, _ in lists]
    return [
        *_query(parts, parts.seen_fields, "reach"),
        *_blocks(parts, [
            f"for l in range(np.uint64({parts.width})):",
            *(f"    {slot(f'square{k}')} = np.inf; {slot(f'place{k}')} = 0" for k in range(many)),
            "for r in range(found):",
            *_indented_list(_meet_range(parts, parts.seen_fields, [candidate, *_insert(slot, "square", "place", many)]), 4),
            "if nx == 0 and present == n:  # sorted by number: the lists lie as the lanes do",
            f"    for l in range(np.uint64({parts.width})):",
            "        i, count = block + l, np.int32(0)",
            *(
                f"        near_square[{k}, i] = {square}; near_who[{k}, i] = np.int32({place})"
                for k, (square, place) in enumerate(lists)
            ),
            _indented(count, 8),
            "        near_count[i] = count",
            "else:",
            "    for l in range(np.uint64(upto - at)):",
            "        i, count = np.uint64(order[block + l]), np.int32(0)",
            *(
                f"        near_square[{k}, i] = {square}; near_who[{k}, i] = order[np.uint64({place})]"
                for k, (square, place) in enumerate(lists)
            ),
            _indented(count, 8),
            "        near_count[i] = count",
        ]),
    ]  # fmt: skip


def _look_at_obstacles(parts: Parts) -> list[str]:
    assert parts.look is not None
    slot, many, d = _Slots(parts), parts.look.obstacles, parts.dimension
    if not many:
        return []
    return [
        "for block in range(first, end):",
        f"    base = np.uint64(block * {d * parts.width})",
        f"    for l in range(np.uint64({parts.width})):",
        *(f"        {slot(f'gap{k}')} = np.inf; {slot(f'which{k}')} = 0" for k in range(many)),
        "    for m in range(obstacle_radius.shape[1]):",
        "        rho = obstacle_radius[b, m]",
        "        if rho > 0:",
        f"            centre = {_vector('obstacle_x[#, b, m]', d)}",
        f"            for l in range(np.uint64({parts.width})):",
        f"                to = offset_to(size, {_lanes_of(parts, 'pos')}, centre)",
        "                far, place = norm(to) - rho, like(rho, m)",
        "                far = far if far < reach else like(rho, np.inf)",
        *_indented_list(_insert(slot, "gap", "which", many), 16),
        f"    for l in range(np.uint64({parts.width})):",
        f"        i, count = np.uint64(block * {parts.width}) + l, np.int32(0)",
        *(
            f"        obstacle_gap[{k}, i] = {slot(f'gap{k}')}; obstacle_who[{k}, i] = np.int32({slot(f'which{k}')}); "
            f"count += 1 if {slot(f'gap{k}')} < np.inf else 0"
            for k in range(many)
        ),
        "        obstacle_count[i] = count",
    ]


def _step_world(parts: Parts) -> str:
    d = parts.dimension
    bad = _Slots(parts)("bad")
    store = [f"{_lane(parts, 'pos', k)} = x[{k}]; {_lane(parts, 'vel', k)} = v[{k}]; {_lane(parts, 'origin', k)} = x[{k}]" for k in range(d)]
    return f'''
@njit(forceinline=True, **FAST)
def into_blocks(blocks, array, b, n, first, end):
    """blocks = array[:, b], agents in blocks of {parts.width}; those beyond n are left as they are."""
    for block in range(first, end):
        for k in range({d}):
            base = np.uint64(block * {d * parts.width} + k * {parts.width})
            if (block + 1) * {parts.width} <= n:
                for l in range(np.uint64({parts.width})):
                    blocks[base + l] = array[np.uint64(k), np.uint64(b), np.uint64(block * {parts.width}) + l]
            else:
                for l in range(np.uint64(n - block * {parts.width})):
                    blocks[base + l] = array[np.uint64(k), np.uint64(b), np.uint64(block * {parts.width}) + l]


@njit(forceinline=True, **FAST)
def out_of_blocks(blocks, array, b, n, first, end):
    """array[:, b] = blocks."""
    for block in range(first, end):
        for k in range({d}):
            base = np.uint64(block * {d * parts.width} + k * {parts.width})
            if (block + 1) * {parts.width} <= n:
                for l in range(np.uint64({parts.width})):
                    array[np.uint64(k), np.uint64(b), np.uint64(block * {parts.width}) + l] = blocks[base + l]
            else:
                for l in range(np.uint64(n - block * {parts.width})):
                    array[np.uint64(k), np.uint64(b), np.uint64(block * {parts.width}) + l] = blocks[base + l]


@njit(forceinline=True, **FAST)
def step_world(
    x_, v_, alive, obstacle_x, obstacle_radius, work, params, dt, count, b, rank, team, {SHARED},
):
    """Advance this thread's part of world b by `count` steps; return its first agent that is not finite, or -1."""
    n = x_.shape[2]
    blocks = (n + {parts.width - 1}) // {parts.width}
    first, end = blocks * rank // team, blocks * (rank + 1) // team
    size = {_vector("params[#]", d)}
    present = 0
    for i in range(n):
        present += alive[b, i]
    for i in range(first * {parts.width}, min(end * {parts.width}, n)):
        living[i] = alive[b, i]
    into_blocks(pos, x_, b, n, first, end)
    into_blocks(vel, v_, b, n, first, end)
    for i in range(first * {d * parts.width}, end * {d * parts.width}):
        origin[i] = pos[i]
    context = ({CONTEXT})
    far = like(dt, np.inf)
    for l in range(np.uint64({parts.width})):
        {bad} = far
    for _ in range(count):
        advance(context, pos, vel, dt, stages, first * {d * parts.width}, end * {d * parts.width})
        for block in range(first, end):
            base, row = np.uint64(block * {d * parts.width}), np.uint64(block * {parts.width})
            for l in range(np.uint64({parts.width})):
                i = row + l
                was, x, v = {_lanes_of(parts, "origin")}, {_lanes_of(parts, "pos")}, {_lanes_of(parts, "vel")}
                where = far if finite(dot(x, x) + dot(v, v)) else like(dt, i)
                {bad} = where if where < {bad} else {bad}
                # nobody moves faster than max_speed, whatever a method makes of the velocity within the step
                x = add(was, scale(limit(sub(x, was), max_speed[i] * dt), living[i]))
                x, v = confine(size, radius[i], x, scale(limit(v, max_speed[i]), living[i]))
{_indented(store, 16)}
    out_of_blocks(pos, x_, b, n, first, end)
    out_of_blocks(vel, v_, b, n, first, end)
    worst = far
    for l in range(np.uint64({parts.width})):
        worst = min(worst, {bad})
    return np.int64(worst) if worst < far else -1
'''


def _step(parts: Parts) -> str:
    d = parts.dimension
    return f'''
@njit(cache=True, **FAST)
def step(
    x, v, alive, tick, obstacle_x, obstacle_radius, work, drive, params, dt, count, from_world, to_world, rank, team,
    {SHARED},
):
    """Advance worlds [from_world, to_world) by `count` steps; return (world, agent) not finite first, or -1s.

    drive (D, B, N), or (D, 0, N) for none. A team of several threads calls this with the same worlds, each with its rank.
    """
    unaliased()
    n = x.shape[2]
    blocks = (n + {parts.width - 1}) // {parts.width}
    first, end = blocks * rank // team, blocks * (rank + 1) // team
    broken, who = -1, -1
    for b in range(from_world, to_world):
        if drive.shape[1] > 0:
            into_blocks(want, drive, b, n, first, end)
        else:
            want[first * {d * parts.width} : end * {d * parts.width}] = 0
        bad = step_world(
            x, v, alive, obstacle_x, obstacle_radius, work, params, dt, count, b, rank, team, {SHARED},
        )
        if rank == 0:
            tick[b] += count
        if bad >= 0 and broken < 0:
            broken, who = b, bad
    return broken, who
'''
