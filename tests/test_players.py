"""Players by name and from files; an invalid player is refused in one line that names the file."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import typer
from typer.main import get_command

from agents import best_response, compare, transfer
from flockenv.cli import main
from flockenv.players import NAMES, WEIGHTS, load_player, other_tasks
from flockenv.players.policy import MlpPolicy
from flockenv.players.rules import PLAYERS
from flockenv.tasks import TASKS, Crossing, Flock, Pursuit, Task

TASK: Any = SimpleNamespace(name="toy", layout=SimpleNamespace(size=5), action_layout=SimpleNamespace(size=2))


# --- by name


@pytest.mark.filterwarnings("ignore:.*together = False, trained with True")
@pytest.mark.parametrize("name", sorted(TASKS))
def test_every_named_player_returns_actions_in_every_task_it_supports(name: str) -> None:
    task = TASKS[name]()
    rows = np.zeros((3, task.layout.size), np.float32)
    playing = [player for player in NAMES if not other_tasks(player, name)]
    for player in playing:
        action, _ = load_player(player, task).predict(rows, None, np.ones(3, np.bool_), True)
        assert action.shape == (3, task.action_layout.size) and np.isfinite(action).all()
    assert {"random", "textbook", "rules", "ppo"} <= set(playing)


def test_names_are_the_hand_written_players_random_and_ppo() -> None:
    assert set(NAMES) == {"random", "ppo", *PLAYERS}


def test_the_seed_determines_the_random_player() -> None:
    rows = np.zeros((2, Pursuit().layout.size), np.float32)
    a, b, c = (load_player("random", Pursuit(), seed).predict(rows)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert (a != c).any()


@pytest.mark.parametrize(
    ("name", "task", "message"),
    [
        ("rule", Pursuit(), "player 'rule': unknown, did you mean `rules`?; allowed: random, textbook, orca_publ"),
        ("reynolds", Pursuit(), "player 'reynolds': is called 'rules'; allowed: "),
        ("x", Pursuit(), "player 'x': unknown; allowed: "),
        ("weights.zip.old", Pursuit(), "ppo, or a .safetensors or .py or .zip file"),
        ("orca", Flock(), "no hand-written player 'orca' for 'flock'; there is one for: crossing, crowd_nav, corridor"),
        ("queueing", Crossing(), "no hand-written player 'queueing' for 'crossing'; there is one for: bottleneck"),
    ],
)
def test_unknown_or_unsuitable_names_are_refused_in_one_line(name: str, task: Task, message: str) -> None:
    with pytest.raises(ValueError, match="player") as caught:
        load_player(name, task)
    assert message in str(caught.value) and "\n" not in str(caught.value)


def test_importing_the_names_of_players_imports_neither_numba_nor_scipy() -> None:
    code = "import flockenv.players, sys; print({'numba', 'scipy'} & set(sys.modules), flockenv.players.NAMES[0])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set() random\n"


# --- from files


@pytest.mark.parametrize("name", ["a\0b.py", "a\0b.safetensors", "x" * 300 + ".py", "no/such.py", ".", "", "\x1b[2Jx"])
def test_hostile_names_are_refused_in_one_printable_line(name: str) -> None:
    with pytest.raises(ValueError, match="player ") as caught:
        load_player(name, TASK)
    assert str(caught.value).isprintable()
    assert len(str(caught.value)) < 500


def test_a_weights_file_loads_as_an_mlp_policy() -> None:
    path = WEIGHTS / "pursuit.safetensors"
    assert isinstance(load_player(str(path), Pursuit()), MlpPolicy)
    assert isinstance(load_player(path, Pursuit()), MlpPolicy)


HALF = "0.5 + 0 * observation[:, :2]"
FILES = {
    "short": f"""
def predict(observation):
    return {HALF}""",
    "whole": f"""
def predict(observation, state, episode_start, deterministic):
    return {HALF}, state""",
    "sb3": f"""
def predict(observation, state=None, episode_start=None, deterministic=False):
    return {HALF}, state""",
    "class": f"""
class Player:
    def predict(self, observation, *rest, **more):
        return {HALF}, None""",
    "class of a task": f"""
class Player:
    def __init__(self, task):
        assert task.name == "toy"
    def predict(self, observation, *rest, **more):
        return {HALF}, None""",
    "class, observation alone": f"""
class Player:
    def predict(self, observation):
        return {HALF}""",
    "factory": f"""
import dataclasses

@dataclasses.dataclass
class Half:
    name: str
    def predict(self, observation, *rest, **more):
        return {HALF}, None

