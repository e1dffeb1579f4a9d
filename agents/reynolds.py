"""The hand-written players: one page of Reynolds per task, from the laws that the simulator itself steers by.

Each sees exactly the learner's observation and nothing else, and asks for a force within the same limits. It is shown
twice: with textbook parameters (the defaults below), and tuned by a plain search that had the budget noted in
configs/<task>.yaml (`python -m agents.tune`).

    from agents.reynolds import player
    action, _ = player(task).predict(observation)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from flockenv import arbitration, shapes, steering, urges
from flockenv.grants import reconcile
from flockenv.orca import orca
from flockenv.rows import rows
from flockenv.tasks import (
    Bottleneck,
    Corridor,
    Crossing,
    CrowdNav,
    Evade,
    Flock,
    Herd,
    Obstacles,
    PathFollow,
    Pursuit,
    School,
    Task,
)

__all__ = ["PLAYERS", "RULES", "Reynolds", "player", "tuned"]

CONFIGS = Path(__file__).parent.parent / "configs"

seek, arrive, contain = rows(steering.seek), rows(steering.arrive), rows(steering.contain)
interception_time, pursue = rows(steering.interception_time), rows(steering.pursue)
threat, avoid = rows(steering.threat), rows(steering.avoid)
separate, align = rows(steering.separate), rows(steering.align)
unaligned_threat, give_way = rows(steering.unaligned_threat), rows(steering.give_way)
allocate, keep_clear = rows(arbitration.allocate), rows(orca)
evade_from, hiding_place = rows(steering.evade), rows(steering.hiding_place)
ray_hit = rows(shapes.ray_hit)
herd_from = rows(steering.herd_from)
follow_path = rows(steering.follow_path)
intention, wander = rows(urges.intention), rows(steering.wander)
repulsion, queue_gap, queue = rows(steering.repulsion), rows(steering.queue_gap), rows(steering.queue)
sidestep, collision_distance = rows(steering.sidestep), rows(steering.collision_distance)


# --- Pursuit: seek where the quarry will be, but never beyond the walls it cannot pass ------------------------------


@dataclass(frozen=True)
class PursuitRules:
    """Textbook: exact interception, full force."""

    factor: float = 1.0  # share of the interception time that is looked ahead
    horizon: float = 10.0  # s, never look further ahead than this
    margin: float = 0.3  # m, the quarry will not be nearer to a wall than this
    gain: float = 5.0  # kg/s, a change of velocity is asked for within 1/gain seconds
    slow_radius: float = 0.01  # m, arrive instead of seek: brake within this distance of the predicted place


def pursuit(see: Any, task: Pursuit, p: PursuitRules) -> np.ndarray:
    """Pursue the nearest opponent (Reynolds 1999) with a bounded exact predictor."""
    offset, quarry = see.opponents[:, 0], see.opponent_velocity[:, 0]
    top = task.pursuer_speed
    time = np.minimum(p.factor * interception_time(offset, quarry, top), p.horizon)
    ahead = offset + quarry * time[:, None]
    ahead = np.clip(ahead, p.margin - see.to_low, see.to_high - p.margin)
    return p.gain * arrive(ahead, see.velocity, top, p.slow_radius)


# --- Obstacles: arrive at the goal, around what is in the way --------------------------------------------------------


@dataclass(frozen=True)
class ObstaclesRules:
    """Textbook: look two seconds ahead, evade with all the force there is, seek with the rest."""

    horizon: float = 2.0  # s, how far ahead a threat counts at the present speed
    margin: float = 0.2  # m, clearance beyond the touching distance
    evade: float = 5.0  # kg/s, strength of an evasion
    urgency: float = 0.0  # 0: evade with full strength at any distance; 1: in proportion to nearness
    brake: float = 0.0  # kg/s against the speed, in proportion to nearness
    gain: float = 2.0  # kg/s towards the goal
    speed: float = 1.0  # share of the top speed that is wanted
    push: float = 0.0  # N m, repulsion from the nearest surfaces (1/gap), a force field for close quarters


def obstacles(see: Any, task: Obstacles, p: ObstaclesRules) -> np.ndarray:
    """Steer to avoid what the straight path touches first (Reynolds 1999), then seek; allocation as in 1987."""
    speed = np.linalg.norm(see.velocity, axis=-1)
    goal_way = see.goal / np.maximum(np.linalg.norm(see.goal, axis=-1), 1e-9)[:, None]
    forward = np.where(speed[:, None] > 0.05, see.velocity / np.maximum(speed, 1e-9)[:, None], goal_way)
    reach = np.maximum(speed, 0.5) * p.horizon
    clearance = see.obstacle_radius + 0.3 + p.margin
    distance = threat(forward[:, None], see.obstacles, clearance, reach[:, None])
    distance = np.where(see.obstacle_radius > 0, distance, np.inf)
    first = np.argmin(distance, axis=1)
    row = np.arange(len(first))
    nearest = distance[row, first]
    danger = np.isfinite(nearest)
    nearness = 1.0 - np.where(danger, nearest / np.maximum(reach, 1e-9), 1.0)
    strength = p.evade * (1.0 - p.urgency * (1.0 - nearness)) * danger
    aside = avoid(forward, see.obstacles[row, first], clearance[row, first], task.max_speed)
    evasion = aside * strength[:, None] - p.brake * see.velocity * nearness[:, None]
    away = -see.obstacles / np.maximum(np.linalg.norm(see.obstacles, axis=-1), 1e-9)[..., None]
    seen = (see.obstacle_radius > 0) & (see.clearance < 1.0)
    field = p.push * np.sum(away * (seen / np.maximum(see.clearance, 0.05))[..., None], axis=1)
    course = p.gain * seek(see.goal, see.velocity, p.speed * task.max_speed)
    return allocate(np.stack([evasion, field, course], axis=1), task.max_force)


# --- Flock: avoid, keep apart, fly as the others do, stay with them, and on course -----------------------------------


@dataclass(frozen=True)
class FlockRules:
    """Textbook: Reynolds' order of 1987, collision avoidance first, then matching velocity, then centring."""

    horizon: float = 2.0  # s, look-ahead for obstacles
    margin: float = 0.3  # m, clearance from obstacles
    evade: float = 5.0  # kg/s, strength of an evasion
    radius: float = 1.5  # m, neighbours nearer than this push
    apart: float = 2.0  # N m, separation
    match: float = 1.5  # kg/s, alignment
    centre: float = 0.3  # N/m, cohesion
    course: float = 2.0  # kg/s, towards the cruising velocity
    blend: float = 0.0  # 0: allocate in order; 1: sum up


