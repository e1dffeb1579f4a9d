"""Networks: which particles are tied, rest lengths, pins and masses."""

from __future__ import annotations

import math
import pickle
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import TypeAdapter

from flockenv.model.finite_elements import contents
from flockenv.model.networks import BEND, EDGE, SHEAR, AnyNetwork, Blocks, Cloth, Jelly, Mesh, Move, Network, Rope
from flockenv.model.spawn import Spawn
from flockenv.physics.effects import Drag, Springs
from flockenv.physics.integrators import INTEGRATORS, Integrator, SemiImplicitEuler
from flockenv.scene import Group, Scene

Floats = NDArray[np.float64]

TURNED = ((0.6, 0.8, 0.0), (-0.8, 0.6, 0.0), (0.0, 0.0, 2.0))  # right-handed edges, not along the axes
SQUARE = ((0, 0), (1, 0), (1, 1), (0, 1))
BOOK = ((0, 1, 2), (0, 2, 3), (0, 2, 4))

NETWORKS: list[tuple[Network, int]] = [
    (Rope(links=5, length=2), 2),
    (Rope(links=5, length=2, bend=True, stretch=1.5), 3),
    (Rope(links=1, start=(1, 2), end=(4, 6)), 2),
    (Rope(links=6, start=(0, 0, 1), end=(1, 0, 1), length=2), 3),
    (Rope(links=3, length=1, pinned=("start",), moves=(Move(particles=("end", 2), velocity=(1, 2)),)), 2),
    (Cloth(cells=(4, 3), sides=(2, 1)), 2),
    (Cloth(cells=(4, 3), sides=(2, 1), stretch=0.5, diagonals="parallel"), 3),
    (Cloth(cells=(1, 1), origin=(1, 2, 3), edges=TURNED[1:]), 3),
    (Cloth(cells=(2, 5), edges=((0, 1), (1, 1)), shear=False, bend=False), 2),
    (Jelly(cells=(3, 2), sides=(1, 1)), 2),
    (Jelly(cells=(2, 2), edges=((0, 1), (1, 0)), diagonals="parallel"), 2),
    (Jelly(cells=(3, 2, 4), sides=(1, 2, 3)), 3),
    (Jelly(cells=(2, 3, 1), edges=TURNED[::-1], diagonals="parallel"), 3),
    (Mesh(vertices=SQUARE, triangles=((0, 1, 2), (0, 3, 2))), 2),
    (Mesh(vertices=SQUARE, bars=((1, 0), (1, 2), (0, 3)), angles=((0, 1, 2),)), 2),
    (Mesh(vertices=((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)), tetrahedra=((0, 2, 1, 3),), stretch=2), 3),
    (Mesh(vertices=SQUARE), 2),
]


def move(particle: int | str, *more: float) -> Move:
    """Return a move of one particle at 1 m/s."""
    return Move(particles=(particle,), velocity=(1.0, 0.0, *more))


EVERY = pytest.mark.parametrize(("network", "dimension"), NETWORKS, ids=lambda value: getattr(value, "kind", value))


# --- every network ----------------------------------------------------------------------------------------------------


@EVERY
def test_springs_are_unique_sorted_and_as_long_as_the_distance_of_their_ends(network: Network, dimension: int) -> None:
    i, j, rest, role = springs = network.springs(dimension)
    assert [array.dtype for array in springs] == [np.int32, np.int32, np.float64, np.int8]
    assert (i < j).all()
    assert (i >= 0).all() and (j < network.size).all()
    assert (np.diff(i.astype(np.int64) * network.size + j) > 0).all()
    points = network.rest_points(dimension)
    np.testing.assert_allclose(rest, np.linalg.norm(points[j] - points[i], axis=1), rtol=1e-14)
    assert set(role.tolist()) <= {EDGE, SHEAR, BEND}


@EVERY
def test_there_is_one_point_per_particle_and_springs_are_stretched_as_given(network: Network, dimension: int) -> None:
    points, rest = network.points(dimension), network.rest_points(dimension)
    assert points.shape == rest.shape == (network.size, dimension)
    assert points.dtype == np.float64
    i, j, length, _ = network.springs(dimension)
    if not (isinstance(network, Rope) and network.end and network.length):  # a slack rope is not stretched
        ratio = np.linalg.norm(points[j] - points[i], axis=1) / length
        np.testing.assert_allclose(ratio, network.stretch, rtol=1e-14)


