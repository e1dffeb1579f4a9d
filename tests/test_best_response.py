"""Best response: one agent of each world deviates from the others; its seat, its return, and the payoffs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from agents import best_response, invasion
from flockenv.envs.disturbance import Disturbance
from flockenv.envs.world import World
from flockenv.evaluation import Episodes, rollout, worlds_for
from flockenv.players import load_player
from flockenv.studies.play_jobs import Player
from flockenv.tasks import Bottleneck, Crossing, Flock, School

FISH, WORLDS = 3, 7
TASK = School(fish=FISH, horizon=60, start_hunger=0.6, metabolism=0.2)  # some starve before the time limit


class Steady:
    """A player with memory: it pushes along x by push cos(n) at decision n."""

    def __init__(self, push: float) -> None:
        self.push = push

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[Any, Any]:
        n = np.zeros(len(observation)) if state is None or episode_start.all() else state
        action = np.zeros((len(observation), 2), np.float32)
        action[:, 0] = self.push * np.cos(n)
        return action, n + 1


def returns_of_seats(actions: Any) -> Any:
    """Return the reward of learner k % L of world k until it is out, if learner i of it acts by `actions(t)[k, i]`."""
    world = World(TASK, WORLDS, TASK.horizon)
    world.reset(worlds_for("evaluation", 0, WORLDS))
    seats, paid, lives = np.arange(WORLDS) % FISH, np.zeros(WORLDS), np.ones(WORLDS, np.bool_)
    for t in range(TASK.horizon):
        step = world.step(actions(t))
        paid += np.where(lives, step.reward[np.arange(WORLDS), seats], 0.0)
        lives &= ~step.terminated[np.arange(WORLDS), seats]
    return paid


@pytest.mark.parametrize("theirs", [0.2, -0.8])
def test_one_agent_per_world_deviates_and_is_rewarded_until_it_is_out(theirs: float) -> None:
    def actions(t: int) -> Any:
        push = np.full((WORLDS, FISH, 2), theirs * np.cos(t))
        push[np.arange(WORLDS), np.arange(WORLDS) % FISH] = 0.2 * np.cos(t)
        push[..., 1] = 0.0
        return push.astype(np.float32)

    first = worlds_for("evaluation", 0, WORLDS)
    made = lambda task, worlds, limit: invasion.Among(task, worlds, limit, Steady(theirs))  # noqa: E731
    alone = rollout(TASK, Steady(0.2), WORLDS, first, make_world=made)
    np.testing.assert_allclose(alone.returns, returns_of_seats(actions), rtol=0, atol=1e-12)
    assert (alone.lengths < TASK.horizon).any()  # some were out before the time limit


def test_several_agents_per_world_are_spread_evenly_and_rewarded() -> None:
    task, learners, egos = Crossing(agents=6, horizon=5), 6, 3
    among = invasion.Among(task, WORLDS, 5, Steady(-0.5), egos)
    plain = World(task, WORLDS, 5)
    seats = (np.arange(WORLDS)[:, None] + np.array([0, 2, 4])) % learners
    mine = (np.arange(learners) == seats[:, :, None]).any(axis=1)
    rows, seen = among.reset(3), plain.reset(3)
    np.testing.assert_array_equal(rows, seen[mine].reshape(WORLDS, egos, -1))
    for t in range(5):
        actions = np.random.default_rng(t).uniform(-1, 1, (WORLDS, egos, 2)).astype(np.float32)
        joint = np.zeros((WORLDS, learners, 2))
        joint[..., 0] = np.float32(-0.5 * np.cos(t))
        joint[mine] = actions.reshape(-1, 2)
        step, expected = among.step(actions), plain.step(joint)
        for name in ("observation", "reward", "terms", "terminated", "alive"):
            values = getattr(expected, name)[mine]
            np.testing.assert_array_equal(getattr(step, name), values.reshape(WORLDS, egos, *values.shape[1:]))
    assert step.truncated.all()


def test_success_is_that_of_the_one_agent() -> None:
    task = Crossing(agents=6, horizon=150)
    made = lambda task, worlds, limit: invasion.Among(task, worlds, limit, Steady(0.0))  # noqa: E731  # they stay
    alone = rollout(task, load_player("rules", task), WORLDS, 0, make_world=made)
    assert alone.success.any()
    assert not rollout(task, Steady(0.0), WORLDS, 0, make_world=made).success.any()


def test_success_of_each_agent() -> None:
    memory, alive = np.zeros((1, 6, 3)), np.array([[True, False, True]])
    memory[0, 2], memory[0, 1] = [1.0, 2.0, 0.0], [10.0, 1e6, 10.0]  # the first is out unhurt, the second out and hurt
    state = Flock(agents=3).scene.start(seed=0)
    expected = ((Bottleneck(people=3), [True, False, False]), (School(fish=3), [True, False, True]), (Flock(), None))
    for task, marks in expected:
        found = task.own_success(state, memory, alive)
        assert marks is None if found is None else found.tolist() == [marks]


def test_payoffs_depend_on_both_players_and_are_reproducible() -> None:
    field = [Player.of("rules"), Player.of("random")]
    flock = Flock(agents=7, horizon=10)
    payoffs = invasion.invade(flock, field, WORLDS)
    assert payoffs.players == ("rules", "random") and len(payoffs.of) == 4
    assert not np.array_equal(payoffs.of["rules", "rules"].returns, payoffs.of["rules", "random"].returns)
    assert not np.array_equal(payoffs.of["rules", "rules"].returns, payoffs.of["random", "rules"].returns)
    again = invasion.invade(flock, field, WORLDS)
    assert all(np.array_equal(payoffs.of[key].returns, again.of[key].returns) for key in payoffs.of)
    assert [column.header for column in best_response.table_of(payoffs).columns] == ["", "rules", "random"]


@pytest.mark.slow
def test_all_agents_play_in_the_same_disturbance() -> None:
    flock, field, delay = Flock(agents=5, horizon=10), [Player.of("rules")], Disturbance(delay=3)
    payoffs = invasion.invade(flock, field, WORLDS, disturbance=delay)
    rules = load_player("rules", flock)
    made = lambda task, worlds, limit: invasion.Among(task, worlds, limit, rules, 1, delay)  # noqa: E731
    expected = rollout(flock, rules, WORLDS, worlds_for("evaluation", 0, WORLDS), make_world=made).returns
    calm = invasion.invade(flock, field, WORLDS)
    np.testing.assert_array_equal(payoffs.of["rules", "rules"].returns, expected)
    assert not np.array_equal(calm.of["rules", "rules"].returns, expected)
    about = best_response.content_of(payoffs)["disturbance"]
    assert about == delay.model_dump() and "disturbance" not in best_response.content_of(calm)


@pytest.mark.slow
def test_one_policy_under_two_names_gains_nothing_and_pairs_are_symmetric(tmp_path: Path) -> None:
    text = "import numpy as np\ndef predict(observation):\n    return 0.3 * observation[:, :2]\n"
    for name in ("one.py", "other.py"):
        (tmp_path / name).write_text(text, encoding="utf-8")
    field = [Player.of(str(tmp_path / name)) for name in ("one.py", "other.py")]
    payoffs = invasion.invade(Flock(agents=5, horizon=10), field, WORLDS)
    returns = [episodes.returns for episodes in payoffs.of.values()]
    assert len(returns) == 4 and all(np.array_equal(each, returns[0]) for each in returns)
    content = best_response.content_of(payoffs)
    assert content["gain"] == {"one among other": [0.0, 0.0, 0.0], "other among one": [0.0, 0.0, 0.0]}
    assert content["verdicts"][0].endswith("not decided in these worlds")


def test_a_job_is_another_one_if_the_others_play_another_policy() -> None:
    jobs = invasion.jobs_of(Flock(agents=5), [Player.of("rules"), Player.of("textbook")], WORLDS)
    assert len({job.key for job in jobs.values()}) == 4
    with pytest.raises(ValueError, match="single learner"):
        invasion.jobs_of(Flock(agents=5, learners=1), [Player.of("rules")], WORLDS)


def made_up(aa: float, ab: float, ba: float, bb: float, noise: float = 0.1) -> invasion.Payoffs:
    """Return payoffs of `a` among `a`, of `a` among `b`, and so on, with noise between worlds."""
    values = {("a", "a"): aa, ("a", "b"): ab, ("b", "a"): ba, ("b", "b"): bb}
    luck = np.random.default_rng(0)

    def episodes(value: float) -> Episodes:
        returns = value + noise * luck.normal(size=40)
        return Episodes(
            "toy", "same", 0, 10, returns, returns > 0, np.full(40, 10), {}, {}, microseconds=1.0, latency=1.0
        )

    return invasion.Payoffs("toy", ("a", "b"), {key: episodes(value) for key, value in values.items()})


@pytest.mark.parametrize(
    ("payoffs", "verdict"),
    [
        (made_up(1, 5, 0, 3), "a prisoner's dilemma, each agent does better with a and all together with b"),
        (made_up(3, 0, 5, 1), "a prisoner's dilemma, each agent does better with b and all together with a"),
        (made_up(1, 2, 4, 5), "b is the better answer to both"),
        (made_up(3, 0, 0, 5), "either is best among its own kind"),
        (made_up(1, 5, 5, 3), "either does better among the other kind"),
        (made_up(1, 5, -3, 1), "a is the better answer to both"),
        (made_up(1, 1, 1, 1), "not decided in these worlds"),
    ],
)
def test_the_verdict_follows_from_the_payoffs(payoffs: invasion.Payoffs, verdict: str) -> None:
    assert payoffs.verdict("a", "b").endswith(verdict)
    assert payoffs.verdict("b", "a") == payoffs.verdict("a", "b")
    assert payoffs.mean("a", "b").low < payoffs.of["a", "b"].returns.mean() < payoffs.mean("a", "b").high


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["configs/training/pursuit.yaml"],
            "task 'pursuit': each world has a single learner; this command needs at least two",
        ),
        (["configs/training/school.yaml", "--players", "ppo,nobody"], "player 'nobody': unknown"),
        (["configs/training/school.yaml", "--players", "orca"], "no hand-written player 'orca' for 'school'"),
        (["configs/no.yaml"], "configs/no.yaml"),
    ],
)
def test_an_invalid_command_is_refused_in_one_line(arguments: list[str], message: str) -> None:
    result = CliRunner().invoke(best_response.app, [*arguments, "--worlds", "2"])
    assert result.exit_code == 2
    assert message in result.stderr and len(result.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (
            "return np.zeros((len(observation), 2 + (len(observation) > 2))), None",
            "mine.py': ValueError in predict: actions of shape (14, 3), must be (14, 2) (task 'school')",
        ),
        ("return observation[:, 10_000], None", "IndexError in predict, line 3: "),
    ],
)
def test_a_player_that_fails_among_others_is_named(tmp_path: Path, code: str, message: str) -> None:
    lines = ("import numpy as np", "def predict(observation, state=None, episode_start=None, deterministic=True):")
    (tmp_path / "mine.py").write_text("\n".join((*lines, f"    {code}", "")), encoding="utf-8")
    arguments = ["configs/training/school.yaml", "--players", str(tmp_path / "mine.py"), "--worlds", "2"]
    result = CliRunner().invoke(best_response.app, arguments)
    assert result.exit_code == 2, result.output
    assert message in result.stderr and "mine" in result.stderr and len(result.stderr.strip().splitlines()) == 1


def test_the_command_prints_a_table_and_a_verdict_for_each_pair() -> None:
    command = ["configs/training/school.yaml", "--players", "textbook,rules", "--worlds", "8"]
    result = CliRunner().invoke(best_response.app, command)
    assert result.exit_code == 0, result.output
    assert "school: mean return of one agent that plays the row, among others that play the column" in result.stdout
    assert "rules among textbook: " in result.stdout and "textbook among rules: " in result.stdout


def test_the_command_writes_files_a_picture_and_a_page_from_stored_jobs(tmp_path: Path) -> None:
    command = ["configs/training/flock.yaml", "--players", "textbook,rules", "--worlds", "2", "--processes", "1"]
    arguments = [*command, "--out", str(tmp_path / "payoffs")]
    first = CliRunner().invoke(best_response.app, arguments)
    assert first.exit_code == 0, first.output
    page = (tmp_path / "payoffs.md").read_text(encoding="utf-8")
    content = json.loads((tmp_path / "payoffs" / "flock.json").read_text(encoding="utf-8"))
    assert content["players"] == ["textbook", "rules"] and len(content["mean"]) == 4 and len(content["gain"]) == 2
    mean, gain = content["mean"]["rules among textbook"][0], content["gain"]["rules among textbook"][0]
    assert f"{mean:.3g} ({gain:+.3g} [" in page and f"* {content['verdicts'][0]}" in page
    assert (tmp_path / "payoffs" / "flock.png").read_bytes().startswith(b"\x89PNG")
    records = {path: path.stat().st_mtime_ns for path in (tmp_path / "payoffs" / "jobs").rglob("*") if path.is_file()}
    again = CliRunner().invoke(best_response.app, arguments)
    assert again.exit_code == 0 and (tmp_path / "payoffs.md").read_text(encoding="utf-8") == page
    now = {path: path.stat().st_mtime_ns for path in (tmp_path / "payoffs" / "jobs").rglob("*") if path.is_file()}
    assert sum("among" in str(path) and now[path] == records[path] for path in records) >= 4  # nothing is played twice