def flock(see: Any, task: Flock, p: FlockRules) -> np.ndarray:
    """Avoid, separate, align, cohere, follow the heading; vectors are (along the heading, to its left)."""
    speed = np.linalg.norm(see.velocity, axis=-1)
    forward = see.velocity / np.maximum(speed, 1e-9)[:, None]
    clearance = see.obstacle_radius + 0.3 + p.margin
    distance = threat(forward[:, None], see.obstacles, clearance, (speed * p.horizon)[:, None])
    distance = np.where(see.obstacle_radius > 0, distance, np.inf)
    first, row = np.argmin(distance, axis=1), np.arange(len(speed))
    around = avoid(forward, see.obstacles[row, first], clearance[row, first], task.max_speed)
    evasion = p.evade * around * np.isfinite(distance[row, first])[:, None]

    here = see.neighbour_present
    count = np.maximum(here.sum(axis=1), 1.0)[:, None]
    near = here * (np.linalg.norm(see.neighbours, axis=-1) < p.radius)
    push = p.apart * np.sum(separate(see.neighbours, np.array([1.0, 0.0])) * near[..., None], axis=1)
    mean_velocity = see.velocity + np.sum(see.neighbour_velocity * here[..., None], axis=1) / count
    match = p.match * align(see.velocity, mean_velocity)
    centre = p.centre * np.sum(see.neighbours * here[..., None], axis=1) / count
    course = p.course * (np.array([task.cruise, 0.0]) - see.velocity)
    ordered = allocate(np.stack([evasion, push, match, centre, course], axis=1), task.max_force)
    summed = evasion + push + match + centre + course
    return (1.0 - p.blend) * ordered + p.blend * summed


# --- Crossing: give way to whom one would meet first, and go on ------------------------------------------------------


@dataclass(frozen=True)
class CrossingRules:
    """Textbook: look three seconds ahead, give way with all the force there is, arrive with the rest."""

    horizon: float = 3.0  # s, how far ahead a meeting counts
    margin: float = 0.2  # m, clearance beyond the touching distance
    evade: float = 5.0  # N, strength of an evasion
    urgency: float = 0.0  # 0: evade with full strength however far ahead; 1: in proportion to nearness in time
    radius: float = 1.0  # m, neighbours nearer than this push
    apart: float = 0.0  # N m, separation
    gain: float = 2.0  # kg/s towards the goal
    speed: float = 1.0  # share of the top speed that is wanted
    slow_radius: float = 0.8  # m, slow down within this of the goal


def crossing(see: Any, task: Crossing, p: CrossingRules) -> np.ndarray:
    """Unaligned collision avoidance (Reynolds 1999), then arrive; vectors are (along the course, to its left)."""
    own = see.velocity[:, None]
    others = own + see.neighbour_velocity
    time = unaligned_threat(see.neighbours, own, others, 0.6 + p.margin, p.horizon)
    time = np.where(see.neighbour_present > 0, time, np.inf)
    row, first = np.arange(len(time)), np.argmin(time, axis=1)
    soonest = time[row, first]
    danger = np.isfinite(soonest)
    nearness = 1.0 - np.where(danger, soonest, p.horizon) / p.horizon
    strength = p.evade * (1.0 - p.urgency * (1.0 - nearness)) * danger
    away = give_way(see.neighbours[row, first], see.velocity, others[row, first], np.where(danger, soonest, 0.0), 1.0)
    near = see.neighbour_present * (np.linalg.norm(see.neighbours, axis=-1) < p.radius)
    push = p.apart * np.sum(separate(see.neighbours, np.array([1.0, 0.0])) * near[..., None], axis=1)
    course = p.gain * arrive(see.goal, see.velocity, p.speed * task.max_speed, p.slow_radius)
    return allocate(np.stack([away * strength[:, None], push, course], axis=1), task.max_force)


