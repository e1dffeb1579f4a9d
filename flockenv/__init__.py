"""flockenv: steering agents, hand-written and learned, behind one interface and in one table.

Importing it registers the environments with Gymnasium and PettingZoo::

    gymnasium.make("flockenv/Pursuit-v0")
    gymnasium.make_vec("flockenv/Obstacles-v0", num_envs=64)
    pettingzoo.make("parallel", "flockenv/Flock-v1")

Everything else is imported on first use; importing flockenv alone imports neither torch nor matplotlib nor numba.
"""

# Signals first, as importing Gymnasium alone takes a third of a second: in a command, `early_signals` blocks them until
# `signals` handles them.
from flockenv.core import early_signals, signals, address_space  # isort: skip

address_space.require(early_signals.command())  # before the first thread and the first library that need a lot of it
signals.begin_early()
early_signals.release()

import importlib  # noqa: E402  # see above
from typing import TYPE_CHECKING, Any  # noqa: E402  # see above

from flockenv.envs.registration import register_all  # noqa: E402  # see above
from flockenv.envs.table import ENVIRONMENTS  # noqa: E402  # see above

if TYPE_CHECKING:
    from flockenv.envs.world import Step, World
    from flockenv.model.snapshot import Snapshot
    from flockenv.model.state import Body, State
    from flockenv.scene import Scene
    from flockenv.tasks import *  # noqa: F403  # the tasks, by the names of their classes
    from flockenv.tasks import TASKS, Task

__version__ = "0.1.0"
"""Version of the package, that of pyproject.toml."""

__all__ = ["TASKS", "Body", "Scene", "Snapshot", "State", "Step", "Task", "World", "__version__", *ENVIRONMENTS]

_HOME = {
    "Scene": "scene",
    "Snapshot": "model.snapshot",
    "Body": "model.state",
    "State": "model.state",
    "TASKS": "tasks",
    "Task": "tasks",
    "Step": "envs.world",
    "World": "envs.world",
    **dict.fromkeys(ENVIRONMENTS, "tasks"),
}
"""Public name -> the module that defines it, imported on first use (PEP 562)."""

register_all()


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'flockenv' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"flockenv.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME})
