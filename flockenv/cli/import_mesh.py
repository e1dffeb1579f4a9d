"""The `import-mesh` command: a mesh of another program as a network in a scene."""

from __future__ import annotations

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
) -> None:
    """Print a scene in which a mesh falls on a floor: `flockenv import-mesh bunny.obj > scene.yaml`."""
    from flockenv.scene.mesh_file import mesh_of, read_mesh, scene_of
    from flockenv.scene.yaml_io import MAX_BYTES, dump_scene

    points, cells = read_mesh(Path(mesh), elements)
    try:
        network = mesh_of(points, cells, scale, rotate, move, merge, dimension, closed)
        rows = network.elements(dimension).tolist()
        if len(str(network.vertices)) + len(str(rows)) > MAX_BYTES:  # known before a scene is made, which takes long
            raise ValueError(
                f"{network.size:,} vertices and {len(rows):,} elements are too many for a scene file of {MAX_BYTES:,} "
                "bytes: simplify it"
            )
        text = dump_scene(scene_of(network), brief=True)
    except ValueError as error:
        raise ValueError(f"{printable(mesh)[1:-1]}: {error}") from None
    print(text, end="")
