"""Rods and ropes: pairs of agents whose distance is fixed, or has an upper limit, at the end of every step."""

from __future__ import annotations

import warnings
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.core.warnings import UnmetWarning
from flockenv.geometry.space import Torus
from flockenv.jit.decorators import finite, kernel, like
from flockenv.jit.section import entry
from flockenv.maths.approximations import round_half_even
from flockenv.model.networks import EDGE
from flockenv.model.scene_view import SceneView
from flockenv.model.state import Floats, State
from flockenv.physics.constraints.constraint import Constraint, Settler

__all__ = ["RodForces", "Rods", "hold_rods", "wrap_position"]

Number = Annotated[int, Field(ge=0, strict=True)]
Pair = tuple[Number, Number]
Length = Annotated[float, Field(gt=0, strict=True)]

KNOWN, UNKNOWN = 0.9999, 0.99
"""Upper limits of the assumed convergence factor of Jacobi's iteration: if directions at rest are known, or not."""

POWERS, LEAST = 50, 1e-9
"""Steps of inverse iteration for that factor, and a shift of the matrix, which redundant rods make singular."""


class RodForces(NamedTuple):
    """Forces of R rods and ropes in a step, sorted by agents; 0 where a rope is slack or an end is dead."""

    first: NDArray[np.int32]  # (R,) the agent of the smaller number
    second: NDArray[np.int32]  # (R,) the other agent
    force: Floats  # (R, D) N, on `first`: impulse over dt; -force acts on `second`
    tension: Floats  # (R,) N, sum of the impulses along the rod over dt; > 0: it pulls, < 0: it pushes


class RodPairs(NamedTuple):
    """R pairs of agents that are held together, in layers; each agent is at most once in a layer."""

    i: NDArray[np.int32]  # (R,)
    j: NDArray[np.int32]  # (R,)
    length: NDArray[np.float64]  # (R,) m
    direction: NDArray[np.float64]  # (R, D) from i to j at rest; 0 = unknown


class Hold(NamedTuple):
    """Arguments of a kernel for R rods: agents, parameters, and scratch memory."""

    weight: Any  # (N,) 1/kg; 0 for agents that are held in place
    i: Any  # (R,)
    j: Any  # (R,)
    length: Any  # (R,) m
    period: Any  # (D,) m, edges of a torus; 0 = not periodic
    per_dt: float  # 1/s
    slack: bool
    tolerance: float
    most: int
    rho: float  # see _spectral_radius
    allowed: Any  # (R,) m, allowed error of a length
    old: Any  # (R, D) m, from i to j before the step
    before: Any  # (R,) m, length before the step
    pull: Any  # (R,) summed correction of each rod over the sweeps
    offset: Any  # (D,) m, from i to j now
    along: Any  # (D,) the direction in which the rod acts, of any length
    kept: Any  # (2, D, N) positions and velocities after the method
    records: Any  # (1,) True while impulses are recorded
    impulse: Any  # (R, D) kg m/s, on agent i in the step of the last world, if recorded
    size: Any  # (R,) kg m/s, sum of the impulses along each rod; > 0: it pulls


@kernel
def _offset_to(x: Any, b: int, i: int, j: int, period: Any, out: Any) -> float:
    """Write the offset from agent i to agent j, the shortest one on a torus; return its length."""
    square = like(out[0], 0.0)
    for k in range(x.shape[0]):
        d = x[k, b, j] - x[k, b, i]
        if period[k] > 0:
            d -= period[k] * round_half_even(d / period[k])
        out[k] = d
        square += d * d
    return np.sqrt(square)  # type: ignore[no-any-return]


@kernel
def _dot(a: Any, b: Any) -> float:
    """Return a . b."""
    total = like(a[0], 0.0)
    for k in range(a.shape[0]):
        total += a[k] * b[k]
    return total


