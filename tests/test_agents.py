"""The workbench: rules beat random players, training is reproducible and resumes, the search writes its result."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from safetensors.numpy import load_file
from stable_baselines3.common.buffers import RolloutBuffer
from typer.testing import CliRunner

from agents import dagger
from agents import imitate as imitation
from agents.dagger import collect_answers
from agents.experiment import AS_CONFIGURED, CONFIGS, Experiment, PpoSettings, load_experiment, seeds_of
from agents.imitate import imitate
from agents.learning_env import ForLearning
from agents.run import load_checkpoint, recipe_of
from agents.team_credit import CaringBuffer
from agents.training_job import training_job, with_seed
from flockenv.envs.sb3 import WorldVecEnv
from flockenv.envs.world import World
from flockenv.evaluation import compare, rollout, worlds_for
from flockenv.jit.thread_pool import threads
from flockenv.players import WEIGHTS
from flockenv.players.policy import MlpPolicy, RandomPolicy
from flockenv.players.rules import Tuned, as_dict, load_tuned, player
from flockenv.tasks import TASKS, School, Task
from tests.training import PURSUIT, TINY, interrupt

ROOT = CONFIGS.parent.parent


@pytest.mark.parametrize("name", sorted(TASKS))
def test_both_hand_written_players_are_far_above_random(name: str) -> None:
    task = load_experiment(CONFIGS / f"{name}.yaml").build()
    first = worlds_for("tuning", 7, 12)
    random = rollout(task, RandomPolicy(task.action_layout.size, 0), 12, first)
    for textbook, margin in (
        (True, 1 if name == "crowd_nav" else 3),
        (False, 10),
    ):  # the textbook is too fast for a narrow track and runs into a crowd that ignores it; tuned rules do not
        rules = rollout(task, player(task, "textbook" if textbook else "rules"), 12, first)
        assert compare(rules, random).difference.low > margin


@pytest.mark.parametrize("name", sorted(TASKS))
def test_the_shipped_policy_is_far_above_random_and_its_card_is_complete(name: str) -> None:
    task = load_experiment(CONFIGS / f"{name}.yaml").build()
    policy = MlpPolicy.load(WEIGHTS / f"{name}.safetensors", task)
    first = worlds_for("tuning", 7, 24)
    random = rollout(task, RandomPolicy(task.action_layout.size, 0), 24, first)
    assert compare(rollout(task, policy, 24, first), random).difference.low > 10
    card = json.loads((WEIGHTS / f"{name}.json").read_text(encoding="utf-8"))
    recipe = load_experiment(CONFIGS / f"{name}.yaml").ppo.model_dump(mode="json")
    assert card["recipe"]["ppo"] == {**recipe, "seed": card["seed"]}, "the weights were trained with this config"
    command = f"python -m agents.ppo configs/training/{name}.yaml"
    assert card["recipe"]["command"] in (command, f"{command} --seed {card['seed']}")
    assert card["arguments"].items() <= task.model_dump(mode="json").items(), "the policy was trained on this task"
    assert card["wall_time_s"] < 600 and card["curve"][-1]["mean"] > card["curve"][0]["mean"]


@pytest.mark.parametrize("name", sorted(TASKS))
def test_a_player_acts_on_one_row_as_on_a_batch(name: str) -> None:
    task = TASKS[name]()
    rows = np.random.default_rng(0).uniform(-1, 1, (5, task.layout.size)).astype(np.float32)
    rows = np.clip(rows, task.layout.low, task.layout.high)
    together, _ = player(task).predict(rows)
    alone = np.stack([player(task).predict(row)[0] for row in rows])
    np.testing.assert_array_equal(together, alone)
    assert together.dtype == np.float32 and np.all(np.linalg.norm(together, axis=1) <= 1 + 1e-6)


@pytest.mark.parametrize("name", sorted(TASKS))
def test_a_player_returns_finite_actions_for_an_observation_of_zeros(name: str) -> None:
    task = TASKS[name]()
    action, _ = player(task).predict(np.zeros((1, task.layout.size), np.float32))
    assert np.isfinite(action).all()


def test_tuned_rules_have_every_parameter_and_beat_the_textbook_on_tuning_worlds() -> None:
    for name in TASKS:
        record = load_tuned(name)
        assert record.parameters == as_dict(player(TASKS[name]()).rules)
        assert record.found["tuning_mean"] > record.found["textbook_mean"]


@pytest.mark.slow
def test_training_is_reproducible_and_exports_a_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from agents import ppo

    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    once, twice = (ppo.train(PURSUIT, tmp_path / name) for name in "ab")
    assert once.tensors.keys() == twice.tensors.keys()
    for name, tensor in once.tensors.items():
        np.testing.assert_array_equal(tensor, twice.tensors[name])
    assert not any(temporary.glob("SB3*")), "a logger without outputs leaves no folder"
    ppo.export(once, tmp_path / "p.safetensors")
    policy = MlpPolicy.load(tmp_path / "p.safetensors", PURSUIT.build())
    assert policy.observation_size == PURSUIT.build().layout.size
    assert policy.card["recipe"]["ppo"] == PURSUIT.ppo.model_dump(mode="json")


@pytest.mark.slow
def test_trainings_with_several_seeds_are_jobs_with_the_same_policies(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from agents import ppo

    monkeypatch.chdir(tmp_path)
    Path("tiny.yaml").write_text(yaml.safe_dump(PURSUIT.model_dump(mode="json", include={"task", "arguments", "ppo"})))
    command = ["tiny.yaml", "--seeds", "3-4", "--processes", "2"]
    result = CliRunner().invoke(ppo.app, command)
    assert result.exit_code == 0, result.output
    for seed in (3, 4):
        options = ["--seed", str(seed), "--out", f"alone-{seed}.safetensors", "--runs", f"alone-{seed}"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        subprocess.run([sys.executable, "-m", "agents.ppo", "tiny.yaml", *options], check=True, env=environment)
        policy = MlpPolicy.load(tmp_path / f"results/ppo/pursuit-seed-{seed}.safetensors", PURSUIT.build())
        assert policy.card["seed"] == seed
        alone = load_file(tmp_path / f"alone-{seed}.safetensors")
        stored = load_file(tmp_path / f"results/ppo/pursuit-seed-{seed}.safetensors")
        assert alone.keys() == stored.keys()
        for name, tensor in alone.items():
            np.testing.assert_array_equal(stored[name], tensor)
    with monkeypatch.context() as patch:
        patch.setattr(ppo, "build", _fail)
        assert CliRunner().invoke(ppo.app, command).exit_code == 0, "stored trainings are not repeated"
    result = CliRunner().invoke(ppo.app, ["tiny.yaml", "--seeds", "3", "--steps", "512", "--processes", "1"])
    assert result.exit_code == 0, "another recipe has a checkpoint of its own"


@pytest.mark.parametrize("other", [("--seed", "1"), ("--resume",)])
def test_seeds_are_refused_beside_options_of_one_training(other: tuple[str, ...]) -> None:
    from agents import ppo

    result = CliRunner().invoke(ppo.app, [str(CONFIGS / "pursuit.yaml"), "--seeds", "0-1", *other])
    assert result.exit_code == 2 and "--seeds: not together with" in result.stderr


def test_a_shard_needs_several_seeds() -> None:
    from agents import ppo

    result = CliRunner().invoke(ppo.app, [str(CONFIGS / "pursuit.yaml"), "--shard", "0/2"])
    assert result.exit_code == 2 and result.stderr == "error: --shard: needs --seeds, whose trainings are jobs\n"


def test_the_checkpoint_of_a_training_job_depends_on_recipe_and_code(monkeypatch: pytest.MonkeyPatch) -> None:
    jobs = [training_job(with_seed(PURSUIT, seed), Path("runs")) for seed in (1, 1, 2)]
    monkeypatch.setattr("flockenv.jobs.job.code_digest", lambda: "other")
    jobs.append(training_job(with_seed(PURSUIT, 1), Path("runs")))
    folders = [job.arguments[1] for job in jobs]
    assert folders[0] == folders[1] and len(set(folders)) == 3


@pytest.mark.parametrize(("text", "seeds"), [("0-3", [0, 1, 2, 3]), ("5, 2,5-6", [5, 2, 6]), ("7", [7])])
def test_seeds_are_numbers_and_ranges(text: str, seeds: list[int]) -> None:
    assert seeds_of(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "1-", "-1", "3-1", "0-1000", "1.5", "99999999999999999999"])
def test_other_seeds_are_refused_in_one_line(text: str) -> None:
    with pytest.raises(ValueError, match=r"^--seeds '.*': .* must be "):
        seeds_of(text)


@pytest.mark.slow
def test_weights_do_not_depend_on_the_threads_that_torch_had_before(tmp_path: Path) -> None:
    from agents import ppo

    found, before = [], torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(ppo.train(PURSUIT, tmp_path / str(threads)).tensors)
    finally:
        torch.set_num_threads(before)
    for name, tensor in found[0].items():
        np.testing.assert_array_equal(tensor, found[1][name])


def _fail(*_: object, **__: object) -> None:
    raise AssertionError("unexpected training")


@pytest.mark.slow
def test_interrupted_training_resumes_and_finished_training_is_not_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from agents import ppo

    interrupt(PURSUIT, tmp_path)
    begun = load_checkpoint(PURSUIT, tmp_path)
    assert begun is not None and 0 < begun.steps < 1024
    run = ppo.train(PURSUIT, tmp_path, go_on=True)
    assert run.steps >= 1024 and run.curve[: len(begun.curve)] == begun.curve
    monkeypatch.setattr(ppo, "build", _fail)
    assert ppo.train(PURSUIT, tmp_path, go_on=True).curve == run.curve


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"ppo": {**TINY, "steps": 1024, "gamma": 0.9}}, "ppo.gamma = 0.9: {}, with 0.99"),
        ({"ppo": {**TINY, "steps": 2048}}, "ppo.steps = 2048: {}, with 1024"),
        ({"arguments": {"pursuer_speed": 2.5}}, "arguments.pursuer_speed = 2.5: {}, with nothing"),
    ],
)
def test_training_does_not_resume_with_another_recipe(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    from agents import ppo

    folder = tmp_path / "runs" / "pursuit"
    interrupt(PURSUIT, folder)
    config = tmp_path / "pursuit.yaml"
    config.write_text(yaml.safe_dump({"task": "pursuit", "ppo": {**TINY, "steps": 1024}, **change}), encoding="utf-8")
    given = [str(config), "--runs", str(tmp_path / "runs"), "--resume", "--out", str(tmp_path / "p.safetensors")]
    result = CliRunner().invoke(ppo.app, given)
    assert result.exit_code == 2
    assert result.stderr == f"error: {message.format(f'the checkpoint in {folder} is of another recipe')}\n"
    assert not (tmp_path / "p.safetensors").exists()


# --- learning curves --------------------------------------------------------------------------------------------------


def _curves(folder: Path, *more: str, code: int = 0, **changes: Any) -> str:
    """Compare two settings of Pursuit from a config with some changes; return the command's stderr."""
    from agents import curves

    settings = {
        "task": "pursuit",
        "ppo": {**TINY, "steps": 512},
        "curves": {"two epochs": {"epochs": 2}},
    }
    config = folder / "pursuit.yaml"
    config.write_text(yaml.safe_dump({**settings, **changes}), encoding="utf-8")
    given = [str(config), "--out", str(folder / "new" / "learning.png"), "--runs", str(folder / "runs")]
    result = CliRunner().invoke(curves.app, [*given, "--jobs", str(folder / "jobs"), *more])
    assert result.exit_code == code, (result.output, result.exception)
    return result.stderr