@EVERY
def test_elements_and_hinges_join_different_particles(network: Network, dimension: int) -> None:
    for rows in (network.elements(dimension), network.hinges(dimension)):
        assert rows.dtype == np.int32
        assert ((rows >= 0) & (rows < network.size)).all()
        assert all(len(set(row)) == len(row) for row in rows.tolist())
    elements = network.elements(dimension)
    if elements.shape[1] == dimension + 1:
        assert (volumes(network.rest_points(dimension), elements) > 0).all()


@EVERY
@pytest.mark.parametrize("lumping", ["equal", "geometric"])
def test_masses_add_up_to_the_total(network: Network, dimension: int, lumping: str) -> None:
    if network == NETWORKS[-1][0]:  # no springs
        return
    masses = network.model_copy(update={"lumping": lumping}).masses(7.0, dimension)
    assert masses.shape == (network.size,)
    assert (masses > 0).all()
    assert masses.sum() == pytest.approx(7, rel=1e-14)


@EVERY
def test_a_network_equals_its_copy_from_json_pickle_and_repr(network: Network, dimension: int) -> None:
    again: Any = TypeAdapter(AnyNetwork).validate_json(network.model_dump_json())
    assert again == network == pickle.loads(pickle.dumps(network)) == eval(repr(network))  # noqa: S307  # our own text
    assert hash(again) == hash(network)


def volumes(points: Floats, elements: NDArray[Any]) -> Floats:
    """Return areas of triangles or volumes of tetrahedra, negative if they are inverted."""
    corners = points[elements]
    factor = {3: 2, 4: 6}[elements.shape[1]]
    return np.asarray(np.linalg.det(corners[:, 1:] - corners[:, :1]) / factor)


# --- ropes ------------------------------------------------------------------------------------------------------------


def test_a_rope_lies_in_its_direction_or_between_its_ends() -> None:
    lying = Rope(links=4, start=(1, 1), direction=(0, 3), length=2)
    np.testing.assert_allclose(lying.points(2), [(1, 1), (1, 1.5), (1, 2), (1, 2.5), (1, 3)])
    taut = Rope(links=2, start=(0, 0), end=(6, 8), length=5)
    np.testing.assert_array_equal(taut.points(2), [(0, 0), (3, 4), (6, 8)])
    far = Rope(links=3, start=(0.1, 0.1), end=(0.7, -0.3))
    np.testing.assert_array_equal(far.points(2)[[0, -1]], [(0.1, 0.1), (0.7, -0.3)])  # exactly
    np.testing.assert_allclose(taut.springs(2).rest, 2.5)
    np.testing.assert_allclose(Rope(links=2, length=1, stretch=1.5).points(3)[-1], (1.5, 0, 0))
    np.testing.assert_allclose(Rope(links=2, end=(3, 0), stretch=1.5).springs(2).rest, 1)
    assert Rope(links=2, length=1).dimension is None
    assert lying.dimension == 2


@pytest.mark.parametrize("links", [2, 3, 10, 101])
@pytest.mark.parametrize("distance", [0.0, 0.3, 1.0, 1.999999])
def test_the_links_of_a_slack_rope_have_their_rest_length(links: int, distance: float) -> None:
    rope = Rope(links=links, start=(1, 1, 5), end=(1 + distance, 1, 5), length=2)
    points = rope.points(3)
    np.testing.assert_array_equal(points[[0, -1]], [(1, 1, 5), (1 + distance, 1, 5)])
    np.testing.assert_allclose(np.linalg.norm(np.diff(points, axis=0), axis=1), 2 / links, rtol=1e-7)
    assert (points[1:-1, 2] < 5).all()
    np.testing.assert_allclose(points[:, 1], 1)


def test_a_slack_rope_sags_in_the_given_direction_unless_it_is_along_the_rope() -> None:
    aside = Rope(links=4, start=(0, 0), end=(1, 0), length=2, sag=(5, 1)).points(2)
    assert (aside[1:-1, 1] > 0).all()
    along = Rope(links=4, start=(0, 0), end=(0, -1), length=2).points(2)
    np.testing.assert_allclose(np.linalg.norm(np.diff(along, axis=0), axis=1), 0.5)
    single = Rope(links=1, start=(0, 0), end=(1, 0), length=2)
    np.testing.assert_array_equal(single.points(2), [(0, 0), (1, 0)])
    np.testing.assert_array_equal(single.springs(2).rest, [2])