@kernel
def _add_along(x: Any, b: int, rods: Any, r: int, by: float) -> None:
    """Add `by` times weight times direction to x of one end of a rod, and subtract it from x of the other."""
    i, j = rods.i[r], rods.j[r]
    for k in range(x.shape[0]):
        x[k, b, i] += by * rods.weight[i] * rods.along[k]
        x[k, b, j] -= by * rods.weight[j] * rods.along[k]


@kernel
def _add_impulse(v: Any, b: int, rods: Any, r: int, by: float) -> None:
    """Change the velocities of both ends by the impulse `by` times the direction, and record it if that is wanted."""
    _add_along(v, b, rods, r, by)
    if rods.records[0]:
        for k in range(v.shape[0]):
            rods.impulse[r, k] += by * rods.along[k]
        rods.size[r] += by * np.sqrt(_dot(rods.along, rods.along))


@kernel
def _write_offsets(x0: Any, x: Any, b: int, rods: Any) -> None:
    """Write each rod's offset before the step, and its allowed error: at least the rounding error of positions."""
    for r in range(rods.i.shape[0]):
        i, j = rods.i[r], rods.j[r]
        rods.before[r] = _offset_to(x0, b, i, j, rods.period, rods.old[r])
        most = like(rods.per_dt, 0.0)
        for k in range(x.shape[0]):
            most = max(most, max(abs(x[k, b, i]), abs(x[k, b, j])))
        rods.allowed[r] = max(rods.tolerance * rods.length[r], most * like(most, 3e-15 if x.itemsize == 8 else 1.5e-6))


@kernel
def _can_move(alive: Any, b: int, rods: Any, r: int) -> bool:
    """Return True if both ends of a rod are alive, and at least one of them can move."""
    i, j = rods.i[r], rods.j[r]
    return alive[b, i] and alive[b, j] and rods.weight[i] + rods.weight[j] > 0  # type: ignore[no-any-return]


@kernel
def _next_relaxation(over: float, rho: float, sweep: int) -> float:
    """Return the over-relaxation of the next sweep: Chebyshev's sequence from 1 to Young's 2 / (1 + sqrt(1 - rho^2)).

    With it errors do not grow at first, as they do if the first sweep uses the final value (Golub and Varga 1961).
    """
    e = like(rho, 1.0)
    return e / (e - rho * rho * over * like(rho, 0.5 if sweep == 0 else 0.25))


@kernel
def _target_length(rods: Any, r: int) -> float:
    """Return a rod's target length in the stage that also changes velocities: the old length if that was wrong."""
    aim, before, allowed = rods.length[r], rods.before[r], rods.allowed[r]
    if before > aim + allowed or (before < aim - allowed and not rods.slack):
        aim = before
    return aim  # type: ignore[no-any-return]


@kernel
def _write_direction(rods: Any, r: int, now: float, carry: bool) -> float:
    """Write the direction in which a rod acts, `along`, and return offset . along, > 0.

    With `carry` it is the rod's direction before the step. Without, or if the rod has turned too far, it is the current
    one.
    """
    o = like(now, 0.0)
    if carry:
        cosine = _dot(rods.offset, rods.old[r])
        if cosine > like(o, 0.3) * now * rods.before[r]:
            for k in range(rods.offset.shape[0]):
                rods.along[k] = rods.old[r, k]
            return cosine
    for k in range(rods.offset.shape[0]):
        rods.along[k] = rods.offset[k]
    if now > o:
        return now * now
    rods.along[0] = rods.length[r]  # both are in one place: any direction is possible
    return rods.length[r] * rods.length[r]  # type: ignore[no-any-return]


