"""Linear finite elements against exact solutions: bars, constant strain, beams, chains, rigid motions."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import sparse

from flockenv.model.finite_elements import (
    DENSE,
    Material,
    blocks,
    contents,
    freedoms,
    frequencies,
    mass,
    rayleigh,
    solve_static,
    stiffness,
)
from flockenv.model.networks import Cloth, Jelly, Mesh, Network, Rope

Floats = NDArray[np.float64]

STEEL = Material(young=2e11, poisson=0.3, density=7800, area=1e-4, thickness=0.01)
SOFT = Material(young=3.0, poisson=0.25, density=2.0, area=0.5, thickness=0.2)
ROPE = Rope(links=6, start=(1, 2), direction=(3, 4), length=2)
SHEET = Jelly(cells=(4, 3), edges=((2, 0.1), (0.3, 1)))
BLOCK = Jelly(cells=(2, 3, 2), edges=((1, 0.2, 0), (0, 1, 0.1), (0.3, 0, 2)))
TRUSS = Mesh(
    vertices=((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)), bars=((0, 1), (0, 2), (0, 3), (1, 2), (2, 3), (3, 1))
)
STRUCTURES = pytest.mark.parametrize(
    ("network", "dimension"), [(ROPE, 2), (SHEET, 2), (BLOCK, 3), (TRUSS, 3)], ids=["rope", "sheet", "block", "truss"]
)


def structure(network: Network, dimension: int, material: Material = SOFT) -> tuple[Floats, Any, Any]:
    """Return the points, K and lumped M of a network."""
    points, elements = network.rest_points(dimension), network.elements(dimension)
    return points, stiffness(points, elements, material), mass(points, elements, material)


def along(points: int, length: float) -> tuple[Floats, NDArray[Any]]:
    """Return a row of bars on a line: points (n, 1), elements (n - 1, 2)."""
    index = np.arange(points - 1)
    return np.linspace(0, length, points)[:, None], np.stack([index, index + 1], axis=1)


def jiggled(network: Network, dimension: int, inside: NDArray[Any]) -> Floats:
    """Return the points of a network, the inner ones moved a little, so that all elements differ."""
    points = network.points(dimension)
    points[inside] += np.random.default_rng(4).uniform(-0.05, 0.05, (len(inside), dimension))
    return points


# --- statics --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("links", [1, 2, 50])
def test_the_elongation_of_a_bar_in_tension_is_exact(links: int) -> None:
    """u(x) = F x / (E A), at every particle."""
    points, elements = along(links + 1, 3.0)
    force = np.zeros_like(points)
    force[-1] = 1000.0
    u = solve_static(stiffness(points, elements, STEEL), force, fixed=[0])
    np.testing.assert_allclose(u, 1000.0 * points / (2e11 * 1e-4), rtol=1e-11)
    assert u[-1, 0] == pytest.approx(1000.0 * 3.0 / (2e11 * 1e-4), rel=1e-12)


def test_a_bar_in_space_is_stiff_only_along_itself() -> None:
    points = np.array([(0.0, 0.0, 0.0), (1.0, 2.0, 2.0)])
    K = stiffness(points, [(0, 1)], SOFT).toarray()
    unit = np.array([1, 2, 2]) / 3
    np.testing.assert_allclose(K[:3, :3], SOFT.young * SOFT.area / 3 * np.outer(unit, unit), rtol=1e-14)
    np.testing.assert_allclose(K[:3, 3:], -K[:3, :3])


def test_the_stiffness_of_one_triangle_is_the_textbook_matrix() -> None:
    """K = t A B' D B, plane stress, with strain (xx, yy, 2 xy)."""
    points = np.array([(0.0, 0.0), (2.0, 0.5), (0.5, 1.5)])
    (x0, y0), (x1, y1), (x2, y2) = points
    area = ((x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)) / 2
    b, c = [y1 - y2, y2 - y0, y0 - y1], [x2 - x1, x0 - x2, x1 - x0]
    B = np.zeros((3, 6))
    B[0, ::2], B[1, 1::2], B[2, ::2], B[2, 1::2] = b, c, c, b
    B /= 2 * area
    v = SOFT.poisson
    D = SOFT.young / (1 - v**2) * np.array([(1, v, 0), (v, 1, 0), (0, 0, (1 - v) / 2)])
    for order in ([0, 1, 2], [2, 1, 0]):  # both orientations
        K = stiffness(points, [order], SOFT).toarray()
        np.testing.assert_allclose(K, SOFT.thickness * area * B.T @ D @ B, atol=1e-14)


