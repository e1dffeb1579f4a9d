"""Common parts of all environment APIs: spaces, seeds, options and pictures."""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box
from numpy.typing import NDArray

from flockenv.core.errors import nearest
from flockenv.envs.disturbance import Disturbance
from flockenv.tasks import Task

if TYPE_CHECKING:
    from flockenv.model.snapshot import Snapshot
    from flockenv.render import Window

__all__ = [
    "RENDER_MODES",
    "ByAgent",
    "Rows",
    "Screen",
    "action_space",
    "build",
    "check_ends_together",
    "check_options",
    "check_seed",
    "iterate_by_name",
    "observation_space",
    "render_fps",
    "require_episode",
    "reward_keys",
]

Rows = NDArray[Any]
RENDER_MODES = ("human", "rgb_array")
DISPLAYED = 256
"""Number of agents up to which code is generated for dictionaries by agent; compiling takes 1 ms per 12 agents."""
SEEDS = 2**63
"""Seeds are 0 ... 2**63 - 1, so that they fit the int64 arrays of a vector env's infos."""


def build(
    task_type: type[Task], parameters: Mapping[str, Any], limit: str, own: Sequence[str] = ()
) -> tuple[Task, Disturbance]:
    """Make a task and its disturbance from the keyword arguments of an environment.

    An argument with the name of a field of both is the task's. limit: the environment's name for its time limit. The
    task's `horizon` is rejected, as two limits could disagree. own: the environment's other arguments, candidates for a
    misspelt name.

    Raises TypeError for an unknown name, with Python's own message, which TorchRL and others match.
    """
    disturbing = [name for name in Disturbance.model_fields if name not in task_type.model_fields]
    allowed = [*(name for name in task_type.model_fields if name != "horizon"), *disturbing, *own]
    unknown = next((name for name in parameters if name not in allowed), None)
    if unknown is not None:
        reason = f": the time limit is `{limit}` here" if unknown == "horizon" else nearest(unknown, allowed)
        raise TypeError(
            f"{task_type.__name__}() got an unexpected keyword argument {unknown!r}{reason}; "
            f"allowed: {', '.join(allowed)}"
        )
    disturbance = Disturbance(**{name: parameters[name] for name in disturbing if name in parameters})
    return task_type(**{name: value for name, value in parameters.items() if name not in disturbing}), disturbance


def check_ends_together(task: Task) -> Task:
    """Return the task; ValueError if its learners end one by one, as a row would have no meaning after its end."""
    if not task.ends_together:
        raise ValueError(
            f"{task.name}: its learners leave one by one, but rows of a vector environment end together; "
            "use pettingzoo.make('parallel', ...), or a task in which all learners end together"
        )
    return task


def observation_space(task: Task) -> Box:
    """Return the space of one learner's observation, (O,) float32."""
    return Box(np.asarray(task.layout.low, np.float32), np.asarray(task.layout.high, np.float32), dtype=np.float32)


def action_space(task: Task) -> Box:
    """Return the space of one learner's action, (A,) float32 in [-1, 1]."""
    return Box(-1.0, 1.0, (task.action_layout.size,), np.float32)


def reward_keys(task: Task) -> tuple[str, ...]:
    """Return the key of each reward term in an info: `reward/` plus its name.

    Infos are flat: many clients turn each value into a tensor, and loggers group by the part before the slash.
    """
    return tuple(f"reward/{name}" for name in task.terms)


def iterate_by_name(names: Sequence[str], rows: Rows) -> Iterator[dict[str, float]]:
    """Return an iterator over dictionaries, by name, of the rows of numbers (R, K).

    Columns become lists, and rows are made one at a time: a list for each row would trigger the garbage collector.
    """
    return map(_dict_maker(*names), *rows.T.tolist())


@functools.cache
def _dict_maker(*names: str) -> Callable[..., dict[str, float]]:
    """Return a function of K numbers that makes a dictionary; a dict display takes half the time of dict(zip(...))."""
    numbers = [f"n{k}" for k in range(len(names))]
    make_dict: Callable[..., dict[str, float]] = eval(f"lambda {', '.join(numbers)}: {_dict_source(names, numbers)}")  # noqa: S307  # reprs alone
    return make_dict


def _dict_source(names: Iterable[str], values: Iterable[str]) -> str:
    """Return the source of a dict display with the source of a value for each name."""
    return f"{{{', '.join(f'{str.__str__(name)!r}: {value}' for name, value in zip(names, values, strict=True))}}}"


class ByAgent:
    """Makes the dictionaries of a step, keyed by agent name, in its method `of`.

    `keys` are those of the reward terms in an info. `of(seen, paid, over, late, terms, success)` takes observations
    (L, O), rewards and terminations as lists of L, one truncation for all, each of the K reward terms as a list of L,
    and the success. It returns observations, rewards, terminations, truncations and infos by agent.

    For up to DISPLAYED agents its code is generated, with a dict display for each dictionary: this takes three quarters
    of the time.
    """

    def __init__(self, keys: Sequence[str], agents: Sequence[str]) -> None:
        self._arguments = tuple(keys), tuple(agents)
        self.of: Callable[..., tuple[dict[str, Any], ...]] = _compile_by_agent(*self._arguments)

    def __reduce__(self) -> tuple[type[ByAgent], tuple[tuple[str, ...], tuple[str, ...]]]:
        return ByAgent, self._arguments