@dataclass(frozen=True)
class OrcaRules:
    """As published, both take half; a wish that is not free is turned right, or twelve wait for each other."""

    horizon: float = 2.0  # s, for so long the velocity must be free
    margin: float = 0.1  # m, clearance for what inertia delays
    turn: float = 0.3  # rad, a wish that is not free is turned right by this
    gain: float = 10.0  # kg/s: within a decision
    slow_radius: float = 1.0  # m, slow down within this of the goal


def orca_crossing(see: Any, task: Crossing, p: OrcaRules) -> np.ndarray:
    """Optimal reciprocal collision avoidance (van den Berg et al. 2011) on the way to the goal."""
    still = np.zeros_like(see.goal)
    wish = arrive(see.goal, still, task.max_speed, p.slow_radius)
    others = see.velocity[:, None] + see.neighbour_velocity
    present = see.neighbour_present > 0
    radius = np.where(present, 0.3 + p.margin, -1.0)[..., None]
    seen = np.concatenate([see.neighbours, others, radius, np.full_like(radius, 0.5)], axis=-1)
    change = keep_clear(
        see.velocity, wish, 0.3, task.max_speed, p.horizon, task.control_dt, p.turn, seen.reshape(len(seen), -1)
    )
    return p.gain * change


# --- Evade: around what is in the way, off the walls, away from pursuers, into cover ----------------------------------


@dataclass(frozen=True)
class EvadeRules:
    """Textbook: evade whoever is near, hide from the nearest otherwise (Reynolds 1999), in order of priority."""

    horizon: float = 1.0  # s, how far ahead cover counts that is in the way
    avoid: float = 5.0  # kg/s, strength of steering around it
    wall: float = 0.5  # s, how far ahead walls count
    alarm: float = 10.0  # m, within which a pursuer is evaded: as far as it sees
    predict: float = 0.5  # s, how far ahead a pursuer is predicted at most
    evade: float = 5.0  # kg/s, strength of an evasion
    crowd: float = 1.0  # how much farther pursuers count beside the nearest; 0: he alone
    middle: float = 0.2  # N/m towards the middle of the field while evading
    margin: float = 1.0  # m, behind cover
    danger: float = 0.0  # m added to the way to a hiding place per m that a pursuer is nearer to it than 10 m
    exposed: float = 0.0  # m added to it for each pursuer that sees that place
    hide: float = 3.0  # kg/s, towards the hiding place


def evade(see: Any, task: Evade, p: EvadeRules) -> np.ndarray:
    """Avoid, contain, evade, hide: allocation in that order (Reynolds 1987)."""
    top, row = task.evader_speed, np.arange(len(see.velocity))
    speed = np.linalg.norm(see.velocity, axis=-1)
    forward = see.velocity / np.maximum(speed, 1e-9)[:, None]
    there, clearance = see.cover_radius > 0, see.cover_radius + 0.4
    hit = np.where(there, threat(forward[:, None], see.cover, clearance, (speed * p.horizon)[:, None]), np.inf)
    first = np.argmin(hit, axis=1)
    aside = p.avoid * avoid(forward, see.cover[row, first], clearance[row, first], top)
    aside *= np.isfinite(hit[row, first])[:, None]
    inside = 5.0 * contain(see.to_low - 0.5, see.to_high - 0.5, see.velocity, top, p.wall)

    distance = np.linalg.norm(see.pursuers, axis=-1)
    time = np.minimum(distance / task.pursuer_speed, p.predict)
    flight = evade_from(see.pursuers, see.velocity[:, None], see.pursuer_velocity, top, time)
    rank = np.where(np.arange(distance.shape[1]) == 0, 1.0, p.crowd)
    weight = rank * (distance < p.alarm) / np.maximum(distance, 0.1) ** 2
    away = p.evade * np.sum(flight * weight[..., None], axis=1) / np.maximum(weight.sum(axis=1), 1e-9)[:, None]
    near = (weight.sum(axis=1) > 0)[:, None]
    away += p.middle * (see.to_high - see.to_low) / 2 * near

    places = hiding_place(see.cover, see.cover_radius, p.margin, see.pursuers[:, :1])
    theirs = np.linalg.norm(places[:, :, None] - see.pursuers[:, None], axis=-1).min(axis=-1)
    way = np.linalg.norm(places, axis=-1) + p.danger * np.maximum(10.0 - theirs, 0.0)
    way += p.exposed * _watchers(places, see)
    soonest = np.argmin(np.where(there, way, np.inf), axis=1)
    hidden = p.hide * arrive(places[row, soonest], see.velocity, top, 0.5) * there.any(axis=1)[:, None]
    return allocate(np.stack([aside, inside, away, hidden], axis=1), task.evader_force)