def test_a_rope_has_a_hinge_at_every_inner_particle() -> None:
    rope = Rope(links=4, length=1, bend=True)
    np.testing.assert_array_equal(rope.hinges(2), [(0, 1, 2), (1, 2, 3), (2, 3, 4)])
    np.testing.assert_array_equal(rope.elements(2), [(0, 1), (1, 2), (2, 3), (3, 4)])
    springs = rope.springs(2)
    assert list(zip(springs.i, springs.j, springs.role, strict=True)) == [
        (0, 1, EDGE), (0, 2, BEND), (1, 2, EDGE), (1, 3, BEND), (2, 3, EDGE), (2, 4, BEND), (3, 4, EDGE)
    ]  # fmt: skip
    assert len(Rope(links=1, length=1, bend=True).springs(2).i) == 1
    np.testing.assert_allclose(Rope(links=4, length=1, lumping="geometric").masses(8, 2), [1, 2, 2, 2, 1])


# --- cloths and jellies -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cells", [(1, 1), (1, 4), (7, 3)])
def test_a_cloth_has_the_expected_number_of_springs(cells: tuple[int, int]) -> None:
    a, b = cells
    cloth = Cloth(cells=cells, sides=(1, 1))
    role = cloth.springs(3).role
    assert cloth.size == (a + 1) * (b + 1)
    assert (role == EDGE).sum() == a * (b + 1) + b * (a + 1)
    assert (role == SHEAR).sum() == 2 * a * b
    assert (role == BEND).sum() == (a - 1) * (b + 1) + (b - 1) * (a + 1) == len(cloth.hinges(3))
    assert len(cloth.elements(3)) == 2 * a * b
    assert contents(cloth.points(3), cloth.elements(3)).sum() == pytest.approx(1)
    none = cloth.model_copy(update={"shear": False, "bend": False})
    assert len(none.springs(3).i) == (role == EDGE).sum()


@pytest.mark.parametrize(
    ("shear", "bend", "printed"), [(False, False, "3.93"), (True, False, "7.80"), (True, True, "9.75")]
)
def test_the_highest_frequency_of_a_cloth_is_that_of_the_table(shear: bool, bend: bool, printed: str) -> None:
    """omega^2 m / k of 12 x 12 particles of mass m with springs of stiffness k."""
    cloth = Cloth(cells=(11, 11), sides=(11, 11), shear=shear, bend=bend)
    points, (i, j, _, _) = cloth.points(2), cloth.springs(2)
    direction = points[j] - points[i]
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    K = np.zeros((cloth.size, 2, cloth.size, 2))
    for a, b, d in zip(i, j, direction, strict=True):
        block = np.outer(d, d)
        K[a, :, a] += block
        K[b, :, b] += block
        K[a, :, b] -= block
        K[b, :, a] -= block
    assert f"{np.linalg.eigvalsh(K.reshape(2 * cloth.size, -1))[-1]:.2f}" == printed


def test_hinges_of_a_cloth_lie_along_both_edges() -> None:
    cloth = Cloth(cells=(2, 1), sides=(2, 1))
    np.testing.assert_array_equal(cloth.hinges(2), [(0, 1, 2), (3, 4, 5)])
    np.testing.assert_array_equal(Cloth(cells=(1, 2), sides=(1, 2)).hinges(2), [(0, 2, 4), (1, 3, 5)])
    for end, apex, other in Cloth(cells=(4, 3), sides=(4, 3)).hinges(2):
        points = Cloth(cells=(4, 3), sides=(4, 3)).points(2)
        np.testing.assert_allclose(points[apex] * 2, points[end] + points[other])