@pytest.mark.slow
def test_curves_train_every_setting_once_and_draw_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from agents.curves import curve_jobs, draw

    experiment = Experiment(task="pursuit", ppo={**TINY, "steps": 512}, curves={"two epochs": {"epochs": 2}})
    job = curve_jobs({"pursuit": experiment}, tmp_path / "runs", 1, True)["pursuit", AS_CONFIGURED]
    interrupt(experiment, Path(job.arguments[1]))
    monkeypatch.setattr("agents.curves.load_tuned", lambda task: Tuned({}, {"tuning_mean": -100.0}))
    message = _curves(tmp_path)
    assert "curves/pursuit/as-configured: done (1 of 2)\ncurves/pursuit/two-epochs: done (2 of 2)\n" in message
    picture, file = tmp_path / "new" / "learning.png", tmp_path / "new" / "learning.json"
    numbers = json.loads(file.read_text(encoding="utf-8"))
    rows = numbers["pursuit"]["settings"]
    assert {name: row["ppo"]["epochs"] for name, row in rows.items()} == {AS_CONFIGURED: 1, "two epochs": 2}
    for row in rows.values():
        assert row["curve"][-1]["steps"] >= 512
        assert row["past_the_rules_s"] == row["curve"][0]["seconds"]
    assert rows[AS_CONFIGURED]["curve"][0]["steps"] == 256 < rows[AS_CONFIGURED]["curve"][-1]["steps"]
    draw(tmp_path / "again.png", numbers)
    assert picture.read_bytes() == (tmp_path / "again.png").read_bytes()
    assert "done (" not in _curves(tmp_path), "no training is repeated"
    assert json.loads(file.read_text(encoding="utf-8")) == numbers
    message = _curves(tmp_path, curves={"two epochs": {"epochs": 2, "gamma": 0.9}})
    assert "two-epochs: done" in message and "as-configured: done" not in message
    again = json.loads(file.read_text(encoding="utf-8"))["pursuit"]["settings"]
    assert again[AS_CONFIGURED] == rows[AS_CONFIGURED] and again["two epochs"]["curve"] != rows["two epochs"]["curve"]