def _watchers(places: np.ndarray, see: Any) -> np.ndarray:
    """Return how many pursuers have no cover between themselves and each of the places (R, K)."""
    ways = places[:, :, None] - see.pursuers[:, None]
    length = np.linalg.norm(ways, axis=-1)
    stones = (see.cover[:, None, :] - see.pursuers[:, :, None])[:, None]
    hit = ray_hit(stones, (ways / np.maximum(length, 1e-9)[..., None])[..., None, :], see.cover_radius[:, None, None])
    hit = np.where(see.cover_radius[:, None, None] > 0, hit, np.inf)
    return np.sum(hit.min(axis=-1) > length, axis=-1)


# --- Herd: collect who strays, else drive them all from behind --------------------------------------------------------


@dataclass(frozen=True)
class HerdRules:
    """Textbook: Strombom et al. 2014; lengths in units of the distance r_a that sheep keep from each other."""

    together: float = 1.0  # times r_a N^(2/3): who is farther from the centre is collected
    collecting: float = 1.0  # r_a, behind who is collected
    driving: float = 1.0  # times r_a sqrt(N), behind the centre
    near: float = 3.0  # r_a, to the nearest sheep: slower within this
    slow: float = 0.0  # share of the top speed within it
    gain: float = 5.0  # kg/s, a change of velocity is asked for within 1/gain seconds
    around: float = 0.0  # kg/s: keep outside a circle about the flock on the way to the place behind it
    width: float = 1.0  # of that circle, times the distance of the farthest sheep from the centre
    apart: float = 4.0  # N, away from other dogs, in proportion to nearness within 10 m


def herd(see: Any, task: Herd, p: HerdRules) -> np.ndarray:
    """Go behind who strays, or behind all of them, and stand still near a sheep; vectors are (along, left)."""
    r, n, top = task.apart_distance, task.sheep, task.dog_speed
    together, driving = p.together * r * n ** (2 / 3), p.driving * r * n**0.5
    place = herd_from(see.centre, see.farthest, see.goal, together, p.collecting * r, driving)
    nearest = np.where(see.sheep_present[:, 0] > 0, np.linalg.norm(see.sheep[:, 0], axis=-1), np.inf)
    speed = np.where(nearest < p.near * r, p.slow, 1.0) * top
    course = p.gain * arrive(place, see.velocity, speed, 0.5)
    way = place / np.maximum(np.linalg.norm(place, axis=-1), 1e-9)[:, None]
    clearance = p.width * see.stray + 2.0 * r
    blocked = np.isfinite(threat(way, see.centre, clearance, np.linalg.norm(place, axis=-1)))
    detour = p.around * avoid(way, see.centre, clearance, top) * blocked[:, None]
    distance = np.linalg.norm(see.mates, axis=-1)[..., None]
    push = -see.mates / np.maximum(distance, 1e-9) * np.maximum(1.0 - distance / 10.0, 0.0)
    mates = p.apart * np.sum(push, axis=1)
    return allocate(np.stack([mates, detour, course], axis=1), task.dog_force)


# --- PathFollow: seek the track ahead if the predicted place is off it; brake before a bend ---------------------------


@dataclass(frozen=True)
class PathFollowRules:
    """Textbook: half a second ahead, the whole track is the tube, full speed whatever comes."""

    time: float = 0.5  # s, how far ahead it predicts itself
    lead: float = 0.5  # s, how far ahead at its present speed the point lies that is sought
    tube: float = 1.0  # share of the track's width that is left alone
    keep: float = 0.5  # share of the speed it wants, below which it is sent on
    speed: float = 1.0  # share of the top speed that is wanted
    grip: float = 100.0  # share of all the force there is that a bend may ask for; much = never slows down
    early: float = 1.0  # share of it that braking before a bend counts on
    brake: float = 0.0  # kg/s against what is too fast
    gain: float = 5.0  # kg/s, a change of velocity is asked for within 1/gain seconds


def path_follow(see: Any, task: PathFollow, p: PathFollowRules) -> np.ndarray:
    """Follow the path (Reynolds 1999), at a speed that the bends ahead allow; vectors are (along the track, left)."""
    row, step = np.arange(len(see.left)), task.spacing / _FINE
    spine = np.concatenate([np.stack([0.0 * see.left, -see.left], axis=-1)[:, None], see.points], axis=1)
    share = (np.arange(task.ahead * _FINE) / _FINE) % 1.0
    piece = np.arange(task.ahead * _FINE) // _FINE
    fine = spine[:, piece] * (1.0 - share)[:, None] + spine[:, piece + 1] * share[:, None]
    far = task.spacing * np.arange(task.ahead)[None]  # a bend begins a point earlier
    bend = np.maximum(np.abs(see.curvature), 1e-6)
    allowed = p.grip * task.max_force / bend + 2.0 * p.early * task.max_force * far
    top = np.minimum(p.speed * task.max_speed, np.sqrt(allowed.min(axis=1)))
    speed = np.linalg.norm(see.velocity, axis=-1)
    gap = np.linalg.norm(fine - p.time * see.velocity[:, None], axis=-1)
    then = np.argmin(gap, axis=1)
    gained = then * step - p.keep * top * p.time
    ahead = p.lead * np.maximum(speed, 0.25 * top)
    target = fine[row, np.minimum(np.round(ahead / step), task.ahead * _FINE - 1).astype(int)]
    wish = p.gain * follow_path(gap[row, then] - p.tube * task.half_width, gained, target, see.velocity, top)
    slower = -p.brake * (np.maximum(speed - top, 0.0) / np.maximum(speed, 1e-9))[:, None] * see.velocity
    return slower + wish


