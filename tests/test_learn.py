"""Training by SAC, TQC, RecurrentPPO and behaviour cloning, and the budget in seconds that PPO has too."""

from __future__ import annotations

import itertools
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from agents import learn, learner_job, ppo
from agents.experiment import CONFIGS, Experiment
from agents.learner_job import ALGORITHMS, check_memory, effective, learner_recipe
from agents.run import Run
from agents.training import card_of
from flockenv.evaluation import rollout, worlds_for
from flockenv.players import load_player
from flockenv.players.policy import MlpPolicy, RandomPolicy
from tests.training import TINY

FEW = {"worlds": 4, "steps": 600, "random_actions": 200, "minibatch": 32, "evaluate_every": 300, "buffer": 1000}
SMALL: dict[str, Any] = {
    "task": "pursuit",
    "arguments": {"horizon": 40},
    "ppo": {**TINY, "steps": 1024, "hidden": [16, 16]},
    "sac": FEW,
    "tqc": FEW,
    "recurrent_ppo": {"lstm": 8},
    "bc": {"updates": 40, "worlds": 3, "evaluate_updates": 10},
}


def trained(algo: str, changes: dict[str, Any] | None = None, **options: Any) -> tuple[Experiment, Run]:
    experiment = effective(Experiment(**{**SMALL, **(changes or {})}), algo, **options)
    run = learn.new_run(experiment, algo)
    with TemporaryDirectory() as folder:
        learn.train(experiment, algo, run, Path(folder))
    return experiment, run


def command(folder: Path, *options: str, changes: dict[str, Any] | None = None) -> Any:
    (folder / "small.yaml").write_text(json.dumps({**SMALL, **(changes or {})}), encoding="utf-8")
    return CliRunner().invoke(learn.app, [str(folder / "small.yaml"), "--runs", str(folder / "runs"), *options])


# --- settings ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "changes", "text"),
    [
        (("--algo", "sacc"), {}, "--algo 'sacc': unknown, did you mean `sac`?; allowed: sac, tqc, recurrent_ppo, bc"),
        (("--algo", "ppo"), {}, "--algo 'ppo': that is python -m agents.ppo"),
        (("--algo", "sac", "--resume"), {}, "--resume: these learners store no checkpoint"),
        (("--algo", "sac", "--seeds", "0", "--seed", "1"), {}, "--seeds: not together with --seed"),
        (("--algo", "sac", "--shard", "0/2"), {}, "--shard: needs --seeds"),
        (("--algo", "sac", "--seconds", "0"), {}, "seconds = 0.0"),
        (("--algo", "bc", "--steps", "5"), {}, "--steps: behaviour cloning has bc.updates"),
        (("--algo", "sac", "--steps", "200"), {}, "sac.steps = 200: must be > 200, the random actions"),
        (("--algo", "sac"), {"sac": {**FEW, "buffer": 31}}, "sac.buffer = 31: must be >= 32, rows and minibatch"),
        (("--algo", "bc"), {"ppo": {"draw": {"noise": [0, 0.1]}}}, "ppo.draw: not with --algo bc"),
        (("--algo", "recurrent_ppo"), {"ppo": {"action": "gate"}}, "ppo.action = 'gate': must be force"),
    ],
)  # fmt: skip
def test_what_a_learner_cannot_use_is_refused_in_one_line(
    tmp_path: Path, options: tuple[str, ...], changes: dict[str, Any], text: str
) -> None:
    result = command(tmp_path, *options, "--out", str(tmp_path / "p.safetensors"), changes=changes)
    assert result.exit_code == 2 and text in result.stderr and result.stderr.count("\n") == 1
    assert not list(tmp_path.glob("p.*"))


def test_a_learner_uses_what_it_shares_with_ppo_and_nothing_else() -> None:
    given = Experiment(task="school", ppo={"care": 0.5, "taught": 9, "gamma": 0.9, "clip": 0.3}, sac={"worlds": 5})
    sac, recurrent = effective(given, "sac").ppo, effective(given, "recurrent_ppo").ppo
    assert (sac.gamma, sac.worlds, sac.care, sac.taught) == (0.9, 5, 0.0, 0)
    assert (recurrent.gamma, recurrent.clip, recurrent.worlds, recurrent.care) == (0.9, 0.3, 2048, 0.0)
    assert not {"care", "taught", "clip"} & learner_recipe(effective(given, "sac"), "sac")["ppo"].keys()


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.stem)
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_every_config_can_be_trained_or_is_refused_in_one_line(algo: str, path: Path) -> None:
    experiment, refused = learn.load_experiment(path), ""
    if algo in ("bc", "recurrent_ppo") and experiment.ppo.action != "force":
        refused = rf"ppo\.action = '{experiment.ppo.action}': must be force with --algo {algo}"
    elif algo == "bc" and experiment.ppo.draw:
        refused = r"ppo\.draw: not with --algo bc"
    if refused:
        with pytest.raises(ValueError, match=refused):
            effective(experiment, algo)
        return
    assert effective(experiment, algo, seconds=300).ppo.seconds == 300


