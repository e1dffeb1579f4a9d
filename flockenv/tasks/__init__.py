"""Tasks, one file each: scene, observations, rewards and episode ends."""

from __future__ import annotations

from flockenv.jit.startup import import_all

import_all(__name__, __path__)

from flockenv.tasks.bottleneck import Bottleneck  # noqa: E402
from flockenv.tasks.corridor import Corridor  # noqa: E402
from flockenv.tasks.crossing import Crossing  # noqa: E402
from flockenv.tasks.crowd_nav import CrowdNav  # noqa: E402
from flockenv.tasks.evade import Evade  # noqa: E402
from flockenv.tasks.flock import Flock  # noqa: E402
from flockenv.tasks.herd import Herd  # noqa: E402
from flockenv.tasks.layout import Layout, Slot, slots_of  # noqa: E402
from flockenv.tasks.obstacles import Obstacles  # noqa: E402
from flockenv.tasks.path_follow import PathFollow  # noqa: E402
from flockenv.tasks.pursuit import Pursuit  # noqa: E402
from flockenv.tasks.school import School  # noqa: E402
from flockenv.tasks.task import TASKS, Frame, Task  # noqa: E402  # after the folder has been walked

__all__ = [
    "TASKS",
    "Bottleneck",
    "Corridor",
    "Crossing",
    "CrowdNav",
    "Evade",
    "Flock",
    "Frame",
    "Herd",
    "Layout",
    "Obstacles",
    "PathFollow",
    "Pursuit",
    "School",
    "Slot",
    "Task",
    "slots_of",
]
