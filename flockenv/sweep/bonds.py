"""Bonds: everybody gathers what acts on him through the bonds that he is in, block after block, lane beside lane.

A table has, for each block of agents, as many slots as its most bonded agent has bonds; in a slot each lane has the
places of its partners and the numbers of its bond, or its own place and zeros (`pack`). So nobody writes what is
another's, and sums are the same for any number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flockenv.effects.base import Bonds, Effect
from flockenv.sweep.parts import Parts
from flockenv.sweep.text import Slots, alone, indented, indented_lines, inner_of, lane, lanes_of

__all__ = ["Table", "bonds", "pack"]


class Table(NamedTuple):
    """The bonds of all effects of a scene, as the kernel reads them."""

    place: NDArray[np.int32]  # where the first coordinate of a partner lies; of an unused slot: of the agent itself
    number: NDArray[np.floating]
    start: NDArray[
        np.int64
    ]  # per effect: the first slot of each block, and one more; then where its part begins, twice


def pack(parts: Parts, agents: int, groups: Sequence[object]) -> Table:
    """Return the table of a scene of so many agents; ValueError, naming the effect, if bonds do not suit it."""
    w, d = parts.width, parts.dimension
    blocks = -(-agents // w)
    places, numbers, starts, bases = [], [], [], []
    first_place = first_number = 0
    for k, effect in parts.bonded:
        try:
            found = effect.bonds(groups, d)
        except ValueError as error:
            listed = k - sum(wish < k for wish in parts.wishes)  # those lie before the effect that reconciles them
            raise ValueError(f"effects[{listed}].{error}") from None
        start, place, number = _packed(found, agents, blocks, w, d)
        starts.append(start)
        bases += [first_place, first_number]
        first_place, first_number = first_place + place.size, first_number + number.size
        places.append(place.ravel())
        numbers.append(number.ravel())
    empty: list[NDArray[np.float64]] = [np.zeros(1)]
    return Table(
        np.concatenate(places or empty).astype(np.int32),
        np.concatenate(numbers or empty).astype(parts.dtype),
        np.concatenate([*starts, np.array(bases, np.int64)] if starts else [np.zeros(1, np.int64)]),
    )


def _packed(
    bonds: Bonds, agents: int, blocks: int, width: int, dimension: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the starts of blocks, places (slots, P, W) and numbers (slots, C, W)."""
    order = np.argsort(bonds.agent, kind="stable")
    agent, partner, number = bonds.agent[order].astype(np.int64), bonds.partner[order], bonds.number[order]
    count = np.bincount(agent, minlength=blocks * width)
    start = np.concatenate([[0], np.cumsum(count.reshape(blocks, width).max(axis=1, initial=0))])
    slot = start[agent // width] + np.arange(len(agent)) - np.concatenate([[0], np.cumsum(count)])[agent]
    lane_of = agent % width

    def place_of(who: NDArray[np.int64]) -> NDArray[np.int64]:
        return (who // width) * (dimension * width) + who % width

    block = np.repeat(np.arange(blocks), np.diff(start))
    places = np.repeat(place_of(block[:, None] * width + np.arange(width))[:, None, :], partner.shape[1], axis=1)
    numbers = np.zeros((int(start[-1]), number.shape[1], width))
    places[slot, :, lane_of] = place_of(partner.astype(np.int64))
    numbers[slot, :, lane_of] = number
    return start.astype(np.int64), places, numbers


def bonds(parts: Parts) -> list[str]:
    """Write how every agent of this thread's blocks gathers what its bonds say; nothing at all if there is none."""
    if not parts.bonded:
        return []
    d, w, slot = parts.dimension, parts.width, Slots(parts)
    sums = slot.all("bond")
    lines = [
        *([] if parts.pairs or parts.far else ["wait_for_team(sync, team)  # positions are everybody's"]),
        f"size_ = (n + {w - 1}) // {w} + 1",
        "for block in range(np.uint64(first), np.uint64(end)):",
        f"    base, row = block * np.uint64({d * w}), block * np.uint64({w})",
        f"    for l in range(np.uint64({w})):",
        indented([f"{s} = {lane(parts, 'pulled', j) if parts.far else 0}" for j, s in enumerate(sums)], 8),
    ]
    for e, (k, effect) in enumerate(parts.bonded):
        lines += indented_lines(_meet(parts, e, k, effect, sums), 4)
    return [
        *lines,
        f"    for l in range(np.uint64({w})):",
        indented([f"{lane(parts, 'pulled', j)} = {s}" for j, s in enumerate(sums)], 8),
        "wait_for_team(sync, team)  # nobody moves before all have looked",
    ]


def _meet(parts: Parts, e: int, k: int, effect: Effect, sums: list[str]) -> list[str]:
    """Write how a block's agents gather from the bonds of one effect."""
    d, w, p, c = parts.dimension, parts.width, effect.partners, effect.numbers(parts.dimension)
    total = len(parts.bonded)

    def vector(array: str, place: str) -> str:
        return "(" + ", ".join(f"{array}[{place} + np.uint64({j * w})]" for j in range(d)) + ",)"

    others = []
    for q in range(p):
        others += [
            f"at{q} = np.uint64(bond_place[places + np.uint64({q * w}) + l])",
            f"to{q} = offset_to(size, x, {vector('pos', f'at{q}')})",
            f"who{q} = at{q} // np.uint64({d * w}) * np.uint64({w}) + at{q} % np.uint64({w})",
            f"fast{q} = {vector('vel', f'at{q}')}",
            f"wide{q}, heavy{q}, in{q} = radius[who{q}], mass[who{q}], {inner_of(parts, f'who{q}')}",
            f"it{q} = Other(like(x[0], who{q}), to{q}, dot(to{q}, to{q}), fast{q}, wide{q}, zero(x), heavy{q}, in{q})",
        ]
    numbers = ", ".join(f"bond_number[numbers + np.uint64({j * w}) + l]" for j in range(c))
    return [
        f"begin, until = bond_start[{e} * size_ + np.int64(block)], bond_start[{e} * size_ + np.int64(block) + 1]",
        "for s_ in range(begin, until):",
        f"    places = np.uint64(bond_start[{total} * size_ + {2 * e}] + s_ * {p * w})",
        f"    numbers = np.uint64(bond_start[{total} * size_ + {2 * e + 1}] + s_ * {c * w})",
        f"    for l in range(np.uint64({w})):",
        "        i = row + l",
        f"        x, v = {lanes_of(parts, 'pos')}, {lanes_of(parts, 'vel')}",
        f"        me = {alone(parts)}",
        indented(others, 8),
        f"        says = bond_law_{k}(p{k}, me, ({', '.join(f'it{q}' for q in range(p))},), ({numbers},))",
        f"        whole = {' & '.join(f'(living[who{q}] > zero(x)[0])' for q in range(p))}  # the dead hold nobody",
        # of a sum of products each form of the loop would fuse another one, and bits would depend on the processor
        indented([f"{s} = exact_sum({s}, says[{j}] if whole else like(x[0], -0.0))" for j, s in enumerate(sums)], 8),
    ]
