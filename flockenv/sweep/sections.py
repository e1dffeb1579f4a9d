"""The sections of a scene: functions that its generated file calls, made of what its parts say.

Each is made by a section of its own module, from as little of the parts as it depends on.
"""

from __future__ import annotations

from typing import Any

from flockenv.integrators.one_stage import OneStage
from flockenv.sweep.agents import AgentPlan, alone_of, still
from flockenv.sweep.blocks import into_blocks, out_of_blocks
from flockenv.sweep.bonds import bond_plan, bonds_of
from flockenv.sweep.far import far_of, far_plan
from flockenv.sweep.meeting import meet_neighbours
from flockenv.sweep.method import advance_of, method_plan
from flockenv.sweep.numbers import images_of, numbers_of
from flockenv.sweep.obstacle_plan import obstacle_plan
from flockenv.sweep.obstacles import obstacles_of
from flockenv.sweep.pair_plan import pairs_of
from flockenv.sweep.parts import Parts

__all__ = ["sections_of"]


def sections_of(parts: Parts) -> tuple[tuple[str, Any], ...]:
    """Return the functions that the generated file of a scene calls, with the names under which it finds them."""
    made: dict[str, Any] = {
        "numbers_of": numbers_of(parts.number_plan),
        "into_blocks": into_blocks(parts.dimension, parts.width),
        "out_of_blocks": out_of_blocks(parts.dimension, parts.width),
    }
    agent = AgentPlan(
        parts.dimension, parts.width, parts.oriented, parts.aims, "desired_speed" in parts.frame_numbers, parts.inner
    )
    made["alone"], made["alone_without_aim"] = alone_of(agent), alone_of(agent._replace(aims=False))
    made["still"] = still
    if parts.far:
        made["far"] = far_of(far_plan(parts))
    if parts.bonded:
        made["bonds"] = bonds_of(bond_plan(parts, agent))
    if isinstance(parts.integrator, OneStage):
        made["move"] = parts.integrator.move()
    else:
        made["advance_of"] = advance_of(parts.integrator.advance(), method_plan(parts))
    if parts.pairs:
        made["meet_neighbours"] = meet_neighbours(pairs_of(parts))
    for k, effect in enumerate(parts.effects):
        if parts.space.periodic and effect.places:
            made[f"images_of_{k}"] = images_of(tuple(parts.names_of(effect)), effect.places, parts.space.offset_law)
    if parts.folds_obstacles:
        made["meet_obstacles"] = obstacles_of(obstacle_plan(parts, agent))
    return tuple(made.items())