@kernel
def _correct_length(x: Any, v: Any, b: int, rods: Any, r: int, over: float, carry: bool) -> tuple[float, bool]:
    """Move the ends of a rod to its target length; return the relative error, and if that exceeds the tolerance.

    With `carry` velocities change by the change of positions per time step.
    """
    o, aim = like(over, 0.0), _target_length(rods, r) if carry else rods.length[r]
    now = _offset_to(x, b, rods.i[r], rods.j[r], rods.period, rods.offset)
    if rods.slack and now <= aim and rods.pull[r] <= o:
        return o, False
    cosine, w = _write_direction(rods, r, now, carry), rods.weight[rods.i[r]] + rods.weight[rods.j[r]]
    by = over * (now * now - aim * aim) / (like(o, 2.0) * w * cosine)
    if rods.slack:
        by = max(by, -rods.pull[r])
    rods.pull[r] += by
    _add_along(x, b, rods, r, by)
    if carry:
        _add_impulse(v, b, rods, r, by * rods.per_dt)
    return abs(now - aim) / rods.length[r], abs(now - aim) > like(o, 0.5) * rods.allowed[r]


@kernel
def _correct_velocity(x: Any, v: Any, b: int, rods: Any, r: int, over: float) -> tuple[float, bool]:
    """Remove the velocity along a rod, or that stretches a taut rope; return its size, and if it exceeds the tolerance.

    The size is in lengths per time step.
    """
    o, allowed = like(over, 0.0), rods.allowed[r]
    now = _offset_to(x, b, rods.i[r], rods.j[r], rods.period, rods.offset)
    if not now > o or (rods.slack and now < rods.length[r] - like(o, 2.0) * allowed):
        return o, False
    rate, w = o, rods.weight[rods.i[r]] + rods.weight[rods.j[r]]
    for k in range(rods.offset.shape[0]):
        rods.along[k] = rods.offset[k] / now
        rate += rods.along[k] * (v[k, b, rods.j[r]] - v[k, b, rods.i[r]])
    if rods.slack and rate <= o and rods.pull[r] <= o:
        return o, False
    by = over * rate / w
    if rods.slack:
        by = max(by, -rods.pull[r])
    rods.pull[r] += by
    _add_impulse(v, b, rods, r, by)
    return abs(rate) / (rods.length[r] * rods.per_dt), abs(rate) > like(o, 0.5) * allowed * rods.per_dt


@kernel
def _sweep(x: Any, v: Any, alive: Any, b: int, rods: Any, stage: int) -> tuple[int, float]:
    """Sweep over all rods with over-relaxation until they are within tolerance.

    Returns the rod of the largest error if they are not, else -1, and that relative error.
    Stage 0: lengths, with velocities; 1: lengths that were wrong before the step; 2: velocities.
    """
    count, o = rods.i.shape[0], like(rods.per_dt, 0.0)
    for r in range(count):
        rods.pull[r] = o
    worst, off, over = -1, o, like(o, 1.0)
    for sweep in range(rods.most):
        worst, off = -1, o
        for r in range(count):
            if _can_move(alive, b, rods, r):
                if stage < 2:
                    wrong, counts = _correct_length(x, v, b, rods, r, over, stage == 0)
                else:
                    wrong, counts = _correct_velocity(x, v, b, rods, r, over)
                if counts and wrong > off:
                    worst, off = r, wrong
        if worst < 0:
            break
        over = _next_relaxation(over, rods.rho, sweep)
    return worst, off


@kernel
def _copy(x: Any, v: Any, kept: Any, b: int, keep: bool) -> None:
    """Save positions and velocities of world b (keep), or restore them."""
    for k in range(x.shape[0]):
        for i in range(x.shape[2]):
            if keep:
                kept[0, k, i], kept[1, k, i] = x[k, b, i], v[k, b, i]
            else:
                x[k, b, i], v[k, b, i] = kept[0, k, i], kept[1, k, i]


@kernel
def _clear_impulses(rods: Any) -> None:
    """Set the impulses of all rods to 0."""
    rods.impulse[:] = 0
    rods.size[:] = 0


@kernel
def wrap_position(x: Any, v: Any, b: int, i: int, period: Any) -> bool:
    """Wrap the position of an agent on a torus; return True if its state is finite."""
    sound = True
    for k in range(x.shape[0]):
        p = period[k]
        if p > 0:
            x[k, b, i] -= p * np.floor(x[k, b, i] / p)
            if x[k, b, i] >= p:
                x[k, b, i] = 0
        sound = sound and finite(x[k, b, i] + v[k, b, i])
    return sound


