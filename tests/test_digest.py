"""Digest of machine code: it covers the sources of all functions in a kernel, and of the records passed to them."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path

import pytest

from flockenv.engine import Worlds, step_of
from flockenv.engine.context import Context
from flockenv.jit.decorators import IN_PYTHON
from flockenv.jit.sources import functions_in, sources_of_code
from flockenv.physics.effects.effect import Far, Me, Members, Obstacle, Other
from flockenv.tasks import TASKS
from flockenv.tasks.play import play_of
from flockenv.tasks.task import Frame
from tests.catalogue import everything


@pytest.mark.skipif(IN_PYTHON, reason="nothing is compiled")
def test_digest_covers_the_source_of_every_function_and_record_of_a_kernel() -> None:
    covered = {path for path, _ in sources_of_code()}
    entries = [
        step_of(everything(2).parts),
        step_of(everything(3).parts),
        *(play_of(kind()) for kind in TASKS.values()),
    ]
    functions = {f for make, plan in (e.made_of for e in entries) for f in functions_in(make(*plan))}  # type: ignore[attr-defined]
    modules = {f.__module__ for f in functions} | {
        record.__module__ for record in (Context, Far, Frame, Me, Members, Obstacle, Other, Worlds)
    }
    used = {Path(inspect.getsourcefile(sys.modules[m]) or "") for m in modules if m.startswith("flockenv")}
    assert len(used) > 30
    assert not used - covered
