"""Meshes of other programs as networks or obstacles: OBJ, PLY, STL, MSH, VTK and others, by meshio (extra `mesh`).

Tetrahedra become a solid body, triangles a sheet, a surface or an obstacle, lines a network of springs. Coordinates are
in m, after they are scaled, rotated and moved in this order.
"""

from __future__ import annotations

import contextlib
import io
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from flockenv.core.errors import nearest, printable
from flockenv.geometry.mesh_checks import check_mesh, refuse_coincident
from flockenv.geometry.shapes import HalfSpace, TriangleMesh
from flockenv.model.finite_elements import contents
from flockenv.model.group import Group
from flockenv.model.network import element_edges, pairs_of
from flockenv.model.networks import Mesh
from flockenv.model.spawn import Spawn
from flockenv.physics.constraints import Collisions, Constraint, FaceCollisions
from flockenv.physics.effects import Bending, Effect, Elastic, Gravity, Membrane, Springs
from flockenv.physics.integrators import LinearlyImplicitEuler, SemiImplicitEuler
from flockenv.scene.scene import Scene
from flockenv.scene.stability import suggest_dt

__all__ = ["Elements", "mesh_of", "obstacle_of", "obstacle_scene_of", "read_mesh", "scene_of"]

Floats = NDArray[np.float64]
Ints = NDArray[Any]

Elements = Literal["bars", "triangles", "tetrahedra"]
"""Cells of a file that become the elements of a network."""

_CELLS = {"bars": ("line",), "triangles": ("triangle", "quad"), "tetrahedra": ("tetra",)}
"""Names in meshio of the cells that become elements: of one, two and three dimensions."""

G = 9.81
"""m/s^2, downwards along y: the second coordinate is up in pictures."""


def read_mesh(path: Path, elements: Elements | None = None) -> tuple[Floats, Ints]:
    """Return the points of a mesh file, (n, 2) or (n, 3), and its elements, (E, k), by meshio.

    path: its ending names the format, one of those that meshio reads.

    elements: those that are taken (default: those of the most dimensions in the file, so tetrahedra and not their
    faces). Quadrilaterals are cut in two triangles along the shorter diagonal. Points that belong to no element are
    left out.
    Raises ValueError, in one line, without meshio, or if the file cannot be read or has other elements.
    """
    name = printable(str(path))[1:-1]
    raw = _read(path, name)
    try:
        return _elements_of(np.asarray(raw.points, float), raw.cells, elements)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def mesh_of(
    points: Floats,
    elements: Ints,
    scale: float = 1.0,
    rotate: Sequence[float] = (0.0, 0.0, 0.0),
    move: Sequence[float] = (0.0, 0.0, 0.0),
    merge: float | None = None,
    dimension: int = 3,
    closed: bool = False,
) -> Mesh:
    """Return a mesh as a network.

    Args:
        points: (n, 2) or (n, 3), in any unit.
        elements: (E, k): bars, triangles or tetrahedra.
        scale: m per unit of length.
        rotate: degrees, about the x axis, then the y axis, then the z axis.
        move: m.
        merge: m, distance up to which points become one (default: points in one place are refused).
        dimension: 3, or 2 for a flat mesh, whose third coordinate is left out.
        closed: True if a surface with a hole is refused.

    Raises:
        ValueError: a mesh that is not sound; see check_mesh; or a number that is not finite.
    """
    points, elements = _merge(_placed(points, scale, rotate, move), elements, merge)
    if dimension == 2:
        thick = np.ptp(points[:, 2])
        if thick > 1e-9 * np.ptp(points, axis=0).max():
            raise ValueError(f"dimension = 2: the mesh is not flat, but {thick:.6g} m thick along z")
        points = points[:, :2]
    kind = tuple(_CELLS)[elements.shape[1] - 2]
    rows = {kind: tuple(map(tuple, elements.tolist()))}
    mesh = Mesh(vertices=tuple(map(tuple, points.tolist())), lumping="geometric", **rows)
    check_mesh(points, elements, closed)
    return mesh


def obstacle_of(
    points: Floats,
    triangles: Ints,
    spacing: float | None = None,
    scale: float = 1.0,
    rotate: Sequence[float] = (0.0, 0.0, 0.0),
    move: Sequence[float] = (0.0, 0.0, 0.0),
    merge: float | None = None,
) -> TriangleMesh:
    """Return a closed surface of triangles as an obstacle.

    points: (n, 3), in any unit; scale: m per unit; rotate: degrees, about the x axis, then y, then z; move: m; merge:
    m, distance up to which points become one (default: points in one place are refused), all as of `mesh_of`.

    spacing: of its grid of distances, m (default: a fortieth of its longest extent). The other arguments are those of
    `mesh_of`. Raises ValueError if triangles do not bound a solid.
    """
    points, triangles = _merge(_placed(points, scale, rotate, move), triangles, merge)
    size = float(np.ptp(points, axis=0).max())
    try:
        return TriangleMesh(
            vertices=tuple(map(tuple, points.tolist())), triangles=tuple(map(tuple, triangles.tolist())),
            spacing=_brief(size / 40) if spacing is None else spacing,
        )  # fmt: skip
    except ValueError as error:
        raise ValueError(str(error).removeprefix("TriangleMesh: ")) from None


