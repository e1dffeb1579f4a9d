"""Triangle cloth: forces against energies and closed forms, derivatives against differences, conserved quantities."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from flockenv.model.networks import Cloth, Mesh, Rope
from flockenv.model.state import State
from flockenv.model.triangles import dihedral_angles, dihedrals
from flockenv.physics.constraints import FaceCollisions, Slide
from flockenv.physics.effects import Bending, Membrane, Springs
from flockenv.physics.integrators import LinearlyImplicitEuler, VelocityVerlet
from flockenv.scene import Group, Scene
from tests.catalogue import Array
from tests.test_linearly_implicit import CLOSELY, dense, differences, filtered_change

MASS = 0.03


def cloth(
    stretch: float = 300.0, shear: float = 80.0, bend: float = 0.4, damping: float = 0.0, network: Any = None,
    cells: tuple[int, int] = (3, 2), **fields: Any,
) -> Scene:  # fmt: skip
    """Return a free sheet of triangles of 0.9 m by 0.6 m in the plane z = 0; all share one kernel."""
    sheet = network or Cloth(cells=cells, sides=(0.9, 0.6))
    effects = (
        Membrane(stretch=stretch, shear=shear, damping=damping, warp=(1.0, 0.0, 0.0)),
        Bending(stiffness=bend, damping=damping),
    )
    return Scene(dimension=3, groups=(Group(network=sheet, mass=MASS),), effects=effects, **({"dt": 1e-4} | fields))


def turn() -> Array:
    """Return a rotation by no simple angle."""
    found, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))
    return np.asarray(found * np.linalg.det(found))


def crumpled(scene: Scene, far: float = 0.08) -> State:
    state, rng = scene.start(0), np.random.default_rng(2)
    return state.with_motion(state.pos + far * rng.normal(size=state.shape), rng.normal(size=state.shape))


def force(scene: Scene, state: State) -> Array:
    return np.asarray(scene.acceleration(state)[0] * MASS)


def energy(scene: Scene, state: State) -> float:
    found = [effect.potential(scene.groups, state, scene.space.displacement) for effect in scene.effects]
    return float(sum(each[0] for each in found if each is not None))


def affine(scene: Scene, by: tuple[float, float]) -> State:
    """Return the sheet stretched along its sides and turned, with random velocities."""
    state = scene.start(0)
    pos = (state.pos * np.array([*by, 1.0])) @ turn().T
    return state.with_motion(pos, np.random.default_rng(5).normal(size=state.shape))


def test_forces_are_minus_the_gradient_of_the_energy() -> None:
    scene = cloth()
    state = crumpled(scene)
    found, expected = force(scene, state), np.zeros(state.shape[1:])
    for i in range(scene.agents):
        for k in range(3):
            off = np.zeros(state.shape)
            off[0, i, k] = 1e-6
            ends = [energy(scene, state.with_motion(state.pos + s * off, state.vel)) for s in (1, -1)]
            expected[i, k] = -(ends[0] - ends[1]) / 2e-6
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def test_derivatives_are_those_of_the_forces() -> None:
    """Of a stretched flat sheet: there all that the matrix leaves out is 0. dF/dv is compared of a crumpled one too."""
    scene = cloth()
    state = affine(scene, (1.2, 1.1))
    found, _ = dense(scene, state, (1.0, 0.0, 0.0))
    expected = differences(scene, state, of_velocity=False)
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())
    damped = cloth(damping=0.02)
    for moving in (state, crumpled(damped)):
        found, _ = dense(damped, moving, (0.0, 1.0, 0.0))
        expected = differences(damped, moving, of_velocity=True)
        np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())


def kept_derivative(scene: Scene, state: State) -> Array:
    """Return what the matrix keeps of dF/dx, from the conditions: -k (C' C'^T + C C''), the last of stretched ones."""
    membrane, bending = scene.effects
    assert isinstance(membrane, Membrane) and isinstance(bending, Bending)
    corners, gradient, area = membrane.triangles(scene.groups, 3)
    agent, number, _ = bending.stencils(scene.groups, 3)
    size, step = state.pos[0].size, 1e-6

    def conditions(x: Any) -> tuple[Any, Any]:
        w = np.einsum("btkd,tku->btud", x.reshape(-1, size // 3, 3)[:, corners], gradient)
        return np.sqrt((w * w).sum(axis=-1)) - 1, (w[:, :, 0] * w[:, :, 1]).sum(axis=-1)

    def slopes(x: Array) -> tuple[Array, Array]:  # by complex steps, exact to rounding
        return tuple(each.imag / 1e-20 for each in conditions(x + 1e-20j * np.eye(size)))

    def pull(x: Array) -> Array:
        length, (slope, _) = conditions(x)[0][0], slopes(x)
        return np.einsum("t,tu,itu->i", membrane.stretch * area, np.where(stretched, length, 0.0), slope)

    x, off = state.pos[0].ravel(), step * np.eye(size)
    stretched = conditions(x)[0][0] > 0
    assert 0.2 < stretched.mean() < 0.8
    found = np.stack([(pull(x + by) - pull(x - by)) / (2 * step) for by in off], axis=1)
    slope, shear = slopes(x)
    found += np.einsum("t,tu,itu,jtu->ij", membrane.stretch * area, ~stretched, slope, slope)
    found += np.einsum("t,it,jt->ij", membrane.shear * area, shear, shear)
    angles = [dihedral_angles(at.reshape(-1, 3), agent)[0] for by in off for at in (x + by, x - by)]
    angle = (np.array(angles[::2]) - angles[1::2]) / (2 * step)
    return -found - np.einsum("e,ie,je->ij", number[:, 0], angle, angle)


def test_derivatives_of_a_sheared_and_bent_sheet_are_those_that_are_kept() -> None:
    """Left out are second derivatives of shear, of angles, and of stretch that is negative, and those of damping."""
    scene = cloth(damping=0.02)
    state = crumpled(scene)
    state.pos[0, :, 0] += 0.4 * state.pos[0, :, 1]
    found, _ = dense(scene, state, (1.0, 0.0, 0.0))
    expected = kept_derivative(scene, state)
    np.testing.assert_allclose(found, expected, atol=1e-6 * np.abs(expected).max())
    assert np.abs(found - differences(scene, state, of_velocity=False)).max() > 0.1 * np.abs(found).max()


@pytest.mark.slow
def test_a_step_is_the_dense_solution_with_filters_in_space() -> None:
    """A particle is held, a side slides in a plane, others on a line."""
    plane = Slide(particles=("right",), along=((1.0, 0.0, 1.0), (0.0, 1.0, 1.0)))
    line = Slide(particles=(4, 5), along=((1.0, 2.0, -2.0),))
    sheet = Cloth(cells=(3, 2), sides=(0.9, 0.6), pinned=("top_left",))
    scene = cloth(damping=0.02, network=sheet, constraints=(plane, line), dt=0.05, integrator=CLOSELY)
    along: dict[int, Array] = {}
    state = crumpled(scene)
    for slide in (plane, line):
        basis = np.linalg.qr(np.array(slide.along).T)[0].T
        along |= dict.fromkeys(slide.agents(scene).tolist(), basis)
    for i, basis in along.items():
        state.vel[0, i] = state.vel[0, i] @ basis.T @ basis
    change = filtered_change(scene, state, along)
    assert np.linalg.norm(change, axis=1).min() == 0 < 1 < np.abs(change[[3, 4, 5, 7, 11]]).max()
    np.testing.assert_allclose(scene.step(state).vel[0] - state.vel[0], change, atol=1e-9 * np.abs(change).max())


def test_the_matrix_of_a_crumpled_sheet_has_no_negative_eigenvalue() -> None:
    scene = cloth(damping=0.02)
    for far in (0.05, 0.5):
        found, _ = dense(scene, crumpled(scene, far), (-1.0, 0.0, 0.0))
        np.testing.assert_allclose(found, found.T, atol=1e-12 * np.abs(found).max())
        assert np.linalg.eigvalsh(found).min() > -1e-9 * np.abs(found).max()


def test_momentum_and_angular_momentum_are_conserved() -> None:
    scene = cloth(damping=0.02)
    state = crumpled(scene)
    found = force(scene, state)
    size = np.abs(found).max()
    np.testing.assert_allclose(found.sum(axis=0), 0, atol=1e-12 * size)
    np.testing.assert_allclose(np.cross(state.pos[0], found).sum(axis=0), 0, atol=1e-12 * size)


def test_a_rigid_motion_has_no_force() -> None:
    scene = cloth(damping=0.02)
    state = affine(scene, (1.0, 1.0))
    spin = np.cross(np.array([0.3, -2.0, 1.1]), state.pos)
    spinning = state.with_motion(state.pos + 3.0, spin + np.array([1.0, 2.0, -0.5]))
    np.testing.assert_allclose(force(scene, spinning), 0, atol=1e-11)


@pytest.mark.parametrize("cells", [(2, 3), (6, 4)])
def test_a_stretched_sheet_pulls_with_stiffness_times_width_and_strain(cells: tuple[int, int]) -> None:
    """On any mesh; and a sheared one with s gamma per length of a side."""
    scene = cloth(cells=cells)
    network, state = scene.groups[0].network, scene.start(0)
    assert network is not None
    right, top = network.particles("pinned", ("right",)), network.particles("pinned", ("top",))
    pulled = state.with_motion(state.pos * (1.07, 1.0, 1.0), state.vel)
    np.testing.assert_allclose(force(scene, pulled)[right].sum(axis=0), (-300.0 * 0.07 * 0.6, 0, 0), atol=1e-11)
    gamma = 1e-4
    pos = state.pos.copy()
    pos[0, :, 0] += gamma * pos[0, :, 1]
    sheared = force(scene, state.with_motion(pos, state.vel))[top].sum(axis=0)
    assert sheared[0] == pytest.approx(-80.0 * gamma * 0.9, rel=1e-3)


@pytest.mark.parametrize("cells", [(8, 2), (16, 3)])
def test_a_sheet_on_a_cylinder_has_the_energy_of_its_curvature(cells: tuple[int, int]) -> None:
    """D kappa^2 / 2 per area, of the part between the first and the last row of edges."""
    scene = cloth(stretch=0.0, shear=0.0, cells=cells)
    state, curvature = scene.start(0), 0.5
    step = 0.9 / cells[0]
    radius = step / (2 * np.sin(curvature * step / 2))
    angle = curvature * state.pos[0, :, 0]
    pos = np.stack([radius * np.sin(angle), state.pos[0, :, 1], radius * (1 - np.cos(angle))], axis=-1)
    found = energy(scene, state.with_motion(pos[None], state.vel))
    assert found == pytest.approx(0.5 * 0.4 * curvature**2 * (0.9 - step) * 0.6, rel=1e-9)


def test_a_hanging_sheet_is_stretched_by_what_hangs_below() -> None:
    """Strain weight / (k width) in each row of cells, from its top side down, carries the rows of particles below."""
    rows, weight = 6, 4 * MASS * 9.81
    scene = cloth(cells=(3, rows))
    state, height = scene.start(0), 0.6 / rows
    strain = np.arange(1, rows + 1) * weight / (300.0 * 0.9)  # of rows of cells, from below
    level = np.concatenate([[0.0], np.cumsum(height * (1 + strain))])
    row = np.rint(state.pos[0, :, 1] / height).astype(int)
    pos = state.pos.copy()
    pos[0, :, 1] = level[row]
    pull = np.bincount(row, force(scene, state.with_motion(pos, state.vel))[:, 1])
    np.testing.assert_allclose(pull[:-1], weight, rtol=1e-9)
    assert level[-1] - 0.6 == pytest.approx(height * weight * rows * (rows + 1) / 2 / (300.0 * 0.9))


def test_a_compressed_strip_buckles_at_eulers_strain() -> None:
    """Of a half wave z = a sin(q x): D q^4 a resists and k strain q^2 a drives, equal at a strain of D q^2 / k."""
    scene = cloth(cells=(16, 3))
    state, q = scene.start(0), np.pi / 0.9
    wave = np.sin(q * state.pos[0, :, 0])
    expected = 0.4 * q**2 / 300.0

    def growth(strain: float) -> float:
        pos = state.pos * (1 - strain, 1.0, 1.0)
        pos[0, :, 2] = 1e-5 * wave
        return float(force(scene, state.with_motion(pos, state.vel))[:, 2] @ wave)

    below, above = growth(0.9 * expected), growth(1.1 * expected)
    assert below < 0 < above
    assert expected * (0.9 + 0.2 * below / (below - above)) == pytest.approx(expected, rel=0.02)


TENT = Mesh(
    vertices=((0, 0, 0), (1, 0, 0), (1, 1, 0.4), (0, 1, 0.4), (0.5, 0.5, 0.6)),
    triangles=((0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)),
)


def test_a_mesh_that_is_not_flat_at_rest_stays_as_it_is() -> None:
    scene = cloth(network=TENT)
    np.testing.assert_allclose(force(scene, scene.start(0)), 0, atol=1e-12)
    assert energy(scene, crumpled(scene)) > 0.1


def test_an_edge_of_three_triangles_is_refused() -> None:
    assert dihedrals(np.array([[0, 1, 2], [1, 0, 3]])).tolist() == [[0, 1, 2, 3]]
    book = Mesh(
        vertices=((0, 0, 0), (0, 1, 0), (1, 0, 0), (0.2, 0, 1), (-1, 0, 0)),
        triangles=((0, 1, 2), (0, 1, 3), (1, 0, 4)),
    )  # fmt: skip
    with pytest.raises(ValueError, match="the edge of particles 0 and 1 is shared by three triangles"):
        dihedrals(np.array(book.triangles))


STRIP = ((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0), (2, 1, 0))
UNSOUND = [
    (STRIP, ((0, 1, 2), (1, 2, 3)), r"triangles 0 and 1 face opposite directions .*: one of them is flipped"),
    (STRIP, ((0, 1, 2), (1, 3, 2), (2, 1, 4)), r"the edge of .* belongs to three triangles or more; at most two do"),
    (STRIP, ((0, 1, 2), (1, 3, 4)), r"parts of the mesh touch in vertex 1, \(1, 0, 0\), without a common edge"),
    (
        (*STRIP, (1, 0, 0)),
        ((0, 1, 2), (5, 3, 2)),
        r"vertices 1 and 5 are in one place, \(1, 0, 0\) m, so nothing joins",
    ),
]


@pytest.mark.parametrize(("vertices", "triangles", "text"), UNSOUND)
@pytest.mark.parametrize(
    "given",
    [{"effects": (Membrane(stretch=1),)}, {"effects": (Bending(stiffness=1),)}, {"constraints": (FaceCollisions(),)}],
)
def test_a_mesh_that_is_no_surface_is_refused_where_it_is_read_as_one(
    given: dict[str, Any], vertices: Any, triangles: Any, text: str
) -> None:
    """As a net of springs it is allowed."""
    group = Group(network=Mesh(vertices=vertices, triangles=triangles))
    Scene(dimension=3, groups=(group,), effects=(Springs(stiffness=1),))
    with pytest.raises(ValueError, match=rf"(group = 0: in its network|in the network of groups\[0\]) {text}"):
        Scene(dimension=3, groups=(group,), **given)


def test_vertices_in_one_place_may_be_joined_by_a_spring() -> None:
    """A seam: two triangles, whose common edge is twice in the mesh."""
    seam = Mesh(
        vertices=(*STRIP[:4], (1, 0, 0), (0, 1, 0)), triangles=((0, 1, 2), (4, 3, 5)),
        pairs=((0, 1), (1, 2), (0, 2), (3, 4), (4, 5), (3, 5), (1, 4), (2, 5)),
    )  # fmt: skip
    Scene(dimension=3, groups=(Group(network=seam),), effects=(Membrane(stretch=1),))


@pytest.mark.parametrize(
    ("effect", "network", "part"),
    [
        (
            Membrane(stretch=1),
            Rope(links=3, length=1.0, direction=(1, 0, 0)),
            r"group = 0: its network has bars; triang",
        ),
        (
            Bending(stiffness=1),
            Rope(links=3, length=1.0, direction=(1, 0, 0)),
            r"group = 0: its network has bars; triang",
        ),
        (Membrane(stretch=1, warp=(0, 0, 1)), Cloth(cells=(2, 2), sides=(1, 1)), r"warp = .*perpendicular to triangle"),
        (Membrane(stretch=1, group=1), Cloth(cells=(2, 2), sides=(1, 1)), r"group = 1: there are 1 groups"),
    ],
)
def test_networks_that_do_not_suit_are_refused(effect: Any, network: Any, part: str) -> None:
    with pytest.raises(ValueError, match=rf"effects\[0\]\.{part}"):
        Scene(dimension=3, groups=(Group(network=network),), effects=(effect,), dt=1e-4)


@pytest.mark.parametrize("dimension", [2])
def test_a_sheet_in_a_plane_does_not_bend(dimension: int) -> None:
    with pytest.raises(ValueError, match="needs dimension = 3, it is 2"):
        Scene(groups=(Group(network=Cloth(cells=(2, 2), sides=(1, 1))),), effects=(Bending(stiffness=1),), dt=1e-4)


@pytest.mark.slow
def test_explicit_and_implicit_steps_agree() -> None:
    """The difference after 0.2 s halves with the step of the method of order 1."""
    still = cloth(damping=0.005, bend=0.01, integrator=VelocityVerlet())
    start = affine(still, (1.1, 1.05))
    start = start.with_motion(start.pos, 0.1 * start.vel)
    expected, gaps = still.run(start, 2000).pos, []
    for n in (400, 800, 1600):
        scene = cloth(damping=0.005, bend=0.01, integrator=LinearlyImplicitEuler(tolerance=1e-9), dt=0.2 / n)
        gaps.append(float(np.abs(scene.run(start.with_dt(0.2 / n), n).pos - expected).max()))
    assert gaps[0] < 0.1
    for coarse, fine in pairwise(gaps):
        assert 1.7 < coarse / fine < 2.4


# --- strips under load, at rest and swinging: slow tests that share the kernels of the one above ----------------------

LENGTH, RIGID = 0.9, LinearlyImplicitEuler(tolerance=1e-9)


def strip(cells: int, width: float, pinned: tuple[Any, ...], **fields: Any) -> tuple[Scene, State, Array, float]:
    """Return a strip of one row of cells, its start, its x, m, and its rigidity under load, N m: see `Bending`."""
    sheet = Cloth(cells=(cells, 1), sides=(LENGTH, width), pinned=pinned)
    scene, r = cloth(network=sheet, **fields), width * cells / LENGTH
    state, bend = scene.start(0), float(scene.effects[1].stiffness)
    return scene, state, np.asarray(state.pos[0, :, 0]), bend * (r + 1 / r) ** 2 / (r * r + (r + 1 / r) ** 2)


@pytest.mark.slow
@pytest.mark.parametrize(("width", "share"), [(LENGTH / 32, 0.8), (LENGTH / 128, 1.0)], ids=["square", "long"])
def test_a_clamped_strip_bends_as_a_beam_of_its_rigidity(width: float, share: float) -> None:
    """q L^4 / (8 D) from the middle of the clamped cells on; D is the stiffness if cells are long, 4/5 if square."""
    held = (0, 1, 33, 34)
    scene, state, x, rigidity = strip(32, width, held, integrator=RIGID, dt=20.0)
    assert rigidity == pytest.approx(share * 0.4, rel=0.005)
    long, load = LENGTH * (1 - 0.5 / 32), np.zeros(state.shape)
    load[0, :, 2] = -0.01 * (LENGTH / 32) * width / 2 * np.where(x > LENGTH - 1e-9, 0.5, 1.0)
    for _ in range(40):
        state = scene.step(state, load)
    assert np.abs(state.vel).max() < 1e-10
    dropped = -state.pos[0, x > LENGTH - 1e-9, 2].mean()
    assert dropped < 0.01 * LENGTH
    assert dropped == pytest.approx(0.01 * long**4 / (8 * rigidity), rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("bend", "short"), [(0.02, 0.01), (0.2, 0.02)])
def test_a_strip_compressed_past_eulers_load_rests_in_the_wave_of_the_elastica(bend: float, short: float) -> None:
    """Amplitude (2 L / pi) sqrt(shortening - strain), with Euler's strain D q^2 / k, to first order; below it, none."""
    for strain, buckles in ((short, True), (0.7 * 0.8 * bend * (np.pi / LENGTH) ** 2 / 300.0, False)):
        scene, state, x, rigidity = strip(16, LENGTH / 16, ("left", "right"), bend=bend, integrator=RIGID, dt=4.0)
        pos = state.pos * (1 - strain, 1.0, 1.0)
        pos[0, :, 2] = 1e-3 * np.sin(np.pi * x / LENGTH)
        end = scene.run(state.with_motion(pos, state.vel), 200)
        assert np.abs(end.vel).max() < 1e-8
        room = strain - rigidity * (np.pi / LENGTH) ** 2 / 300.0
        expected = 2 * LENGTH / np.pi * np.sqrt(room) if buckles else 0.0
        assert end.pos[0, :, 2].max() == pytest.approx(expected, rel=0.01, abs=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("waves", [1, 2])
@pytest.mark.parametrize("width", [LENGTH / 32, LENGTH / 128], ids=["square", "long"])
def test_a_strip_swings_at_the_frequencies_of_a_beam(width: float, waves: int) -> None:
    """With pinned ends (n pi / L)^2 sqrt(D / mass per area); after a quarter of the time it is flat."""
    scene, state, x, rigidity = strip(32, width, ("left", "right"), integrator=VelocityVerlet(), dt=1e-3, bend=0.01)
    q = waves * np.pi / LENGTH
    wave, omega = np.sin(q * x), q**2 * np.sqrt(rigidity / (2 * MASS / (width * LENGTH / 32)))
    pos = state.pos.copy()
    pos[0, :, 2] = 1e-4 * wave
    end = scene.run(state.with_motion(pos, state.vel), round(np.pi / 2 / omega / scene.dt))
    phase = float(end.pos[0, :, 2] @ wave / (1e-4 * wave @ wave))
    assert abs(phase) < 0.01 * np.pi / 2
    assert float(end.vel[0, :, 2] @ wave / (1e-4 * wave @ wave)) == pytest.approx(-omega, rel=0.01)