_FINE = 5
"""Places between two points of the track that are seen, among which the nearest is."""


# --- CrowdNav: social force, ORCA, and the two rules of Moussaid et al. -----------------------------------------------


@dataclass(frozen=True)
class CrowdNavRules:
    """Textbook: Moussaid et al. 2009, as the pedestrians themselves."""

    tau: float = 0.54  # s, relaxation time
    speed: float = 1.0  # share of the top speed that is wanted
    strength: float = 4.5  # A, m/s^2
    importance: float = 2.0  # lambda, s/m, of velocities against positions
    gamma: float = 0.35  # s, the range of the force per m/s of what closes in
    angular: float = 2.0  # n, 1/m, of turning
    forward: float = 3.0  # n', 1/m, of slowing down
    bias: float = 0.005  # eps, 1/m, to the right


def crowd_nav(see: Any, task: CrowdNav, p: CrowdNavRules) -> np.ndarray:
    """Drive to the goal, slow down before others and pass them on one side; vectors are (along the course, left)."""
    own = see.velocity[:, None]
    wish = sidestep(
        see.neighbours, own, own + see.neighbour_velocity, np.array([1.0, 0.0]), p.importance, p.gamma, p.angular,
        p.forward, p.bias,
    )  # fmt: skip
    way = see.goal / np.maximum(np.linalg.norm(see.goal, axis=-1), 1e-9)[:, None]
    push = p.strength * np.sum(wish * see.neighbour_present[..., None], axis=1)
    return (p.speed * task.max_speed * way - see.velocity) / p.tau + push


@dataclass(frozen=True)
class RobotOrcaRules:
    """As published, but for the share: whom nobody sees must do all there is to do."""

    horizon: float = 2.0  # s, for so long the velocity must be free
    margin: float = 0.1  # m, clearance for what inertia delays
    turn: float = 0.0  # rad, a wish that is not free is turned right by this
    gain: float = 10.0  # kg/s: within a decision
    share: float = 1.0  # of the change that is its own where it is not seen; a half where it is


def orca_crowd_nav(see: Any, task: CrowdNav, p: RobotOrcaRules) -> np.ndarray:
    """Optimal reciprocal collision avoidance (van den Berg et al. 2011) on the way to the goal."""
    wish = seek(see.goal, np.zeros_like(see.goal), task.max_speed)
    others = see.velocity[:, None] + see.neighbour_velocity
    radius = np.where(see.neighbour_present > 0, _PEDESTRIAN + p.margin, -1.0)[..., None]
    share = np.full_like(radius, 0.5 if task.visible else p.share)
    seen = np.concatenate([see.neighbours, others, radius, share], axis=-1)
    change = keep_clear(
        see.velocity, wish, _ROBOT, task.max_speed, p.horizon, task.control_dt, p.turn, seen.reshape(len(seen), -1)
    )
    return p.gain * change


@dataclass(frozen=True)
class HeuristicsRules:
    """As published; it sees no further than it is shown."""

    tau: float = 0.5  # s, relaxation time, and the time that it keeps to what is ahead
    reach: float = 10.0  # d_max, m
    view: float = 75.0  # degrees to either side of where it goes
    margin: float = 0.0  # m, clearance


def heuristics_crowd_nav(see: Any, task: CrowdNav, p: HeuristicsRules) -> np.ndarray:
    """Look where the way is free, and go no faster than is safe (Moussaid, Helbing and Theraulaz 2011)."""
    aim = see.goal / np.maximum(np.linalg.norm(see.goal, axis=-1), 1e-9)[:, None]
    speed = np.linalg.norm(see.velocity, axis=-1)[:, None]
    gaze = np.where(speed > 0.05, see.velocity / np.maximum(speed, 1e-9), aim)
    turn = np.radians(np.linspace(-p.view, p.view, 31))
    cosine, sine = np.cos(turn), np.sin(turn)
    ways = np.stack([gaze[:, :1] * cosine - gaze[:, 1:] * sine, gaze[:, :1] * sine + gaze[:, 1:] * cosine], axis=-1)
    ways = np.concatenate([aim[:, None], ways], axis=1)  # the aim first: of what is as good, what it wants
    seen, moving = see.neighbour_present[:, :, None] > 0, see.velocity[:, None] + see.neighbour_velocity
    clearance, one = _ROBOT + _PEDESTRIAN + p.margin, ways[:, None]
    free = collision_distance(one, see.neighbours[:, :, None], moving[:, :, None], clearance, task.max_speed)
    free = np.where(seen, free, np.inf).min(axis=1).clip(max=p.reach)
    now = collision_distance(one, see.neighbours[:, :, None], np.zeros(2), clearance, 1.0)
    now = np.where(seen, now, np.inf).min(axis=1)
    left = p.reach**2 + free**2 - 2.0 * p.reach * free * np.sum(ways * aim[:, None], axis=-1)
    row, best = np.arange(len(left)), np.argmin(left, axis=1)
    safe = np.minimum(task.max_speed, now[row, best] / p.tau)[:, None]
    return (safe * ways[row, best] - see.velocity) / p.tau