def obstacle_scene_of(obstacle: TriangleMesh) -> Scene:
    """Return a scene in which balls fall on an obstacle that stands on a floor, to be edited.

    The balls start above its middle, in 3 x 3 columns, which have room for them however slim it is.
    """
    corners = np.array(obstacle.vertices)[np.array(obstacle.triangles)]  # not of vertices without a triangle
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    size = float((high - low).max())
    radius = _brief(0.05 * size)
    spacing = 2.1 * radius
    middle = ((low + high) / 2 * (1, 0, 1)) + (high + 0.1 * size) * (0, 1, 0)
    spawn = Spawn(
        low=tuple((middle - spacing * np.array((1.6, 0.0, 1.6))).tolist()),
        high=tuple((middle + spacing * np.array((1.6, 3.2, 1.6))).tolist()), spacing=spacing,
    )  # fmt: skip
    floor = HalfSpace(point=(0.0, float(low[1]), 0.0), direction=(0.0, 1.0, 0.0))
    return Scene(
        dimension=3, groups=(Group(count=20, radius=radius, spawn=spawn),), obstacles=(obstacle, floor),
        effects=(Gravity(acceleration=(0.0, -G, 0.0)),), constraints=(Collisions(restitution=0.5, friction=0.3),),
        dt=float(f"{0.03 * math.sqrt(size / G):.0e}"),
    )  # fmt: skip


def scene_of(mesh: Mesh) -> Scene:
    """Return a scene in which a mesh falls on a floor, to be edited: its stiffness and step suit its size and weight.

    Raises ValueError if its faces intersect each other.
    """
    dimension = mesh.dimension or 3
    points, elements = mesh.points(dimension), mesh.elements(dimension)
    size = float(np.ptp(points, axis=0).max())
    edges = pairs_of(element_edges(elements, mesh.size), mesh.size)
    length = float(np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1).mean())
    density = {2: 0.1, 3: 0.2 if dimension == 3 else 10.0, 4: 1000.0}[elements.shape[1]]
    total = density * float(contents(points, elements).sum())
    up = np.eye(dimension)[1]
    floor = (points.min(axis=0) - 0.2 * size) * up + 0.0  # 0.0 instead of -0.0
    solid: tuple[Constraint, ...] = (FaceCollisions(friction=0.5),) if dimension == 3 and elements.shape[1] > 2 else ()
    forces = _forces(elements.shape[1], dimension, size, density, total)
    scene = Scene(
        dimension=dimension,
        groups=(Group(network=mesh, mass=_brief(total / mesh.size), radius=_brief(0.1 * length)),),
        obstacles=(HalfSpace(point=tuple(floor.tolist()), direction=tuple(up.tolist())),),
        effects=(Gravity(acceleration=tuple((0.0 - G * up).tolist())), *forces),
        integrator=LinearlyImplicitEuler() if all(force.derivative for force in forces) else SemiImplicitEuler(),
        constraints=(Collisions(agents=False, restitution=0.0, friction=0.5), *solid),
        dt=1e-9,
    )
    step = min(0.01, 0.5 * suggest_dt(scene).dt)
    digit = 10.0 ** math.floor(math.log10(step))
    return scene.model_copy(update={"dt": float(f"{math.floor(step / digit) * digit:.0e}")})


def _forces(corners: int, dimension: int, size: float, density: float, total: float) -> tuple[Effect, ...]:
    """Return forces under which a mesh that stands on its end is compressed by about a twentieth by its weight."""
    weight, slow = _brief(20 * density * G * size), _brief(0.005 * math.sqrt(size / G))
    if corners == 2:
        return (Springs(stiffness=_brief(20 * total * G / size), ratio=0.1),)
    if corners == dimension + 1:
        return (Elastic(young=weight, strain="corotated", beta=slow),)
    rigidity = _brief(density * G * (0.2 * size) ** 3)
    return Membrane(stretch=weight, shear=_brief(0.3 * weight), damping=slow), Bending(stiffness=rigidity, damping=slow)


def _brief(value: float) -> float:
    """Return a number rounded to two digits."""
    return float(f"{value:.1e}")


# --- files --------------------------------------------------------------------------------------------------------


def _read(path: Path, name: str) -> Any:
    """Return the mesh of meshio; raise ValueError if it is not installed or cannot read the file."""
    try:
        import meshio
    except ImportError:
        raise ValueError("a mesh file needs the package meshio: pip install 'flockenv[mesh]'") from None
    try:
        with path.open("rb"):
            pass
    except OSError as error:
        raise ValueError(f"{name}: cannot be read: {error.strerror or error}") from None
    known = sorted(meshio.extension_to_filetypes)
    if not {suffix.lower() for suffix in _endings(path)} & set(known):
        hint = nearest(path.suffix.lower(), known) or ";"
        raise ValueError(f"{name}: unknown format{hint} known are .obj, .ply, .stl, .msh, .vtk and others of meshio")
    said = io.StringIO()
    try:  # meshio prints its errors, and ends the process
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with np.errstate(all="ignore"):
                return meshio.read(path)
    except MemoryError:
        raise
    except (Exception, SystemExit) as error:
        text = said.getvalue().replace("Error: ", "") if isinstance(error, SystemExit) else str(error)
        reason = " ".join(text.split())[:200]
        raise ValueError(f"{name}: not a mesh that meshio reads: {reason or type(error).__name__}") from None