@pytest.mark.parametrize("diagonals", ["alternating", "parallel"])
@pytest.mark.parametrize("edges", [TURNED, TURNED[::-1], ((1, 0, 0), (1, 1, 0), (0, 1, 1))])
@pytest.mark.parametrize("cells", [(1, 1, 1), (2, 3, 4), (3, 1, 2)])
def test_tetrahedra_fill_a_jelly_and_share_whole_faces(
    cells: tuple[int, int, int], edges: tuple[Any, ...], diagonals: Any
) -> None:
    jelly = Jelly(cells=cells, edges=edges, diagonals=diagonals)
    points, elements = jelly.points(3), jelly.elements(3)
    content = volumes(points, elements)
    assert (content > 0).all()
    assert content.sum() == pytest.approx(abs(np.linalg.det(edges)), rel=1e-13)
    assert len(elements) == np.prod(cells) * (5 if diagonals == "alternating" else 6)
    faces = np.sort(elements[:, [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)]].reshape(-1, 3), axis=1)
    times = np.unique(faces, axis=0, return_counts=True)[1]
    assert times.max() <= 2
    a, b, c = cells
    assert (times == 1).sum() == 4 * (a * b + b * c + c * a)  # the surface: two triangles per square
    assert len(jelly.hinges(3)) == 0


@pytest.mark.parametrize("diagonals", ["alternating", "parallel"])
@pytest.mark.parametrize("edges", [((2, 0), (0, 1)), ((0, 1), (2, 0)), ((1, 1), (-1, 2))])
def test_triangles_fill_a_jelly_in_two_dimensions(edges: tuple[Any, ...], diagonals: Any) -> None:
    jelly = Jelly(cells=(3, 4), edges=edges, diagonals=diagonals)
    content = volumes(jelly.points(2), jelly.elements(2))
    assert (content > 0).all()
    assert content.sum() == pytest.approx(abs(np.linalg.det(edges)), rel=1e-13)
    role = jelly.springs(2).role
    assert (role == EDGE).sum() == 3 * 5 + 4 * 4
    assert (role == SHEAR).sum() == 3 * 4


@pytest.mark.parametrize(("diagonals", "across"), [("alternating", 0), ("parallel", 1)])
def test_springs_of_a_jelly_are_the_edges_of_its_tetrahedra(diagonals: Any, across: int) -> None:
    jelly = Jelly(cells=(2, 3, 4), sides=(2, 3, 4), diagonals=diagonals)
    rest, role = jelly.springs(3)[2:]
    np.testing.assert_allclose(rest[role == EDGE], 1)
    assert (role == EDGE).sum() == 2 * 4 * 5 + 3 * 3 * 5 + 4 * 3 * 4
    faces = 2 * 3 * 5 + 3 * 4 * 3 + 2 * 4 * 4
    np.testing.assert_allclose(np.sort(rest[role == SHEAR]), [2**0.5] * faces + [3**0.5] * 24 * across)


def test_a_cloth_without_coordinates_fits_two_and_three_dimensions() -> None:
    cloth = Cloth(cells=(2, 1), sides=(4, 1))
    assert cloth.dimension is None
    np.testing.assert_allclose(cloth.points(2), [(0, 0), (2, 0), (4, 0), (0, 1), (2, 1), (4, 1)])
    np.testing.assert_allclose(cloth.points(3)[:, :2], cloth.points(2))
    assert not cloth.points(3)[:, 2].any()
    stretched = cloth.model_copy(update={"stretch": 2.0, "origin": (1, 1)})
    np.testing.assert_allclose(stretched.rest_points(2)[[0, -1]], [(1, 1), (3, 1.5)])


def test_geometric_masses_follow_the_area_around_a_particle() -> None:
    cloth = Cloth(cells=(2, 2), sides=(2, 2), lumping="geometric", diagonals="parallel")
    np.testing.assert_allclose(cloth.masses(24, 3), [2, 3, 1, 3, 6, 3, 1, 3, 2])  # number of triangles at each particle
    np.testing.assert_allclose(cloth.model_copy(update={"lumping": "equal"}).masses(9, 3), 1)