_ROBOT, _PEDESTRIAN = 0.3, 0.25
"""Radii of the robot and of a pedestrian, m."""


# --- Bottleneck: push, as in 2000; or queue ---------------------------------------------------------------------------


@dataclass(frozen=True)
class BottleneckRules:
    """Textbook: Helbing, Farkas and Vicsek 2000; bodies and walls themselves are the scene's."""

    tau: float = 0.5  # s, relaxation time
    speed: float = 1.0  # share of the top speed that is wanted
    strength: float = 2000.0  # A, N
    decay: float = 0.08  # B, m
    walls: float = 2000.0  # A of walls, N


def bottleneck(see: Any, task: Bottleneck, p: BottleneckRules) -> np.ndarray:
    """Drive to the door, and be pushed off by others and by walls, exponentially."""
    drive = 80.0 * (p.speed * task.max_speed * _to_opening(see, task) - see.velocity) / p.tau
    tie = np.array([1.0, 0.0])
    push = p.strength * repulsion(see.neighbours, tie, 2 * _PERSON, p.decay) * see.neighbour_present[..., None]
    x, y, half = see.door[:, 0], see.door[:, 1], task.width / 2
    points = [
        np.stack([x, np.minimum(y - half, 0.0)], axis=-1), np.stack([x, np.maximum(y + half, 0.0)], axis=-1),
        np.stack([0.0 * x, -see.to_sides[:, 0]], axis=-1), np.stack([0.0 * x, see.to_sides[:, 1]], axis=-1),
    ]  # fmt: skip
    off = p.walls * repulsion(np.stack(points, axis=1), tie, _PERSON, p.decay)
    return drive + push.sum(axis=1) + off.sum(axis=1)


def _to_opening(see: Any, task: Bottleneck) -> np.ndarray:
    """Return the unit vectors to the nearest place of the door where a body fits; straight on before it."""
    half = max(task.width / 2 - 1.2 * _PERSON, 0.0)
    aside = see.door[:, 1] - np.clip(see.door[:, 1], -half, half)
    way = np.stack([np.maximum(see.door[:, 0], 0.0) + 0.1, aside], axis=-1)
    return way / np.linalg.norm(way, axis=-1)[:, None]


@dataclass(frozen=True)
class QueueingRules:
    """Reynolds' queue, with the headway of Tordeux, Chraibi and Seyfried 2016."""

    headway: float = 1.0  # s
    margin: float = 0.05  # m, clearance
    gain: float = 8.0  # 1/s: at least 4 / headway
    apart: float = 40.0  # N m, separation
    radius: float = 0.8  # m, between centres, within which it acts


def queueing(see: Any, task: Bottleneck, p: QueueingRules) -> np.ndarray:
    """Go to the door as fast as the gap ahead allows, and keep a little apart."""
    way, present = _to_opening(see, task), see.neighbour_present > 0
    others = see.velocity[:, None] + see.neighbour_velocity
    gap = queue_gap(way[:, None], see.neighbours, others, 2 * _PERSON + p.margin, task.max_speed)
    gap = np.where(present, gap, np.inf).min(axis=1).clip(max=1e3)
    near = present & (np.linalg.norm(see.neighbours, axis=-1) < p.radius)
    push = p.apart * np.sum(separate(see.neighbours, np.array([1.0, 0.0])) * near[..., None], axis=1)
    return 80.0 * p.gain * queue(way, see.velocity, gap, task.max_speed, p.headway) + push


_PERSON = 0.25
"""Radius of somebody in the room, m."""


# --- Corridor: slow down before others, and pass them on one side -----------------------------------------------------


@dataclass(frozen=True)
class CorridorRules:
    """Textbook: Moussaid et al. 2009, with its bias to the right, and its walls."""

    tau: float = 0.54  # s, relaxation time
    strength: float = 4.5  # A, m/s^2
    importance: float = 2.0  # lambda, s/m, of velocities against positions
    gamma: float = 0.35  # s, the range of the force per m/s of what closes in
    angular: float = 2.0  # n, 1/m, of turning
    forward: float = 3.0  # n', 1/m, of slowing down
    bias: float = 0.005  # eps, 1/m, to the right
    walls: float = 3.0  # a, m/s^2
    wall_decay: float = 0.1  # b, m