def test_a_training_among_others_is_another_curve(tmp_path: Path) -> None:
    """Its wall time is not comparable with that of one which ran alone."""
    from agents.curves import NOTE, curve_jobs, note_of

    experiment = Experiment(task="pursuit", ppo=TINY, curves={"two epochs": {"epochs": 2}})
    keys = {
        job.key
        for at_a_time in (1, 2, "ray")
        for job in curve_jobs({"pursuit": experiment}, tmp_path, at_a_time, True).values()
    }
    assert len(keys) == 6
    assert note_of(1) == NOTE and NOTE.endswith("One training at a time.")
    assert "up to 3; wall times are comparable only" in note_of(3) and "Ray cluster" in note_of("ray")


@pytest.mark.parametrize(
    ("curves", "message"),
    [
        ({"two epochs": {"epocs": 2}}, "curves.'two epochs'.epocs = 2: unknown key, did you mean `epochs`? allowed"),
        ({"none": {"epochs": 0}}, "curves.none.epochs = 0: must be an integer >= 1 (passes over a rollout)"),
        ({"text": {"epochs": "2"}}, "curves.text.epochs = '2': must be an integer >= 1, not text"),
        ({"../up": {"epochs": 2}}, "curves.'../up': a name is up to 40 letters, digits"),
        ({AS_CONFIGURED: {"epochs": 2}}, "curves.'as configured': that is what the settings under ppo are called"),
    ],
)
def test_invalid_curves_are_refused_in_one_line(tmp_path: Path, curves: dict[str, Any], message: str) -> None:
    error = _curves(tmp_path, code=2, curves=curves)
    assert error.startswith("error: ") and error.count("\n") == 1
    assert f": {message}" in error
    (name,) = curves
    lines = (tmp_path / "pursuit.yaml").read_text(encoding="utf-8").splitlines()
    at = int(error.split("pursuit.yaml:")[1].split(":")[0]) - 1
    assert name in lines[at] or next(iter(curves[name])) in lines[at]
    assert not (tmp_path / "runs").exists() and not (tmp_path / "new").exists()