@pytest.mark.parametrize("diagonals", ["alternating", "parallel"])
@pytest.mark.parametrize("cells", [(5, 4), (3, 3, 4)])
def test_constant_strain_is_reproduced_on_any_mesh(cells: tuple[int, ...], diagonals: Any) -> None:
    """The patch test: with u = A x + c on the border, inner particles follow, and no force acts on them."""
    dimension = len(cells)
    jelly = Jelly(cells=cells, sides=(1,) * dimension, diagonals=diagonals, pinned=("border",))
    border = jelly.pins()
    inside = np.setdiff1d(np.arange(jelly.size), border)
    points = jiggled(jelly, dimension, inside)
    K = stiffness(points, jelly.elements(dimension), SOFT)
    A = np.random.default_rng(1).normal(size=(dimension, dimension))
    exact = points @ A.T + 0.3
    held = freedoms(border, dimension)
    known = np.zeros(exact.size)
    known[held] = exact.ravel()[held]
    force = -(K @ known).reshape(exact.shape)
    found = solve_static(K, force, held).ravel() + known
    np.testing.assert_allclose(found.reshape(exact.shape), exact, atol=1e-12)
    np.testing.assert_allclose((K @ exact.ravel()).reshape(exact.shape)[inside], 0, atol=1e-12)


def test_a_block_in_tension_contracts_by_poissons_ratio() -> None:
    """Uniaxial stress s = F / A: strain s / E along, -v s / E across, in the plane and in space."""
    for cells in ((3, 2), (3, 2, 2)):
        d = len(cells)
        jelly = Jelly(cells=cells, sides=(3.0, 1.0, 1.0)[:d])
        points = jelly.points(d)
        solid = SOFT.model_copy(update={"thickness": 1.0})
        K = stiffness(points, jelly.elements(d), solid)
        strain = np.array([0.01, *[-solid.poisson * 0.01] * (d - 1)])
        pull = (K @ (points * strain).ravel()).reshape(points.shape)
        end = points[:, 0] == 3
        np.testing.assert_allclose(pull[end].sum(axis=0), [0.01 * solid.young, *[0] * (d - 1)], atol=1e-14)
        np.testing.assert_allclose(pull[~end & (points[:, 0] > 0)], 0, atol=1e-14)


def deflection(refined: int) -> float:
    """Return the deflection, m, of a cantilever of 10 m by 1 m under 1 N at its tip (E = 1000 Pa, v = 0)."""
    beam = Jelly(cells=(10 * refined, 2 * refined), sides=(10, 1), pinned=("left",))
    points, elements = beam.points(2), beam.elements(2)
    tip = np.flatnonzero(points[:, 0] > 9.999)
    y = points[tip, 1]
    share = np.where((y == 0) | (y == 1), 0.5, 1.0)
    share *= 6 * y * (1 - y) + 1e-12  # shear stress of a beam: a parabola
    force = np.zeros_like(points)
    force[tip, 1] = -share / share.sum()
    K = stiffness(points, elements, Material(young=1000, poisson=0))
    return -float(solve_static(K, force, freedoms(beam.pins(), 2))[tip, 1].mean())


def test_a_cantilever_converges_to_beam_theory_at_second_order() -> None:
    """Timoshenko: F L^3 / (3 E I) + F L / (5/6 G A); linear triangles are too stiff by an error of order h^2."""
    beam = 10**3 / (3 * 1000 / 12) + 10 / (5 / 6 * 500)
    error = np.array([1 - deflection(refined) / beam for refined in (4, 8, 16)])
    assert (error > 0).all()
    assert error[-1] < 0.01
    rates = np.log2(error[:-1] / error[1:])
    assert ((rates > 1.8) & (rates < 2.1)).all(), rates


