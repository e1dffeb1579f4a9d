"""A step: worlds are brought into blocks, advanced by the integrator's method, bounded, and written back.

`step_world` is called by scenes through `step`, and by tasks through their `play`. Several threads may advance one
world together, each the agents of its own blocks.
"""

from __future__ import annotations

from flockenv.state import COUNTED_BY_KERNELS
from flockenv.sweep.accelerate import felt_as, parameters, responses
from flockenv.sweep.arrange import go_home, move_in
from flockenv.sweep.handed import OPEN_SCRATCH, Context
from flockenv.sweep.parts import Parts
from flockenv.sweep.text import (
    Slots,
    alone,
    asked,
    given,
    in_blocks,
    in_common,
    indented,
    indented_lines,
    lane,
    lanes_of,
    nearest_images,
    needed,
    tuple_of,
)

__all__ = ["begin", "kept_frame", "kept_inner", "step", "step_world"]


PART = 8
"""Blocks that are advanced together."""

AHEAD = 16
"""So many blocks on it is asked for what agents are moved by, in large worlds: several arrays are read side by side."""


def kept_frame(parts: Parts, from_state: bool) -> list[str]:
    """Write how frames come out of the state's array, or go back into it; nothing if nobody keeps one."""
    d, way = parts.dimension, "into_blocks" if from_state else "out_of_blocks"
    return [
        f"{way}({name}, frame_[{k * d} : {(k + 1) * d}], b, n, first, end)"
        for k, name in enumerate(parts.frame_vectors)
    ]


def kept_inner(parts: Parts, from_state: bool) -> list[str]:
    """Write how inner states come out of the state's array, or go back into it; nothing if nobody has one."""
    if not parts.inner:
        return []
    pairs = [(f"scratch.inner[{k}][i]", f"inner_[{k}, b, i]") for k in range(len(parts.inner))]
    return [
        f"for i in range(first * {parts.width}, min(end * {parts.width}, n)):",
        *(f"    {mine} = {kept}" if from_state else f"    {kept} = {mine}" for mine, kept in pairs),
    ]


def step_world(parts: Parts) -> str:
    """Return the source of `step_world`: steps of one world, or of one thread's part of it."""
    d, bad = parts.dimension, Slots(parts)("bad")
    arriving, stepping = [*_confine(parts), *move_in(parts)], _advance(parts)
    kept = "(" + ", ".join(f"work[b, {k}]" for k in range(COUNTED_BY_KERNELS)) + ")"
    restored = "; ".join(f"work[b, {k}] = counted_[{k}]" for k in range(COUNTED_BY_KERNELS))
    return f'''@kernel
def step_world(
    x_, v_, {parts.frame_argument}alive, tick, key, obstacle_x, obstacle_radius, work, drive, asked, params, dt, count,
    b, rank, team, scratch,
):
    """Advance this thread's part of world b by `count` steps; return an agent that is not finite, or -1.

    What is asked of its agents is drive[:, asked], N; nothing if drive is empty.

    It is the lowest of those who are not at the end of the call, or, where that spreads, after the first step that
    failed. A world in which somebody is not stays as it was, whole.
    """
    {OPEN_SCRATCH}
    n = x_.shape[2]
    blocks = (n + {parts.width - 1}) // {parts.width}
    first, end = blocks * rank // team, blocks * (rank + 1) // team
    present = np.int64(0)  # not a literal: laws would be typed for it too, and compiled twice
    for i in range(n):
        present += alive[b, i]
    for i in range(first * {parts.width}, min(end * {parts.width}, n)):
        living[i] = alive[b, i]
    into_blocks(pos, x_, b, n, first, end)
    into_blocks(vel, v_, b, n, first, end)
{indented(asked(parts), 4)}
{indented([*kept_frame(parts, from_state=True), *kept_inner(parts, from_state=True)], 4)}
{indented(needed(parameters(parts), [*arriving, *stepping, "numbers"]), 4)}
{indented(arriving, 4)}
    context = Context({", ".join(Context._fields)})
    well, begun = like(dt, np.inf), tick[b]
    counted_ = {kept}
    for l in range(np.uint64({parts.width})):
        {bad} = well
    nobody = np.int64(n * (count + 1))
    failed = nobody
    for step_ in range(count):
        time = like(dt, (begun + step_) * np.float64(dt))
{indented([*stepping, *_noted(parts)], 8)}
{indented(go_home(parts), 4)}
    worst = well
    for lane in range({parts.width}):  # one after the other: no loop over lanes
        l = np.uint64(lane)
        worst = min(worst, {bad})
    # who counts may still be reading the first half
    tally[team + rank] = {"failed" if parts.spreads else "np.int64(worst) if worst < well else nobody"}
    wait_for_team(sync, team)
    first_bad = nobody
    for r in range(team):
        first_bad = min(first_bad, tally[team + r])
    wait_for_team(sync, team)  # before anybody counts again
    if first_bad < nobody:
        first_bad %= n
        if rank == 0:
            {restored}
        for i in range({"n" if parts.trusts else "0"}):  # who was nowhere before is whom it comes from
            for k in range({d}):
                if alive[b, i] and not finite(x_[k, b, i]):
                    return i
        return first_bad
    out_of_blocks(pos, x_, b, n, first, end)
    out_of_blocks(vel, v_, b, n, first, end)
{indented([*kept_frame(parts, from_state=False), *kept_inner(parts, from_state=False)], 4)}
    if rank == 0:
        tick[b] += count
    return -1
'''


