"""Many wishes, one wish: how behaviours that want different things are reconciled.

`wishes` is a tuple of vectors in order of priority, all in one unit; a wish of zero asks for nothing. `budget` bounds
the result, in the same unit.
"""

from __future__ import annotations

from flockenv.kernels import Vec, law, like
from flockenv.vec import add, limit, norm, scale, select, zero

__all__ = ["allocate", "blend", "prioritise"]

Wishes = tuple[Vec, ...]


@law
def blend(wishes: Wishes, weights: Vec, budget: float) -> Vec:
    """Return the weighted sum, shortened to the budget (Reynolds 1999). Opposite wishes cancel: +8 and -8 give 0."""
    total = zero(wishes[0])
    for k in range(len(wishes)):
        total = add(total, scale(wishes[k], weights[k]))
    return limit(total, budget)


@law
def prioritise(wishes: Wishes, threshold: float, budget: float) -> Vec:
    """Return the first wish longer than the threshold, shortened to the budget, and nothing of the others."""
    chosen = zero(wishes[0])
    open_ = True
    for k in range(len(wishes)):
        takes = open_ and norm(wishes[k]) > threshold
        chosen = select(takes, wishes[k], chosen)
        open_ = open_ and not takes
    return limit(chosen, budget)


@law
def allocate(wishes: Wishes, budget: float) -> Vec:
    """Grant wishes in order until their lengths have used up the budget; the last one served is cut to what is left.

    Prioritised acceleration allocation (Reynolds 1987): lengths add up as scalars, so the sum needs no shortening, and
    in an emergency the most pressing wish is served whole. (8,0), (-8,0), (0,5) within 10 give (6, 0).
    """
    total = zero(wishes[0])
    left = budget
    o = like(budget, 0.0)
    for k in range(len(wishes)):
        length = norm(wishes[k])
        whole = length <= left
        total = add(total, wishes[k] if whole else scale(wishes[k], left / length))
        left = left - length if whole else o
    return total