@STRUCTURES
def test_a_structure_that_can_move_is_refused(network: Network, dimension: int) -> None:
    points, K, _ = structure(network, dimension)
    force = np.ones_like(points)
    for fixed in ([], [0], freedoms([0], dimension)):
        with pytest.raises(
            ValueError, match=r"^the structure can move without resistance, particle \d+ along [xyz] most"
        ):
            solve_static(K, force, fixed)


def test_a_mechanism_is_refused_and_its_particle_named() -> None:
    square = Mesh(vertices=((0, 0), (1, 0), (1, 1), (0, 1)), bars=((0, 1), (1, 2), (2, 3), (3, 0)))
    points, K, _ = structure(square, 2)
    with pytest.raises(ValueError, match=r"particle [23] along x"):
        solve_static(K, np.ones_like(points), freedoms([0, 1], 2))
    straight = Rope(links=2, length=2)
    points, K, _ = structure(straight, 2)
    with pytest.raises(ValueError, match="particle 1 along y"):
        solve_static(K, np.ones_like(points), freedoms([0, 2], 2))


def test_stiffness_from_rounding_errors_does_not_hold_a_particle() -> None:
    points = np.array([(0.0, 0.0), (1e-15, 1.0), (0.0, 2.0)])
    K = stiffness(points, [(0, 1), (1, 2)], SOFT)
    assert K[2, 2] > 0
    with pytest.raises(ValueError, match="particle 1 along x"):
        solve_static(K, np.ones_like(points), freedoms([0, 2], 2))


def test_very_different_stiffnesses_are_not_taken_for_a_mechanism() -> None:
    points, elements = along(3, 2.0)
    stiff, soft = (stiffness(points, [row], SOFT.model_copy(update={"area": area}))
                   for row, area in zip(elements, (1e9, 1e-9), strict=True))  # fmt: skip
    u = solve_static(stiff + soft, np.array([[0.0], [0.0], [3e-9]]), [0])
    assert u[2, 0] == pytest.approx(1.0)


def test_a_structure_with_all_freedoms_fixed_does_not_move() -> None:
    points, K, M = structure(SHEET, 2)
    everything = freedoms(np.arange(SHEET.size), 2)
    assert not solve_static(K, np.ones_like(points), everything).any()
    assert frequencies(K, M, everything).shape == (0,)


# --- matrices -------------------------------------------------------------------------------------------------------


@STRUCTURES
def test_rigid_motions_need_no_force(network: Network, dimension: int) -> None:
    points, K, _ = structure(network, dimension)
    scale = abs(K).max()
    for axis in np.eye(dimension):
        np.testing.assert_allclose(K @ np.tile(axis, len(points)), 0, atol=1e-14 * scale)
    for a, b in [(0, 1), (1, 2), (2, 0)][: 1 if dimension == 2 else 3]:
        turn = np.zeros_like(points)
        turn[:, a], turn[:, b] = -points[:, b], points[:, a]
        np.testing.assert_allclose(K @ turn.ravel(), 0, atol=1e-13 * scale)


@STRUCTURES
def test_stiffness_is_symmetric_and_positive_semidefinite(network: Network, dimension: int) -> None:
    _, K, _ = structure(network, dimension)
    assert K.format == "csr"
    dense = K.toarray()
    np.testing.assert_allclose(dense, dense.T, atol=1e-15 * np.abs(dense).max())
    values = np.linalg.eigvalsh(dense)
    assert values[0] > -1e-14 * values[-1]
    still = int((values < 1e-12 * values[-1]).sum())
    assert still == len(dense) - ROPE.links if network is ROPE else still == dimension * (dimension + 1) // 2