# --- pins -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("network", "pinned", "held"),
    [
        (Rope(links=4, length=1), ("start",), [0]),
        (Rope(links=4, length=1), ("ends", 2, "start"), [0, 2, 4]),
        (Rope(links=4, length=1), ("end", np.int64(4)), [4]),
        (Cloth(cells=(2, 3), sides=(1, 1)), ("left",), [0, 3, 6, 9]),
        (Cloth(cells=(2, 3), sides=(1, 1)), ("right",), [2, 5, 8, 11]),
        (Cloth(cells=(2, 3), sides=(1, 1)), ("top",), [9, 10, 11]),
        (Cloth(cells=(2, 3), sides=(1, 1)), ("corners",), [0, 2, 9, 11]),
        (Cloth(cells=(2, 3), sides=(1, 1)), ("top_left", "bottom_right"), [2, 9]),
        (Cloth(cells=(2, 3), sides=(1, 1)), ("border",), [0, 1, 2, 3, 5, 6, 8, 9, 10, 11]),
        (Cloth(cells=(2, 3), sides=(1, 1)), (), []),
        (Jelly(cells=(1, 2), sides=(1, 1)), ("bottom", "top_right"), [0, 1, 5]),
        (Jelly(cells=(1, 1, 1), sides=(1, 1, 1)), ("left",), [0, 2, 4, 6]),
        (Jelly(cells=(1, 1, 1), sides=(1, 1, 1)), ("front",), [0, 1, 4, 5]),
        (Jelly(cells=(1, 1, 1), sides=(1, 1, 1)), ("back",), [2, 3, 6, 7]),
        (Jelly(cells=(1, 1, 1), sides=(1, 1, 1)), ("top",), [4, 5, 6, 7]),
        (Jelly(cells=(2, 1, 1), sides=(1, 1, 1)), ("corners",), [0, 2, 3, 5, 6, 8, 9, 11]),
        (Mesh(vertices=SQUARE), (3, 1), [1, 3]),
    ],
)
def test_pins_are_given_by_place_or_number(network: Network, pinned: tuple[Any, ...], held: list[int]) -> None:
    pins = network.model_copy(update={"pinned": pinned}).pins()
    assert pins.dtype == np.int32
    assert pins.tolist() == held


def test_particles_that_move_are_held_at_their_velocity() -> None:
    """Whatever heading and speed the group begins with."""
    moves = (Move(particles=("right",), velocity=(0.5, 0.25)), Move(particles=(6, 7), velocity=(0, 1)))
    sheet = Cloth(cells=(2, 2), sides=(1, 1), pinned=("top_left", "bottom_left"), moves=moves[:1])
    assert sheet.pins().tolist() == [0, 2, 5, 6, 8]
    assert sheet.dimension == 2
    group = Group(network=sheet, spawn=Spawn(heading=(1, 0), speed=(3, 3)))
    vel = Scene(groups=(group,)).start(0).vel[0]
    np.testing.assert_array_equal(vel[[0, 6]], 0)
    np.testing.assert_array_equal(vel[[2, 5, 8]], [(0.5, 0.25)] * 3)
    np.testing.assert_array_equal(vel[[1, 3, 4, 7]], [(3.0, 0.0)] * 4)


@pytest.mark.parametrize(
    "method",
    [
        pytest.param(kind(), marks=() if kind is SemiImplicitEuler else pytest.mark.slow)
        for kind in INTEGRATORS.values()
    ],
    ids=lambda method: method.kind,
)
def test_a_moving_end_pulls_a_rope_and_keeps_its_velocity(method: Integrator) -> None:
    """The forces at the end of a rope at rest: one is pinned, one moves, and the spring between has their distance."""
    rope = Rope(links=2, length=2.0, pinned=("start",), moves=(Move(particles=("end",), velocity=(0.1, 0.02)),))
    effects = (Springs(stiffness=50.0, damping=2.0), Drag(rate=0.1))
    scene = Scene(groups=(Group(network=rope, mass=0.1),), effects=effects, integrator=method, dt=0.01)
    end = scene.run(scene.start(0), 500).pos[0]
    np.testing.assert_allclose(end[[0, 2]], [(0, 0), (2.5, 0.1)], atol=1e-12)
    np.testing.assert_allclose(end[1], (1.25, 0.05), atol=2e-3)


# --- meshes -----------------------------------------------------------------------------------------------------------


def test_a_mesh_keeps_the_rest_lengths_given_with_its_pairs() -> None:
    mesh = Mesh(vertices=SQUARE, pairs=((3, 2), (2, 0), (1, 0)), rest=(3.0, 2.0, 0.0))
    i, j, rest, _ = mesh.springs(2)
    assert list(zip(i.tolist(), j.tolist(), rest.tolist(), strict=True)) == [(0, 1, 0.0), (0, 2, 2.0), (2, 3, 3.0)]
    assert mesh.elements(2).shape == (0, 2)