def _noted(parts: Parts) -> list[str]:
    """Write how it is noted after which step somebody was nowhere first, and who, where that spreads from him."""
    if not parts.spreads:
        return []
    bad = Slots(parts)("bad")
    return [
        "fallen = np.int32(0)",
        f"for l in range(np.uint64({parts.width})):",
        f"    fallen += np.int32(1) if {bad} < well else np.int32(0)",
        "if fallen > np.int32(0) and failed == nobody:",
        f"    for lane in range({parts.width}):",
        "        l = np.uint64(lane)",
        f"        failed = min(failed, np.int64(step_ * n) + np.int64(min({bad}, like(dt, n))))",
    ]


def _confine(parts: Parts) -> list[str]:
    """Write how everybody is brought into a periodic box, where steps rely on it."""
    if not parts.confines:
        return []
    confining = [
        f"for l in range(np.uint64({parts.width})):",
        f"    x, v = {lanes_of(parts, 'pos')}, {lanes_of(parts, 'vel')}",
        "    x, v = confine(size, radius[row + l], x, v)",
        *(f"    {lane(parts, 'pos', k)} = x[{k}]" for k in range(parts.dimension)),
    ]
    return in_blocks(parts, "first", "end", confining)


def _advance(parts: Parts) -> list[str]:
    """Write one step of this thread's agents."""
    if parts.one_stage:
        return [*_count(parts), "sense(context, pos, vel, time)", *_in_two_loops(parts)]
    size, flow = parts.dimension * parts.width, "carrying" if parts.flows else "()"
    told = ["sense(context, pos, vel, time)"] * (parts.inner != () and parts.integrator.solves)
    advance = f"advance(context, pos, vel, {flow}, time, dt, stages, first * {size}, end * {size})"
    moved = [
        f"was, x, v = {lanes_of(parts, 'aside')}, {lanes_of(parts, 'pos')}, {lanes_of(parts, 'vel')}",
        *[f"earlier = {lanes_of(parts, 'aside[len(pos):]')}"] * parts.bounces,
    ]
    return [*_count(parts), *told, *_remember(parts), advance, *in_blocks(parts, "first", "end", _bound(parts, moved))]