def test_curves_take_one_config_per_task_and_write_a_png(tmp_path: Path) -> None:
    from agents import curves

    config = str(CONFIGS / "pursuit.yaml")
    for given, message in (
        ([config, config], "another config is of that task"),
        ([config, "--out", str(tmp_path / "x.json")], "must end in .png"),
        ([str(CONFIGS.parent / "scenes" / "boids.yaml")], "unknown key"),
    ):
        result = CliRunner().invoke(curves.app, given)
        assert result.exit_code == 2 and message in result.stderr


def test_the_stored_curves_match_the_settings_in_the_configs() -> None:
    """Except for threads, which change only the duration. If this fails: docs/players.md shows how to remake them."""
    files = [ROOT / "docs" / name for name in ("learning.json", "learning_school.json")]
    stored = {task: numbers for file in files for task, numbers in json.loads(file.read_text(encoding="utf-8")).items()}
    assert stored.keys() == {name for name in TASKS if load_experiment(CONFIGS / f"{name}.yaml").curves}
    for name, numbers in stored.items():
        experiment = load_experiment(CONFIGS / f"{name}.yaml")
        assert numbers["rules"] == load_tuned(name).found["tuning_mean"]
        kept = {setting: PpoSettings(**{**row["ppo"], "threads": 2}) for setting, row in numbers["settings"].items()}
        assert kept == {setting: p.model_copy(update={"threads": 2}) for setting, p in experiment.settings().items()}