@kernel
def hold_rods(x0: Any, x: Any, v: Any, alive: Any, rods: Any, first: int, end: int) -> tuple[int, int, int, float]:
    """Apply the rods of worlds [first, end), in place.

    If the first stage does not converge, as in far too long a step, its changes are undone, as velocities could have
    any value. So energy is lost and never gained.
    Returns the first (world, agent) that is not finite, or -1s, the last rod out of tolerance, or -1, and its relative
    error.
    """
    world, agent, rod, off = -1, -1, -1, like(rods.per_dt, 0.0)
    for b in range(first, end):
        _copy(x, v, rods.kept, b, True)
        _clear_impulses(rods)
        _write_offsets(x0, x, b, rods)
        for stage in range(3):
            worst, by = _sweep(x, v, alive, b, rods, stage)
            if worst >= 0:
                rod, off = worst, by
                if stage == 0:
                    _copy(x, v, rods.kept, b, False)
                    _clear_impulses(rods)
        for r in range(2 * rods.i.shape[0]):
            i = rods.i[r // 2] if r % 2 == 0 else rods.j[r // 2]
            if not wrap_position(x, v, b, i, rods.period) and world < 0:
                world, agent = b, i
    return world, agent, rod, off


class Rods(Constraint):
    """Pairs of agents keep their distances, as if joined by massless rods, or by ropes, which may be slack.

    Each step ends with a correction of positions, and with them velocities, along the rods' directions before the step;
    then the velocity along the rods is removed (Ryckaert, Ciccotti and Berendsen 1977; Andersen 1983, RATTLE). Momentum
    is conserved, and in gravity no energy is gained. A rope that becomes taut loses the speed that would stretch it.
    Agents that are held in place are not moved. Distances that are wrong at the start are corrected in the first step,
    without a change of velocity. A chain of n links takes some 6 n sweeps in a step, and so does a cloth of n x n
    cells. Rods are applied last, after the speed limit and the walls of a box.
    `Scene.rod_forces` returns their tensions.

    |x_i - x_j| = L for a rod, <= L for a rope.

    Limits: it is an iteration: a chain or a cloth of n needs a number of sweeps that grows with n, and after `most`
    of them lengths may be off, with a warning. Rods do not resist bending, have no mass and no body, and cannot break.
    """

    kind: Literal["rods"] = "rods"
    group: int | None = Field(default=None, ge=0, description="index of a group: rods along the edges of its network")
    pairs: tuple[Pair, ...] = Field(default=(), description="pairs of agents, by index (instead of a group)")
    lengths: tuple[Length, ...] = Field(default=(), description="m, lengths of the pairs; one for all, or one for each")
    slack: bool = Field(default=False, description="True: ropes, whose ends may be nearer than the length")
    tolerance: float = Field(default=1e-10, ge=1e-14, le=0.1, description="relative error of a length, or rounding")
    most: int = Field(default=5000, ge=1, le=1_000_000, description="sweeps over all rods in a step; then a warning")

    @model_validator(mode="after")
    def _check_pairs(self) -> Self:
        """Raise ValueError unless a group is given, or pairs of different agents, each once, with lengths."""
        if (self.group is None) == (not self.pairs):
            raise ValueError("group: give either a group with a network or pairs")
        if len(self.lengths) not in ((1, len(self.pairs)) if self.pairs else (0,)):
            allowed = f"1 or {len(self.pairs)}" if self.pairs else "none with a group"
            raise ValueError(f"lengths: there are {len(self.lengths)}; allowed: {allowed}")
        seen: dict[frozenset[int], int] = {}
        for k, pair in enumerate(self.pairs):
            if pair[0] == pair[1]:
                raise ValueError(f"pairs[{k}] = {pair}: two different agents are needed")
            if seen.setdefault(frozenset(pair), k) != k:
                raise ValueError(f"pairs[{k}] = {pair}: is the same pair as pairs[{seen[frozenset(pair)]}]")
        return self

    def rod_pairs(self, scene: SceneView) -> RodPairs:
        """Return the pairs that are held together in a scene; raise ValueError if it has no such group or network."""
        d = scene.dimension
        if self.group is None:
            i, j = np.array(self.pairs, np.int32).T
            return _sort_by_layer(RodPairs(i, j, np.resize(np.array(self.lengths), len(i)), np.zeros((len(i), d))))
        if self.group >= len(scene.groups):
            raise ValueError(f"group = {self.group}: there are {len(scene.groups)} groups, counted from 0")
        network = scene.groups[self.group].network
        if network is None:
            raise ValueError(f"group = {self.group}: has no network; give groups[{self.group}].network")
        springs, points, first = network.springs(d), network.rest_points(d), scene.starts[self.group]
        edges = springs.role == EDGE
        i, j = springs.i[edges], springs.j[edges]
        return _sort_by_layer(
            RodPairs(i + np.int32(first), j + np.int32(first), springs.rest[edges], points[j] - points[i])
        )

    def check(self, scene: SceneView) -> None:
        """Raise ValueError if an agent or network is missing, an end can be newborn, or a rod wraps around a torus."""
        pairs = self.rod_pairs(scene)
        most = int(max(pairs.i.max(initial=0), pairs.j.max(initial=0)))
        if most >= scene.agents:
            raise ValueError(f"pairs: there is no agent {most}, they are 0 to {scene.agents - 1}")
        for k, member in enumerate(scene.population):
            for agent in np.unique([pairs.i, pairs.j]):
                if member.feeds(int(np.searchsorted(scene.starts, agent, "right")) - 1):
                    raise ValueError(
                        f"pairs: agent {agent} is of a group that population[{k}] fills: newborn agents have no rods"
                    )
        if isinstance(scene.space, Torus) and pairs.length.max(initial=0.0) > min(scene.space.size) / 2:
            raise ValueError(
                f"lengths: {pairs.length.max():g} m reaches around the torus; at most half its shortest edge, "
                f"{min(scene.space.size) / 2:g} m, is allowed"
            )

    def numbers(self, scene: SceneView) -> int:
        """Return the memory of `Hold`, and of a copy of positions and velocities, in numbers per agent."""
        d = int(scene.dimension)
        return 2 * d - (-(7 + 2 * d) * len(self.rod_pairs(scene).i) // int(scene.agents))

    def settler(self, scene: SceneView) -> Settler:
        """Return a function that corrects a step, with scratch memory of its own, and warns once of wrong lengths."""
        return RodSettler(self, scene)


class RodSettler:
    """Correction of the steps of one scene by one record of rods; its scratch memory holds the impulses of the last."""

    def __init__(self, record: Rods, scene: SceneView) -> None:
        self.record, self.dt, self.warned = record, float(scene.dt), False
        pairs, real, d = record.rod_pairs(scene), np.dtype(scene.dtype).type, scene.dimension
        weight = (1 / scene.body.mass).astype(real)  # agents held in place have an infinite mass
        period = np.array(scene.space.extent(d) if scene.space.periodic else (0.0,) * d, real)
        length = pairs.length.astype(real)
        self.rods = Hold(
            weight, pairs.i, pairs.j, length, period, real(1 / scene.dt), record.slack,
            real(record.tolerance), record.most, real(_spectral_radius(pairs, weight)), np.zeros_like(length),
            np.zeros((len(length), d), real), np.zeros_like(length), np.zeros_like(length), np.zeros(d, real),
            np.zeros(d, real), np.zeros((2, d, scene.agents), real), np.zeros(1, np.bool_),
            np.zeros((len(length), d), real), np.zeros_like(length),
        )  # fmt: skip

    def __call__(self, x0: Floats, v0: Floats, state: State, first: int, end: int) -> tuple[int, int]:
        """Correct the steps of worlds [first, end); return the first (world, agent) that is not finite, or (-1, -1)."""
        rods = self.rods
        world, agent, rod, off = entry(hold_rods)(x0, state.x, state.v, state.alive, rods, first, end)
        if rod >= 0 and world < 0 and not self.warned:
            self.warned = True
            warnings.warn(
                f"rods: after most = {rods.most} sweeps agents {rods.i[rod]} and {rods.j[rod]} were {off:.2g} of "
                f"their length off (tolerance = {rods.tolerance:g}); their speeds are only damped then, so allow "
                "more sweeps, or make shorter steps",
                UnmetWarning,
                stacklevel=2,
            )
        return int(world), int(agent)

    def found(self) -> RodForces:
        """Return the forces in the world that was corrected last while rods.records was True."""
        rods = self.rods
        order = np.lexsort((rods.j, rods.i))
        return RodForces(rods.i[order], rods.j[order], rods.impulse[order] / self.dt, rods.size[order] / self.dt)


def _sort_by_layer(pairs: RodPairs) -> RodPairs:
    """Return the pairs sorted by layer; their initial order has no influence.

    Each agent is at most once in a layer. The layers of a chain are every other link, which is Young's ordering.
    """
    swap = pairs.i > pairs.j
    i, j = np.where(swap, pairs.j, pairs.i), np.where(swap, pairs.i, pairs.j)
    direction = np.where(swap[:, None], -pairs.direction, pairs.direction)
    order = np.lexsort((j, i))
    layer, of = np.zeros(len(i), np.int64), dict[int, set[int]]()
    for r in order:
        taken = of.setdefault(int(i[r]), set()) | of.setdefault(int(j[r]), set())
        layer[r] = next(k for k in range(len(taken) + 1) if k not in taken)
        of[int(i[r])].add(int(layer[r]))
        of[int(j[r])].add(int(layer[r]))
    order = order[np.argsort(layer[order], kind="stable")]
    return RodPairs(i[order], j[order], pairs.length[order], direction[order])


def _spectral_radius(pairs: RodPairs, weight: Floats) -> float:
    """Return rho, the spectral radius of Jacobi's iteration for the network at rest.

    It is 1 minus the smallest eigenvalue of the matrix that couples the rods, by inverse iteration. Rods of unknown
    directions count as parallel. A wrong rho costs more sweeps, and does not change the result.
    """
    from scipy import sparse  # slow to import, and used only by rods
    from scipy.sparse.linalg import splu

    weight = weight.astype(np.float64)
    moves = weight[pairs.i] + weight[pairs.j] > 0
    direction, d = pairs.direction[moves], pairs.direction.shape[1]
    long = np.linalg.norm(direction, axis=1)
    known = bool(long.all())
    units = direction / long[:, None] if known else np.eye(1, d).repeat(len(direction), axis=0)
    speeds: Any = 0  # velocity along each rod per velocity of its ends, (R, N D)
    for ends, sign in ((pairs.i[moves], -1.0 if known else 1.0), (pairs.j[moves], 1.0)):
        share = np.sqrt(weight[ends] / (weight[pairs.i] + weight[pairs.j])[moves])
        column = ends[:, None] * d + np.arange(d)
        entries = (sign * share[:, None] * units).ravel(), (np.repeat(np.arange(len(direction)), d), column.ravel())
        speeds = sparse.csr_array(entries, shape=(len(direction), len(weight) * d)) + speeds
    if not len(direction):
        return 0.0
    lu = splu((speeds @ speeds.T + LEAST * sparse.eye_array(len(direction))).tocsc())
    vector, growth = np.random.default_rng(0).normal(size=len(direction)), 1.0
    for _ in range(POWERS):
        vector = lu.solve(vector / np.linalg.norm(vector))
        growth = float(np.linalg.norm(vector))
    return min(max(0.0, 1 - 1 / growth), KNOWN if known else UNKNOWN)
