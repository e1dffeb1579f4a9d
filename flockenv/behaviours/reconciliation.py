"""An arbitration over rows of arrays: combines steering forces that are passed as arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from flockenv.jit.decorators import Law, kernel
from flockenv.jit.section import entry_of, read_several, record, vector
from flockenv.physics.effects.effect import Me
from flockenv.steering.arbitration import Arbitration

__all__ = ["reconcile"]

Reals = NDArray[np.floating[Any]]


def reconcile(
    arbitration: Arbitration, forces: ArrayLike, max_force: ArrayLike, time: ArrayLike = 0.0, key: ArrayLike = 0,
    who: ArrayLike = 0, heading: ArrayLike | None = None, dtype: Any = np.float64,
    inner: Mapping[str, ArrayLike] | None = None,
) -> tuple[Reals, Reals]:  # fmt: skip
    """Return the force, (R, D) N, and the share of each behaviour, (R, K), from steering forces (R, K, D) N.

    The other arguments are (R,), or one number for all: max_force, N; time, s; key of the world; agent `who`; heading
    (R, D); `inner` numbers by name, each (R,), if the arbitration recalls them.
    """
    requested = np.ascontiguousarray(forces, dtype)
    if requested.ndim != 3 or requested.shape[1] < 1 or requested.shape[2] not in (2, 3):
        raise ValueError(f"forces has shape {requested.shape}, expected (R, K, D) with K >= 1 and D = 2 or 3")
    rows, count, dimension = requested.shape
    real = requested.dtype.type
    ahead = np.zeros((rows, dimension)) if heading is None else heading
    numbers = arbitration.parameters(count)
    force, share = np.empty((rows, dimension), dtype), np.empty((rows, count), dtype)
    recalled = {name: (inner or {})[name] for name in arbitration.recalls}
    kept = np.array([np.broadcast_to(x, rows) for x in recalled.values()], dtype).reshape(-1, rows).T
    given = {k: tuple(map(real, v)) if isinstance(v, tuple) else real(v) for k, v in numbers.items()}
    p = record(tuple(given))(*(given or {"nothing": real(0)}).values())
    _over_rows(arbitration.law, count, dimension, tuple(recalled))(
        p, requested, *(np.ascontiguousarray(np.broadcast_to(x, rows), kind) for x, kind in
                 ((max_force, dtype), (time, dtype), (key, np.uint64), (who, dtype))),
        np.ascontiguousarray(np.broadcast_to(ahead, (rows, dimension)), dtype), np.ascontiguousarray(kept), force,
        share,
    )  # fmt: skip
    return force, share


@kernel
def _number(numbers: Any, k: int) -> float:
    return numbers[k]  # type: ignore[no-any-return]


@entry_of
def _over_rows(law: Law, count: int, dimension: int, recalled: tuple[str, ...]) -> Callable[..., None]:
    """Return the loop of one arbitration over rows."""
    direction, force_of = vector(dimension), kernel(lambda forces, k: direction(forces[k], 0))
    forces_of, kept_of = read_several(count, force_of), read_several(max(len(recalled), 1), _number)
    inner_of, recalls = record(recalled), bool(recalled)

    def over_rows(
        p: Any,
        forces: Any,
        max_force: Any,
        time: Any,
        key: Any,
        who: Any,
        heading: Any,
        kept: Any,
        force: Any,
        share: Any,
    ) -> None:
        o = max_force.dtype.type(0)
        for r in range(forces.shape[0]):
            h = direction(heading[r], 0)
            inner = inner_of(*kept_of(kept[r], 0)) if recalls else ()
            me = Me(who[r], h, h, h, o, o, o, max_force[r], h, time[r], h, key[r], h, o, inner)
            f, s = law(p, me, forces_of(forces[r], 0))
            for j in range(dimension):
                force[r, j] = f[j]
            for k in range(count):
                share[r, k] = s[k]

    return over_rows
