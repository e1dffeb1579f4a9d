"""The sweep: composes the laws of a scene into one kernel of Python functions, which numba compiles once and keeps.

What is compiled depends only on which laws there are, in which space, dimension and integrator, and which of them see
the same neighbours; numbers are arguments. A law that is not listed leaves no trace: no branch, no buffer, no query.

Agents go side by side in blocks, as many as a vector register holds (16 with AVX-512, 8 without, in float64 half of
that), and every array of a world lies in blocks: the first coordinates of one, its second ones, and so on. So a loop
over the lanes has a constant length and constant offsets, and the compiler makes it straight vector code; running sums
lie in one small scratch array and stay in vector registers.

The files, from the whole to its parts: `entries` are what Python calls; `step` advances a world, by `respond` (what all
laws say), the integrator's `method` and `move`; `listing` sorts the agents and walks their blocks, `meeting` lets a
block meet its candidates, `far` all agents, `bonds` its partners, `obstacles` what stands around; `look` is what tasks
add. `parts` says what follows from which laws there are. Each file holds sections (see `flockenv.jit.section`): a
function `thing_of(plan)` makes the function `thing`, of as little as it depends on.
"""

from __future__ import annotations

from flockenv.engine.bonds import Table, pack
from flockenv.engine.context import Worlds, worlds_of
from flockenv.engine.entry_points import BeginPlan, begin_inner_of, begin_of, begin_plan, field_of, step_of
from flockenv.engine.kernel_plan import Look, Parts, flattened
from flockenv.engine.observation_query import look_of
from flockenv.engine.query_plan import LookPlan, plan_look
from flockenv.engine.scratch import GIVEN, OWN, scratch_bytes, scratch_of, scratch_record
from flockenv.engine.step import StepPlan, step_plan, step_world_of

__all__ = [
    "GIVEN",
    "OWN",
    "BeginPlan",
    "Look",
    "LookPlan",
    "Parts",
    "StepPlan",
    "Table",
    "Worlds",
    "begin_inner_of",
    "begin_of",
    "begin_plan",
    "field_of",
    "flattened",
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
