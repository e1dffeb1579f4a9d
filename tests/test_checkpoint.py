"""Checkpoints: resumed trainings equal uninterrupted ones bit for bit; damaged files are refused in one line."""

from __future__ import annotations

import json
import os
import pickle
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from safetensors.numpy import save
from typer.testing import CliRunner

from agents import checkpoint as files
from agents import ppo
from agents.checkpoint import FILE, CheckpointParts, Damaged, InUse, claim, digest
from agents.divergence import LearningDiverged
from agents.experiment import CONFIGS, Experiment
from agents.run import load_checkpoint, save_checkpoint
from benchmarks import kills
from flockenv.core.atomic_files import LEFTOVERS
from flockenv.core.output_paths import check_room
from flockenv.envs.sb3 import WorldVecEnv
from flockenv.envs.world import World
from flockenv.players.policy import MlpPolicy
from tests.training import PURSUIT, SCHOOL, TINY, interrupt

LARGEST = 2**26
TWO_THREADS = PURSUIT.model_copy(update={"ppo": PURSUIT.ppo.model_copy(update={"threads": 2})})


def parts_in(folder: Path) -> CheckpointParts:
    parts = files.read(folder, LARGEST)
    assert parts is not None
    return parts


def same_training(one: Path, other: Path) -> None:
    """Assert that two trainings left equal checkpoints, except for times."""
    mine, its = parts_in(one), parts_in(other)
    for part, name in [(p, name) for p, tensors in mine.items() if p != files.TIMES for name in tensors]:
        np.testing.assert_array_equal(mine[part][name], its[part][name], f"{part}/{name}")
    assert digest(mine) == digest(its)


# --- resumed = uninterrupted ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Experiment], Path]:
    """Return a function that returns the folder of an uninterrupted training."""
    trained: dict[str, Path] = {}

    def of(experiment: Experiment) -> Path:
        key = repr(experiment)
        if key not in trained:
            trained[key] = tmp_path_factory.mktemp("whole")
            ppo.train(experiment, trained[key])
        return trained[key]

    return of


@pytest.mark.parametrize(
    ("experiment", "points"),
    [
        *(pytest.param(PURSUIT, k, id=f"pursuit-{k}") for k in range(4)),
        *(pytest.param(SCHOOL, k, id=f"school-{k}", marks=pytest.mark.slow) for k in range(4)),
        pytest.param(TWO_THREADS, 1, id="two threads", marks=pytest.mark.slow),
    ],
)
def test_resumed_training_equals_the_uninterrupted_one(
    tmp_path: Path, whole: Callable[[Experiment], Path], experiment: Experiment, points: int
) -> None:
    interrupt(experiment, tmp_path, points)
    begun = load_checkpoint(experiment, tmp_path)
    assert begun is not None and begun.steps < experiment.ppo.steps and len(begun.curve) <= points
    run = ppo.train(experiment, tmp_path, go_on=True)
    same_training(tmp_path, whole(experiment))
    assert run.resumed == []


