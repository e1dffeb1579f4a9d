"""Players from files: weights with their card, a Python file, or a zip of Stable-Baselines3.

A Python file offers one of these; if it offers several, the first counts:

* a function `player(task)` that returns a player;
* a class `Player`, which is built with the task, or with nothing;
* a function `predict`.

The file may also say what its player is: `kind = "rules"` (hand-written, the default), "policy", "hybrid" or "planner".

A player is an object with a method `predict`. Every `predict` takes SB3's four arguments (observation, state,
episode_start, deterministic) and returns (actions, state), or takes the observations alone and returns actions. If the
player has a method `watch`, `flockenv.evaluation.rollout` calls it with its World before the first decision, so that a
planner can see the state.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import inspect
import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flockenv.core.errors import printable_path
from flockenv.players.policy import MlpPolicy, Observation, Policy, State

if TYPE_CHECKING:
    from flockenv.tasks import Task

__all__ = ["SUFFIXES", "FilePlayer", "PlayerError", "load_file"]

SUFFIXES = (".safetensors", ".py", ".zip")

EXPECTED = (
    "a player file has a function player(task) or a class Player, whose player has predict(observation, state, "
    "episode_start, deterministic) or predict(observation), or such a function predict"
)


class PlayerError(ValueError):
    """Error in the code of a player file, or a file without a player; one line with the name of the file."""


def load_file(name: str, task: Task, seed: int = 0, trust_pickle: bool = False) -> Policy:
    """Return the player of a file whose name ends with one of SUFFIXES; raise ValueError if there is none."""
    suffix = Path(name).suffix.lower()
    if suffix == ".zip" and not trust_pickle:
        raise ValueError(
            f"player {printable_path(name)}: loading a Stable-Baselines3 zip executes the code stored in it; "
            "if the file is your own, pass --trust-pickle (trust_pickle=True)"
        )
    if not os.path.isfile(name):  # Path.is_file raises for a name that no file can have
        raise ValueError(f"player {printable_path(name)}: no such file")
    if suffix == ".safetensors":
        return MlpPolicy.load(name, task, seed)
    return _load_python(Path(name), task) if suffix == ".py" else _load_zip(Path(name))


def _load_zip(path: Path) -> Policy:
    # imported by name: only zips need stable-baselines3 and torch, and sb3.py is a layer above this file
    policy: Policy = importlib.import_module("flockenv.envs.sb3").load_sb3_zip(path, trust_pickle=True)
    return policy


def _load_python(path: Path, task: Task) -> FilePlayer:
    """Execute a player file and return its player."""
    module = _call_guarded(path, "while loading it", _execute, path)
    found = [name for name in ("player", "Player", "predict") if hasattr(module, name)]
    if not found:
        raise PlayerError(f"player {printable_path(path)}: offers none of player, Player, predict; {EXPECTED}")
    kind, offered = found[0], getattr(module, found[0])
    if not callable(offered):
        raise PlayerError(
            f"player {printable_path(path)}: {kind} is {_describe_type(offered)}, not a function; {EXPECTED}"
        )
    if kind == "predict":
        return FilePlayer(path, kind, offered, task.action_layout.size, _kind_of(module))
    arguments = (task,) if kind == "player" or _accepts(offered, 1) else ()
    if not _accepts(offered, len(arguments)):
        given = _describe_arguments(arguments)
        raise PlayerError(f"player {printable_path(path)}: {kind} cannot be called with {given}; {EXPECTED}")
    player = _call_guarded(path, f"in {kind}", offered, *arguments)
    if isinstance(player, type) or not callable(getattr(player, "predict", None)):
        what = _describe_type(player)
        raise PlayerError(f"player {printable_path(path)}: {kind} made {what} without a predict(); {EXPECTED}")
    name = f"{type(player).__name__}.predict"
    file_player = FilePlayer(path, name, player.predict, task.action_layout.size, _kind_of(module))
    if callable(getattr(player, "watch", None)):
        file_player.watch = player.watch
    return file_player


def _kind_of(module: Any) -> str:
    """Return what a player file says that its player is."""
    return str(getattr(module, "kind", "rules"))


def _execute(path: Path) -> Any:
    """Import a file under a name of its own, so that two players of the same file name stay apart."""
    name = f"flockenv_player_{hashlib.sha256(str(path.resolve()).encode()).hexdigest()[:16]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ImportError("not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickle look a class's module up there
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


class FilePlayer:
    """The `predict` of a player file: SB3's four arguments and a pair back, or observations in and actions out.

    Any exception of its code, also SystemExit, becomes a PlayerError: one line with the file, the line in it and the
    error. So do actions of another shape, or that are not finite.
    """

    def __init__(
        self, path: Path, name: str, function: Callable[..., Any], action_size: int, kind: str = "rules"
    ) -> None:
        self.kind = kind
        self.watch: Callable[[Any], None] = lambda world: None
        self.path, self._name, self._function, self._takes_all = path, name, function, _accepts(function, 4)
        self._action_size = action_size
        if not self._takes_all and not _accepts(function, 1):
            raise PlayerError(
                f"player {printable_path(path)}: {name} takes neither four arguments nor the observation alone; "
                f"{EXPECTED}"
            )

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], State | None]:
        """Return the file's actions for observations, (R, O) -> (R, A), and its state."""
        arguments = (observation, state, episode_start, deterministic) if self._takes_all else (observation,)
        answer = _call_guarded(self.path, f"in {self._name}", self._call_function, state, arguments)
        return answer[0], answer[1]

    def _call_function(self, state: State | None, arguments: tuple[Any, ...]) -> tuple[NDArray[Any], State | None]:
        answer = self._function(*arguments)
        if isinstance(answer, tuple) and len(answer) != 2:
            raise TypeError(f"returned {len(answer)} values, must be actions, or (actions, state)")
        actions, state = answer if isinstance(answer, tuple) else (np.asarray(answer, np.float32), state)
        actions, expected = np.asarray(actions), (*np.shape(arguments[0])[:-1], self._action_size)
        if actions.shape != expected:
            raise ValueError(f"actions of shape {actions.shape}, must be {expected}")
        if not np.isfinite(actions).all():
            raise ValueError("an action is not finite")
        return actions, state


def _call_guarded(path: Path, where: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """Call code of a player file; an exception becomes one line that names the file."""
    try:
        return function(*arguments)
    except (Exception, SystemExit) as error:
        description = f"{type(error).__name__} {where}{_line_in(path, error)}"
        text = " ".join(str(error).split()) if error.args != (None,) else ""  # exit() without a code
        raise PlayerError(f"player {printable_path(path)}: {description}{': ' + text if text else ''}") from error


def _line_in(path: Path, error: BaseException) -> str:
    """Return ", line N" with the last line of the file in an error's traceback; "" if there is none."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame.lineno for frame in frames if os.path.abspath(frame.filename) == os.path.abspath(path)]
    return f", line {own[-1]}" if own else ""


def _accepts(function: Callable[..., Any], count: int) -> bool:
    """Return True if a function accepts `count` arguments; also for built-in ones without a signature."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):
        return True
    try:
        signature.bind(*[None] * count)
    except TypeError:
        return False
    return True


def _describe_type(value: object) -> str:
    return f"the class {value.__name__}" if isinstance(value, type) else f"an object of type {type(value).__name__}"


def _describe_arguments(arguments: tuple[Any, ...]) -> str:
    return "the task" if arguments else "the task, nor without arguments"