def corridor(see: Any, task: Corridor, p: CorridorRules) -> np.ndarray:
    """Drive at the desired speed, off others and off walls; vectors are (along one's way, to its left)."""
    own = see.velocity[:, None]
    wish = sidestep(
        see.neighbours, own, own + see.neighbour_velocity, np.array([1.0, 0.0]), p.importance, p.gamma, p.angular,
        p.forward, p.bias,
    )  # fmt: skip
    push = p.strength * np.sum(wish * see.neighbour_present[..., None], axis=1)
    return (_ahead(see) - see.velocity) / p.tau + push + _off_walls(see, p.walls, p.wall_decay)


def _ahead(see: Any) -> np.ndarray:
    """Return the velocities that are wanted, m/s."""
    return np.stack([see.desired_speed, 0.0 * see.desired_speed], axis=-1)


def _off_walls(see: Any, strength: float, decay: float) -> np.ndarray:
    """Return the push off both walls, a exp(-d / b), d from the body's centre."""
    push = strength * (np.exp(-see.walls[:, 1] / decay) - np.exp(-see.walls[:, 0] / decay))
    return np.stack([0.0 * push, push], axis=-1)


@dataclass(frozen=True)
class CorridorOrcaRules:
    """As published, both take half; a wish that is not free is turned right."""

    horizon: float = 2.0  # s, for so long the velocity must be free
    margin: float = 0.05  # m, clearance for what inertia delays
    turn: float = 0.3  # rad, a wish that is not free is turned right by this
    gain: float = 10.0  # kg/s: within a decision


def orca_corridor(see: Any, task: Corridor, p: CorridorOrcaRules) -> np.ndarray:
    """Optimal reciprocal collision avoidance (van den Berg et al. 2011) along the corridor; walls are no neighbours."""
    others = see.velocity[:, None] + see.neighbour_velocity
    radius = np.where(see.neighbour_present > 0, _PERSON + p.margin, -1.0)[..., None]
    seen = np.concatenate([see.neighbours, others, radius, np.full_like(radius, 0.5)], axis=-1)
    change = keep_clear(
        see.velocity, _ahead(see), _PERSON, task.max_speed, p.horizon, task.control_dt, p.turn,
        seen.reshape(len(seen), -1),
    )  # fmt: skip
    return p.gain * change + _off_walls(see, 3.0, 0.1)


# --- School: a state machine: flee, join the others, eat, or wander; keep off walls and each other always -------------


@dataclass(frozen=True)
class SchoolRules:
    """Textbook: Tu and Terzopoulos 1994, the levels of the scene's own effect `intention`, the nearest food."""

    escape: float = 0.4  # fear above which it flees
    school: float = 0.15  # fear above which it joins the others
    need: float = 0.5  # hunger above which it eats
    calm: float = 0.1  # how much less fear ends either
    content: float = 0.3  # how much less hunger ends it
    wall: float = 0.3  # s, how far ahead walls count
    apart: float = 1.0  # N m, separation from whom it nearly touches
    predict: float = 0.5  # s, how far ahead a hunter is predicted at most
    evade: float = 5.0  # kg/s, strength of an evasion
    middle: float = 0.0  # N/m towards the middle of the tank while it flees
    forage: float = 5.0  # kg/s, towards food
    rich: float = 0.0  # m of way that a full patch is worth more than an empty one
    match: float = 2.0  # kg/s, alignment
    centre: float = 1.0  # N/m, cohesion
    pace: float = 0.5  # share of the top speed that it wanders at
    turn: float = 0.2  # m aside per m ahead, while it wanders


_WHEN = arbitration.Intentions(when=("avoid", "avoid", "escape", "school", "eat", "wander"))


def school(see: Any, task: School, p: SchoolRules, before: Any, begins: Any) -> tuple[np.ndarray, np.ndarray]:
    """Choose a state from hunger and fear, with hysteresis, and hear its behaviours; return that state too, (R,)."""
    count, top, ahead = len(see.velocity), task.fish_speed, np.array([1.0, 0.0])
    known = before is not None and np.shape(before) == (count,)
    was = np.where(begins, 0.0, before) if known else np.zeros(count)
    calm, content = min(p.calm, p.school), min(p.content, p.need)
    now = intention(was, see.hunger, 0.0, see.fear, max(p.escape, p.school), p.school, p.need, calm, content)
    hunted = see.hunter_present[:, 0] > 0
    # in sight there is nobody to flee from, or nothing to eat: go on, and look around
    some = np.linalg.norm(see.food_bearing, axis=-1) > 0
    now_heard = np.where((now == urges.ESCAPE) & ~hunted, urges.WANDER, now)
    now_heard = np.where((now == urges.EAT) & ~some.any(axis=1), urges.WANDER, now_heard)
    here = see.mate_present
    now_heard = np.where((now == urges.SCHOOL) & (here.sum(axis=1) == 0), urges.WANDER, now_heard)

    inside = 5.0 * contain(see.to_low - 0.5, see.to_high - 0.5, see.velocity, top, p.wall)
    near = here * (np.linalg.norm(see.mates, axis=-1) < 0.6)
    push = p.apart * np.sum(separate(see.mates, ahead) * near[..., None], axis=1)
    time = np.minimum(np.linalg.norm(see.hunters[:, 0], axis=-1) / task.hunter_speed, p.predict)
    flight = p.evade * evade_from(see.hunters[:, 0], see.velocity, see.hunter_velocity[:, 0], top, time)
    flight += p.middle * (see.to_high - see.to_low) / 2
    many = np.maximum(here.sum(axis=1), 1.0)[:, None]
    course = np.sum(see.mate_velocity * here[..., None], axis=1) / many
    centre = np.sum(see.mates * here[..., None], axis=1) / many
    join = p.match * align(see.velocity, course) + p.centre * centre
    way = np.linalg.norm(see.food, axis=-1) - p.rich * see.food_amount / task.capacity
    best = np.argmin(np.where(some, way, np.inf), axis=1)
    eat = p.forage * arrive(see.food[np.arange(count), best], see.velocity, top, 1.0)
    still = np.linalg.norm(see.velocity, axis=-1, keepdims=True) < 1e-6
    heading = np.where(still, ahead, see.velocity)
    roam = 2.0 * (wander(np.array([0.0, p.turn]), heading, p.pace * top, 1.0) + heading - see.velocity)
    wishes = np.stack([inside, push, flight, join, eat, roam], axis=1)
    force, _ = reconcile(_WHEN, wishes, task.fish_force, inner={"intention": now_heard})
    return force, now