@STRUCTURES
def test_blocks_of_partners_give_the_force(network: Network, dimension: int) -> None:
    """F_i = -sum_j K_ij ((x_j - x_i) - (X_j - X_i)) is -K u: rows of K sum to zero."""
    X, K, _ = structure(network, dimension)
    start, partner, block, offset = blocks(K, X)
    u = np.random.default_rng(2).normal(size=X.shape)
    x = X + u
    force = np.zeros_like(X)
    for i in range(len(X)):
        for e in range(start[i], start[i + 1]):
            force[i] -= block[e] @ ((x[partner[e]] - x[i]) - offset[e])
    np.testing.assert_allclose(force.ravel(), -(K @ u.ravel()), atol=1e-13 * abs(K).max())
    assert start.shape == (len(X) + 1,) and start[-1] == len(partner) == len(block) == len(offset)
    index = np.repeat(np.arange(len(X)), np.diff(start))
    assert (index != partner).all()
    springs = network.springs(dimension)
    expected = {*zip(springs.i, springs.j, strict=True), *zip(springs.j, springs.i, strict=True)}
    assert {*zip(index, partner, strict=True)} <= expected  # a diagonal of a right-angled cell may have no stiffness
    assert all((np.diff(partner[a:b]) > 0).all() for a, b in itertools.pairwise(start))


@STRUCTURES
@pytest.mark.parametrize("lumped", [True, False])
def test_masses_add_up_to_density_times_volume(network: Network, dimension: int, lumped: bool) -> None:
    points, elements = network.rest_points(dimension), network.elements(dimension)
    M = mass(points, elements, SOFT, lumped)
    k = elements.shape[1]
    expected = contents(points, elements).sum() * 2.0 * {2: 0.5, 3: 0.2, 4: 1.0}[k]
    for axis in np.eye(dimension):
        moved = np.tile(axis, len(points))
        assert moved @ (M @ moved) == pytest.approx(expected, rel=1e-13)
    assert np.linalg.eigvalsh(M.toarray())[0] > 0
    assert (M.nnz == M.shape[0]) == lumped


def test_the_consistent_mass_of_a_bar_is_the_textbook_matrix() -> None:
    M = mass([[0.0], [3.0]], [(0, 1)], SOFT, lumped=False).toarray()
    np.testing.assert_allclose(M, 2 * 0.5 * 3 / 6 * np.array([(2, 1), (1, 2)]))


def test_rayleigh_damping_gives_each_mode_its_damping_ratio() -> None:
    _, K, M = structure(SHEET, 2)
    w = frequencies(K, M)[3:]
    ratio = 0.4 / (2 * w) + 0.02 * w / 2
    damped = np.linalg.eigvalsh(scaled(rayleigh(M, K, 0.4, 0.02), M))
    np.testing.assert_allclose(damped[:3], 0.4, rtol=1e-9)  # rigid motions are damped by alpha only
    np.testing.assert_allclose(damped[3:], 2 * ratio * w, rtol=1e-9)


def scaled(A: Any, M: Any) -> Floats:
    """Return M^-1/2 A M^-1/2 for a diagonal M."""
    root = np.sqrt(M.diagonal())
    return np.asarray(A.toarray() / root / root[:, None])


# --- frequencies ----------------------------------------------------------------------------------------------------


def chain(free: int) -> Floats:
    """Return sin((2 k - 1) pi / (2 (2 N + 1))), for N equal masses in a row, the first tied to a wall."""
    k = np.arange(1, free + 1)
    return np.asarray(np.sin((2 * k - 1) * np.pi / (2 * (2 * free + 1))))


def test_frequencies_of_a_rope_are_those_of_a_chain_of_masses() -> None:
    """N = 20, k = 400, m = 0.1; fixed-free, fixed-fixed and free-free."""
    rope = Rope(links=20, length=2, pinned=("start",))
    K = stiffness(rope.points(2), rope.elements(2), Material(young=400 * 0.1, area=1))
    M = sparse.diags_array(np.repeat(rope.masses(2.1, 2), 2))
    across = np.arange(1, 42, 2)
    found = frequencies(K, M, [0, *across])
    np.testing.assert_allclose(found, 2 * np.sqrt(400 / 0.1) * chain(20), rtol=1e-12)
    np.testing.assert_allclose(found**2, np.linalg.eigvalsh(K.toarray()[2::2, 2::2] / 0.1), rtol=1e-10)
    free = frequencies(K, M, across)
    np.testing.assert_allclose(free, 2 * np.sqrt(400 / 0.1) * np.sin(np.arange(21) * np.pi / 42), atol=1e-9)
    assert free[0] == 0
    fixed = Rope(links=21, length=2.1)
    K = stiffness(fixed.points(3), fixed.elements(3), Material(young=400 * 0.1, area=1))
    M = sparse.diags_array(np.full(66, 0.1))
    across = np.setdiff1d(np.arange(66), np.arange(3, 63, 3))
    assert frequencies(K, M, across)[[0, -1]] == pytest.approx([9.4527, 126.137], rel=1e-5)


