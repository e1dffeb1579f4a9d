"""Domain measures in cases with known results."""

from __future__ import annotations

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flockenv.geometry.shapes import Circle
from flockenv.geometry.space import Box, Plane, Space, Torus
from flockenv.model.networks import Cloth, Jelly, Mesh, Network
from flockenv.model.spawn import Spawn
from flockenv.scene import Group, Scene
from flockenv.studies.measures import MEASURES, measure, nearest_distances, order, polarisation
from flockenv.studies.measures.bodies import nearest_of_others
from flockenv.studies.measures.proportions import touching_pairs
from flockenv.studies.trajectory import whole_steps


@pytest.mark.parametrize(
    ("vel", "expected"),
    [
        ([[1, 0], [3, 0], [0.1, 0]], 1.0),  # speeds do not matter
        ([[1, 0], [-2, 0]], 0.0),
        ([[1, 0], [0, 1]], math.sqrt(0.5)),
        ([[1, 0], [0, 0]], 1.0),  # an agent at rest has no heading
        ([[1, 0, 0], [0, 1, 0], [0, 0, 1]], 1 / math.sqrt(3)),
        ([[0, 0]], math.nan),
        (np.zeros((0, 2)), math.nan),
    ],
)
def test_polarisation_is_the_length_of_the_mean_heading(vel: list[list[float]], expected: float) -> None:
    assert polarisation(np.array(vel, float)) == pytest.approx(expected, nan_ok=True)


SPACES: list[Space] = [Torus(size=(10, 12)), Box(size=(10, 12)), Plane()]


@given(
    points=st.lists(st.tuples(st.floats(0, 9.99), st.floats(0, 11.99)), min_size=2, max_size=12),
    space=st.sampled_from(SPACES),
)
def test_nearest_distances_are_those_of_all_pairs(points: list[tuple[float, float]], space: Space) -> None:
    pos = np.array(points)
    distances = np.linalg.norm(space.displacement(pos[:, None], pos[None]), axis=-1)
    np.fill_diagonal(distances, np.inf)
    distance, nearest = nearest_distances(pos, space)
    assert distance == pytest.approx(distances.min(axis=1), abs=1e-12)
    assert (nearest != np.arange(len(pos))).all()
    assert distances[np.arange(len(pos)), nearest] == pytest.approx(distance, abs=1e-12)


def test_nearest_distances_found_in_pieces_are_the_same_and_each_piece_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pos, space, news = np.random.default_rng(0).uniform(0, 10, (100, 2)), Torus(size=(10, 12)), list[int]()
    whole = nearest_distances(pos, space)
    monkeypatch.setattr(order, "AT_A_TIME", 30)
    pieces = nearest_distances(pos, space, news.append)
    assert all((a == b).all() for a, b in zip(whole, pieces, strict=True))
    assert news == [0, 30, 60, 90]


def test_nearest_distances_around_the_corner_of_a_torus() -> None:
    pos = np.array([[0.5, 0.5], [9.5, 11.5], [5.0, 6.0], [10.0, -1e-17]])
    distance, nearest = nearest_distances(pos, Torus(size=(10, 12)))
    assert distance[0] == pytest.approx(math.sqrt(0.5))
    assert nearest[0] == 3  # at (10, -1e-17), which is the origin


@pytest.mark.parametrize("pos", [np.zeros((0, 2)), np.zeros((1, 2)), np.array([[0.0, 0.0], [1e200, 0.0]])])
def test_the_nearest_distance_is_infinite_without_a_neighbour(pos: np.ndarray) -> None:
    distance, nearest = nearest_distances(pos, Plane())
    assert np.isinf(distance).all()
    assert (nearest == np.arange(len(pos))).all()


def test_measures_of_agents_placed_by_hand() -> None:
    scene = Scene(
        groups=(Group(count=4, radius=0.5, spawn=Spawn(low=(0, 0), high=(1, 1))),),
        obstacles=(Circle(centre=(20, 0), radius=2),),
    )
    pos = [[[0, 0], [0.9, 0], [10, 0], [17.6, 0]]]  # two agents overlap; the last overlaps the obstacle by 0.1 m
    vel = [[[3, 4], [3, 4], [3, 4], [3, 4]]]
    found = measure(scene, scene.start(0).with_motion(pos, vel))
    assert found == pytest.approx(
        {
            "agents": 4, "speed": 5, "polarisation": 1, "nearest_neighbour": (0.9 + 0.9 + 7.6 + 7.6) / 4, "contacts": 3,
            "volume": math.nan, "smallest_element": math.nan,
        },
        nan_ok=True,
    )  # fmt: skip
    assert found.keys() == MEASURES.keys()


