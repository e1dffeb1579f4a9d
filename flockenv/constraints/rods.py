"""Rods and ropes: pairs of agents whose distance is given, or at most given, at the end of every step."""

from __future__ import annotations

import warnings
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.constraints.base import Constraint, Settler
from flockenv.kernels import entry, finite, kernel, like
from flockenv.networks import EDGE
from flockenv.space import Torus
from flockenv.state import Floats, State

__all__ = ["Rods", "UnmetWarning", "hold"]

Number = Annotated[int, Field(ge=0, strict=True)]
Pair = tuple[Number, Number]
Length = Annotated[float, Field(gt=0, strict=True)]

KNOWN, UNKNOWN = 0.9999, 0.99
"""By which factor at most Jacobi's iteration is taken to shrink errors: where directions at rest are known, or not."""


class UnmetWarning(UserWarning):
    """A rod or rope is not as long as it should be: the sweeps that were allowed did not suffice."""


class Ties(NamedTuple):
    """Who is held to whom, R pairs, in layers of which each has nobody twice."""

    i: NDArray[np.int32]  # (R,)
    j: NDArray[np.int32]  # (R,)
    length: NDArray[np.float64]  # (R,) m
    way: NDArray[np.float64]  # (R, D) from i to j when nothing is strained; 0 = nobody knows


@kernel
def _to(x: Any, b: int, i: int, j: int, period: Any, way: Any) -> float:
    """Write the way from agent i to agent j, the shortest around a torus; return its square."""
    square = like(way[0], 0.0)
    for k in range(x.shape[0]):
        d = x[k, b, j] - x[k, b, i]
        if period[k] > 0:
            d -= period[k] * np.floor(d / period[k] + like(d, 0.5))
        way[k] = d
        square += d * d
    return square


@kernel
def _along(a: Any, b: Any) -> float:
    """Return a . b."""
    total = like(a[0], 0.0)
    for k in range(a.shape[0]):
        total += a[k] * b[k]
    return total


@kernel
def _push(x: Any, b: int, i: int, by: float, way: Any) -> None:
    """Add by times way to agent i."""
    for k in range(x.shape[0]):
        x[k, b, i] += by * way[k]


@kernel
def _grain(x: Any, b: int, i: int, j: int) -> float:
    """Return some roundings of the largest coordinate of two agents: no length is known better."""
    most = like(x[0, 0, 0], 0.0)
    for k in range(x.shape[0]):
        most = max(most, max(abs(x[k, b, i]), abs(x[k, b, j])))
    return most * like(most, 3e-15 if x.itemsize == 8 else 1.5e-6)


@kernel
def _sooner(over: float, rho: float, sweep: int) -> float:
    """Return by how much the next sweep is over-relaxed: Chebyshev's way from 1 to Young's 2 / (1 + sqrt(1 - rho^2)).

    (Golub and Varga 1961.) Errors do not grow on the way, as they do if one begins with the last.
    """
    e = like(rho, 1.0)
    return e / (e - rho * rho * over * like(rho, 0.5 if sweep == 0 else 0.25))