def test_lumped_mass_lowers_and_consistent_mass_raises_the_frequency_of_a_bar() -> None:
    """Fixed-free, c = sqrt(E / rho): w_1 = pi c / (2 L); lumped N links have 2 c N / L sin(pi / (4 N))."""
    N, L = 40, 2.0
    c = np.sqrt(SOFT.young / SOFT.density)
    points, elements = along(N + 1, L)
    K = stiffness(points, elements, SOFT)
    lumped = frequencies(K, mass(points, elements, SOFT), [0])
    consistent = frequencies(K, mass(points, elements, SOFT, lumped=False), [0])
    k = np.arange(1, N + 1)
    np.testing.assert_allclose(lumped, 2 * c * N / L * np.sin((2 * k - 1) * np.pi / (4 * N)), rtol=1e-11)
    exact = np.pi * c / (2 * L)
    assert lumped[0] < exact < consistent[0]
    assert consistent[0] == pytest.approx(exact, rel=1e-4)


def test_the_bending_frequencies_of_a_beam_converge_to_those_of_euler_and_bernoulli() -> None:
    """Fixed-free, 20 m by 1 m: w = (b / L)^2 sqrt(E I / (rho A)) with cos b cosh b = -1; errors are of order h^2."""
    material, beam = Material(young=1000, poisson=0, density=1), np.sqrt(1000 / 12) / 20**2
    found = []
    for refined in (2, 4, 8):
        block = Jelly(cells=(20 * refined, 2 * refined), sides=(20, 1), pinned=("left",))
        points, elements = block.points(2), block.elements(2)
        K, M = stiffness(points, elements, material), mass(points, elements, material, lumped=False)
        found.append(frequencies(K, M, freedoms(block.pins(), 2), count=2))
    rates = np.log2((found[0] - found[1]) / (found[1] - found[2]))
    assert (rates > 1.7).all() and (rates < 2.2).all(), rates
    limit = found[2] - (found[1] - found[2]) / 3
    exact = beam * np.array([1.875104, 4.694091]) ** 2
    assert (np.abs(limit / exact - 1) < (0.01, 0.03)).all(), "shear and rotation of the section lower them a little"


def test_the_lowest_frequencies_of_a_large_structure_are_exact() -> None:
    """Inverse iteration, used above DENSE freedoms, against closed forms of a fixed and of a free bar."""
    N = DENSE + 200
    points, elements = along(N + 1, 1.0)
    K, M = stiffness(points, elements, SOFT), mass(points, elements, SOFT)
    c = np.sqrt(SOFT.young / SOFT.density)
    k = np.arange(1, 7)
    np.testing.assert_allclose(frequencies(K, M, [0], 6), 2 * c * N * np.sin((2 * k - 1) * np.pi / (4 * N)), rtol=1e-7)
    np.testing.assert_allclose(frequencies(K, M, (), 6), 2 * c * N * np.sin((k - 1) * np.pi / (2 * N)), rtol=1e-7)


def test_the_lowest_frequencies_of_a_free_structure_are_found(monkeypatch: pytest.MonkeyPatch) -> None:
    for network, dimension in ((SHEET, 2), (BLOCK, 3)):
        _, K, M = structure(network, dimension)
        still = dimension * (dimension + 1) // 2
        expected = frequencies(K, M)[: still + 5]
        with monkeypatch.context() as patch:
            patch.setattr("flockenv.model.finite_elements.DENSE", 20)
            lowest = frequencies(K, M, count=still + 5)
        assert lowest[:still].tolist() == [0] * still
        np.testing.assert_allclose(lowest, expected, rtol=1e-7)