def test_particles_of_networks_have_no_polarisation_and_do_not_touch_within_a_network() -> None:
    """Nets of particles of radius .3 m, .2 m apart, beside two agents, and beside another net."""
    net = Group(network=Cloth(cells=(2, 2), sides=(0.4, 0.4), origin=(0, 0)), radius=0.3)
    loose = Group(count=2, radius=0.3, spawn=Spawn(low=(0, 0), high=(1, 1)))
    scene = Scene(groups=(net, loose))
    state = scene.start(0)
    state.pos[0, -2:] = [[-0.55, 0.0], [5.0, 5.0]]  # touches (0, 0) and (0, .2), but not (0, .4)
    state.vel[0, :-2], state.vel[0, -2:] = (1, 0), ((0, 1), (0, 3))
    found = measure(scene, state)
    assert (found["contacts"], found["polarisation"]) == (3, 1)
    pair = Scene(groups=(net, net))
    state = pair.start(0)
    state.pos[0, 9:, 0] += 0.95  # the right column of the first, and the left one of the second
    found = measure(pair, state)
    assert found["contacts"] == 6
    assert math.isnan(found["polarisation"])
    state.pos[0, 9:, 0] = np.nan
    assert measure(pair, state)["contacts"] == 0


TETRAHEDRON = Mesh(vertices=((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)), tetrahedra=((0, 1, 2, 3),))
JELLIES = [
    (Jelly(cells=(2, 1), sides=(2, 1), stretch=1.2, origin=(0, 0)), 4),
    (Jelly(cells=(2, 1, 1), sides=(2, 1, 1), stretch=1.2, origin=(0, 0, 0)), 10),
    (TETRAHEDRON.model_copy(update={"stretch": 1.2}), 1),
]


@pytest.mark.parametrize(("network", "elements"), JELLIES)
def test_the_volume_of_a_jelly_is_relative_to_rest_and_signed(network: Network, elements: int) -> None:
    """Behind a group of plain agents, on a torus, across its edge: stretched 1.2 times, pulled, and mirrored."""
    d = len(network.points(2 if elements == 4 else 3)[0])
    plain = Group(count=3, spawn=Spawn(low=(0,) * d, high=(1,) * d))
    scene = Scene(dimension=d, space=Torus(size=(20,) * d), groups=(plain, Group(network=network)))
    state = scene.start(0)
    assert scene.view.volumes(state)[0].shape == scene.view.volumes(state)[1].shape == (elements,)
    for pull, content in ((1.0, 1.2**d), (1.5, 1.5 * 1.2**d), (-1.0, -(1.2**d))):
        moved = scene.space.wrap(state.pos[:, 3:] * ([pull] + [1.0] * (d - 1)) - 0.5)
        pos = np.concatenate([state.pos[:, :3], moved], axis=1)
        found = measure(scene, state.with_motion(pos, state.vel))
        assert (found["volume"], found["smallest_element"]) == pytest.approx((content, content))


def test_the_smallest_element_is_inside_out_where_a_corner_is_pushed_through() -> None:
    """A square of two triangles, one corner of which is moved beyond the diagonal: areas 1/2 and -1/4 of 1/2 each."""
    square = Mesh(vertices=((0, 0), (1, 0), (1, 1), (0, 1)), triangles=((0, 1, 2), (0, 2, 3)))
    scene = Scene(groups=(Group(network=square),))
    state = scene.start(0)
    state.pos[0, 3] = (0.75, 0.25)  # its mirror image is at (.25, .75), half as far from the diagonal
    found = measure(scene, state)
    assert (found["volume"], found["smallest_element"]) == pytest.approx((0.25, -0.5))
    state.pos[0, 3] = np.inf
    assert not math.isfinite(measure(scene, state)["volume"])


