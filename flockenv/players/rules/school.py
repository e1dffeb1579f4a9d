"""School: a state machine: flee, join other fish, eat, or wander; in each state avoid walls and other fish."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv import steering
from flockenv.players.rules.parameter import Order, in_order, parameter, per_row
from flockenv.players.rules.slots import nearest
from flockenv.players.rules.vectors import length
from flockenv.steering import arbitration, motivation
from flockenv.steering.vectorize import rows
from flockenv.tasks import School

__all__ = ["SchoolRules", "school"]

align = rows(steering.align)
allocate = rows(arbitration.allocate)
arrive = rows(steering.arrive)
contain = rows(steering.contain)
evade_from = rows(steering.evade)
intention = rows(motivation.intention)
separate = rows(steering.separate)
wander = rows(steering.wander)


@dataclass(frozen=True)
class SchoolRules:
    """Parameters of `school`; defaults: Tu and Terzopoulos 1994, thresholds as in the scene's `intention`."""

    escape: float = parameter(0.4, 0.05, 1.0)  # fear above which it flees
    school: float = parameter(0.15, 0.05, 1.0)  # fear above which it joins other fish
    need: float = parameter(0.5, 0.05, 0.8)  # hunger above which it eats
    calm: float = parameter(0.1, 0.0, 0.2)  # hysteresis: decrease of fear that ends fleeing or schooling
    content: float = parameter(0.3, 0.0, 0.6)  # hysteresis: decrease of hunger that ends eating
    wall: float = parameter(0.3, 0.1, 1.5)  # s, how far ahead walls count
    apart: float = parameter(1.0, 0.0, 4.0)  # N m, separation from agents that it nearly touches
    predict: float = parameter(0.5, 0.0, 2.0)  # s, how far ahead a hunter is predicted at most
    evade: float = parameter(5.0, 1.0, 8.0)  # kg/s, strength of an evasion
    middle: float = parameter(0.0, 0.0, 1.5)  # N/m towards the middle of the tank while it flees
    forage: float = parameter(5.0, 1.0, 8.0)  # kg/s, towards food
    rich: float = parameter(0.0, 0.0, 20.0)  # m by which a full patch counts as nearer than an empty one
    match: float = parameter(2.0, 0.0, 5.0)  # kg/s, alignment
    centre: float = parameter(1.0, 0.0, 3.0)  # N/m, cohesion
    pace: float = parameter(0.5, 0.1, 1.0)  # speed of wandering, as a share of the top speed
    turn: float = parameter(0.2, 0.0, 1.0)  # m aside per m ahead, while it wanders


BEHAVIOURS = ("contain", "separate", "flee", "join", "eat", "wander")
"""In order of priority; the last four are active in one state each."""

_STATES = (motivation.ESCAPE, motivation.SCHOOL, motivation.EAT, motivation.WANDER)


def school(
    see: Any, task: School, p: SchoolRules, before: Any, begins: Any, order: Order = None
) -> tuple[NDArray[np.floating], NDArray[np.float64]]:
    """Select a state from hunger and fear, with hysteresis, and its behaviours; return force and state, (R,)."""
    count, top, ahead = len(see.velocity), task.fish_speed, np.array([1.0, 0.0])
    known = before is not None and np.shape(before) == (count,)
    was = np.where(begins, 0.0, before) if known else np.zeros(count)
    calm, content = np.minimum(p.calm, p.school), np.minimum(p.content, p.need)
    now = intention(was, see.hunger, 0.0, see.fear, np.maximum(p.escape, p.school), p.school, p.need, calm, content)
    hunted, hunter, its_velocity = nearest(see.hunter_present, see.hunters, see.hunter_velocity)
    # without a hunter or food in sight: wander
    has_food = length(see.food_bearing) > 0
    selected = np.where((now == motivation.ESCAPE) & ~hunted, motivation.WANDER, now)
    selected = np.where((now == motivation.EAT) & ~has_food.any(axis=1), motivation.WANDER, selected)
    here = see.mate_present
    selected = np.where((now == motivation.SCHOOL) & (here.sum(axis=1) == 0), motivation.WANDER, selected)

    inside = 5.0 * contain(see.to_low - 0.5, see.to_high - 0.5, see.velocity, top, p.wall)
    near = here * (length(see.mates) < 0.6)
    push = per_row(p.apart) * np.sum(separate(see.mates, ahead) * near[..., None], axis=1)
    time = np.minimum(length(hunter) / task.hunter_speed, p.predict)
    flight = per_row(p.evade) * evade_from(hunter, see.velocity, its_velocity, top, time)
    flight += per_row(p.middle) * (see.to_high - see.to_low) / 2
    many = np.maximum(here.sum(axis=1), 1.0)[:, None]
    course = np.sum(see.mate_velocity * here[..., None], axis=1) / many
    centre = np.sum(see.mates * here[..., None], axis=1) / many
    join = per_row(p.match) * align(see.velocity, course) + per_row(p.centre) * centre
    cost = length(see.food) - per_row(p.rich) * see.food_amount / task.capacity
    best = np.argmin(np.where(has_food, cost, np.inf), axis=1)
    eat = per_row(p.forage) * arrive(see.food[np.arange(count), best], see.velocity, top, 1.0)
    still = length(see.velocity)[..., None] < 1e-6
    heading = np.where(still, ahead, see.velocity)
    aside = np.stack([np.zeros_like(p.turn), np.asarray(p.turn)], axis=-1)
    roam = 2.0 * (wander(aside, heading, p.pace * top, 1.0) + heading - see.velocity)
    active = np.stack([np.ones(count, np.bool_)] * 2 + [selected == state for state in _STATES], axis=1)
    forces = np.stack([inside, push, flight, join, eat, roam], axis=1) * active[..., None]
    return allocate(in_order(forces, order), task.fish_force), now