@kernel
def _reach(
    x0: Any, x: Any, v: Any, alive: Any, b: int, weight: Any, i_: Any, j_: Any, length: Any, pull: Any, way: Any,
    was: Any, period: Any, per_dt: float, slack: bool, tolerance: float, most: int, rho: float, carry: bool,
) -> tuple[int, float]:  # fmt: skip
    """Move agents of world b until all lengths hold; with `carry`, as velocities that act along the old ways.

    Gauss and Seidel's sweeps, over-relaxed. Carried, the aim is the length before the step where that was wrong: what
    was wrong already is mended without it. Returns the worst rod, or -1, and by which share of its length.
    """
    count, o = i_.shape[0], like(per_dt, 0.0)
    for r in range(count):
        pull[r] = o
    bad, off, over = -1, o, like(o, 1.0)
    for sweep in range(most):
        bad, off = -1, o
        for r in range(count):
            i, j, aim = i_[r], j_[r], length[r]
            w = weight[i] + weight[j]
            if not (alive[b, i] and alive[b, j] and w > o):
                continue
            allowed = max(tolerance * length[r], _grain(x, b, i, j))
            if carry:
                before = np.sqrt(_to(x0, b, i, j, period, was))
                if before > aim + allowed or (before < aim - allowed and not slack):
                    aim = before
            square = _to(x, b, i, j, period, way)
            now = np.sqrt(square)
            if slack and now <= aim and pull[r] <= o:
                continue
            wrong = abs(now - aim) / length[r]
            if wrong > off:
                off = wrong
                if abs(now - aim) > like(o, 0.5) * allowed:
                    bad = r
            along = _along(way, was) if carry else o
            if not (carry and along > like(o, 0.3) * now * np.sqrt(_along(was, was))):
                for k in range(way.shape[0]):
                    was[k] = way[k]  # it turned too far in one step, or was in one place: along the way it has now
                along = square
            if not along > o:
                was[0], along = length[r], length[r] * length[r]  # both are in one place
            by = over * (square - aim * aim) / (like(o, 2.0) * w * along)
            if slack:
                by = max(by, -pull[r])
            pull[r] += by
            _push(x, b, i, by * weight[i], was)
            _push(x, b, j, -by * weight[j], was)
            if carry:
                _push(v, b, i, by * weight[i] * per_dt, was)
                _push(v, b, j, -by * weight[j] * per_dt, was)
        if bad < 0:
            break
        over = _sooner(over, rho, sweep)
    return bad, off


@kernel
def _still(
    x: Any, v: Any, alive: Any, b: int, weight: Any, i_: Any, j_: Any, length: Any, pull: Any, way: Any, period: Any,
    per_dt: float, slack: bool, tolerance: float, most: int, rho: float,
) -> tuple[int, float]:  # fmt: skip
    """Take the velocities along rods from the agents of world b, and those that would stretch taut ropes."""
    count, o = i_.shape[0], like(per_dt, 0.0)
    for r in range(count):
        pull[r] = o
    bad, off, over = -1, o, like(o, 1.0)
    for sweep in range(most):
        bad, off = -1, o
        for r in range(count):
            i, j = i_[r], j_[r]
            w = weight[i] + weight[j]
            if not (alive[b, i] and alive[b, j] and w > o):
                continue
            allowed = max(tolerance * length[r], _grain(x, b, i, j))
            square = _to(x, b, i, j, period, way)
            now = np.sqrt(square)
            if not square > o or (slack and now < length[r] - like(o, 2.0) * allowed):
                continue
            rate = o
            for k in range(way.shape[0]):
                way[k] /= now
                rate += way[k] * (v[k, b, j] - v[k, b, i])
            if slack and rate <= o and pull[r] <= o:
                continue
            wrong = abs(rate) / (length[r] * per_dt)
            if wrong > off:
                off = wrong
                if abs(rate) > like(o, 0.5) * allowed * per_dt:
                    bad = r
            by = over * rate / w
            if slack:
                by = max(by, -pull[r])
            pull[r] += by
            _push(v, b, i, by * weight[i], way)
            _push(v, b, j, -by * weight[j], way)
        if bad < 0:
            break
        over = _sooner(over, rho, sweep)
    return bad, off