def test_springs_of_a_mesh_are_the_edges_of_its_elements_unless_pairs_are_given() -> None:
    mesh = Mesh(vertices=SQUARE, triangles=((0, 1, 2), (0, 3, 2)))
    assert np.stack(mesh.springs(2)[:2], axis=1).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    assert len(mesh.model_copy(update={"pairs": ()}).springs(2).i) == 0
    assert mesh.model_copy(update={"pairs": ((2, 1),)}).springs(2).j.tolist() == [2]
    np.testing.assert_array_equal(mesh.elements(2), [(0, 1, 2), (3, 0, 2)])


CUBE = (
    (0, 3, 1), (0, 2, 3), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4), (2, 7, 3), (2, 6, 7), (0, 4, 6), (0, 6, 2),
    (1, 3, 7), (1, 7, 5),
)  # fmt: skip


@pytest.mark.parametrize(
    ("triangles", "count"),
    [
        (tuple(map(tuple, Cloth(cells=(3, 2), sides=(3, 2)).elements(3).tolist())), 11),
        (CUBE, 7),  # the other diagonals of its sides, and one through it
        (((0, 1, 2), (0, 2, 3), (0, 3, 1)), 0),  # each two opposite corners are joined by a side
    ],
)
def test_bending_springs_of_a_mesh_join_the_opposite_corners_of_edges(triangles: Any, count: int) -> None:
    size = 1 + max(map(max, triangles))
    vertices = tuple(map(tuple, np.random.default_rng(0).uniform(-1, 1, (size, 3)).tolist()))
    plain, mesh = (Mesh(vertices=vertices, triangles=triangles, bend=bend) for bend in (False, True))
    i, j, rest, role = mesh.springs(3)
    pairs = list(zip(i.tolist(), j.tolist(), strict=True))
    assert len(set(pairs)) == len(pairs) and (role == BEND).sum() == count
    edges = np.stack(plain.springs(3)[:2], axis=1)
    np.testing.assert_array_equal(np.stack([i, j], axis=1)[role == EDGE], edges)
    sides: dict[frozenset[int], set[int]] = {}
    for corners in triangles:
        for corner in corners:
            sides.setdefault(frozenset(corners) - {corner}, set()).add(corner)
    expected = {tuple(sorted(far)) for far in sides.values() if len(far) == 2} - set(map(tuple, edges.tolist()))
    assert {pair for pair, one in zip(pairs, role, strict=True) if one == BEND} == expected
    np.testing.assert_allclose(rest, np.linalg.norm(np.subtract(mesh.points(3)[i], mesh.points(3)[j]), axis=1))


def test_bending_springs_of_a_mesh_resist_folding_with_the_stiffness_bend() -> None:
    """Two triangles, folded by a right angle: the opposite corners, sqrt(2) apart at rest, are 1 m apart."""
    hinge = ((0, 0, 0), (1, 1, 0), (1, 0, 0), (0, 1, 0))
    scene = Scene(
        dimension=3, effects=(Springs(stiffness=0, bend=3.0),), dt=1e-3,
        groups=(Group(network=Mesh(vertices=hinge, triangles=((0, 2, 1), (0, 1, 3)), bend=True)),),
    )  # fmt: skip
    state = scene.start(0)
    pos = state.pos.copy()
    pos[0, 3] = (0.5, 0.5, 0.5**0.5)
    found = scene.effects[0].potential(scene.groups, state.with_motion(pos, state.vel), scene.space.displacement)
    assert found == pytest.approx([0.5 * 3.0 * (math.sqrt(2) - 1) ** 2])


def test_rest_lengths_given_with_pairs_do_not_change_those_of_bending() -> None:
    square = Mesh(
        vertices=SQUARE, triangles=((0, 1, 2), (0, 2, 3)), pairs=((2, 0), (1, 0)), rest=(3.0, 2.0), bend=True
    )  # fmt: skip
    i, j, rest, role = square.springs(2)
    across = float(np.linalg.norm(np.subtract(SQUARE[1], SQUARE[3])))
    rows = list(zip(i.tolist(), j.tolist(), rest.tolist(), role.tolist(), strict=True))
    assert rows == [(0, 1, 2.0, EDGE), (0, 2, 3.0, EDGE), (1, 3, across, BEND)]