def player(task):
    return Half(task.name)""",
}


@pytest.mark.parametrize("source", FILES.values(), ids=FILES)
def test_python_files_of_every_form_load_as_players(tmp_path: Path, source: str) -> None:
    path = tmp_path / "half.py"
    path.write_text(source)
    action, state = load_player(str(path), TASK).predict(np.zeros((3, 5), np.float32), None, None, True)
    np.testing.assert_array_equal(action, np.full((3, 2), 0.5))
    assert state is None


ANSWER = "return 0 * observation[:, :2]"
KIND = "a player file has a function player(task) or a class Player"
NO_PLAYER = {
    "x = 1": f"offers none of player, Player, predict; {KIND}",
    "def predict(:": "SyntaxError while loading it: invalid syntax",
    "import no_such_module_xyz": "ModuleNotFoundError while loading it, line 1: No module named 'no_such_module_xyz'",
    "\0": "while loading it",
    "1 / 0": "ZeroDivisionError while loading it, line 1: division by zero",
    "exit()": "SystemExit while loading it, line 1",
    "import sys\nsys.exit('enough')": "SystemExit while loading it, line 2: enough",
    "class P:\n    def predict(self, o): pass\nplayer = P()": f"player is an object of type P, not a function; {KIND}",
    "predict = 3": f"predict is an object of type int, not a function; {KIND}",
    "Player = 'me'": f"Player is an object of type str, not a function; {KIND}",
    "def player(): pass": f"player cannot be called with the task; {KIND}",
    "def player(task):\n    return 3": f"player made an object of type int without a predict(); {KIND}",
    "def player(task): pass": f"player made an object of type NoneType without a predict(); {KIND}",
    "def player(task):\n    return Half\nclass Half:\n    def predict(self, o): pass": "player made the class Half",
    "def player(task):\n    raise KeyError('no')": "KeyError in player, line 2: 'no'",
    "def player(task):\n    exit(0)": "SystemExit in player, line 2: 0",
    "class Player:\n    pass": f"Player made an object of type Player without a predict(); {KIND}",
    "class Player:\n    predict = 3": f"Player made an object of type Player without a predict(); {KIND}",
    "class Player:\n    def __init__(self, a, b): pass": "Player cannot be called with the task, nor without arguments",
    "class Player:\n    def predict(self): pass": "Player.predict takes neither four arguments nor",
    "class Player:\n    def predict(self, a, b): pass": "Player.predict takes neither four arguments nor",
    "def predict(): pass": f"predict takes neither four arguments nor the observation alone; {KIND}",
}


@pytest.mark.parametrize("source", NO_PLAYER)
def test_python_files_without_a_player_are_refused_at_load(tmp_path: Path, source: str) -> None:
    path = tmp_path / "half.py"
    path.write_text(source)
    with pytest.raises(ValueError, match="player") as caught:
        load_player(path, TASK)
    assert NO_PLAYER[source] in str(caught.value)
    assert str(caught.value).isprintable() and str(caught.value).startswith("player '")


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ("return observation[0, 99]", "IndexError in predict, line 2: index 99 is out of bounds"),
        ("exit(3)", "SystemExit in predict, line 2: 3"),
        ("exit()", "SystemExit in predict, line 2"),
        ("raise ValueError('two\\nlines')", "ValueError in predict, line 2: two lines"),
        ("return observation", "ValueError in predict: actions of shape (3, 5), must be (3, 2)"),
        ("return None", "ValueError in predict: actions of shape (), must be (3, 2)"),
        ("return float('nan') * observation[:, :2]", "ValueError in predict: an action is not finite"),
        ("return 1, 2, 3", "TypeError in predict: returned 3 values, must be actions, or (actions, state)"),
    ],
)
def test_a_failure_in_predict_raises_one_line_that_names_the_file(tmp_path: Path, body: str, message: str) -> None:
    path = tmp_path / "half.py"
    path.write_text(f"def predict(observation):\n    {body}")
    player = load_player(path, TASK)
    with pytest.raises(ValueError, match="player") as caught:
        player.predict(np.zeros((3, 5), np.float32))
    assert str(caught.value).startswith(f"player {os.fspath(path)!r}: {message}") and "None" not in str(caught.value)


def test_a_keyboard_interrupt_in_a_player_file_is_not_converted(tmp_path: Path) -> None:
    path = tmp_path / "half.py"
    path.write_text("def predict(observation):\n    raise KeyboardInterrupt")
    with pytest.raises(KeyboardInterrupt):
        load_player(path, TASK).predict(np.zeros((3, 5), np.float32))


def test_two_files_of_one_name_are_two_players(tmp_path: Path) -> None:
    for folder, value in (("a", 0.25), ("b", 0.75)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "p.py").write_text(f"def predict(o):\n    return {value} + 0 * o[:, :2]")
    a, b = (load_player(tmp_path / folder / "p.py", TASK) for folder in "ab")
    rows = np.zeros((1, 5), np.float32)
    assert a.predict(rows)[0][0, 0] == 0.25
    assert b.predict(rows)[0][0, 0] == 0.75


def test_a_zip_is_loaded_only_with_trust_pickle(tmp_path: Path) -> None:
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    from flockenv.envs.sb3 import WorldVecEnv

    path = tmp_path / "model.zip"
    model = stable_baselines3.PPO("MlpPolicy", WorldVecEnv(Pursuit(), 1), n_steps=2, batch_size=2, device="cpu")
    model.save(path)
    with pytest.raises(ValueError, match=r"executes the code stored in it; .* --trust-pickle"):
        load_player(path, Pursuit())
    rows = np.zeros((2, Pursuit().layout.size), np.float32)
    action, _ = load_player(path, Pursuit(), trust_pickle=True).predict(rows, deterministic=True)
    np.testing.assert_array_equal(action, model.predict(rows, deterministic=True)[0])


@pytest.mark.parametrize(
    "app",
    [main.app, compare.app, best_response.app, transfer.app],
    ids=["flockenv", "compare", "best_response", "transfer"],
)
def test_every_command_with_players_has_the_option_trust_pickle(app: typer.Typer) -> None:
    commands = getattr(get_command(app), "commands", {"": get_command(app)})
    options = [{option for p in command.params for option in p.opts} for command in commands.values()]
    playing = [each for each in options if each & {"--player", "--players"}]
    assert playing and all("--trust-pickle" in each for each in playing)
