"""Laws of one agent, as kernels call them: with the numbers of their effects, and sums of their results."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

from flockenv.engine.parameters import Images, images_in, images_of
from flockenv.jit.decorators import Law, Vec, kernel
from flockenv.maths.vectors import add

if TYPE_CHECKING:
    from flockenv.engine.kernel_plan import KernelPlan

__all__ = ["OneLaw", "arguments_of", "laws_of", "sum_of", "value_of"]


class OneLaw(NamedTuple):
    """A law of one agent."""

    k: int  # index of its effect
    law: Law
    images: Images | None = None

    @classmethod
    def of(cls, parts: KernelPlan, k: int, slot: str) -> OneLaw:
        """Return the law that effect k has in a slot."""
        effect = parts.effects[k]
        return cls(k, getattr(effect, slot), images_in(parts, effect))


def laws_of(parts: KernelPlan, slot: str) -> tuple[OneLaw, ...]:
    """Return the laws of all effects that have one in a slot, in order."""
    return tuple(OneLaw.of(parts, k, slot) for k, e in enumerate(parts.effects) if getattr(e, slot) is not None)


@functools.cache
def arguments_of(k: int, images: Images | None) -> Callable[[Any, Any], Any]:
    """Return a function `given(numbers, me)`: what the laws of effect k are passed.

    Points are replaced by their images nearest to the agent.
    """
    if images is None:
        return kernel(lambda numbers, me: numbers.effects[k])
    nearest = images_of(images)
    return kernel(lambda numbers, me: nearest(numbers.effects[k], numbers.size, me.pos))


@functools.cache
def value_of(one: OneLaw) -> Callable[[Any, Any], Any]:
    """Return a function `value(numbers, me)`: the value of a law for an agent."""
    given, law = arguments_of(one.k, one.images), one.law
    return kernel(lambda numbers, me: law(given(numbers, me), me))


@functools.cache
def sum_of(indices: tuple[int, ...]) -> Callable[[Vec, Any], Vec]:
    """Return a function `total(start, vectors)`: start plus some vectors of a tuple, added in order."""
    if not indices:
        return kernel(lambda start, vectors: start)
    before, last = sum_of(indices[:-1]), indices[-1]
    if not indices[1:]:
        return kernel(lambda start, vectors: add(start, vectors[last]))
    return kernel(lambda start, vectors: add(before(start, vectors), vectors[last]))