@pytest.mark.parametrize(
    ("owner", "name", "call"),
    [(torch.optim.Adam, "step", 9), (World, "step", 40), (WorldVecEnv, "step_wait", 17), (files, "write", 2)],
    ids=["in an update", "while a world acts", "in a rollout", "before a checkpoint is written"],
)
def test_interrupted_training_resumes_from_the_last_rollout(
    tmp_path: Path, whole: Callable[[Experiment], Path], owner: Any, name: str, call: int
) -> None:
    original, calls = getattr(owner, name), 0

    def interrupted(*given: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call:
            raise KeyboardInterrupt
        return original(*given, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(owner, name, interrupted)
        with pytest.raises(KeyboardInterrupt):
            ppo.train(PURSUIT, tmp_path)
    ppo.train(PURSUIT, tmp_path, go_on=True)
    same_training(tmp_path, whole(PURSUIT))


def test_training_can_be_resumed_many_times(tmp_path: Path, whole: Callable[[Experiment], Path]) -> None:
    measure, at = ppo.score, 0

    def interrupted(*given: Any) -> tuple[float, float]:
        nonlocal at
        at += 1
        if at % 2:
            raise KeyboardInterrupt
        return measure(*given)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ppo, "score", interrupted)
        for _ in range(8):
            with pytest.raises(KeyboardInterrupt):
                ppo.train(PURSUIT, tmp_path, go_on=True)
    ppo.train(PURSUIT, tmp_path, go_on=True)
    same_training(tmp_path, whole(PURSUIT))


@pytest.mark.slow
def test_killed_trainings_end_equal_to_uninterrupted_ones() -> None:
    command = [sys.executable, "-m", "benchmarks.kills", "--times", "20"]
    done = subprocess.run(command, cwd=CONFIGS.parent.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "20 kills" in done.stdout and "0 ended otherwise, 0 resumptions were refused" in done.stdout


def test_kills_are_spread_over_several_trainings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a busy machine every kill may come before any progress: one training took 151 of 200 kills."""

    class Life:
        exitcode = 0

        def join(self) -> None:
            pass

    class TrainingServer:
        def begin(self, *given: object) -> Life:
            return Life()

        def run_undisturbed(self, *given: object) -> tuple[float, str]:
            return 1.0, "digests"

    monkeypatch.setattr(kills, "TrainingServer", TrainingServer)
    monkeypatch.setattr(kills, "_kill", lambda *given: True)
    monkeypatch.setattr(kills, "digests", lambda folder: "digests")
    count = kills.kill_and_resume(20, 0, tmp_path)
    assert (count.kills, count.same, count.different, count.refused) == (20, 3, [], [])


def test_worlds_restored_from_arrays_continue_bit_for_bit() -> None:
    task = SCHOOL.build()
    one, other = World(task, 3, task.horizon), World(task, 3, task.horizon)
    with pytest.raises(RuntimeError, match="before the first reset"):
        one.arrays()
    one.reset(5), other.reset(70)
    rng = np.random.default_rng(0)
    actions = rng.uniform(-1, 1, (12, 3, task.learners, 2))
    for action in actions[:5]:
        ended = one.step(action).ended
        one.reset(mask=ended)
    kept = {name: array.copy() for name, array in one.arrays().items()}
    other.restore(kept)
    for action in actions[5:]:
        for mine, its in zip(one.step(action), other.step(action), strict=True):
            np.testing.assert_array_equal(mine, its)
        np.testing.assert_array_equal(one.reset(), other.reset())
    for wrong, message in (
        ({**kept, "spin": kept["steps"]}, "'spin' is unknown"),
        ({k: v for k, v in kept.items() if k != "paid"}, "'paid' is missing"),
        ({**kept, "steps": kept["steps"][:2]}, r"'steps' is \(2,\) of int64, expected \(3,\) of int64"),
        ({**kept, "state.x": kept["state.x"].astype(np.float16)}, r"'state.x' is .* of float16, expected"),
    ):
        with pytest.raises(ValueError, match=message):
            other.restore(wrong)


# --- damaged files ----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def begun(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a checkpoint and the config of its training."""
    folder = tmp_path_factory.mktemp("begun")
    interrupt(PURSUIT, folder / "runs" / "pursuit", 2)
    settings = {"task": "pursuit", "ppo": {**TINY, "steps": 1024}}
    (folder / "pursuit.yaml").write_text(yaml.safe_dump(settings), encoding="utf-8")
    return folder


@pytest.fixture
def copied(tmp_path: Path, begun: Path) -> Path:
    shutil.copytree(begun, tmp_path, dirs_exist_ok=True)
    return tmp_path


def command(folder: Path, *more: str) -> Any:
    given = [str(folder / "pursuit.yaml"), "--runs", str(folder / "runs"), "--out", str(folder / "p.safetensors")]
    return CliRunner().invoke(ppo.app, [*given, *more])


def refused(folder: Path, message: str) -> None:
    """Resume, and assert that it is refused in one line that contains the message, without a change of files."""
    path = folder / "runs" / "pursuit" / FILE
    before = path.read_bytes() if path.is_file() and path.stat().st_size < LARGEST else None
    result = command(folder, "--resume")
    assert result.exit_code == 2, (result.output, result.exception)
    assert result.stderr.startswith(f"error: the checkpoint in {path.parent} is damaged: "), result.stderr
    assert message in result.stderr and result.stderr.count("\n") == 1 and len(result.stderr) < 600
    assert before is None or path.read_bytes() == before
    assert {path.name for path in folder.iterdir()} == {"pursuit.yaml", "runs"}


def changed(change: Callable[[CheckpointParts], Any]) -> Callable[[Path], None]:
    """Return a function that changes a checkpoint and rewrites it with valid digests."""

    def write(folder: Path) -> None:
        parts = parts_in(folder)
        change(parts)
        files.write(folder, parts)

    return write


def noted(**changes: Any) -> Callable[[Path], None]:
    """Return a function that changes the notes of a checkpoint; the value "gone" removes a key."""

    def change(parts: CheckpointParts) -> None:
        notes = {**json.loads(parts["notes"]["json"].tobytes()), **changes}
        text = json.dumps({key: value for key, value in notes.items() if value != "gone"})
        parts["notes"] = {"json": np.frombuffer(text.encode(), np.uint8)}

    return changed(change)


def bytes_in(content: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return lambda folder: (folder / FILE).write_bytes(content((folder / FILE).read_bytes()))  # type: ignore[func-returns-value]


def as_bytes(text: str) -> dict[str, Any]:
    return {"json": np.frombuffer(text.encode(), np.uint8)}


def tensor(part: str, name: str, value: Callable[[Any], Any]) -> Callable[[Path], None]:
    def change(parts: CheckpointParts) -> None:
        parts[part][name] = value(parts[part][name].copy())

    return changed(change)


def with_nan(array: Any) -> Any:
    array.flat[3] = np.nan
    return array


def sparse(folder: Path) -> None:
    os.truncate(folder / FILE, 5 * 2**29)


def a_folder(folder: Path) -> None:
    (folder / FILE).unlink()
    (folder / FILE).mkdir()


def foreign(folder: Path) -> None:
    (folder / FILE).write_bytes(save({"x": np.zeros(3)}, {"format": "pt"}))


def pickled(folder: Path) -> None:
    (folder / FILE).write_bytes(pickle.dumps({"steps": 3}))


DAMAGES: dict[str, tuple[Callable[[Path], Any], str]] = {
    "empty": (bytes_in(lambda data: b""), f"{FILE}: "),
    "cut by a byte": (bytes_in(lambda data: data[:-1]), f"{FILE}: "),
    "cut in the header": (bytes_in(lambda data: data[:100]), f"{FILE}: "),
    "a byte more": (bytes_in(lambda data: data + b"\0"), f"{FILE}: "),
    "twice": (bytes_in(lambda data: data + data), f"{FILE}: "),
    "zeros": (bytes_in(lambda data: bytes(len(data))), f"{FILE}: "),
    "a pickle": (pickled, f"{FILE}: "),
    "JSON": (bytes_in(lambda data: b'["a", "list"]'), f"{FILE}: "),
    "of something else": (foreign, "header: format = 'pt', must be 'flockenv checkpoint 1'"),
    "a folder": (a_folder, f"{FILE} is not a file"),
    "2.5 GiB": (sparse, f"{FILE} has 2,684,354,560 bytes, one of this training has at most"),
    "a part more": (changed(lambda parts: parts.update(more={"x": np.zeros(3)})), "more: is no part of a checkpoint"),
    "no optimizer": (changed(lambda parts: parts.pop("optimizer")), "optimizer: is missing"),
    "no notes": (changed(lambda parts: parts.pop("notes")), "notes: "),
    "steps -5": (noted(steps=-5), "notes: steps = -5: must be an integer >= 0"),
    "steps in words": (noted(steps="many"), "notes: steps = 'many': must be an integer >= 0"),
    "a key more": (noted(lucky=7), "notes: lucky = 7: unknown key"),
    "a key less": (noted(curve="gone"), "notes: curve: missing; must be a list"),
    "fewer steps": (noted(steps=256), "notes: curve goes to 512 steps"),
    "another best": (noted(best=1e6), "notes: best = 1000000.0 is not the best of the curve"),
    "notes are a list": (changed(lambda parts: parts.update(notes=as_bytes("[1, 2]"))), "notes: "),
    "notes are NaN": (changed(lambda parts: parts.update(notes=as_bytes("NaN"))), "notes: is not JSON: NaN"),
    "notes are no text": (changed(lambda parts: parts.update(notes=as_bytes("\x80[" * 9999))), "notes: is not JSON"),
    "notes are numbers": (changed(lambda parts: parts.update(notes={"json": np.zeros(3)})), "notes: must be one"),
    "no times": (changed(lambda parts: parts.update(times=as_bytes('{"wall": 1, "seconds": []}'))), "times: 0 times"),
    "NaN policy": (tensor("policy", "action_net.weight", with_nan), "policy: action_net.weight holds nan"),
    "NaN best": (tensor("best", "action.weight", with_nan), "best: tensor 'action.weight' holds NaN"),
    "NaN moments": (tensor("optimizer", "3.exp_avg", with_nan), "optimizer: 3.exp_avg holds nan"),
    "NaN position": (tensor("worlds", "state.x", with_nan), "worlds: state.x holds nan"),
    "doubles": (tensor("policy", "log_std", lambda a: a.astype(float)), "policy: log_std is float64 of shape (2,)"),
    "fewer worlds": (tensor("worlds", "steps", lambda a: a[:-1]), "worlds: steps is int64 of shape (15,)"),
    "a moment less": (changed(lambda parts: parts["optimizer"].pop("3.step")), "optimizer: 3.step is missing"),
    "a moment more": (
        changed(lambda parts: parts["optimizer"].update({"99.step": np.zeros(())})), "optimizer: 99.step is unknown",
    ),
    "a tensor more": (changed(lambda parts: parts["rollout"].update(x=np.zeros(2))), "rollout: x is unknown"),
    "torch's generator": (tensor("random", "torch", lambda a: a[:-9]), "random: torch is uint8 of shape"),
    "no generators": (changed(lambda parts: parts["random"].update(as_bytes("{}"))), "random: "),
}  # fmt: skip


@pytest.mark.parametrize("name", DAMAGES)
def test_damaged_checkpoint_is_refused_in_one_line(copied: Path, name: str) -> None:
    damage, message = DAMAGES[name]
    damage(copied / "runs" / "pursuit")
    refused(copied, message)


@pytest.mark.parametrize("mean", [1e-160, -1e103, 5e-324, -1.7e308])
def test_results_of_any_finite_size_are_stored(tmp_path: Path, mean: float) -> None:
    run = ppo.train(PURSUIT, tmp_path)
    run.curve = [{**point, "mean": mean, "seconds": 1e-160} for point in run.curve]
    run.best, run.wall = mean, 1e-160
    save_checkpoint(tmp_path, run)
    again = load_checkpoint(PURSUIT, tmp_path)
    assert again is not None and (again.best, again.wall, again.curve) == (mean, 1e-160, run.curve)


def test_flipped_bits_are_detected(copied: Path) -> None:
    """One bit in every seventh byte of the header and in 300 bytes of tensors; the error names the damaged part."""
    folder = copied / "runs" / "pursuit"
    data = bytearray((folder / FILE).read_bytes())
    header = 8 + int.from_bytes(data[:8], "little")
    rng, named = np.random.default_rng(0), set()
    for at in [*range(0, header, 7), *rng.choice(np.arange(header, len(data)), 300, replace=False).tolist()]:
        bit = 1 << int(rng.integers(8))
        data[at] ^= bit
        (folder / FILE).write_bytes(data)
        with pytest.raises(Damaged) as caught:
            files.read(folder, LARGEST)
        data[at] ^= bit
        text = str(caught.value)
        assert text.isprintable() and len(text) < 500
        if at >= header:
            assert text.endswith(": its SHA-256 is not the recorded one"), text
            named.add(text.split(": ")[1])
    (folder / FILE).write_bytes(data)
    assert named >= {"policy", "optimizer", "worlds", "rollout", "random", "best"}
    assert files.read(folder, LARGEST) is not None


@pytest.mark.parametrize("name", ["run.json", "policy.pt"])
def test_checkpoint_of_an_older_format_is_refused_in_one_line(copied: Path, name: str) -> None:
    folder = copied / "runs" / "pursuit"
    (folder / FILE).unlink()
    (folder / name).write_bytes(b"{}")
    result = command(copied, "--resume")
    message = f"error: the checkpoint in {folder} is in an older format: start anew without --resume\n"
    assert (result.exit_code, result.stderr) == (2, message)


def test_resume_without_a_checkpoint_starts_a_training_and_reports_it(fresh: Path) -> None:
    result = command(fresh, "--resume")
    assert result.stderr == f"no checkpoint in {fresh / 'runs' / 'pursuit'}: training starts from the beginning\n"
    assert isinstance(result.exception, AssertionError)  # from the fixture's build


def test_checkpoint_contains_only_numeric_tensors(copied: Path) -> None:
    data = (copied / "runs" / "pursuit" / FILE).read_bytes()
    header = json.loads(data[8 : 8 + int.from_bytes(data[:8], "little")])
    kinds = {entry["dtype"] for name, entry in header.items() if name != "__metadata__"}
    assert kinds <= {"F32", "F64", "I64", "U64", "U8", "BOOL"}
    assert sorted(path.name for path in (copied / "runs" / "pursuit").iterdir()) == [FILE, "log_1", "training.lock"]


# --- one training per folder ------------------------------------------------------------------------------------------


def test_second_training_in_a_folder_is_refused_at_once(copied: Path) -> None:
    folder = copied / "runs" / "pursuit"
    before = (folder / FILE).read_bytes()
    with claim(folder):
        for more in ((), ("--resume",)):
            result = command(copied, *more)
            message = f"error: {folder} is in use by another training: wait for its end, or choose another --runs\n"
            assert (result.exit_code, result.stderr) == (2, message)
        with pytest.raises(InUse):
            ppo.train(PURSUIT, folder)
    assert (folder / FILE).read_bytes() == before and not (copied / "p.safetensors").exists()
    with claim(folder):
        pass


def test_lock_of_another_process_is_released_when_it_ends(copied: Path) -> None:
    folder = copied / "runs" / "pursuit"
    code = f"""
from pathlib import Path
from agents.checkpoint import claim
with claim(Path({str(folder)!r})):
    print("held", flush=True)
    input()
"""
    root = CONFIGS.parent.parent
    holder = subprocess.Popen(
        [sys.executable, "-c", code], cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    with holder:
        assert holder.stdout is not None and holder.stdout.readline() == "held\n"
        with pytest.raises(InUse, match="in use by another training"), claim(folder):
            pass
        holder.kill()
    with claim(folder):
        pass


def test_partial_files_of_a_killed_training_are_removed(copied: Path) -> None:
    folder = copied / "runs" / "pursuit"
    half = folder / LEFTOVERS.replace("*", "4711")
    half.mkdir()
    (half / "new").write_bytes(b"half")
    with claim(folder):
        assert not half.exists() and (folder / FILE).exists()


# --- outputs are checked before training ------------------------------------------------------------------------------


def untouched(folder: Path, result: Any, message: str) -> None:
    assert result.exit_code == 2, (result.output, result.exception)
    assert result.stderr.startswith("error: ") and message in result.stderr and result.stderr.count("\n") == 1
    assert [path.name for path in folder.iterdir()] == ["pursuit.yaml"]


@pytest.fixture
def fresh(tmp_path: Path, begun: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder with only a config; a call of build fails the test."""
    shutil.copy(begun / "pursuit.yaml", tmp_path)

    def build(*_: Any) -> None:
        raise AssertionError("build was called")

    monkeypatch.setattr(ppo, "build", build)
    return tmp_path


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--out", "{}/w.bin", "w.bin': must end in .safetensors"),
        ("--out", "{}/w", "w': must end in .safetensors"),
        ("--out", "../../../elsewhere.safetensors", "--out '../../../elsewhere.safetensors': must not go up with '..'"),
        ("--out", "/proc/w.safetensors", "--out '/proc/w.safetensors': must lie below"),
        ("--out", "{}/pursuit.yaml/w.safetensors", "pursuit.yaml' is not a folder"),
        ("--runs", "../elsewhere", "--runs '../elsewhere/pursuit': must not go up with '..'"),
        ("--runs", "/proc/runs", "--runs '/proc/runs/pursuit': must lie below"),
        ("--runs", "{}/pursuit.yaml", "pursuit.yaml' is not a folder"),
    ],
)
def test_invalid_output_path_is_refused_before_training(fresh: Path, option: str, value: str, message: str) -> None:
    untouched(fresh, command(fresh, option, value.format(fresh)), message)


def test_card_that_cannot_be_written_is_refused_before_training(fresh: Path) -> None:
    (fresh / "p.json").mkdir()
    result = command(fresh)
    assert result.exit_code == 2 and "its card, 'p.json', is a folder" in result.stderr


@pytest.mark.parametrize("place", ["w.safetensors", "runs"])
def test_read_only_folder_is_refused_before_training(
    fresh: Path, monkeypatch: pytest.MonkeyPatch, place: str
) -> None:  # fmt: skip
    closed = fresh / "closed"
    closed.mkdir()
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: not str(path).startswith(str(closed)) and access(path, mode))
    option = "--runs" if place == "runs" else "--out"
    result = command(fresh, option, str(closed / place))
    assert result.exit_code == 2 and "cannot be written to" in result.stderr and result.stderr.count("\n") == 1
    assert not any(closed.iterdir())


def test_full_disk_is_refused_before_training(fresh: Path) -> None:
    """A limit on file size replaces the full disk; both are detected by a trial write."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**10, before[1]))
    try:
        result = command(fresh)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    untouched(fresh, result, "cannot write")


def test_check_room_tries_the_final_path_and_leaves_no_files(tmp_path: Path) -> None:
    check_room(tmp_path / "deep" / "down" / "x", 2**20)
    with pytest.raises(OSError, match=r"cannot write '.*x' \([\d,]+ bytes\): ") as caught:
        check_room(tmp_path / "deep" / "x", 2**60)
    assert "\n" not in str(caught.value) and not any(tmp_path.iterdir())


# --- NaN --------------------------------------------------------------------------------------------------------------


def spoilt(monkeypatch: pytest.MonkeyPatch, call: int, quantity: str, row: int, column: int) -> None:
    """Put a NaN into the rewards, or inf into the observations, that one call of step_wait returns."""
    original, calls = WorldVecEnv.step_wait, 0

    def step_wait(self: WorldVecEnv) -> Any:
        nonlocal calls
        seen, reward, done, infos = original(self)
        calls += 1
        if calls == call and quantity == "reward":
            reward[row] = np.nan
        elif calls == call:
            seen[row, column] = np.inf
        return seen, reward, done, infos

    monkeypatch.setattr(WorldVecEnv, "step_wait", step_wait)


NAN = [
    ("reward", 0, "world 11, pursuer_0: reward, is nan after decision 41 of its episode"),
    ("observation", 0, "world 11, pursuer_0: observation, {slot}, is inf after decision 41 of its episode"),
]


@pytest.mark.parametrize(("quantity", "column", "message"), NAN)
def test_non_finite_number_is_named_and_the_last_good_policy_is_kept(
    copied: Path, monkeypatch: pytest.MonkeyPatch, quantity: str, column: int, message: str
) -> None:
    """It is in the third rollout: the curve has two points, and the checkpoint is from the start of that rollout."""
    shutil.rmtree(copied / "runs")
    spoilt(monkeypatch, 2 * 16 + 9, quantity, 11, column)
    result = command(copied)
    slot = PURSUIT.build().layout.slots[0].name
    folder, target = copied / "runs" / "pursuit", copied / "p.safetensors"
    assert result.exit_code == 1, (result.output, result.exception)
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    kept = f"kept: the checkpoint of 512 steps in {folder}, and the best policy so far (mean return "
    assert len(lines) == 1 and message.format(slot=slot) in lines[0] and kept in lines[0]
    run = load_checkpoint(PURSUIT, folder)
    assert run is not None and run.steps == 512 and len(run.curve) == 2
    assert MlpPolicy.load(target, PURSUIT.build()).card["tuning_mean"] == run.best


def test_nan_in_the_first_rollout_is_named(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shutil.rmtree(copied / "runs")
    spoilt(monkeypatch, 1, "reward", 0, 0)
    result = command(copied)
    assert result.exit_code == 1 and "world 0, pursuer_0: reward, is nan after decision 1" in result.stderr
    assert "kept: the checkpoint of 0 steps" in result.stderr and not (copied / "p.safetensors").exists()


OLDER = {"of the same recipe": 0, "of another recipe": 1, "damaged": 0}


@pytest.mark.parametrize("older", OLDER)
@pytest.mark.parametrize(
    ("error", "code", "message"),
    [(LearningDiverged("too far"), 1, "error: too far; nothing was learnt before"),
     (KeyboardInterrupt(), 130, "interrupted; nothing was learnt yet")],
    ids=["divergence", "Ctrl-C"],
)  # fmt: skip
def test_run_that_saved_nothing_does_not_report_an_older_checkpoint(
    copied: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException, code: int, message: str, older: str
) -> None:
    def build(*_: Any) -> None:
        raise error

    monkeypatch.setattr(ppo, "build", build)
    path = copied / "runs" / "pursuit" / FILE
    if older == "damaged":
        path.write_bytes(path.read_bytes()[:-1])
    before = path.read_bytes()
    result = command(copied, "--seed", str(OLDER[older]))
    assert result.exit_code == code and message in result.stderr, result.output
    assert path.read_bytes() == before and not (copied / "p.safetensors").exists()


def test_non_finite_reward_in_a_tuning_world_is_named(
    copied: Path, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    step = World.step

    def spoils(self: World, *given: Any, **named: Any) -> Any:
        result = step(self, *given, **named)
        if self.worlds == 4:  # the tuning worlds, which measure the curve
            result.reward[2] = np.nan
        return result

    monkeypatch.setattr(World, "step", spoils)
    result = command(copied, "--resume")
    assert result.exit_code == 1 and "error: on the tuning worlds: world 2: its reward is nan" in result.stderr
    assert "and the best policy so far" in result.stderr and (copied / "p.safetensors").exists()


@pytest.mark.slow
@pytest.mark.parametrize("experiment", [PURSUIT, SCHOOL], ids=["pursuit", "school"])
def test_divergence_of_learning_is_reported(tmp_path: Path, experiment: Experiment) -> None:
    settings = experiment.ppo.model_copy(update={"learning_rate": 1e30, "taught": 0, "critic_first": 0})
    with pytest.raises(LearningDiverged, match=r"largest weight is \d.*e\+\d+|weights of the network") as caught:
        ppo.train(experiment.model_copy(update={"ppo": settings}), tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore:overflow:RuntimeWarning")
@pytest.mark.parametrize(
    ("scale", "message"),
    [(1e38, "weights of the network, .*; the largest return of the .*e\\+"), (1e39, "advantages of the .* hold -inf")],
)
def test_non_finite_loss_is_reported(tmp_path: Path, scale: float, message: str) -> None:
    huge = PURSUIT.ppo.model_copy(update={"reward_scale": scale})
    with pytest.raises(LearningDiverged, match=message):
        ppo.train(PURSUIT.model_copy(update={"ppo": huge}), tmp_path)


# --- versions ---------------------------------------------------------------------------------------------------------


def test_different_versions_are_reported_and_listed_in_the_card(copied: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, real = load_checkpoint(PURSUIT, copied / "runs" / "pursuit"), ppo.surroundings
    monkeypatch.setattr(ppo, "surroundings", lambda task: {**real(task), "torch": "9.1.0", "numpy": "3.0.0"})
    result = command(copied, "--resume")
    assert result.exit_code == 0, result.output
    torch_now, numpy_now = torch.__version__, np.__version__
    message = " ".join(result.stderr.split())
    assert (
        f"numpy 3.0.0 after {numpy_now}, torch 9.1.0 after {torch_now}: weights may differ from those of an" in message
    )
    card = json.loads((copied / "p.json").read_text(encoding="utf-8"))
    assert card["versions"]["torch"] == torch_now
    assert card["versions"].keys() >= {"flockenv", "python", "numpy", "stable-baselines3", "system", "processor"}
    others = {"numpy": "3.0.0", "torch": "9.1.0"}
    assert begun is not None and card["resumed"] == [{"steps": begun.steps, "surroundings": others}]


def test_equal_versions_are_not_reported(copied: Path) -> None:
    result = command(copied, "--resume")
    assert result.exit_code == 0 and "resumed" not in result.stderr
    assert "resumed" not in json.loads((copied / "p.json").read_text(encoding="utf-8"))