def _in_two_loops(parts: Parts) -> list[str]:
    """Write how agents are moved by a method of one stage, once all is sensed: nobody reads what others write.

    A part after the other, which stays in the nearest cache, and of which accelerations are put aside. In one loop,
    from what is felt to where that leads, too few agents would be under way at a time.
    """
    d, w = parts.dimension, parts.width
    past = f"past = base - np.uint64((begin - first) * {d * w})"  # each thread at a place of its own
    told = [f"{lane(parts, 'aside', k, 'past')} = a[{k}]" for k in range(d)]
    moved = [
        f"x, v, a = {lanes_of(parts, 'pos')}, {lanes_of(parts, 'vel')}, {lanes_of(parts, 'aside', 'past')}",
        f"was{', earlier' * parts.bounces} = x{', v' * parts.bounces}",
        *(f"x{k}, v{k} = move(x[{k}], v[{k}], a[{k}], dt)" for k in range(d)),
        f"x, v = {tuple_of('x#', d)}, {tuple_of('v#', d)}",
        *[f"x = add(x, scale({lanes_of(parts, 'carrying')}, dt))"] * parts.flows,
    ]
    respond = in_blocks(parts, "begin", "until", [past, *_ahead(parts), *responses(parts, told)])
    move = in_blocks(parts, "begin", "until", [past, *_bound(parts, moved)])
    return [
        f"for begin in range(first, end, {PART}):",
        f"    until = min(begin + {PART}, end)",
        *indented_lines([*respond, *move], 4),
    ]


def _ahead(parts: Parts) -> list[str]:
    """Write how what comes next is asked for, in large worlds."""
    if not parts.sorts:
        return []
    rows = {"pos": parts.dimension, "vel": parts.dimension, "felt": parts.dimension * len(parts.targets), "ident": 1}
    return [
        f"ahead = block + np.uint64({AHEAD})",
        *(
            f"ask_for({array}, ahead * np.uint64({many * parts.width}) + np.uint64({k * parts.width}))"
            for array, many in rows.items()
            for k in range(many)
        ),
    ]


def _count(parts: Parts) -> list[str]:
    """Write how all agents of the world are counted at the beginning of a step, by one of the team."""
    effects = [(k, e) for k, e in enumerate(parts.effects) if e.count_law is not None]
    if not effects:
        return []
    d, w = parts.dimension, parts.width
    lines = []
    for k, _ in effects:
        lines += [
            f"which = np.int64(count_law_{k}({given(parts, k)}, me))",
            f"if living[i] > like(dt, 0.0) and which >= 0 and which < len(p{k}.counted):",
            f"    p{k}.counted[which] += like(dt, 1.0)",
        ]
    return [
        "wait_for_team(sync, team)  # what goes on inside everybody was written by others",
        "if rank == 0:",
        *(f"    p{k}.counted[:] = 0" for k, _ in effects),
        "    for i in range(np.uint64(n)):",
        f"        block, l = i // np.uint64({w}), i % np.uint64({w})",
        f"        base = block * np.uint64({d * w})",
        f"        x, v = {lanes_of(parts, 'pos')}, {lanes_of(parts, 'vel')}",
        f"        me = {alone(parts, aim=False)}",
        *indented_lines([*nearest_images(parts, effects), *lines], 8),
        "wait_for_team(sync, team)  # before anybody changes",
    ]


def _bound(parts: Parts, moved: list[str]) -> list[str]:
    """Write what happens to the agents of a block after the method: limits, the space, and who is not finite.

    moved: where agent i was, with velocity `earlier`, and x and v to which the method has brought it.
    """
    bad = Slots(parts)("bad")
    bounding = [
        *_kick(parts),
        "where = well if finite(dot(x, x) + dot(v, v)) else ident[i]",
        f"{bad} = where if where < {bad} else {bad}",
        *_turn(parts),
        "# nobody moves faster than max_speed, whatever a method makes of the velocity within the step",
        "x = add(was, scale(limit(sub(x, was), max_speed[one + l] * dt), living[live + l]))",
        *_stay_inside(parts),
        *_face(parts),
        *(f"{lane(parts, 'pos', k)}, {lane(parts, 'vel', k)} = x[{k}], v[{k}]" for k in range(parts.dimension)),
        *_keep(parts),
    ]
    return [
        *in_common(parts),
        f"for l in range(np.uint64({parts.width})):",
        *indented_lines(["i = row + l", *moved, *bounding], 4),
    ]