def _endings(path: Path) -> list[str]:
    """Return the last suffix of a file, the last two, and so on: .vtk, .xml.gz."""
    return ["".join(path.suffixes[k:]) for k in range(len(path.suffixes))]


def _elements_of(points: Floats, blocks: Sequence[Any], kind: Elements | None) -> tuple[Floats, Ints]:
    """Return points and elements of the blocks of cells that a file has."""
    count: dict[str, int] = {}
    for block in blocks:
        count[block.type] = count.get(block.type, 0) + len(block)
    found = ", ".join(f"{number:,} {name}" for name, number in count.items() if number) or "none"
    most = max((block.dim for block in blocks if len(block)), default=0)
    wanted = most if kind is None else 1 + get_args(Elements).index(kind)
    taken = [block for block in blocks if block.dim == wanted and len(block)]
    if not taken or wanted == 0:
        raise ValueError(f"the file has no {kind or 'bars, triangles or tetrahedra'}; its cells: {found}")
    allowed = _CELLS[get_args(Elements)[wanted - 1]]
    for block in taken:
        if block.type not in allowed:
            raise ValueError(f"cells of kind {block.type}: allowed: {' and '.join(allowed)}; its cells: {found}")
    rows = np.concatenate([_corners_of(block, points) for block in taken])
    return _used(points, rows)


def _used(points: Floats, rows: Ints) -> tuple[Floats, Ints]:
    """Return the points that belong to an element, and the elements with their new numbers."""
    used, numbers = np.unique(rows, return_inverse=True)
    return points[used], numbers.reshape(rows.shape)


def _corners_of(block: Any, points: Floats) -> Ints:
    """Return the corners of a block's elements, (E, k), with quadrilaterals in two."""
    corners = np.asarray(block.data, np.int64)
    for at in np.argwhere((corners < 0) | (corners >= len(points))):
        raise ValueError(f"{block.type} {at[0]} has a vertex {corners[tuple(at)]}; there are {len(points)}, from 0 on")
    if block.type != "quad":
        return corners
    across, along = (np.linalg.norm(points[corners[:, k]] - points[corners[:, k + 2]], axis=1) for k in (0, 1))
    turned = np.where((across <= along)[:, None], corners, np.roll(corners, -1, axis=1))  # cut from the first corner
    return turned[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


# --- points -------------------------------------------------------------------------------------------------------


def _placed(points: Floats, scale: float, rotate: Sequence[float], move: Sequence[float]) -> Floats:
    """Return points in m, (n, 3): scaled, then rotated, then moved; raise ValueError unless they are finite."""
    from scipy.spatial.transform import Rotation

    for name, value in {"scale": scale, "rotate": rotate, "move": move}.items():
        if not np.isfinite(np.asarray(value)).all():
            raise ValueError(f"{name} = {value}: must be finite")
    for k in np.flatnonzero(~np.isfinite(points).all(axis=1)):
        raise ValueError(f"vertex {k} = {tuple(points[k].tolist())}: must be finite")
    placed = np.zeros((len(points), 3))
    placed[:, : points.shape[1]] = points * scale
    if any(rotate):
        turn = Rotation.from_euler("xyz", rotate, degrees=True).as_matrix()
        placed = placed @ turn.round(15).T  # so that quarter turns are exact
    return np.asarray(placed + np.array(move, float))


def _merge(points: Floats, elements: Ints, distance: float | None) -> tuple[Floats, Ints]:
    """Return points and elements after points up to a distance apart have become the first of them.

    Elements of which corners become one are left out, and so are points that belong to no other element. Raises
    ValueError if no element is left, or if distance is None and points coincide.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    if distance is None:
        refuse_coincident(points)
        return points, elements
    if not np.isfinite(distance):
        raise ValueError(f"merge = {distance}: must be finite")
    near = KDTree(points).query_pairs(distance, output_type="ndarray")
    if not len(near):
        return points, elements
    links = coo_array((np.ones(len(near), bool), tuple(near.T)), shape=(len(points), len(points)))
    label = connected_components(links, directed=False)[1]
    _, first, which = np.unique(label, return_index=True, return_inverse=True)
    order = np.argsort(first)  # the numbers of points in the order of the file
    rows = np.argsort(order)[which][elements]
    ordered = np.sort(rows, axis=1)
    left = rows[(ordered[:, 1:] != ordered[:, :-1]).all(axis=1)]
    if not len(left):
        raise ValueError(f"merge = {distance:g}: corners of every element become one")
    return _used(points[first[order]], left)