# --- the player ------------------------------------------------------------------------------------------------------

RULES: dict[str, tuple[Callable[..., np.ndarray], type]] = {
    "pursuit": (pursuit, PursuitRules),
    "obstacles": (obstacles, ObstaclesRules),
    "evade": (evade, EvadeRules),
    "flock": (flock, FlockRules),
    "crossing": (crossing, CrossingRules),
    "herd": (herd, HerdRules),
    "path_follow": (path_follow, PathFollowRules),
    "school": (school, SchoolRules),
    "crowd_nav": (crowd_nav, CrowdNavRules),
    "bottleneck": (bottleneck, BottleneckRules),
    "corridor": (corridor, CorridorRules),
}
"""What the player "reynolds" does in each task, and its parameters."""

PLAYERS: dict[str, dict[str, tuple[Callable[..., np.ndarray], type]]] = {
    "orca": {
        "crossing": (orca_crossing, OrcaRules),
        "crowd_nav": (orca_crowd_nav, RobotOrcaRules),
        "corridor": (orca_corridor, CorridorOrcaRules),
    },
    "heuristics": {"crowd_nav": (heuristics_crowd_nav, HeuristicsRules)},
    "queueing": {"bottleneck": (queueing, QueueingRules)},
}
"""Other hand-written players by name, for those tasks that have one."""

REMEMBERING = (school,)
"""Those that keep a number per row from one decision to the next."""


@dataclass(frozen=True)
class Reynolds:
    """A hand-written player: SB3's `predict` around one of the functions above."""

    task: Task
    rules: Any
    name: str = "reynolds"

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = True
    ) -> tuple[np.ndarray, Any]:
        """Return actions (R, A) float32 for observation rows (R, O), or (A,) for one row (O,)."""
        seen = np.asarray(observation)
        steer = _rules(self.name)[self.task.name][0]
        see = self.task.layout.unpack(np.atleast_2d(seen))
        if steer in REMEMBERING:
            begins = False if episode_start is None else np.atleast_1d(episode_start)
            force, state = steer(see, self.task, self.rules, state, begins)
        else:
            force = steer(see, self.task, self.rules)
        strongest = self.task.action_layout.slots[0].scale
        wish = force / strongest
        length = np.maximum(np.linalg.norm(wish, axis=-1, keepdims=True), 1.0)
        action = (wish / length).astype(np.float32)
        return (action[0] if seen.ndim == 1 else action), state

    def with_rules(self, values: Mapping[str, float]) -> Reynolds:
        """Return the same player with other parameters."""
        return replace(self, rules=replace(self.rules, **values))


def _rules(name: str) -> dict[str, tuple[Callable[..., np.ndarray], type]]:
    """Return what a player does, by task."""
    return RULES if name == "reynolds" else PLAYERS[name]


def tuned(name: str) -> dict[str, float]:
    """Return the parameters that the search found for a task, from configs/<name>.yaml; {} if there are none yet."""
    path = CONFIGS / f"{name}.yaml"
    if not path.exists():
        return {}
    config = yaml.safe_load(path.read_text(encoding="utf-8"))
    return dict((config.get("reynolds") or {}).get("rules") or {})


def player(task: Task, textbook: bool = False, name: str = "reynolds") -> Reynolds:
    """Return a hand-written player of a task; "reynolds" is tuned unless the textbook's parameters are asked for."""
    known = _rules(name)
    if task.name not in known:
        which = "" if name == "reynolds" else f" {name!r}"
        raise ValueError(
            f"there is no hand-written player{which} for {task.name!r}; there is one for: {', '.join(known)}"
        )
    found = tuned(task.name) if name == "reynolds" and not textbook else {}
    return Reynolds(task, replace(known[task.name][1](), **found), name)


def as_dict(rules: Any) -> dict[str, float]:
    """Return parameters by name."""
    return {name: float(value) for name, value in asdict(rules).items()}
