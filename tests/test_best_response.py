"""Best response: one agent of each world deviates from the others; its seat, its return, and the payoffs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from agents import best_response
from flockenv.envs.world import World
from flockenv.evaluation import Episodes, rollout, worlds_for
from flockenv.players.policy import RandomPolicy
from flockenv.tasks import Flock, School

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
    made = lambda task, worlds, limit: best_response.Among(task, worlds, limit, Steady(theirs))  # noqa: E731
    alone = rollout(TASK, Steady(0.2), WORLDS, first, make_world=made)
    np.testing.assert_allclose(alone.returns, returns_of_seats(actions), rtol=0, atol=1e-12)
    assert (alone.lengths < TASK.horizon).any()  # some were out before the time limit


def test_payoffs_depend_on_both_players_and_are_reproducible() -> None:
    field = {"calm": lambda task: Steady(0.0), "wild": lambda task: RandomPolicy(2, 0)}
    calls: list[int] = []
    flock = Flock(agents=7, horizon=10)
    payoffs = best_response.invade(flock, field, WORLDS, advance=lambda: calls.append(1))  # type: ignore[arg-type]
    assert len(calls) == 4 and payoffs.players == ("calm", "wild")
    assert not np.array_equal(payoffs.of["calm", "calm"].returns, payoffs.of["calm", "wild"].returns)
    assert not np.array_equal(payoffs.of["calm", "calm"].returns, payoffs.of["wild", "calm"].returns)
    again = best_response.invade(flock, field, WORLDS)  # type: ignore[arg-type]
    assert all(np.array_equal(payoffs.of[key].returns, again.of[key].returns) for key in payoffs.of)
    assert [column.header for column in best_response.table_of(payoffs).columns] == ["", "calm", "wild"]


def made_up(aa: float, ab: float, ba: float, bb: float, noise: float = 0.1) -> best_response.Payoffs:
    """Return payoffs of `a` among `a`, of `a` among `b`, and so on, with noise between worlds."""
    values = {("a", "a"): aa, ("a", "b"): ab, ("b", "a"): ba, ("b", "b"): bb}
    luck = np.random.default_rng(0)

    def episodes(value: float) -> Episodes:
        returns = value + noise * luck.normal(size=40)
        return Episodes(
            "toy", "same", 0, 10, returns, returns > 0, np.full(40, 10), {}, {}, microseconds=1.0, latency=1.0
        )

    return best_response.Payoffs("toy", ("a", "b"), {key: episodes(value) for key, value in values.items()})


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
def test_the_verdict_follows_from_the_payoffs(payoffs: best_response.Payoffs, verdict: str) -> None:
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