def _turn(parts: Parts) -> list[str]:
    """Write how agent i is kept from turning faster than it can: neither its velocity nor its way in this step does.

    What a medium adds to its way is none of its doing.
    """
    if not parts.turns:
        return []
    way = f"sub(x, add(was, scale({lanes_of(parts, 'carrying')}, dt)))" if parts.flows else "sub(x, was)"
    return [
        "most = min(max_turn_rate[i] * dt, like(dt, np.pi))",
        f"before, way = {lanes_of(parts, 'facing')}, {way}",
        "there, over = turned(way, before, most)",
        "x = add(x, sub(held(way, there, over), way))",
        "ahead, over = turned(v, before, most)",
        "v = held(v, ahead, over)",
    ]


def _face(parts: Parts) -> list[str]:
    """Write where agent i faces after the step, and which way is up."""
    if not parts.oriented:
        return []
    # who may not turn as fast as he wants to turns while he stands still, too
    lines = [f"before = {lanes_of(parts, 'facing')}", f"ahead = faced(v, {'ahead' if parts.turns else 'before'})"]
    lines += [f"{lane(parts, 'facing', k)} = ahead[{k}]" for k in range(parts.dimension)]
    if parts.dimension == 2:
        return lines
    lines.append(f"up = {lanes_of(parts, 'above')}")
    if parts.leans:
        lines.append("up = leant(ahead, before, up, norm(v), dt, banking[i])")
    lines.append("up = raised(ahead, before, up)")
    return lines + [f"{lane(parts, 'above', k)} = up[{k}]" for k in range(parts.dimension)]


def _remember(parts: Parts) -> list[str]:
    """Write how positions before the step are kept, where bodies bounce velocities too."""
    size = parts.dimension * parts.width
    return [
        f"for i in range(np.uint64(first * {size}), np.uint64(end * {size})):",
        "    aside[i] = pos[i]",
        *["    aside[np.uint64(len(pos)) + i] = vel[i]"] * parts.bounces,
    ]


def _stay_inside(parts: Parts) -> list[str]:
    """Write how agent i is kept to the space: put back into it, or bounced off its walls."""
    limited = "scale(limit(v, max_speed[one + l]), living[live + l])"
    if not parts.bounces:
        return [f"x, v = confine(size, radius[one + l], x, {limited})"]
    restitution = "numbers.space[0]"
    return [
        "earlier = scale(earlier, living[live + l])",
        f"x, v = bounce(size, radius[one + l], {restitution}, dt, was, earlier, x, {limited})",
        "v = limit(v, max_speed[one + l])",
    ]


def _kick(parts: Parts) -> list[str]:
    """Write what is added to the velocity of agent i once per step: random numbers of (world, step, agent, effect)."""
    lines = []
    for k, effect in enumerate(parts.effects):
        if effect.kick_law is None:
            continue
        gauss = ", ".join(
            f"like(dt, standard_normal(key[b], begun + step_, np.int64(ident[i]), {8 * k + j}))"
            for j in range(parts.dimension)
        )
        lines += [
            f"says = kick_law_{k}(p{k}, me, dt, ({gauss},))",
            "free = (living[i] > like(dt, 0.0)) & (mass[i] < like(dt, np.inf))",
            "kick = (" + ", ".join(f"says[{j}] if free else like(dt, 0.0)" for j in range(parts.dimension)) + ",)",
            "x, v = add(x, scale(kick, like(dt, 0.5) * dt)), add(v, kick)  # as if it came in the middle of the step",
        ]
    return [f"me = {alone(parts)}", *lines] if lines else []


