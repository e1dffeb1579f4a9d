"""The `import-plan` command: a floor plan of another program as a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flockenv.core.errors import printable

__all__ = ["import_plan"]


def import_plan(
    plan: Annotated[
        str, typer.Argument(metavar="PLAN", help="GeoJSON or WKT, lines and areas, with coordinates in metres.")
    ],
    solid: Annotated[
        bool, typer.Option("--solid", help="Areas are solid. Otherwise agents are in them, and their holes are solid.")
    ] = False,
    thickness: Annotated[float, typer.Option(metavar="M", min=0, help="Thickness of lines in metres.")] = 0.0,
    scale: Annotated[
        float, typer.Option(metavar="X", min=1e-9, max=1e9, help="Factor on coordinates: 0.001 for millimetres.")
    ] = 1.0,
    agents: Annotated[int, typer.Option(metavar="N", min=1, help="Number of agents in the scene.")] = 20,
) -> None:
    """Print a scene whose obstacles are a floor plan, with agents: `flockenv import-plan plan.wkt > scene.yaml`."""
    from flockenv.scene.floor_plan import read_plan, scene_of, shapes_of
    from flockenv.scene.yaml_io import dump_scene

    geometry = read_plan(Path(plan), scale)
    try:
        scene = scene_of(shapes_of(geometry, solid, thickness), agents)
    except ValueError as error:
        raise ValueError(f"{printable(plan)[1:-1]}: {error}") from None
    print(dump_scene(scene, brief=True), end="")