def test_the_memory_of_a_replay_buffer_is_counted() -> None:
    experiment = effective(Experiment(**SMALL), "tqc")
    buffer: Any = learn.build(experiment, "tqc").replay_buffer  # type: ignore[attr-defined]
    arrays = [value for value in vars(buffer).values() if isinstance(value, np.ndarray)]
    assert sum(array.nbytes for array in arrays) == learner_job._extra_bytes(experiment, "tqc")


def test_the_memory_of_lstm_states_is_counted() -> None:
    experiment = effective(Experiment(**SMALL), "recurrent_ppo")
    buffer: Any = learn.build(experiment, "recurrent_ppo").rollout_buffer  # type: ignore[attr-defined]
    names = [f"{kind}_states_{part}" for kind in ("hidden", "cell") for part in ("pi", "vf")]
    bytes_of_states = sum(getattr(buffer, name).nbytes for name in names)
    assert 2 * bytes_of_states == learner_job._extra_bytes(experiment, "recurrent_ppo")


def test_a_replay_buffer_that_does_not_fit_is_refused_before_training(monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = effective(Experiment(**{**SMALL, "sac": {**FEW, "buffer": 10**9}}), "sac")
    monkeypatch.setattr(learner_job, "available_memory", lambda: 8 * 10**9)
    with pytest.raises(MemoryError, match=r"training needs .* GB, .* GB of them for sac.buffer; 8 GB are available"):
        check_memory(experiment, "sac")
    check_memory(effective(Experiment(**SMALL), "sac"), "sac")


@pytest.mark.parametrize(
    ("algo", "config", "changes", "options"),
    [
        ("sac", "crossing_drawn", {}, ""),
        ("sac", "crossing", {}, ""),
        ("tqc", "crossing_residual", {"steps": 50_000, "seconds": 9.0}, " --steps 50000 --seconds 9.0"),
        ("recurrent_ppo", "crossing_drawn", {"steps": 50_000}, " --steps 50000"),
        ("bc", "crowd_nav", {"seed": 3}, " --seed 3"),
    ],
)  # fmt: skip
def test_a_card_names_the_config_and_the_options_of_its_recipe(
    algo: str, config: str, changes: dict[str, Any], options: str
) -> None:
    experiment = effective(learn.load_experiment(CONFIGS / f"{config}.yaml"), algo, **changes)
    run = Run(learner_recipe(experiment, algo), {}, ended_by="steps")
    expected = f"python -m agents.learn configs/training/{config}.yaml --algo {algo}{options}"
    assert learn.card(run, algo)["recipe"]["command"] == expected


# --- training ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_learner_trains_and_exports_a_policy_that_plays(algo: str, tmp_path: Path) -> None:
    experiment, run = trained(algo)
    task, path = experiment.build(), tmp_path / "p.safetensors"
    assert len(run.curve) >= 2 and run.best == max(point["mean"] for point in run.curve)
    assert len({point["mean"] for point in run.curve}) > 1, "learning changes the policy"
    learn.export(run, algo, path)
    policy = load_player(path, task)
    assert isinstance(policy, MlpPolicy) and policy.differences == ()
    card = policy.card
    assert card["recipe"]["command"] == f"python -m agents.learn CONFIG.yaml --algo {algo}"
    assert card["recipe"][algo] == getattr(experiment, algo).model_dump(mode="json")
    assert card["ended_by"] == "steps" and card["steps"] == run.steps == run.curve[-1]["steps"]
    first = worlds_for("tuning", 0, 4)
    assert rollout(task, policy, 4, first).returns.mean() == pytest.approx(run.best, abs=1e-5)


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_budget_in_seconds_ends_training_and_the_card_shows_it(algo: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of this test goes on by a second each time that it is read."""
    ticks = itertools.count()
    monkeypatch.setattr(learn, "time", SimpleNamespace(perf_counter=lambda: float(next(ticks))))
    many = {**FEW, "steps": 10**6}
    changes = {
        "ppo": {**SMALL["ppo"], "steps": 10**6},
        "sac": many,
        "tqc": many,
        "bc": {**SMALL["bc"], "updates": 10**6},
    }
    _, run = trained(algo, changes, seconds=12)
    assert run.wall >= 12 and 0 < run.steps < 10**5
    assert learn.card(run, algo)["ended_by"] == "seconds" and learn.card(run, algo)["recipe"]["ppo"]["seconds"] == 12


@pytest.mark.parametrize("algo", ALGORITHMS)
def test_ctrl_c_keeps_the_best_policy_in_one_line(algo: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scores = iter([(1.0, 0.5), (3.0, 0.5)])

    def interrupted(*_: object) -> tuple[float, float]:
        try:
            return next(scores)
        except StopIteration:
            raise KeyboardInterrupt from None

    monkeypatch.setattr(learn, "score", interrupted)
    path = tmp_path / "p.safetensors"
    result = command(tmp_path, "--algo", algo, "--out", str(path))
    assert result.exit_code == 130
    assert "interrupted; " in result.stderr and "mean return 3.000 on the tuning worlds" in result.stderr
    card = MlpPolicy.load(path).card
    assert card["ended_by"] == "interrupt" and card["tuning_mean"] == 3.0


def test_ctrl_c_before_the_first_point_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(learn, "score", interrupted)
    result = command(tmp_path, "--algo", "sac", "--out", str(tmp_path / "p.safetensors"))
    assert result.exit_code == 130 and "no policy was evaluated yet" in result.stderr
    assert not list(tmp_path.glob("p.*"))


@pytest.mark.parametrize("algo", ["sac", "recurrent_ppo"])
def test_training_that_diverges_keeps_the_best_policy(algo: str, tmp_path: Path) -> None:
    changes = {"ppo": {**SMALL["ppo"], "learning_rate": 1e30}, "sac": {**FEW, "learning_rate": 1e30}}
    result = command(tmp_path, "--algo", algo, "--out", str(tmp_path / "p.safetensors"), changes=changes)
    assert result.exit_code == 1 and "error: " in result.stderr and "on the tuning worlds after" in result.stderr
    card = MlpPolicy.load(tmp_path / "p.safetensors").card
    assert card["ended_by"] == "divergence" and card["tuning_mean"] is not None


# --- PPO's budget in seconds ------------------------------------------------------------------------------------------


def test_ppo_ends_at_the_first_budget_and_its_rate_follows_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The clock of this test goes on by a second each time that it is read."""
    ticks, rates = itertools.count(), []
    monkeypatch.setattr(ppo, "time", SimpleNamespace(perf_counter=lambda: float(next(ticks))))
    learning = ppo.PPO.train

    def noting(model: Any) -> None:
        learning(model)
        rates.append(model.policy.optimizer.param_groups[0]["lr"])

    monkeypatch.setattr(ppo.PPO, "train", noting)
    experiment = Experiment(**SMALL).with_ppo(steps=10**6, seconds=30.0)
    run = ppo.train(experiment, tmp_path / "run")
    assert run.wall >= 30 and run.steps < 10**5
    assert card_of(run)["ended_by"] == "seconds"
    assert rates == sorted(rates, reverse=True) and rates[0] > 0.8 * 2e-3 and rates[-1] < 0.3 * 2e-3
    again = ppo.train(experiment, tmp_path / "run", go_on=True)
    assert again.steps == run.steps and again.wall == run.wall, "a finished run is returned as it is"
    short = ppo.train(Experiment(**SMALL).with_ppo(steps=512, seconds=1e6), tmp_path / "short")
    assert card_of(short)["ended_by"] == "steps" and short.steps == 512


def test_a_recipe_without_seconds_stays_as_it_was() -> None:
    assert "seconds" not in Experiment(**SMALL).ppo.model_dump()
    assert Experiment(**SMALL).with_ppo(seconds=None) == Experiment(**SMALL)


# --- slow -------------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_several_seeds_are_jobs_with_the_policies_of_single_trainings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = command(tmp_path, "--algo", "sac", "--seeds", "3-4", "--processes", "2")
    assert result.exit_code == 0, result.output
    for seed in (3, 4):
        policy = MlpPolicy.load(tmp_path / f"results/sac/pursuit-seed-{seed}.safetensors")
        _, alone = trained("sac", seed=seed)
        assert policy.card["seed"] == seed and policy.card["tuning_mean"] == pytest.approx(alone.best, abs=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("algo", ALGORITHMS)
def test_a_seed_determines_the_training(algo: str) -> None:
    (_, once), (_, again), (_, other) = trained(algo), trained(algo), trained(algo, seed=1)
    for name, tensor in once.tensors.items():
        np.testing.assert_array_equal(tensor, again.tensors[name])
    assert any((tensor != other.tensors[name]).any() for name, tensor in once.tensors.items())


@pytest.mark.slow
@pytest.mark.parametrize("algo", [algo for algo in ALGORITHMS if algo != "tqc"])  # SAC with other critics
def test_every_learner_passes_random_on_pursuit(algo: str, tmp_path: Path) -> None:
    budgets = {"sac": {"steps": 60_000}, "recurrent_ppo": {}, "bc": {"updates": 600}}
    settings = {"worlds": 256, "rollout": 32, "minibatch": 2048, "evaluate_worlds": 32, "threads": 1, "steps": 600_000}
    experiment = effective(Experiment(task="pursuit", ppo=settings, **{algo: budgets[algo]}), algo)  # type: ignore[arg-type]
    run = learn.new_run(experiment, algo)
    learn.train(experiment, algo, run, tmp_path)
    task = experiment.build()
    random = rollout(task, RandomPolicy(task.action_layout.size, 0), 32, worlds_for("tuning", 0, 32)).returns
    assert run.best is not None and run.best > random.mean() + 3 * random.std()