def test_a_cloth_in_space_has_no_volume() -> None:
    scene = Scene(dimension=3, groups=(Group(network=Cloth(cells=(2, 2), sides=(1, 1))),))
    assert math.isnan(measure(scene, scene.start(0))["volume"])


def test_dead_agents_are_not_measured() -> None:
    scene = Scene(space=Torus(size=(9, 9)), groups=(Group(count=3),))
    state = scene.start(0).with_motion([[[1, 1], [1, 1.01], [5, 5]]], [[[1, 0], [-1, 0], [1, 0]]])
    state.alive[0, 1] = False
    found = measure(scene, state)
    assert (found["agents"], found["polarisation"], found["contacts"]) == (2, 1, 0)
    state.alive[:] = False
    assert math.isnan(measure(scene, state)["speed"])


@pytest.mark.parametrize(
    ("seconds", "dt", "steps"), [(0, 0.1, 0), (1, 0.1, 10), (0.3, 0.1, 3), (1e6, 0.02, 50_000_000)]
)
def test_whole_steps_divides_a_time_by_dt(seconds: float, dt: float, steps: int) -> None:
    assert whole_steps("t", seconds, dt) == steps


@pytest.mark.parametrize(
    ("seconds", "message"),
    [
        (1.0, "t = 1 s: must be a whole multiple of dt = 0.3 s, say 0.9 or 1.2"),
        (0.1, "t = 0.1 s: must be a whole multiple of dt = 0.3 s, say 0 or 0.3"),
        (-0.3, "t = -0.3: must be a finite number of seconds >= 0"),
        (math.inf, "t = inf: must be a finite number of seconds >= 0"),
        (math.nan, "t = nan: must be a finite number of seconds >= 0"),
    ],
)
def test_a_time_that_is_no_multiple_of_dt_is_refused_with_the_nearest_multiples(seconds: float, message: str) -> None:
    with pytest.raises(ValueError) as caught:  # noqa: PT011  # the whole text is compared
        whole_steps("t", seconds, 0.3)
    assert str(caught.value) == message


@pytest.mark.parametrize("space", [Plane(), Torus(size=(3, 3))], ids=lambda space: space.kind)
def test_neighbours_of_another_body_are_those_of_all_distances(space: Space) -> None:
    rng = np.random.default_rng(4)
    pos, radius = rng.uniform(0, 3, (60, 2)), rng.uniform(0.05, 0.6, 60)
    body = np.repeat([0, 20, 40], 20)
    body[40:] = np.arange(40, 60)  # two networks, and twenty agents
    far = np.linalg.norm(space.displacement(pos[:, None], pos[None]), axis=2)
    far[body[:, None] == body[None]] = np.inf
    found, which = nearest_of_others(pos, space, body)
    np.testing.assert_allclose(found, far.min(axis=1), rtol=1e-12)
    assert (which == far.argmin(axis=1)).all()
    pairs, apart = touching_pairs(pos, radius, space, body=body)
    wanted = np.argwhere(np.triu(far < radius[:, None] + radius))
    assert sorted(map(tuple, pairs.tolist())) == sorted(map(tuple, wanted.tolist())) and len(wanted) > 100
    np.testing.assert_allclose(apart, far[tuple(pairs.T)], rtol=1e-12)
    alone, itself = nearest_of_others(pos[:20], space, body[:20])
    assert np.isinf(alone).all() and (itself == np.arange(20)).all()


def test_a_large_ball_beside_a_fine_cloth_is_measured_without_pairs_of_the_cloth() -> None:
    """10,201 particles within the ball's radius: all pairs of them would take 1.9 GB."""
    cloth = Group(network=Cloth(cells=(100, 100), sides=(1, 1)), radius=0.005)
    ball = Group(count=1, radius=0.5, spawn=Spawn(low=(0.5, 0.5), high=(0.5, 0.5)))
    scene = Scene(groups=(cloth, ball))
    state = scene.start(0)
    tracemalloc.start()
    found = measure(scene, state)["contacts"]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    inside = np.linalg.norm(state.pos[0, :-1] - 0.5, axis=1) < 0.505
    assert found == inside.sum() + 1 and peak < 50e6