def test_training_restores_the_number_of_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import torch

    from agents import ppo

    inside = []

    def interrupted(*_: object) -> None:
        inside.append((torch.get_num_threads(), threads()))
        raise KeyboardInterrupt

    before = torch.get_num_threads(), threads()
    monkeypatch.setattr(ppo, "save_checkpoint", interrupted)
    with pytest.raises(KeyboardInterrupt):
        ppo.train(PURSUIT.model_copy(update={"ppo": PpoSettings(**{**TINY, "threads": 3})}), tmp_path)
    assert inside[0] == (3, 3)
    assert (torch.get_num_threads(), threads()) == before


def test_invalid_settings_are_refused_in_one_line(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text("task: pursuit\nppo: {stpes: 3}\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"ppo\.stpes.*did you mean `steps`") as caught:
        load_experiment(path)
    assert "\n" not in str(caught.value)
    with pytest.raises(ValueError, match=r"task = 'pursiut': unknown, did you mean 'pursuit'"):
        Experiment(task="pursiut").build()
    with pytest.raises(ValueError, match="PpoSettings: steps = 0"):
        PpoSettings(steps=0)


# --- imitation --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_longer_imitation_brings_a_network_closer_to_the_rules(tmp_path: Path) -> None:
    experiment = Experiment(task="pursuit", ppo={**TINY, "evaluate_worlds": 16})
    little, more = (imitate(experiment, tmp_path, worlds=4, updates=updates) for updates in (1, 300))
    assert little.rules == more.rules and more.rows > 4 * little.rows > 0  # the network acted in later rounds
    assert more.missed < 0.5 * little.missed
    assert more.network > little.network


@pytest.mark.parametrize("rate", [1e19, 1e30], ids=str)
@pytest.mark.parametrize("updates", [1, 8], ids=str)
def test_diverging_imitation_ends_with_one_error_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, rate: float, updates: int
) -> None:
    monkeypatch.setattr(dagger, "RATE", rate)
    (tmp_path / "p.yaml").write_text(f"task: pursuit\nppo: {json.dumps(TINY)}\n", encoding="utf-8")
    given = [str(tmp_path / "p.yaml"), "--worlds", "2", "--updates", str(updates), "--runs", str(tmp_path)]
    result = CliRunner().invoke(imitation.app, given)
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert result.exit_code == 1 and len(lines) == 1 and "Traceback" not in result.stderr, result.stderr
    assert "not finite" in lines[0] or "is nan" in lines[0]


def test_training_that_diverges_during_imitation_ends_with_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from agents import ppo

    monkeypatch.setattr(dagger, "RATE", 1e30)
    (tmp_path / "p.yaml").write_text(f"task: pursuit\nppo: {json.dumps(TINY | {'taught': 5})}\n", encoding="utf-8")
    given = [str(tmp_path / "p.yaml"), "--runs", str(tmp_path / "runs"), "--out", str(tmp_path / "p.safetensors")]
    result = CliRunner().invoke(ppo.app, given)
    assert result.exit_code == 1 and "not finite" in result.stderr and "nothing was learnt before" in result.stderr
    assert not (tmp_path / "p.safetensors").exists()


def test_rules_are_queried_on_the_observations_of_the_acting_policy() -> None:
    """The acting policy does nothing; its worlds are those after the first five training worlds."""
    task = School(fish=3, horizon=20)
    rules = player(task)
    rows, answers = collect_answers(task, rules, 2, lambda rows: torch.zeros(len(rows), 2), first=5)
    world, state = World(task, 2, task.horizon), None
    seen, first = world.reset(worlds_for("training") + 5), True
    for step in range(20):
        here = slice(6 * step, 6 * step + 6)
        expected, state = rules.predict(seen.reshape(6, -1), state, np.full(6, first))
        np.testing.assert_array_equal(rows[here].numpy(), seen.reshape(6, -1))
        np.testing.assert_array_equal(answers[here].numpy(), np.asarray(expected, np.float32))
        seen, first = world.step(np.zeros((2, 3, 2))).observation, False
    assert len(rows) == len(answers) == 120  # no fish starves in 20 steps


HUNGRY = School(fish=3, horizon=40, start_hunger=0.6, metabolism=0.4)
"""Three fish that starve one after another."""


def for_learning(task: Task, worlds: int, **changes: Any) -> ForLearning:
    venv = ForLearning(WorldVecEnv(task, worlds, leaving=True), 1.0, stagger=False, **changes)
    venv.seed(5)
    venv.reset()
    return venv


@pytest.mark.parametrize(("task", "hold"), [(HUNGRY, 3), (School(fish=3, horizon=2), 5)], ids=["deaths", "short"])
def test_a_held_action_collects_the_rewards_of_its_decisions_until_an_episode_ends(task: School, hold: int) -> None:
    """Each row has the rewards until its own end, the infos of the first end of its world, and the last observation."""
    held, each = for_learning(task, 2, hold=hold), for_learning(task, 2).venv
    rng, ends, alone = np.random.default_rng(2), 0, 0
    for _ in range(30):
        actions = rng.uniform(-1, 1, (6, 2))
        seen, reward, done, infos = held.step(actions)
        sums, over = np.zeros(6), ~each.present
        expected: list[dict[str, Any]] = [{}] * 6
        for _ in range(hold):
            last, paid, ended, news = each.step(actions)
            sums, over = sums + np.where(over, 0.0, paid), over | ended
            expected = [before or dict(new) for new, before in zip(news, expected, strict=True)]
        np.testing.assert_array_equal(seen, last)
        np.testing.assert_allclose(reward, sums, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(done, over)
        for row in range(6):
            assert infos[row].keys() == expected[row].keys()
            for key in infos[row]:
                np.testing.assert_array_equal(infos[row][key], expected[row][key])
        ends += sum(bool(info) for info in infos)
        alone += sum(bool(out) and not info for out, info in zip(done, infos, strict=True))
    assert ends >= 6 and (alone > 0) == (task is HUNGRY)  # worlds ended, and some fish died before that


def test_the_learning_rate_stays_positive_beyond_the_budget() -> None:
    """SB3 then passes a negative rest of the budget."""
    from agents import ppo

    task = HUNGRY
    model = ppo.build(task, PpoSettings(**TINY, steps=1))
    assert model.lr_schedule(1.0) == pytest.approx(2e-3) and model.lr_schedule(0.0) == pytest.approx(2e-4)
    assert model.lr_schedule(-5.0) == pytest.approx(1e-4)


@pytest.mark.parametrize("care", [0.25, 1.0])
def test_care_adds_the_advantages_of_the_other_agents_of_a_world(care: float) -> None:
    """Advantages by hand: of each row by SB3's plain buffer, then summed over the rows of its world with an agent."""
    steps, rows = 40, 6
    worlds = for_learning(HUNGRY, 2)
    space = (worlds.observation_space, worlds.action_space, "cpu", 0.9, 0.95, rows)
    plain, caring = (
        RolloutBuffer(steps, *space),
        CaringBuffer(steps, *space, worlds=worlds, learners=3, care=care),
    )
    rng, start, here = np.random.default_rng(3), np.ones(rows), []
    for _ in range(steps):
        here.append(worlds.venv.world.state.alive[:, :3].reshape(-1).copy())
        action, value = rng.uniform(-1, 1, (rows, 2)), torch.from_numpy(rng.standard_normal(rows))
        seen, reward, done, _ = worlds.step(action)
        for buffer in (plain, caring):
            buffer.add(seen, action, reward, start, value, torch.zeros(rows))
        start = done
    for buffer in (plain, caring):
        buffer.compute_returns_and_advantage(torch.zeros(rows), start)
    np.testing.assert_array_equal(caring.returns, plain.returns)  # critics learn an agent's own return
    there = np.array(here)
    assert there.any(axis=1).all() and not there.all()
    for t in range(steps):
        for i in range(rows):
            mates = [j for j in range(rows) if j // 3 == i // 3 and j != i and there[t, j]]
            expected = plain.advantages[t, i] + care * sum(plain.advantages[t, j] for j in mates)
            got = caring.advantages[t, i]
            assert got == (pytest.approx(expected, rel=1e-5, abs=1e-6) if there[t, i] else 0.0)


def test_a_held_action_counts_as_several_decisions(tmp_path: Path) -> None:
    from agents import ppo

    settings = PpoSettings(**{**TINY, "steps": 1536, "evaluate_every": 768, "hold": 3})
    whole = ppo.train(Experiment(task="pursuit", ppo=settings), tmp_path / "run")
    rows = settings.worlds * settings.rollout * 3
    assert [point["steps"] % rows for point in whole.curve] == [0] * len(whole.curve)
    assert whole.steps >= 1536 > whole.steps - rows


def test_a_taught_actor_keeps_its_weights_while_only_the_critic_learns(tmp_path: Path) -> None:
    from agents import ppo

    def weights(**changes: Any) -> Any:
        settings = {**TINY, "steps": 1024, "taught": 5, **changes}
        experiment = Experiment(task="pursuit", ppo=PpoSettings(**settings))
        return ppo.train(experiment, tmp_path / "run").state["policy"]

    waits, faster, learns = weights(critic_first=1024), weights(critic_first=1024, learning_rate=0.01), weights()
    untaught, thaws = weights(critic_first=1024, taught=0), weights(critic_first=512)
    actor = [name for name in waits if "policy_net" in name or "action_net" in name or name == "log_std"]
    assert len(actor) == 7
    for name in actor:
        np.testing.assert_array_equal(waits[name], faster[name])
        assert not np.array_equal(waits[name], learns[name])
        assert not np.array_equal(waits[name], thaws[name]) and not np.array_equal(learns[name], thaws[name])
    assert not np.array_equal(waits["value_net.weight"], faster["value_net.weight"])
    assert not np.array_equal(waits["action_net.weight"], untaught["action_net.weight"])


def test_a_taught_run_stores_its_teacher_and_counts_the_time_of_teaching(tmp_path: Path) -> None:
    from agents import ppo

    taught = Experiment(task="pursuit", ppo=PpoSettings(**TINY, steps=1024, taught=5, critic_first=1024))
    interrupt(taught, tmp_path)  # after it was taught
    begun = load_checkpoint(taught, tmp_path)
    assert begun is not None and begun.recipe["rules"] == as_dict(player(taught.build()).rules)
    assert "rules" not in recipe_of(PURSUIT)
    kept = begun.state["policy"]
    found = ppo.train(taught, tmp_path, go_on=True).state["policy"]  # not taught again; only the critic learns
    for name in ("action_net.weight", "mlp_extractor.policy_net.0.weight", "log_std"):
        np.testing.assert_array_equal(found[name], kept[name])
    assert not np.array_equal(found["value_net.weight"], kept["value_net.weight"])
    moments = iter((0.0, 100.0, *np.linspace(100.0, 101.0, 500)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ppo, "time", SimpleNamespace(perf_counter=lambda: next(moments)))
        assert ppo.train(taught, tmp_path / "timed").curve[0]["seconds"] >= 100


def test_ctrl_c_during_teaching_reports_no_checkpoint_and_deletes_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from agents import ppo

    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    (tmp_path / "p.yaml").write_text(f"task: pursuit\nppo: {json.dumps(TINY | {'taught': 5})}\n", encoding="utf-8")
    interrupt(PURSUIT, tmp_path / "runs" / "pursuit")  # a checkpoint of another recipe
    monkeypatch.setattr(ppo, "teach", interrupted)
    result = CliRunner().invoke(ppo.app, [str(tmp_path / "p.yaml"), "--runs", str(tmp_path / "runs")])
    assert result.exit_code == 130 and "nothing was learnt yet" in result.stderr
    assert load_checkpoint(PURSUIT, tmp_path / "runs" / "pursuit") is not None


def test_observations_are_collected_until_each_episode_ends() -> None:
    task = load_experiment(CONFIGS / "pursuit.yaml").build()
    rules = player(task)
    rows, answers = collect_answers(task, rules, 6)
    episodes = rollout(task, rules, 6, worlds_for("training", 0, 6))
    assert len(rows) == len(answers) == episodes.lengths.sum() * task.learners
    np.testing.assert_allclose(answers, rules.predict(rows.numpy())[0], atol=1e-6)