@kernel
def hold(
    x0: Any, x: Any, v: Any, alive: Any, weight: Any, i_: Any, j_: Any, length: Any, pull: Any, ways: Any, period: Any,
    per_dt: float, slack: bool, tolerance: float, most: int, rho: float, first: int, end: int,
) -> tuple[int, int, int, float]:  # fmt: skip
    """Hold the agents of worlds [first, end) together.

    Returns the first (world, agent) not finite, or -1s, and the last rod that is not right, or -1, and by which share.
    """
    world, agent, rod, off = -1, -1, -1, like(per_dt, 0.0)
    way, was = ways[0], ways[1]
    for b in range(first, end):
        for stage in range(3):
            if stage < 2:
                bad, by = _reach(
                    x0, x, v, alive, b, weight, i_, j_, length, pull, way, was, period, per_dt, slack, tolerance, most,
                    rho, stage == 0,
                )
            else:
                bad, by = _still(
                    x, v, alive, b, weight, i_, j_, length, pull, way, period, per_dt, slack, tolerance, most, rho
                )
            if bad >= 0:
                rod, off = bad, by
        for r in range(2 * i_.shape[0]):
            i = i_[r // 2] if r % 2 == 0 else j_[r // 2]
            for k in range(x.shape[0]):
                p = period[k]
                if p > 0:
                    x[k, b, i] -= p * np.floor(x[k, b, i] / p)
                    if x[k, b, i] >= p:
                        x[k, b, i] = 0
                if world < 0 and not finite(x[k, b, i] + v[k, b, i]):
                    world, agent = b, i
    return world, agent, rod, off


class Rods(Constraint):
    """Agents keep their distances, as if there were rods without mass between them; or ropes, which may hang slack.

    Each step ends with positions moved along the directions that the rods had before it, velocities with them, and
    then without any speed along the rods (Ryckaert, Ciccotti and Berendsen 1977; Andersen 1983, RATTLE): momentum is
    kept, and in gravity no energy is pumped. A rope that is drawn tight loses the speed that would stretch it. Who is
    held in place is not moved. Distances that are wrong to begin with are mended in the first step, without a speed.
    Rods have the last word: a limit of speed, and the walls of a box, were before them.
    """

    kind: Literal["rods"] = "rods"
    group: int | None = Field(default=None, ge=0, description="number of the group along the edges of whose network")
    pairs: tuple[Pair, ...] = Field(default=(), description="or who to whom, by numbers of agents")
    lengths: tuple[Length, ...] = Field(default=(), description="m, of the pairs; one for all, or one for each")
    slack: bool = Field(default=False, description="ropes, not rods: they may come nearer")
    tolerance: float = Field(default=1e-10, ge=1e-14, le=0.1, description="of a length, or what numbers can tell")
    most: int = Field(default=1000, ge=1, le=1_000_000, description="sweeps over all in one step; then it warns")

    @model_validator(mode="after")
    def _one_or_the_other(self) -> Self:
        """Refuse what is about nobody, or about two things; who is tied to himself; lengths that are too few."""
        if (self.group is None) == (not self.pairs):
            raise ValueError("group: give either a group with a network or pairs")
        if len(self.lengths) not in ((1, len(self.pairs)) if self.pairs else (0,)):
            allowed = f"1 or {len(self.pairs)}" if self.pairs else "none beside a group"
            raise ValueError(f"lengths: {len(self.lengths)} of them; {allowed} is allowed")
        seen: dict[frozenset[int], int] = {}
        for k, pair in enumerate(self.pairs):
            if pair[0] == pair[1]:
                raise ValueError(f"pairs[{k}] = {pair}: two different agents are needed")
            if seen.setdefault(frozenset(pair), k) != k:
                raise ValueError(f"pairs[{k}] = {pair}: is pairs[{seen[frozenset(pair)]}] again")
        return self

    def ties(self, scene: Any) -> Ties:
        """Return who is held to whom in a scene; ValueError if it has no such network or agents."""
        d = scene.dimension
        if self.group is None:
            i, j = np.array(self.pairs, np.int32).T
            return _layered(Ties(i, j, np.resize(np.array(self.lengths), len(i)), np.zeros((len(i), d))))
        if self.group >= len(scene.groups):
            raise ValueError(f"group = {self.group}: there are {len(scene.groups)} groups, counted from 0")
        network = scene.groups[self.group].network
        if network is None:
            raise ValueError(f"group = {self.group}: has no network; give groups[{self.group}].network")
        springs, points, first = network.springs(d), network.rest_points(d), scene.starts[self.group]
        edges = springs.role == EDGE
        i, j = springs.i[edges], springs.j[edges]
        return _layered(Ties(i + np.int32(first), j + np.int32(first), springs.rest[edges], points[j] - points[i]))

    def check(self, scene: Any) -> None:
        """Refuse agents and networks that are not there, and lengths that reach around a torus."""
        ties = self.ties(scene)
        most = int(max(ties.i.max(initial=0), ties.j.max(initial=0)))
        if most >= scene.agents:
            raise ValueError(f"pairs: there is no agent {most}, they are 0 to {scene.agents - 1}")
        if isinstance(scene.space, Torus) and ties.length.max(initial=0.0) > min(scene.space.size) / 2:
            raise ValueError(
                f"lengths: {ties.length.max():g} m reaches around the torus; at most half its shortest edge, "
                f"{min(scene.space.size) / 2:g} m, is allowed"
            )

    def numbers(self, scene: Any) -> int:
        """Of each pair its two agents, length and pull."""
        return 1 + -(-3 * len(self.ties(scene).i) // scene.agents)

    def settler(self, scene: Any) -> Settler:
        """Return what mends a step, with scratch of its own; it warns once if lengths are not met."""
        ties, real = self.ties(scene), np.dtype(scene.dtype).type
        weight = (1 / scene.body.mass).astype(real)  # who is held in place has an infinite mass
        period = np.array(scene.space.extent(scene.dimension) if scene.space.periodic else (0.0,) * scene.dimension)
        numbers = (
            weight, ties.i, ties.j, ties.length.astype(real), np.zeros(len(ties.i), real),
            np.zeros((2, scene.dimension), real), period.astype(real), real(1 / scene.dt), self.slack,
            real(self.tolerance), self.most, real(_slowness(ties, weight)),
        )  # fmt: skip
        solve, told = entry(hold), False

        def settle(x0: Floats, v0: Floats, state: State, first: int, end: int) -> tuple[int, int]:
            nonlocal told
            world, agent, rod, off = solve(x0, state.x, state.v, state.alive, *numbers, first, end)
            if rod >= 0 and world < 0 and not told:
                told = True
                warnings.warn(
                    f"rods: after most = {self.most} sweeps agents {ties.i[rod]} and {ties.j[rod]} are {off:.2g} of "
                    f"their length off (tolerance = {self.tolerance:g}); allow more sweeps, or make shorter steps",
                    UnmetWarning,
                    stacklevel=2,
                )
            return world, agent

        return settle


def _layered(ties: Ties) -> Ties:
    """Return the same in ascending order, layer after layer: the order in which they were given makes no difference.

    In each layer nobody is twice, so that those of a chain, every other one, are Young's ordering.
    """
    swap = ties.i > ties.j
    i, j = np.where(swap, ties.j, ties.i), np.where(swap, ties.i, ties.j)
    way = np.where(swap[:, None], -ties.way, ties.way)
    order = np.lexsort((j, i))
    layer, of = np.zeros(len(i), np.int64), dict[int, set[int]]()
    for r in order:
        taken = of.setdefault(int(i[r]), set()) | of.setdefault(int(j[r]), set())
        layer[r] = next(k for k in range(len(taken) + 1) if k not in taken)
        of[int(i[r])].add(int(layer[r]))
        of[int(j[r])].add(int(layer[r]))
    order = order[np.argsort(layer[order], kind="stable")]
    return Ties(i[order], j[order], ties.length[order], way[order])


def _slowness(ties: Ties, weight: Floats) -> float:
    """Return rho, by which Jacobi's iteration shrinks errors, of everybody at rest.

    Rods of unknown directions count as if all were in line. A wrong one makes more sweeps, and no other result.
    """
    count = len(ties.i)
    w = weight[ties.i].astype(float) + weight[ties.j].astype(float)
    long = np.linalg.norm(ties.way, axis=1)
    known = bool(long.all())
    ends = np.concatenate([ties.i, ties.j])
    # J: what speeds along rods agents have; |J| where directions are not known
    sign = np.repeat([-1.0, 1.0], count)[:, None] if known else np.ones((2 * count, 1))
    ways = np.tile(ties.way / long[:, None] if known else np.ones((count, 1)), (2, 1)) * sign
    scale = 1 / np.sqrt(np.where(w > 0, w, 1.0))
    said, rho = np.random.default_rng(0).normal(size=count) if known else np.ones(count), 0.0
    for _ in range(100):
        said /= max(float(np.linalg.norm(said)), 1e-300)
        forces = np.zeros((len(weight), ways.shape[1]))
        np.add.at(forces, ends, ways * np.tile(scale * said, 2)[:, None])
        moved = (forces * weight[:, None])[ends] * ways
        after = said - scale * moved.sum(axis=1).reshape(2, count).sum(axis=0)  # Jacobi's: 1 - the scaled matrix
        if not known:
            after = -after
        rho, said = float(np.linalg.norm(after)), after
    return min(rho, KNOWN if known else UNKNOWN)
