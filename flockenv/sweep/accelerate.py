"""The acceleration of every agent of a world: what all laws say, summed and divided by mass.

Pair laws come first, in one sweep (`sense`), and leave what they came to in `felt`, by agent; laws about everybody, and
bonds, in `pulled`. Then each block adds what an agent wants or feels by itself, and a fold over the obstacles
(`responses`); what it wants is bounded by max_force. By a method of one stage `step` goes on from there, part after
part; `accelerate` is for all others, and for who asks for accelerations alone.
"""

from __future__ import annotations

from flockenv.sweep.handed import OPEN_CONTEXT
from flockenv.sweep.parts import Parts
from flockenv.sweep.text import (
    Slots,
    alone,
    given,
    in_blocks,
    in_common,
    indented,
    indented_lines,
    lane,
    lanes_of,
    nearest_images,
    needed,
)

__all__ = ["accelerate", "felt_as", "parameters", "responses", "sense"]


def sense(parts: Parts) -> str:
    """Return the source of `sense`: what is felt from others."""
    sensing = [
        *_aim(parts),
        *["meet_neighbours(context, pos, vel, time)"] * bool(parts.pairs),
        *["far(context, pos, time)"] * bool(parts.far),
        *["bonds(context, pos, vel, time)"] * bool(parts.bonded),
    ]
    return f'''

@kernel
def sense(context, pos, vel, time):
    """Write what this thread's agents of one world feel from others, at this instant, whatever law it is by."""
    {OPEN_CONTEXT}
{indented(needed(parameters(parts, "context.numbers"), sensing), 4)}
    if rank == 0:
        work[b, 0] += 1
{indented(sensing, 4)}
'''


def responses(parts: Parts, told: list[str]) -> list[str]:
    """Write how each agent of a block responds, once all is sensed.

    told: to whom it is told what acceleration `a` agent i, in lane l, has. With what velocity the medium carries it, if
    it does, is in `carrying`.
    """
    d = parts.dimension
    here = f"x, v = {lanes_of(parts, 'pos')}, {lanes_of(parts, 'vel')}"
    responding = [
        "i = row + l",
        here,
        f"me = {alone(parts, one='one + l')}",
        "o = zero(x)",
        f"s, f = {lanes_of(parts, 'want', 'wish')}, o",
        *(f"{parts.target(k)} = o" for k in parts.wishes),
        *nearest_images(parts, list(enumerate(parts.effects))),
        *_medium(parts),
        *_own(parts),
        *_felt(parts),
        *_reconcile(parts),
        "s = limit(s, max_force[one + l])",
        "# a choice, not a factor of 0: a law may be infinite where the dead, what is held in place (by an infinite",
        "# mass) and the lanes beyond the last agent lie",
        "here = (living[live + l] > o[0]) & (mass[one + l] < like(o[0], np.inf))",
        "share = like(o[0], 1.0) / mass[one + l]",
        f"a = ({', '.join(f'(s[{k}] + f[{k}]) * share if here else o[{k}]' for k in range(d))})",
        *told,
        *_carry(parts),
    ]
    return [
        *in_common(parts),
        *["meet_obstacles(context, pos, vel, time, block)"] * parts.folds_obstacles,
        f"for l in range(np.uint64({parts.width})):",
        *indented_lines(responding, 4),
    ]


def accelerate(parts: Parts) -> str:
    """Return the source of `accelerate`: pair laws first, then each agent by itself, block after block."""
    responding = responses(parts, [f"{lane(parts, 'acc', k)} = a[{k}]" for k in range(parts.dimension)])
    return f'''

@kernel
def accelerate(context, pos, vel, time, acc):
    """Write the acceleration of this thread's agents, m/s^2."""
    {OPEN_CONTEXT}
{indented(needed(parameters(parts, "context.numbers"), responding), 4)}
    sense(context, pos, vel, time)
{indented(in_blocks(parts, "first", "end", responding), 4)}
'''