# --- refusals ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("call", "line"), [
    (lambda: Rope(links=0, length=1), "Rope: links = 0: must be an integer >= 1"),
    (lambda: Rope(links=True, length=1), "links = True"),
    (lambda: Rope(links=2), "a rope needs an end or a length"),
    (lambda: Rope(links=2, end=(0, 0)), "it is the start, so the rope needs a length"),
    (lambda: Rope(links=2, end=(1, 0), direction=(1, 0)), "give one of them"),
    (lambda: Rope(links=2, end=(1, 0), length=2, stretch=2), "stretch = 2"),
    (lambda: Rope(links=2, length=1, direction=(0, 0)), "direction = (0.0, 0.0): it has no length"),
    (lambda: Rope(links=2, start=(0, 0), end=(1, 0, 0)), "3 coordinates, start = (0.0, 0.0) has 2"),
    (lambda: Rope(links=2, length=-1), "length = -1"),
    (lambda: Rope(links=2, start=(0, float("nan")), length=1), "start[1] = nan"),
    (lambda: Rope(links=10**7, length=1), "10,000,001 particles: at most 10,000,000"),
    (lambda: Rope(links=2, length=1, stretch=0), "stretch = 0"),
    (lambda: Rope(links=2, lenght=1), "did you mean `length`?"),
    (lambda: Rope(links=2, length=1, pinned=("strat",)), "did you mean `start`? allowed: start, end, ends or numbers"),
    (lambda: Rope(links=2, length=1, pinned=(3,)), "pinned[0] = 3: there is no such particle, they are 0 to 2"),
    (lambda: Rope(links=2, length=1, pinned=(-1,)), "pinned[0] = -1"),
    (lambda: Rope(links=2, length=1, pinned=(True,)), "pinned[0] = True"),
    (lambda: Rope(links=2, start=(0, 0), length=1).points(3), "rope: lies in 2 dimensions, not in 3"),
    (lambda: Rope(links=2, length=1).springs(4), "dimension = 4: must be 2 or 3"),
    (lambda: Rope(links=2, length=1).masses(0, 2), "total = 0"),
    (lambda: Rope(links=2, length=1).masses(float("nan"), 2), "total = nan"),
    (lambda: Rope(links=2, length=1, moves=(move("ned"),)), "moves[0].particles[0] = 'ned': unknown, did you mean"),
    (lambda: Rope(links=2, length=1, moves=(move("end"), move(2))), "moves[1].particles: particle 2 is held by"),
    (lambda: Rope(links=2, length=1, moves=(move(0),), pinned=("start",)), "particle 0 is held by pinned, too"),
    (lambda: Rope(links=2, length=1, moves=(move(0), move(1, 0.0))), "moves[1].velocity = (1.0, 0.0, 0.0) has 3"),
    (lambda: Rope(links=2, end=(1, 0, 0), moves=(move(0),)), "moves[0].velocity = (1.0, 0.0) has 2 coordinates, end"),
    (lambda: Group(network=Rope(links=2, length=1, moves=(move(0),)), max_speed=0.5), "1 m/s is more than the limit"),
    (lambda: Blocks(sides=(1, 1), centres=((0, 0),), moves=(move(0),)), "moves: blocks move as a whole"),
    (lambda: Cloth(cells=(0, 1), sides=(1, 1)), "cells[0] = 0"),
    (lambda: Cloth(cells=(2, 2)), "sides or edges: give one of them"),
    (lambda: Cloth(cells=(2, 2), sides=(1, 0)), "sides[1] = 0"),
    (lambda: Cloth(cells=(2, 2), sides=(1, 1, 1)), "cells = (2, 2) needs 2 of them"),
    (lambda: Cloth(cells=(2, 2), edges=((1, 0), (0, 0))), "edges[1] = (0.0, 0.0): it has no length"),
    (lambda: Cloth(cells=(2, 2), edges=((1, 0, 1), (-2, 0, -2))), "they are parallel"),
    (lambda: Cloth(cells=(2, 2), edges=((1, 0), (0, 1)), origin=(0, 0, 0)), "edges[0] = (1.0, 0.0) has 2 coordinates"),
    (lambda: Cloth(cells=(10**5, 10**5), sides=(1, 1)), "at most 10,000,000 are allowed"),
    (lambda: Cloth(cells=(10**30, 10**30), sides=(1, 1)), "at most 10,000,000 are allowed"),
    (lambda: Cloth(cells=(2, 2), sides=(1, 1), pinned=("topleft",)), "did you mean `top_left`?"),
    (lambda: Cloth(cells=(2, 2), sides=(1, 1), pinned=("front",)), "pinned[0] = 'front': unknown"),
    (lambda: Jelly(cells=(2, 2, 2), sides=(1, 1)), "needs 3 of them"),
    (lambda: Jelly(cells=(2, 2, 2), edges=((1, 0, 0), (0, 1, 0), (1, 1, 0))), "they are in one plane"),
    (lambda: Jelly(cells=(2, 2), edges=((1, 0, 0), (0, 1, 0))), "cells = (2, 2) lies in 2 dimensions"),
    (lambda: Jelly(cells=(2, 2, 2), sides=(1, 1, 1)).elements(2), "jelly: lies in 3 dimensions, not in 2"),
    (lambda: Jelly(cells=(2, 2, 2), sides=(1, 1, 1)).hinges(2), "jelly: lies in 3 dimensions, not in 2"),
    (lambda: Mesh(vertices=()), "vertices: must be a list of at least 1"),
    (lambda: Mesh(vertices=((0, 0), (1, 1, 1))), "vertices[1] = (1.0, 1.0, 1.0) has 3 coordinates"),
    (lambda: Mesh(vertices=SQUARE, pairs=((0, 1), (2, 2))), "pairs[1] = (2, 2): the same particle twice"),
    (lambda: Mesh(vertices=SQUARE, pairs=((0, 1), (2, 3), (1, 0))), "pairs[2] = (1, 0): the same as pairs[0]"),
    (lambda: Mesh(vertices=SQUARE, pairs=((0, 4),)), "pairs[0] = (0, 4): there is no such particle, they are 0 to 3"),
    (lambda: Mesh(vertices=SQUARE, pairs=((0, -1),)), "pairs[0][1] = -1: must be an integer >= 0"),
    (lambda: Mesh(vertices=SQUARE, pairs=((0, 10**30),)), "pairs[0][1] = 1"),
    (lambda: Mesh(vertices=SQUARE, pairs=((0, 1),), rest=(-1,)), "rest[0] = -1"),
    (lambda: Mesh(vertices=SQUARE, pairs=((0, 1),), rest=(1, 1)), "rest: 2 lengths for 1 pairs"),
    (lambda: Mesh(vertices=SQUARE, pairs=((0, 1),), rest=(1,), stretch=2), "stretch = 2"),
    (lambda: Mesh(vertices=SQUARE, triangles=((0, 1, 2), (2, 1, 0))), "triangles[1] = (2, 1, 0): the same as"),
    (lambda: Mesh(vertices=((0, 0), (1, 1), (3, 3)), triangles=((0, 1, 2),)), "triangles[0] = (0, 1, 2): it has no"),
    (lambda: Mesh(vertices=SQUARE, triangles=((0, 1, 2),), bars=((0, 1),)), "bars and triangles: elements are of one"),
    (lambda: Mesh(vertices=SQUARE, tetrahedra=((0, 1, 2, 3),)), "tetrahedra: vertices have 2 coordinates"),
    (lambda: Mesh(vertices=SQUARE, angles=((0, 1, 2), (0, 2, 1), (2, 1, 0))), "angles[2] = (2, 1, 0): the same as"),
    (lambda: Mesh(vertices=SQUARE, triangles=((0, 1, 2),), lumping="geometric"), "particle 3 is part of no element"),
    (lambda: Mesh(vertices=SQUARE, bars=((0, 1),), bend=True), "bend = True: needs triangles"),
    (lambda: Mesh(vertices=(*SQUARE, (3, 1)), triangles=BOOK, bend=True), "bend = True: the edge of particles 0 and 2"),
    (lambda: Mesh(vertices=SQUARE, pinned=("left",)), "pinned[0] = 'left': unknown; allowed: numbers 0 to 3"),
])  # fmt: skip
def test_an_invalid_network_is_refused_in_one_line(call: Any, line: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        call()
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_hinges_of_the_same_particles_may_differ_in_their_middle() -> None:
    assert len(Mesh(vertices=SQUARE, angles=((0, 1, 2), (0, 2, 1), (1, 0, 2))).hinges(2)) == 3
