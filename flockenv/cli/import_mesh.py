"""The `import-mesh` command: a mesh of another program as a network, or an obstacle, in a scene."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

from flockenv.core.errors import printable

__all__ = ["import_mesh"]

Three = tuple[float, float, float]


def import_mesh(
    mesh: Annotated[
        str,
        typer.Argument(metavar="MESH", help="OBJ, PLY, STL, MSH, VTK or another format of meshio (extra `mesh`)."),
    ],
    elements: Annotated[
        Literal["bars", "triangles", "tetrahedra"] | None,
        typer.Option(
            help="Cells of the file that are taken.", show_default="those of the most dimensions: tetrahedra first"
        ),
    ] = None,
    scale: Annotated[
        float, typer.Option(metavar="X", min=1e-9, max=1e9, help="Factor on coordinates: 0.001 for millimetres.")
    ] = 1.0,
    rotate: Annotated[
        Three, typer.Option(metavar="X Y Z", help="Degrees about the x axis, then y, then z; after the scale.")
    ] = (0.0, 0.0, 0.0),
    move: Annotated[Three, typer.Option(metavar="X Y Z", help="Metres, after the rotation.")] = (0.0, 0.0, 0.0),
    merge: Annotated[
        float | None,
        typer.Option(
            metavar="M", min=0, help="Vertices up to M metres apart become one.", show_default="refuse two in one place"
        ),
    ] = None,
    dimension: Annotated[
        int, typer.Option(metavar="2|3", min=2, max=3, help="2: a flat mesh, without its third coordinate.")
    ] = 3,
    closed: Annotated[bool, typer.Option("--closed", help="Refuse a surface with a hole.")] = False,
    obstacle: Annotated[
        bool, typer.Option("--obstacle", help="A closed surface of triangles as a solid obstacle, on which balls fall.")
    ] = False,
    spacing: Annotated[
        float | None,
        typer.Option(
            metavar="M", min=1e-9, help="Of the obstacle's grid of distances.", show_default="a fortieth of its extent"
        ),
    ] = None,
    repair: Annotated[
        bool,
        typer.Option(
            "--repair",
            help="With --obstacle or --closed: merge points, turn triangles outwards and fill small holes, by trimesh.",
        ),
    ] = False,
) -> None:
    """Print a scene in which a mesh falls on a floor: `flockenv import-mesh bunny.obj > scene.yaml`."""
    from flockenv.scene.mesh_file import mesh_of, obstacle_of, obstacle_scene_of, read_mesh, scene_of
    from flockenv.scene.mesh_repair import repair_surface
    from flockenv.scene.yaml_io import dump_scene

    if obstacle and (dimension == 2 or elements not in (None, "triangles")):
        raise ValueError("--obstacle: is a surface of triangles in 3-D; leave out --dimension and --elements")
    if spacing is not None and not obstacle:
        raise ValueError("--spacing: is of the grid of an obstacle; add --obstacle")
    if repair and not (obstacle or closed):
        raise ValueError("--repair: is of closed surfaces, as it fills holes; add --obstacle or --closed")
    points, cells = read_mesh(Path(mesh), "triangles" if obstacle or repair else elements)
    try:
        if repair:
            points, cells, report = repair_surface(points, cells)
            print(f"import-mesh: {report}", file=sys.stderr)
        if obstacle:
            solid = obstacle_of(points, cells, spacing, scale, rotate, move, merge)
            _refuse_many(solid.vertices, solid.triangles)
            scene = obstacle_scene_of(solid)
        else:
            network = mesh_of(points, cells, scale, rotate, move, merge, dimension, closed)
            _refuse_many(network.vertices, network.elements(dimension).tolist())
            scene = scene_of(network)
        text = dump_scene(scene, brief=True)
    except ValueError as error:
        raise ValueError(f"{printable(mesh)[1:-1]}: {error}") from None
    print(text, end="")


def _refuse_many(vertices: Sequence[object], rows: Sequence[object]) -> None:
    """Raise ValueError if a scene file has no room for a mesh: known before a scene is made, which takes long."""
    from flockenv.scene.yaml_io import MAX_BYTES

    if len(str(vertices)) + len(str(rows)) > MAX_BYTES:
        raise ValueError(
            f"{len(vertices):,} vertices and {len(rows):,} elements are too many for a scene file of {MAX_BYTES:,} "
            "bytes: simplify it"
        )