def parameters(parts: Parts, numbers: str = "numbers_of(params, scratch.counters)") -> list[str]:
    """Write by which names the numbers of a scene are known."""
    lines = [f"numbers = {numbers}", "size, reach = numbers.size, numbers.reach"]
    for q, sight in enumerate(parts.sights):
        lines += [f"within{q} = numbers.views[{q}].within", f"view{q} = numbers.views[{q}].cone"]
        if sight.group is not None:
            lines += [f"first{q} = numbers.views[{q}].first", f"end{q} = numbers.views[{q}].end"]
    return lines + [f"p{k} = numbers.effects[{k}]" for k in range(len(parts.effects))]


def _aim(parts: Parts) -> list[str]:
    """Write where everybody wants to go, if any effect says so."""
    effects = [(k, e) for k, e in enumerate(parts.effects) if e.aim_law is not None]
    if not effects:
        return []
    aiming = [
        f"i, x, v = row + l, {lanes_of(parts, 'pos')}, {lanes_of(parts, 'vel')}",
        f"me, e = {alone(parts, aim=False)}, zero(x)",
        *nearest_images(parts, effects),
        *(f"e = add(e, aim_law_{k}({given(parts, k)}, me))" for k, _ in effects),
        "e = limit(e, like(x[0], 1.0))",
        *(f"{lane(parts, 'aiming', k)} = e[{k}]" for k in range(parts.dimension)),
    ]
    each = [f"for l in range(np.uint64({parts.width})):", *indented_lines(aiming, 4)]
    return in_blocks(parts, "first", "end", each)


def _medium(parts: Parts) -> list[str]:
    """Write how fast the medium is where agent i is, if any effect says so."""
    media = [f"m = add(m, medium_law_{k}({given(parts, k)}, me))" for k, e in enumerate(parts.effects) if e.medium_law]
    if not media:
        return []
    return [
        "m = o",
        *media,
        f"me = {alone(parts, medium='m', one='one + l')}",
    ]


def _carry(parts: Parts) -> list[str]:
    """Write with which velocity the medium carries agent i, if it does."""
    if not parts.flows:
        return []
    laws = [f"u = add(u, flow_law_{k}({given(parts, k)}, me))" for k, e in enumerate(parts.effects) if e.flow_law]
    return [
        "u = o",
        *laws,
        *(f"{lane(parts, 'carrying', k)} = u[{k}] if here else o[{k}]" for k in range(parts.dimension)),
    ]


def _own(parts: Parts) -> list[str]:
    """Write the laws of one agent by itself, and what the folds over the obstacles came to."""
    lines, slot = [], Slots(parts)
    for k, effect in enumerate(parts.effects):
        to = parts.target(k)
        if effect.own_law is not None:
            still = effect.linear_drag is not None and parts.integrator.splits_drag
            if still:  # what is left of -c (v - u): the method adds -c v
                lines.append("rest = still(me)")
            lines.append(f"{to} = add({to}, own_law_{k}({given(parts, k)}, {'rest' if still else 'me'}))")
        if effect.obstacle_start is not None:
            lines.append(f"{to} = add({to}, obstacle_finish_{k}(p{k}, me, ({', '.join(slot.all(f'o{k}_'))},)))")
    return lines


def felt_as(parts: Parts, name: str) -> str:
    """Write what the pair laws came to for one of their targets."""
    d, t = parts.dimension, parts.targets.index(name)
    each = d * len(parts.targets)
    places = [f"felt[row * np.uint64({each}) + np.uint64({(d * t + k) * parts.width}) + l]" for k in range(d)]
    return f"({', '.join(places)},)"


def _felt(parts: Parts) -> list[str]:
    """Write how what the pair laws came to is added."""
    lines = [f"{name} = add({name}, {felt_as(parts, name)})" for name in parts.targets if name[0] != "n"]
    if parts.pulls:
        lines.append(f"f = add(f, {lanes_of(parts, 'pulled')})")
    return lines


def _reconcile(parts: Parts) -> list[str]:
    """Write how wishes become what agent i wants: for each effect that has behaviours, if it is about i."""
    lines = []
    for k, effect in enumerate(parts.effects):
        if effect.wishes:
            to = parts.target(k)
            wishes = ", ".join(parts.target(j) for j, by in parts.wishes.items() if by == k)
            lines += [
                f"member = (ident[i] >= p{k}.first) & (ident[i] < p{k}.end)",
                f"{to} = add({to}, select(member, steer_law_{k}(p{k}, me, ({wishes},))[0], o))",
            ]
    return lines
