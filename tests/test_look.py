"""The nearest neighbours and their distances equal those of a sort of all squares, however the lists are stored."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit

from flockenv.engine.nearest import AT_ONCE, exchanges, insert, merge
from flockenv.envs.world import World
from flockenv.jit.decorators import kernel
from flockenv.jit.simd_rows import float_as_key, key_as_float, key_of, order_keys, same_key, tag_of
from flockenv.tasks import Bottleneck, Flock

pytestmark = pytest.mark.slow

SIGHT, MIDDLE = 6.1, 20.0  # the last bits of the square of SIGHT are not zeros


def flock(agents: int, neighbours: int, kind: str) -> World:
    return World(Flock(agents=agents, neighbours=neighbours, obstacle_count=0, sight=SIGHT, dtype=kind))


def found(world: World, places: Any) -> tuple[Any, Any, Any]:
    """Return the lists of a world with agents at these places (N, 2): squares and numbers (K, N), counts (N,)."""
    n = world.agents
    world.state.x[:, 0] = np.asarray(places).T
    world.reset(mask=np.zeros(1, bool))  # restarts no episode, only observes
    square, numbers, count = world._scratch[0][1][:3]
    return square[:, :n].copy(), numbers[:, :n].copy(), count[:n].copy()


def expected(places: Any, neighbours: int, kind: str) -> tuple[Any, Any, Any]:
    """Return all rounded squares (N, N), the sorted ones (K, N), and counts; no agent is near the edge of the box."""
    at = np.asarray(places).astype(kind)
    to = at[None, :, :] - at[:, None, :]
    square = to[..., 0] * to[..., 0] + to[..., 1] * to[..., 1]
    np.fill_diagonal(square, np.inf)
    square[square >= np.dtype(kind).type(SIGHT * SIGHT)] = np.inf
    nearest = np.sort(square, axis=1)[:, :neighbours].T
    return square, nearest, (nearest < np.inf).sum(axis=0)


def crowd(n: int, rng: np.random.Generator) -> Any:
    return MIDDLE + rng.normal(size=(n, 2)) * 3


def lattice(n: int, rng: np.random.Generator) -> Any:
    side = int(np.ceil(np.sqrt(n)))
    order = rng.permutation(n)
    return MIDDLE - 4 + np.stack(np.divmod(order, side), axis=1)


def ring(n: int, rng: np.random.Generator) -> Any:
    """Return agents on a circle around one in the middle: equal distances except for the last bits."""
    angle = rng.uniform(0, 2 * np.pi, n)
    places = MIDDLE + 2 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    places[n // 2] = MIDDLE
    return places


def heap(n: int, rng: np.random.Generator) -> Any:
    """Return agents that stand in one of two places."""
    return MIDDLE + rng.integers(0, 2, (n, 1)) * np.ones(2)


def edge(n: int, rng: np.random.Generator) -> Any:
    """Return agents around the first one at the limit of its sight, a little nearer or farther in the last bits."""
    angle = rng.uniform(0, 2 * np.pi, n)
    radius = SIGHT * (1 + 1.2e-7 * rng.choice([-4, -3, -2, -1, 1, 2, 3, 4], n))
    places = MIDDLE + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    places[0] = MIDDLE
    return places


def sparse(n: int, rng: np.random.Generator) -> Any:
    """Return agents that do not see each other, except for one pair."""
    places = 7.0 * np.stack(np.divmod(np.arange(n), 5), axis=1)[:, ::-1] % 35 + 2
    return places if n > 25 else np.concatenate([places[:-1], places[:1] + 1])


CROWDS = (crowd, lattice, ring, heap, edge, sparse)


@pytest.mark.parametrize("kind", ["float32", "float64"])
@pytest.mark.parametrize("make", CROWDS)
@pytest.mark.parametrize(
    ("agents", "neighbours"),
    [
        (7, 6),
        (17, 6),
        (64, 6),
        *(pytest.param(*few, marks=pytest.mark.slow) for few in ((3, 2), (16, 6), (25, 6), (33, 6))),
    ],
)
def test_the_nearest_neighbours_are_those_of_a_sort(agents: int, neighbours: int, make: Any, kind: str) -> None:
    world = flock(agents, neighbours, kind)
    world.reset(0)
    rng = np.random.default_rng(agents)
    for _ in range(20):
        places = make(agents, rng).astype(kind)
        squares, numbers, count = found(world, places)
        every, nearest, many = expected(places, neighbours, kind)
        np.testing.assert_array_equal(count, many)
        if kind == "float32":
            np.testing.assert_array_equal(squares, nearest)
        else:  # operations may be fused
            np.testing.assert_allclose(squares, nearest, rtol=1e-14)
        assert (numbers >= 0).all() and (numbers < agents).all()
        assert (places[numbers.T] == world._scratch[0][1][6][:, :, :agents].T).all()  # positions are listed also
        for i in range(agents):  # of equally far ones any may be listed, but each only once
            listed = numbers[: count[i], i]
            np.testing.assert_allclose(every[i, listed], nearest[: count[i], i], rtol=0 if kind == "float32" else 1e-14)
            assert len(set(listed.tolist())) == count[i]


def test_the_lists_are_the_same_across_the_edge_of_a_periodic_box() -> None:
    rng = np.random.default_rng(1)
    world, size = flock(25, 6, "float32"), 40.0
    world.reset(0)
    places = rng.normal(size=(25, 2)) * 3
    inside = found(world, (places + MIDDLE).astype("f4"))
    across = found(world, (places % size).astype("f4"))
    np.testing.assert_allclose(across[0], inside[0], rtol=1e-4)
    np.testing.assert_array_equal(across[1], inside[1])
    assert (across[0][1:] >= across[0][:-1]).all()


def test_absent_agents_are_in_no_list() -> None:
    """In a kernel that uses keys as long as all agents are present."""
    world = World(Bottleneck(dtype="float32"))
    assert world.task.parts.keyed
    world.reset(0)
    gone = np.arange(0, world.agents, 3)
    world.state.alive[0, gone] = False
    world.reset(mask=np.zeros(1, bool))
    numbers, count = world._scratch[0][1][1:3]
    for i in np.setdiff1d(np.arange(world.agents), gone):
        listed = numbers[: count[i], i]
        assert i not in listed
        assert not np.isin(listed, gone).any()
    assert count[: world.agents].max() > 0


def test_keys_are_used_for_small_worlds_in_single_precision() -> None:
    """Lists of one neighbour need no keys."""
    worlds = flock(24, 6, "float32"), flock(24, 1, "float32"), flock(24, 6, "float64"), flock(600, 6, "float32")
    assert [world.task.parts.keyed for world in worlds] == [True, False, False, False]


@kernel
def _round(square: Any, place: Any, tags: Any) -> Any:
    """Return the key of a square and a place, its value after writing and reading it, and the place read from it."""
    key = key_of(square, place, tags)
    return key, float_as_key(key_as_float(key)), tag_of(key, tags)


def test_keys_are_ordered_like_squares_and_contain_their_places() -> None:
    call = njit(lambda square, place, tags: _round(square, np.int32(place), np.int32(tags)))
    doubt = njit(lambda one, other, tags: same_key(np.uint32(one), np.uint32(other), np.int32(tags)))
    order = njit(lambda one, other: order_keys(np.uint32(one), np.uint32(other)))
    rng = np.random.default_rng(0)
    squares = np.sort(np.concatenate([[0, 1e-45, 1e-38, 3e38, np.inf], 10.0 ** rng.uniform(-30, 30, 400)])).astype("f4")
    for tags in (1, 7, 31, 127):
        places = rng.integers(0, tags + 1, len(squares))
        keys = np.array([call(s, p, tags) for s, p in zip(squares, places, strict=True)])
        np.testing.assert_array_equal(keys[:, 0], keys[:, 1])
        np.testing.assert_array_equal(keys[:, 2], places)
        same = np.array([doubt(*pair, tags) for pair in zip(keys[:-1, 0], keys[1:, 0], strict=True)])
        apart = squares.view("i4")[1:] // (tags + 1) != squares.view("i4")[:-1] // (tags + 1)
        np.testing.assert_array_equal(same, ~apart)
        assert (np.diff(keys[:, 0].astype(int))[apart] > 0).all()
        for pair in zip(keys[:-1, 0], keys[1:, 0], strict=True):
            assert order(*pair) == order(*pair[::-1]) == tuple(sorted(pair))
    empty = 0xFFFFFFFF  # larger than all keys, also than those of NaN of either sign
    for number in (np.inf, np.nan, -np.nan):
        key = call(np.float32(number), 0, 1)[0]
        assert call(np.float32(3e38), 1, 1)[0] < key and order(key, empty) == (key, empty)


@pytest.mark.parametrize("length", range(2, 34))
def test_exchanges_keep_the_least_numbers_of_a_list_sorted(length: int) -> None:
    rng = np.random.default_rng(length)
    for most in (3, 1000):
        kept, every = [most] * length, [most] * length
        for _ in range(40):
            come = rng.integers(0, most, AT_ONCE).tolist()
            row = kept + come
            for one, other in exchanges(length, AT_ONCE):
                row[one], row[other] = sorted((row[one], row[other]))
            kept, every = row[:length], sorted(every + come)
            assert kept == every[:length]


@pytest.mark.parametrize("length", [2, 7])
def test_keys_stored_as_float32_are_merged_into_lists_bit_for_bit(length: int) -> None:
    """Keys may then be NaN or denormal numbers."""
    call = njit(lambda numbers, come: merge(numbers, come))
    rng = np.random.default_rng(length)
    kept = np.full(length, 0xFFFFFFFF, np.uint32)
    every = kept.tolist()
    for _ in range(40):
        come = rng.choice([0, 1, 2**20, 0x7F800000, 0x7FC00000, 0xFF800001, *rng.integers(0, 2**32, 9)], AT_ONCE)
        kept = np.array(call(tuple(kept.view("f4")), tuple(come.astype(np.uint32))), "f4").view(np.uint32)
        every = sorted([*every, *come.tolist()])
        assert kept.tolist() == every[:length]


@pytest.mark.parametrize("kind", ["float32", "float64"])
def test_distances_are_inserted_into_a_list_with_their_places(kind: str) -> None:
    """NaN and infinity stay out of a list; each of several equal distances is in it once."""
    call, real = njit(lambda numbers, far, place: insert(numbers, far, place)), np.dtype(kind).type
    rng, length = np.random.default_rng(3), 5
    kept: tuple[Any, ...] = tuple([real(np.inf)] * length + [real(0)] * length)
    every: dict[int, Any] = {}
    for place in range(60):
        far = real(rng.choice([np.nan, np.inf, *rng.integers(0, 30, 6)]))
        kept = call(kept, far, real(place))
        if far < np.inf:
            every[place] = far
        many = min(len(every), length)
        assert list(kept[:length]) == sorted(every.values())[:length] + [np.inf] * (length - many)
        assert [every[int(one)] for one in kept[length : length + many]] == list(kept[:many])
        assert len(set(kept[length : length + many])) == many
