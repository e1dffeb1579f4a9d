"""The sweep: composes the laws of a scene into one small source file, which numba compiles once and keeps.

What is written depends only on which laws there are, in which space, dimension and integrator, and which of them see
the same neighbours; numbers are arguments. A law that is not listed leaves no trace: no branch, no buffer, no query.

Agents go side by side in blocks, as many as a vector register holds (16 with AVX-512, 8 without, in float64 half of
that), and every array of a world lies in blocks: the first coordinates of one, its second ones, and so on. So a loop
over the lanes has a constant length and constant offsets, and the compiler makes it straight vector code; running sums
lie in one small scratch array and stay in vector registers.

The files, as a source is put together: `parts` says what it depends on, `text` holds the smallest pieces of it;
`listing` sorts the agents and walks their blocks, `meeting` lets a block meet its candidates, `far` all agents, `bonds`
its partners; `accelerate` is the sum of all laws, `method` the integrator, `step` advances worlds by it, `source` is
the whole file, and `handed` leaves its functions the scratch that they name; `look` is what tasks add to it.
"""

from __future__ import annotations

from flockenv.sweep.bonds import Table, pack
from flockenv.sweep.look import look_of
from flockenv.sweep.look_plan import plan_look
from flockenv.sweep.parts import Look, Parts, flattened
from flockenv.sweep.scratch import GIVEN, OWN, scratch_bytes, scratch_of, scratch_record
from flockenv.sweep.sections import sections_of
from flockenv.sweep.source import field_source, scene_source

__all__ = [
    "GIVEN", "OWN", "Look", "Parts", "Table", "field_source", "flattened", "look_of", "pack", "plan_look",
    "scene_source", "scratch_bytes", "scratch_of", "scratch_record", "sections_of",
]  # fmt: skip