@functools.lru_cache(64)
def _compile_by_agent(keys: tuple[str, ...], agents: tuple[str, ...]) -> Callable[..., tuple[dict[str, Any], ...]]:
    def info(numbers: Iterable[str]) -> str:
        return _dict_source((*keys, "is_success"), (*numbers, "success"))

    if len(agents) <= DISPLAYED:
        many = range(len(agents))
        lists = {"s": "seen", "r": "paid", "o": "over"} | {f"t{k}_": f"terms[{k}]" for k in range(len(keys))}
        each = {one: [f"{one}{i}" for i in many] for one in lists}
        lines = [f"{', '.join(each[one])}, = {target}" for one, target in lists.items()]
        infos = [info(each[f"t{k}_"][i] for k in range(len(keys))) for i in many]
        columns = (each["s"], each["r"], each["o"], ["late"] * len(agents), infos)
        lines += [f"return {', '.join(_dict_source(agents, values) for values in columns)}"]
    else:
        numbers = [f"n{k}" for k in range(len(keys))]
        infos_source = f"{{agent: {info(numbers)} for agent, {', '.join(numbers)} in zip(agents, *terms, strict=True)}}"
        target = ", ".join(f"dict(zip(agents, {what}, strict=True))" for what in ("seen", "paid", "over"))
        lines = [f"return {target}, dict.fromkeys(agents, late), {infos_source}"]
    namespace: dict[str, Any] = {"agents": agents}
    exec("def of(seen, paid, over, late, terms, success):\n " + "\n ".join(lines), namespace)  # noqa: S102  # reprs alone
    return namespace["of"]  # type: ignore[no-any-return]


def render_fps(task: Task) -> int:
    """Return the frames per second at which a replay runs in real time: one frame per decision."""
    return max(1, round(1.0 / task.control_dt))


def check_seed(seed: Any) -> int | None:
    """Return the seed as an int, or None; TypeError if it is not an integer, ValueError outside 0 ... 2**63 - 1."""
    if seed is None:
        return None
    try:
        number = operator.index(seed)
    except TypeError:
        number = None
    if number is None or isinstance(seed, bool | np.bool_):
        raise TypeError(f"seed: {seed!r} is not an integer; allowed: 0 to 2**63 - 1, or None for a random one")
    if not 0 <= number < SEEDS:
        raise ValueError(f"seed: {number} is out of range; allowed: 0 to 2**63 - 1, or None for a random one")
    return number


def check_options(options: Mapping[str, Any] | None, known: Iterable[str] = ()) -> Mapping[str, Any]:
    """Return the options of a reset; ValueError for a name not in `known`, with the nearest known name."""
    if options is None:
        return {}
    if not isinstance(options, Mapping):
        raise TypeError(f"options: {options!r}, must be a dictionary or None")
    known = list(known)
    unknown = [name for name in options if name not in known]
    if unknown:
        suggestion = nearest(str(unknown[0]), known)
        raise ValueError(f"options: {unknown[0]!r} is unknown{suggestion}; allowed: {', '.join(known) or 'none'}")
    return options


def require_episode(running: bool, call: str) -> None:
    """Raise ResetNeeded for a step or a picture of an environment that was not reset, or was closed."""
    if not running:
        raise ResetNeeded(f"{call}: there is no episode; call reset() first")


class Screen:
    """Shows a world in one render mode; a window opens with the first frame.

    Args:
        mode: "human" (a window), "rgb_array" ((H, W, 3) uint8, headless) or None.
        fps: frames per second of the window.
        modes: the modes of this environment.
    """

    def __init__(self, mode: str | None, fps: int, modes: tuple[str, ...] = RENDER_MODES) -> None:
        if mode is not None and mode not in modes:
            raise ValueError(
                f"render_mode: {mode!r} is unknown{nearest(str(mode), modes)}; allowed: {', '.join(modes)}"
            )
        self.mode, self.fps = mode, fps
        self._window: Window | None = None

    def show(self, snapshot: Snapshot, mode: str | None = None) -> NDArray[np.uint8] | None:
        """Draw one instant, in `mode` if given; return the picture, or show it in the window and return None."""
        from flockenv.render import Window, draw

        mode = mode or self.mode
        if mode == "rgb_array":
            return draw(snapshot)
        if mode == "human":
            self._window = self._window or Window()
            self._window.show(draw(snapshot), self.fps)
        return None

    def close(self) -> None:
        """Close the window, if there is one; may be called twice."""
        if self._window is not None:
            self._window.close()
            self._window = None

    def __getstate__(self) -> dict[str, Any]:
        # A window belongs to its process: a copy opens its own.
        return {**self.__dict__, "_window": None}