@STRUCTURES
def test_frequencies_agree_with_eigenvalues_of_the_full_matrix(network: Network, dimension: int) -> None:
    _, K, M = structure(network, dimension)
    held = freedoms([0], dimension)
    free = np.setdiff1d(np.arange(K.shape[0]), held)
    expected = np.maximum(np.linalg.eigvalsh(scaled(K, M)[np.ix_(free, free)]), 0)
    found = frequencies(K, M, held)
    np.testing.assert_allclose(found**2, expected, atol=1e-12 * expected[-1])
    np.testing.assert_array_equal(frequencies(K, M, held, count=3), found[:3])
    assert (np.diff(found) >= 0).all()


# --- refusals -------------------------------------------------------------------------------------------------------

POINTS = np.array([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0), (2.0, 0.0)])
BAR = stiffness([[0.0], [1.0]], [(0, 1)], SOFT)


@pytest.mark.parametrize(("call", "line"), [
    (lambda: Material(young=0), "Material: young = 0: must be a number > 0"),
    (lambda: Material(young=float("inf")), "young = inf"),
    (lambda: Material(young=1, poisson=0.5), "poisson = 0.5: must be a number > -1 and < 0.5"),
    (lambda: Material(young=1, density=-1), "density = -1"),
    (lambda: Material(young=1, area=0), "area = 0"),
    (lambda: Material(young=1, thicknes=1), "did you mean `thickness`?"),
    (lambda: stiffness(POINTS, [(0, 1, 4)], SOFT), "elements[0] = (0, 1, 4): particles are numbered 0 to 3"),
    (lambda: stiffness(POINTS, [(0, 1, -1)], SOFT), "elements[0] = (0, 1, -1)"),
    (lambda: stiffness(POINTS, [(0, 1, 2), (0, 1, 3)], SOFT), "elements[1] = (0, 1, 3): it has no area"),
    (lambda: stiffness(POINTS, [(1, 1)], SOFT), "elements[0] = (1, 1): it has no length"),
    (lambda: stiffness(POINTS, [(0, 1, 2, 3)], SOFT), "in 2 dimensions k must be 2 (bars) or 3 (triangles)"),
    (lambda: stiffness(np.eye(3), [(0, 1, 2)], SOFT), "in 3 dimensions k must be 2 (bars) or 4 (tetrahedra)"),
    (lambda: stiffness(POINTS * np.nan, [(0, 1, 2)], SOFT), "points of shape (4, 2): must be finite"),
    (lambda: mass(POINTS, [(0.0, 1.0)], SOFT), "elements of shape (1, 2), float64: must be integers"),
    (lambda: rayleigh(BAR, BAR, -1, 0), "alpha = -1: must be a number >= 0"),
    (lambda: rayleigh(BAR, BAR, 0, float("nan")), "beta = nan"),
    (lambda: solve_static(BAR, [0.0, 1.0], [0]), "F of shape (2,)"),
    (lambda: solve_static(BAR, [[0.0], [np.nan]], [0]), "F of shape (2, 1): must be finite"),
    (lambda: solve_static(BAR, [[0.0], [1.0]], [2]), "fixed: 2 is no degree of freedom; they are 0 to 1"),
    (lambda: frequencies(BAR, BAR, [0], 2), "count = 2: must be an integer from 1 to 1"),
    (lambda: frequencies(BAR, 0 * BAR), "M: degree of freedom 0 has no mass"),
    (lambda: frequencies(sparse.eye_array(5000), sparse.eye_array(5000)), "5,000 degrees of freedom"),
    (lambda: blocks(BAR + sparse.eye_array(2), [[0.0], [1.0]]), "the rows of particle 0 do not sum to zero"),
    (lambda: blocks(BAR, POINTS), "K of shape (2, 2): 4 points in 2 dimensions need (8, 8)"),
])  # fmt: skip
def test_invalid_input_is_refused_in_one_line(call: Any, line: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        call()
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_mask_of_fixed_freedoms_is_refused() -> None:
    with pytest.raises(TypeError, match="fixed of bool: must be degrees of freedom"):
        solve_static(BAR, [[0.0], [1.0]], [True, False])


def test_a_cloth_in_space_has_areas() -> None:
    cloth = Cloth(cells=(3, 2), edges=((1, 0, 1), (0, 2, 0)))
    assert contents(cloth.points(3), cloth.elements(3)).sum() == pytest.approx(2 * 2**0.5)
