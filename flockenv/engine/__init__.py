"""The kernel engine: composes the laws of a scene into one kernel, which numba compiles once and caches.

What is compiled depends only on which laws there are, on the space, the dimension and the integrator, and on which laws
share a sight; numbers are arguments. A law that the scene does not have costs nothing: no branch, no buffer, no query.

Agents lie side by side in blocks, as many as a vector register holds (16 with AVX-512, 8 without, in float64 half of
that). Every array of a world consists of blocks: the first coordinates of a block's agents, then their second ones, and
so on. So a loop over the lanes has a constant length and constant offsets, and compiles to straight vector code;
running sums lie in one small scratch array and stay in vector registers.

The files, from the whole to its parts: `entry_points` has what Python calls; `step` advances a world, by `respond` in
`accelerations` (the sum of all laws), the integrator's `method` and `move`. `neighbour_lists` sorts the agents and
walks through their blocks; a block interacts with its candidates in `pair_loop`, with all agents in `far_field`, with
its partners in `bonds`, and with obstacles in `obstacle_loop`. `observation_query` is what tasks add. `kernel_plan`
derives the plans from the laws of a scene. Each file holds sections (see `flockenv.jit.section`): a function
`thing_of(plan)` makes the function `thing`, and depends on as little as possible.
"""

from __future__ import annotations

from flockenv.engine.bonds import Table, pack
from flockenv.engine.context import Worlds, worlds_of
from flockenv.engine.entry_points import BeginPlan, begin_inner_of, begin_of, begin_plan, field_of, step_of
from flockenv.engine.kernel_plan import KernelPlan, Look, flatten_effects
from flockenv.engine.observation_query import look_of
from flockenv.engine.query_plan import LookPlan, plan_look
from flockenv.engine.scratch import OWN, TABLES, scratch_bytes, scratch_of, scratch_record
from flockenv.engine.step import StepPlan, step_plan, step_world_of

__all__ = [
    "OWN",
    "TABLES",
    "BeginPlan",
    "KernelPlan",
    "Look",
    "LookPlan",
    "StepPlan",
    "Table",
    "Worlds",
    "begin_inner_of",
    "begin_of",
    "begin_plan",
    "field_of",
    "flatten_effects",
    "look_of",
    "pack",
    "plan_look",
    "scratch_bytes",
    "scratch_of",
    "scratch_record",
    "step_of",
    "step_plan",
    "step_world_of",
    "worlds_of",
]  # fmt: skip