def _keep(parts: Parts) -> list[str]:
    """Write what goes on inside agent i after the step."""
    if not parts.inner:
        return []
    bad, lines = Slots(parts)("bad"), [f"me = {alone(parts)}", *nearest_images(parts, parts.keeping)]
    for k, effect in parts.keeping:
        told = felt_as(parts, f"n{k}_") if effect.pair_law else "zero(x)"
        lines.append(f"says{k} = keep_law_{k}({given(parts, k)}, me, {told}, dt)")
    now = [_summed(parts, name, "me.inner") for name in parts.inner]
    return [
        *lines,
        *(f"now{j} = {value}" for j, value in enumerate(now)),
        f"where = well if finite({' + '.join(f'now{j}' for j in range(len(now)))}) else ident[i]",
        f"{bad} = where if where < {bad} else {bad}",
        *(
            f"scratch.inner[{j}][i] = now{j} if living[i] > like(dt, 0.0) else me.inner.{n}"
            for j, n in enumerate(parts.inner)
        ),
    ]


def _summed(parts: Parts, name: str, was: str) -> str:
    """Write what a number becomes: what the effect that keeps it says, or what was and the changes by several."""
    says = [f"says{k}[{e.keeps.index(name)}]" for k, e in parts.keeping if name in e.keeps]
    if len(says) == 1:
        return says[0]
    return f"{was}.{name}" + "".join(f" + ({value} - {was}.{name})" for value in says)


def begin(parts: Parts) -> str:
    """Return the source of `begin_inner`, and of the entry point `begin`: what goes on inside who comes into being."""
    if not parts.inner:
        return ""
    d, w = parts.dimension, parts.width
    lines = [f"me = {alone(parts, aim=False)}", *nearest_images(parts, parts.keeping)]
    lines += [f"says{k} = begin_law_{k}({given(parts, k)}, me)" for k, _ in parts.keeping]
    lines += [f"inner_[{j}, b, i] = {_summed(parts, name, 'me.inner')}" for j, name in enumerate(parts.inner)]
    return f'''
@kernel
def begin_inner(x_, v_, {parts.frame_argument}key, tick, params, dt, fresh, b, scratch):
    """Write what goes on inside those of world b who are `fresh`."""
    {OPEN_SCRATCH}
    n = x_.shape[2]
    first, end = 0, (n + {w - 1}) // {w}
    time = like(dt, tick[b] * np.float64(dt))
{indented([*parameters(parts)], 4)}
    into_blocks(pos, x_, b, n, first, end)
    into_blocks(vel, v_, b, n, first, end)
{indented(kept_frame(parts, from_state=True), 4)}
    for block in range(np.uint64(first), np.uint64(end)):
        base, row = block * np.uint64({d * w}), block * np.uint64({w})
        for l in range(np.uint64({w})):
            i, x, v = row + l, {lanes_of(parts, "pos")}, {lanes_of(parts, "vel")}
            if i < n and fresh[b, i]:
{indented([f"scratch.inner[{k}][i] = 0" for k in range(len(parts.inner))], 16)}
{indented(lines, 16)}


@njit(**FAST)
def begin(x, v, {parts.frame_argument}key, tick, params, dt, fresh, scratch):
    """Write what goes on inside those of all worlds who are `fresh`, (B, N)."""
    unaliased()
    for b in range(x.shape[1]):
        begin_inner(x, v, {parts.frame_argument}key, tick, params, dt, fresh, b, scratch)

'''


def step(parts: Parts) -> str:
    """Return the source of `step`, the entry point: some worlds, one after another."""
    return f'''
@njit(**FAST)
def step(
    x, v, {parts.frame_argument}alive, tick, key, obstacle_x, obstacle_radius, work, drive, params, dt, count,
    from_world, to_world, rank, team, scratch,
):
    """Advance worlds [from_world, to_world) by `count` steps; return (world, agent) not finite first, or -1s.

    drive (D, B, N), or (D, 0, N) for none. A team of several threads calls this with the same worlds, each with its
    rank.
    """
    unaliased()
    broken, who = -1, -1
    for b in range(from_world, to_world):  # no choice in here: LLVM would copy the step for each of its outcomes
        bad = step_world(
            x, v, {parts.frame_argument}alive, tick, key, obstacle_x, obstacle_radius, work, drive, b, params, dt,
            count, b, rank, team, scratch,
        )
        if bad >= 0 and broken < 0:
            broken, who = b, bad
    return broken, who
'''
