"""Inner states of fish, the behaviour that follows from them, and the task `School`."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flockenv.behaviours import Evade, Forage, Separation, Shadow, Wander
from flockenv.behaviours.reconciliation import reconcile
from flockenv.behaviours.steer import Steer
from flockenv.envs.world import World
from flockenv.evaluation import rollout, worlds_for
from flockenv.jit.thread_pool import use_threads
from flockenv.model.spawn import Spawn
from flockenv.model.state import State
from flockenv.physics.effects import Fear, Grazing, Intention, Libido, Metabolism, Predation
from flockenv.physics.population import Threshold
from flockenv.players.rules import player
from flockenv.scene import Group, Scene
from flockenv.steering import motivation
from flockenv.steering.arbitration import Intentions
from flockenv.steering.vectorize import rows
from flockenv.studies.arbitration_trace import arbitration_shares
from flockenv.tasks import School
from flockenv.tasks.school import CAUGHT, EATEN, FATE, FEAR, FOOD, HUNGER, INTENT

pytestmark = pytest.mark.slow

FISH, HUNTERS, PATCHES = 6, 2, 3
AWAY = 1e3  # m, more than any radius of an effect


def tank(mortal: bool = True, **changes: Any) -> Scene:
    """Return fish, hunters and food under the effects of configs/scenes/fish.yaml; one kernel serves this file."""
    given: dict[str, Any] = {
        "hungry": {"rate": 0.02, "effort": 0.01, "start": 0.5, "spread": 0.4},
        "starving": {"rate": 0.0, "start": 0.8},
        "grazing": {"rate": 0.5, "growth": 0.2, "capacity": 3.0, "start": 0.5, "appetite": 2.0},
        "predation": {"meal": 0.5, "hungry": 0.3},
        "fear": {"fov": 300.0, "span": 2.0, "memory": 3.0},
        "libido": {"rate": 0.05, "ready": 0.4},
        "intention": {},
        "force": 8.0,
    }
    for name, change in changes.items():
        given[name] = {**given[name], **change} if isinstance(change, dict) else change
    spot = Spawn(low=(0, 0), high=(1, 1))
    groups = (
        Group(count=FISH, radius=0.2, max_speed=2, max_force=given["force"], spawn=spot),
        Group(count=HUNTERS, radius=0.4, max_speed=2.5, max_force=0, spawn=spot),
        Group(count=PATCHES, radius=0.1, max_speed=1, max_force=0, spawn=spot),
    )
    steer = Steer(
        group=0,
        arbitration=Intentions(when=("avoid", "escape", "eat", "mate", "school", "wander")),
        behaviours=(
            Separation(weight=0.5, radius=0.5, group=0), Evade(weight=6, group=1, radius=9, fov=300),
            Forage(weight=3, food=2, radius=12), Shadow(weight=4, group=0, radius=6, distance=0.2),
            Separation(weight=2, radius=1.5, group=0), Wander(weight=2, speed=1),
        ),
    )  # fmt: skip
    effects = (
        Metabolism(group=0, **given["hungry"]), Metabolism(group=1, **given["starving"]),
        Grazing(group=0, other=2, radius=1.0, **given["grazing"]),
        Predation(group=1, other=0, radius=0.6, **given["predation"]),
        Fear(group=0, other=1, radius=9, **given["fear"]),
        Libido(group=0, radius=0.6, **given["libido"]), Intention(**given["intention"]), steer,
    )  # fmt: skip
    sinks = (Threshold(group=0, of="hunger"), Threshold(group=0, of="caught")) if mortal else ()
    return Scene(groups=groups, effects=effects, population=sinks, dt=0.05)


def placed(scene: Scene, *places: Any, worlds: int = 1, velocity: Any = 0.0) -> State:
    """Return a state with the first agents of each group at `places`, the others far apart, all at `velocity`."""
    state = scene.start(1, worlds)
    n = scene.agents
    state.pos[...] = np.stack([AWAY * np.arange(1, n + 1), np.zeros(n)], axis=1)
    state.vel[...] = velocity
    for group, where in enumerate(places):
        for k, place in enumerate(where):
            state.pos[:, scene.starts[group] + k] = place
    return state


# --- closed forms -----------------------------------------------------------------------------------------------------


def test_hunger_grows_with_time_and_effort_up_to_1() -> None:
    scene = tank(mortal=False, force=0.0)
    state = placed(scene, velocity=(1.0, 0.0))  # half of max_speed; no force changes it
    hunger = np.array(scene.inner(state, "hunger"))
    assert np.ptp(hunger[0, :FISH]) > 0.05
    state = scene.run(state, 100)
    expected = hunger[0, :FISH] + (0.02 + 0.01 * 0.25) * 5.0
    np.testing.assert_allclose(scene.inner(state, "hunger")[0, :FISH], expected, rtol=1e-12)
    state = scene.run(state, 600)
    assert scene.inner(state, "hunger")[0, :FISH].max() == 1.0
    np.testing.assert_array_equal(scene.inner(state, "hunger")[0, FISH + HUNTERS :], 0)


def test_food_grows_by_the_logistic_equation_of_verhulst() -> None:
    scene = tank(force=0.0)
    state = scene.run(placed(scene), 200)
    a0, t = 1.5, 10.0
    expected = 3.0 / (1 + (3.0 / a0 - 1) * np.exp(-0.2 * t))
    np.testing.assert_allclose(scene.inner(state, "food")[0, -PATCHES:], expected, rtol=1e-12)
    np.testing.assert_array_equal(scene.inner(state, "food")[0, :-PATCHES], 0)


def test_food_is_conserved_and_lowers_the_hunger_of_fish() -> None:
    scene = tank(mortal=False, force=0.0, grazing={"growth": 0.0}, hungry={"rate": 0.0, "effort": 0.0})
    # two fish at the first patch, one between both, one out of reach
    state = placed(scene, [(0, 0), (0.3, 0), (0.8, 0), (0, 2.5)], (), [(0, 0), (1.6, 0)])
    food, hunger = (np.array(scene.inner(state, name)) for name in ("food", "hunger"))
    state = scene.run(state, 400)
    eaten, left = scene.inner(state, "eaten"), scene.inner(state, "food")
    assert abs(eaten.sum() + left.sum() - food.sum()) < 1e-12
    np.testing.assert_allclose(scene.inner(state, "hunger"), hunger - eaten / 2.0, atol=1e-12)
    assert left[0, FISH + HUNTERS] < 0.7
    assert (eaten[0, :3] > 0.1).all()
    np.testing.assert_array_equal(eaten[0, 3:], 0)


def test_fear_rises_with_hunters_in_sight_and_decays() -> None:
    scene = tank(mortal=False, force=0.0, predation={"meal": 0.0})
    hunters = [(0, 0), (0, 3)]
    ahead, behind, hurried = (4.0, 0.0), (-8.0, 0.0), (1.0, 0.5)  # the second swims away from both
    state = placed(scene, [ahead, behind, hurried], hunters, velocity=(-1e-9, 0.0))
    fear = scene.inner(scene.run(state, 1), "fear")[0]
    np.testing.assert_allclose(fear[0], 2 / 4 + 2 / 5, rtol=1e-6)
    assert fear[1] == 0
    assert fear[2] == 1
    assert (fear[3:] == 0).all()
    state = scene.run(state, 1)
    state.pos[0, FISH : FISH + HUNTERS] = -AWAY
    state = scene.run(state, 40)
    np.testing.assert_allclose(scene.inner(state, "fear")[0, 0], 0.9 * np.exp(-2 / 3), rtol=1e-6)


def test_two_ready_fish_mate_and_a_hungry_one_does_not() -> None:
    scene = tank(mortal=False, force=0.0, hungry={"rate": 0.0, "effort": 0.0, "start": 0.2, "spread": 0.0})
    state = placed(scene, [(0, 0), (0.5, 0), (0, 9), (0.5, 9)])
    scene.inner(state, "hunger")[0, 3] = 0.9
    state = scene.run(state, 199)  # 0.05 x 9.95 x 0.8 = 0.398
    assert scene.inner(state, "mated").sum() == 0
    state = scene.run(state, 3)
    np.testing.assert_array_equal(scene.inner(state, "mated")[0, :FISH], [1, 1, 0, 0, 0, 0])
    urge = scene.inner(state, "libido")[0, :FISH]
    assert (urge[:2] < 0.01).all()
    np.testing.assert_allclose(urge[2:], 0.05 * 202 * 0.05, rtol=1e-12)


def test_caught_and_starved_fish_die_and_a_fed_hunter_stops_hunting() -> None:
    hungry = {"rate": 0.02, "effort": 0.0, "start": 0.5, "spread": 0.0}
    scene = tank(force=0.0, hungry=hungry, predation={"meal": 0.6})
    state = placed(scene, [(0, 0.5), (0, 0.7), (9, 0)], [(0, 0), (9, 3)])
    scene.inner(state, "hunger")[0, 5] = 0.9995
    state = scene.run(state, 1)
    np.testing.assert_array_equal(state.alive[0, :FISH], [False, True, True, True, True, False])
    assert state.count_of("deaths") == 2
    np.testing.assert_allclose(scene.inner(state, "hunger")[0, FISH : FISH + HUNTERS], [0.2, 0.8])
    state.pos[0, 1] = (0, 0.1)  # the hunter is not hungry now
    state = scene.run(state, 5)
    assert state.alive[0, 1]


# --- intentions -------------------------------------------------------------------------------------------------------


def test_intentions_follow_fear_before_needs_with_hysteresis() -> None:
    """A state begins above its level and ends a margin below it; values rise and fall through every level."""
    law = rows(motivation.intention)

    def walk(name: str, values: Any, **rest: float) -> list[float]:
        now, found = 0.0, []
        for value in values:
            needs = {"hunger": 0.0, "libido": 0.0, "fear": 0.0} | rest | {name: value}
            now = float(law(now, needs["hunger"], needs["libido"], needs["fear"], 0.4, 0.15, 0.5, 0.1, 0.3))
            found.append(now)
        return found

    names = {name: float(k) for k, name in enumerate(motivation.INTENTIONS)}
    rise, fall = [0.1, 0.2, 0.39, 0.41], [0.35, 0.31, 0.29, 0.1, 0.04]
    expected = ["wander", "school", "school", "escape", "escape", "escape", "school", "school", "wander"]
    assert walk("fear", rise + fall) == [names[name] for name in expected]
    assert walk("hunger", [0.4, 0.51, 0.4, 0.21, 0.19, 0.4]) == [
        names[n] for n in ("wander", *["eat"] * 3, *["wander"] * 2)
    ]
    assert walk("libido", [0.4, 0.51, 0.21, 0.19]) == [names[n] for n in ("wander", "mate", "mate", "wander")]
    # the larger need wins, but replaces the other only if larger by the margin; fear comes before both
    assert walk("libido", [0.7, 0.85, 0.95], hunger=0.6) == [names["mate"]] * 3
    assert walk("libido", [0.55, 0.85, 0.95], hunger=0.6) == [names[n] for n in ("eat", "eat", "mate")]
    assert walk("fear", [0.2, 0.5], hunger=0.9, libido=0.9) == [names[n] for n in ("school", "escape")]


def test_only_permanent_behaviours_and_those_of_the_intention_are_granted() -> None:
    record = Intentions(when=("avoid", "escape", "eat", "eat"))
    forces = np.array([[[3, 0], [0, 9], [4, 0], [0, 4]]] * 3, float)
    force, share = reconcile(record, forces, 8.0, inner={"intention": [0.0, 3.0, 4.0]})
    np.testing.assert_allclose(share, [[1, 0, 0, 0], [1, 0, 1, 0.25], [1, 5 / 9, 0, 0]])
    np.testing.assert_allclose(force, [[3, 0], [7, 1], [3, 5]])
    with pytest.raises(ValueError, match=r"arbitration.when = \['eat'\]: must be one for each of 2 behaviours"):
        Steer(arbitration=Intentions(when=("eat",)), behaviours=(Wander(weight=1), Wander(weight=2)))


def test_fish_flee_hunters_in_sight_only() -> None:
    scene = tank(mortal=False, predation={"meal": 0.0}, hungry={"start": 0.2, "spread": 0.0})
    state = placed(
        scene, [(3, 0), (-3, 0)], [(0, 0)], velocity=(-0.5, 0.0)
    )  # the first swims towards the hunter, the second away
    state = scene.run(state, 10)
    intent = scene.inner(state, "intention")[0]
    assert intent[0] == motivation.ESCAPE
    assert intent[1] == motivation.WANDER
    away = state.vel[0, 0] / np.linalg.norm(state.vel[0, 0])
    assert away[0] > 0.9
    assert np.linalg.norm(state.vel[0, 1]) < 1.05  # it goes on wandering


@pytest.mark.slow  # a kernel for each behaviour
def test_the_trace_of_arbitration_follows_the_intention() -> None:
    scene = tank(mortal=False, predation={"meal": 0.0}, hungry={"start": 0.2, "spread": 0.0})
    state = placed(scene, [(3, 0), (-3, 0)], [(0, 0)], velocity=(-0.5, 0.0))
    share = arbitration_shares(scene, scene.run(state, 2))[0].share[0]
    assert share[0, 1] > 0
    assert (share[0, 2:] == 0).all()
    assert (share[1, 1:5] == 0).all()
    assert share[1, 5] > 0


def test_eating_does_not_depend_on_order_batch_or_threads() -> None:
    scene = tank()
    near = [(0.3 * k, 0.4 * (k % 2)) for k in range(FISH)]
    state = placed(scene, near, [(6, 6)], [(1, 0), (4, 4)], worlds=3)
    state.pos[1, :FISH] += 0.01
    start = state.copy()
    end = scene.run(state, 100)
    assert scene.inner(end, "eaten")[0].max() > 0.1
    use_threads(2)
    try:
        again = scene.run(start.copy(), 100)
    finally:
        use_threads(1)
    for name in ("pos", "vel", "alive", "inner"):
        np.testing.assert_array_equal(getattr(end, name), getattr(again, name))
    alone = scene.run(placed(scene, near, [(6, 6)], [(1, 0), (4, 4)]), 100)
    np.testing.assert_array_equal(alone.inner[:, 0], end.inner[:, 0])
    calm = tank(mortal=False, force=0.0)  # no forces: random numbers depend on the agent
    one = placed(calm, near, [(6, 6)], [(1, 0), (4, 4)])
    for name in ("hunger", "libido"):
        calm.inner(one, name)[0, :FISH] = np.linspace(0.2, 0.8, FISH)
    other, turn = one.copy(), np.arange(FISH)[::-1]
    other.pos[0, :FISH], other.inner[:, 0, :FISH] = one.pos[0, turn], one.inner[:, 0, turn]
    one, other = calm.run(one, 50), calm.run(other, 50)
    np.testing.assert_allclose(other.inner[:, 0, :FISH], one.inner[:, 0, turn], rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(other.inner[:, 0, FISH:], one.inner[:, 0, FISH:], rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: tank(grazing={"rate": 4.0}),
            "effects[2].rate = 4: all 6 of groups[0] could eat more than a patch holds",
        ),
        (lambda: Metabolism(start=0.9, spread=0.4), "spread = 0.4: at most 0.2 is allowed"),
        (lambda: Intention(school=0.5), "school = 0.5: must not be above escape = 0.4"),
        (lambda: Intention(content=0.5), "content = 0.5: must be below need = 0.5"),
        (
            lambda: Scene(
                groups=(Group(count=1, spawn=Spawn(low=(0, 0), high=(1, 1))),), population=(Threshold(of="hunger"),)
            ),
            "population[0].of = 'hunger': no effect of this scene keeps such an inner number",
        ),
        (lambda: School(learners=9), "learners = 9: there are only 8 fish"),
        (lambda: School(grazing=2.0), "grazing = 2: 8 fish could eat more than there is"),
        (lambda: School(start_distance=15), "start_distance = 15"),
    ],
)
def test_bad_numbers_raise_errors_of_one_line(make: Any, message: str) -> None:
    with pytest.raises(ValueError, match=r".") as caught:
        make()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


# --- the task ---------------------------------------------------------------------------------------------------------

FAR = ((1.0, 23.0), (23.0, 23.0), (23.0, 1.0))


def school(fish: Any, hunter: Any, patches: Any, hunger: float = 0.4, hunting: bool = True, worlds: int = 1) -> World:
    """Return a world with the first fish at the places in `fish`, the rest in a corner, all at rest."""
    world = World(School(), worlds)
    world.reset(3)
    task = world.task
    assert isinstance(task, School)
    corner = [(0.5 + 0.4 * k, 0.5) for k in range(task.fish)]
    places = [*fish, *corner[len(fish) :], hunter, *patches]
    world.state.pos[:], world.state.vel[:] = places, 0.0
    world._memory[...] = 0.0
    world._memory[HUNGER, :, :9], world._memory[FOOD, :, 9:] = hunger, task.capacity
    world._memory[HUNGER, :, 8], world._memory[INTENT, :, 8] = (
        (0.9, motivation.EAT) if hunting else (0.0, motivation.WANDER)
    )
    return world


def still(world: World) -> Any:
    return world.step(np.zeros((world.worlds, world.learners, 2)))


def test_the_task_conserves_food_and_rewards_low_hunger() -> None:
    world = school([(12, 12), (12.5, 12)], (23, 12), [(12.2, 12), *FAR], hunting=False)
    step, task = still(world), world.task
    assert isinstance(task, School)
    memory = world._memory[:, 0]
    eaten = 0.5 * 1.5 * 0.4 * 0.1
    np.testing.assert_allclose(memory[EATEN, :2], eaten, rtol=1e-12)
    assert abs(memory[EATEN, :8].sum() - memory[EATEN, 9:].sum()) < 1e-12
    np.testing.assert_allclose(memory[FOOD, 9], 1.5 - 2 * eaten, rtol=1e-12)  # a full patch does not grow
    np.testing.assert_allclose(memory[HUNGER, :3], [0.402 - eaten, 0.402 - eaten, 0.402], rtol=1e-12)
    np.testing.assert_allclose(step.terms[0, 0], [0.05, 0.05 * (1 - memory[HUNGER, 0]), 0.0], rtol=1e-12)


def test_dead_fish_terminate_are_penalised_once_and_are_no_longer_observed() -> None:
    world = school([(12, 12), (12, 14)], (12, 11.6), [(5, 12), *FAR])
    world._memory[HUNGER, 0, 3] = 0.9999
    first = still(world)
    np.testing.assert_array_equal(first.terminated[0], [True, False, False, True, *[False] * 4])
    np.testing.assert_array_equal(first.alive[0], ~first.terminated[0])
    np.testing.assert_array_equal(world._memory[FATE, 0, :4], [CAUGHT, 0, 0, 2])
    np.testing.assert_array_equal(first.terms[0, 0], [0, 0, -10])
    np.testing.assert_array_equal(first.terms[0, 3], [0, 0, -10])
    assert not first.ended.any()
    assert first.success.all()
    np.testing.assert_allclose(world._memory[HUNGER, 0, 8], 0.9 + 0.04 * 0.1 - 0.8, atol=2e-3)  # the hunter has eaten
    np.testing.assert_array_equal(np.flatnonzero(first.observation[0, 0]), [6])
    later = still(world)
    np.testing.assert_array_equal(later.terms[0, [0, 3]], 0)
    assert later.terminated[0, [0, 3]].all()
    seen = world.task.layout.unpack(later.observation[0])
    offsets = np.linalg.norm(world.state.pos[0, 1] - seen.mates[1] - world.state.pos[0, 0], axis=-1)
    assert (offsets > 1e-3).all()
    measured = {name: float(value[0]) for name, value in world.measure().items()}
    assert measured["survived"] == 0.75
    assert measured["caught"] == measured["starved"] == 0.125


def test_observations_of_fish_exclude_what_lies_behind() -> None:
    world = school([(12, 12), (14, 12), (10, 12.5)], (12, 16), [(16, 12), (8, 12), *FAR[:2]], hunting=False)
    world.state.vel[0, 0] = (1.0, 0.0)  # towards the second fish; the third and one patch are behind
    world._memory[FOOD, 0, 9] = 0.75
    seen, s = world.task.layout.unpack(world.reset(mask=np.zeros(1, bool))[0]), world.state
    np.testing.assert_allclose(seen.mates[0, 0], (2, 0), atol=1e-6)
    np.testing.assert_array_equal(seen.mate_present[0], [1, 0, 0])
    np.testing.assert_allclose(seen.food[0, 0], (4, 0), atol=1e-6)
    np.testing.assert_allclose(seen.food_amount[0], [0.75, 0, 0], atol=1e-6)
    np.testing.assert_allclose(seen.hunters[0, 0], (0, 4), atol=1e-6)
    np.testing.assert_allclose(seen.hunter_closeness[0, 0], 0.2, atol=1e-6)
    np.testing.assert_allclose(seen.hunger[0], 0.4, atol=1e-6)
    s.vel[0, 0] = (0.0, -1.0)
    seen = world.task.layout.unpack(world.reset(mask=np.zeros(1, bool))[0])
    assert seen.hunter_present[0, 0] == 0
    still(world)
    assert world._memory[FEAR, 0, 0] == 0
    np.testing.assert_allclose(world._memory[FEAR, 0, 1], 1 / np.hypot(2, 4), rtol=1e-2)


def test_the_textbook_player_flees_keeps_its_state_and_beats_random() -> None:
    task = School()
    rules = player(task, name="textbook")
    empty = {slot.name: np.zeros((2, *slot.shape)) for slot in task.layout.slots}
    empty |= {"to_low": np.full((2, 2), 12.0), "to_high": np.full((2, 2), 12.0), "velocity": np.full((2, 2), 0.1)}

    def act(state: Any, **given: Any) -> tuple[Any, Any]:
        quantities = empty | {name: np.broadcast_to(value, empty[name].shape) for name, value in given.items()}
        row = np.concatenate([(quantities[s.name] / s.scale).reshape(2, -1) for s in task.layout.slots], axis=1)
        return rules.predict(row.astype(np.float32), state)

    hunted = {"hunters": (3.0, 0.0), "hunter_bearing": (1.0, 0.0), "hunter_present": 1.0}
    action, state = act(None, fear=0.5, **hunted)
    np.testing.assert_array_equal(state, motivation.ESCAPE)
    assert (action[:, 0] < -0.9).all()
    food = {"food": [(0, 4), (0, 0), (0, 0)], "food_bearing": [(0, 1), (0, 0), (0, 0)]}
    action, state = act(state, hunger=0.6, **food)
    np.testing.assert_array_equal(state, motivation.EAT)
    assert (action[:, 1] > 0.9).all()
    np.testing.assert_array_equal(act(state, hunger=0.3, **food)[1], motivation.EAT)
    np.testing.assert_array_equal(act(None, hunger=0.3, **food)[1], motivation.WANDER)

    class Random:
        def predict(self, seen: Any, state: Any = None, *_: Any) -> Any:
            return np.random.default_rng(7).uniform(-1, 1, (len(seen), 2)), state

    short, seed = School(horizon=200), worlds_for("tuning", 1, 16)
    ours, theirs = (rollout(short, each, 16, seed) for each in (player(short, name="textbook"), Random()))  # type: ignore[arg-type]
    assert np.mean(ours.returns - theirs.returns) > 3
    assert ours.metrics["survived"].mean() > theirs.metrics["survived"].mean() + 0.2


def test_scripted_fish_survive_and_use_all_states_except_mate() -> None:
    world = World(School(learners=1), 32)
    world.reset(5)
    states = set()
    for _ in range(200):
        still(world)
        states |= set(world._memory[INTENT, :, 1:8][world.state.alive[:, 1:8]].tolist())
    assert states == {motivation.WANDER, motivation.SCHOOL, motivation.EAT, motivation.ESCAPE}
    assert world.state.alive[:, 1:8].mean() > 0.6
