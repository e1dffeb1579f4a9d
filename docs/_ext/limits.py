"""Limits of a kind: the paragraph "Limits: ..." of its docstring, and what its class holds.

The class holds its dimensions, what it reads, what it refuses (the docstrings of its checks), and its stiffness (that
of `rates`); the longest stable steps of a method, and of pedestrians of a preset, are computed.
"""

from __future__ import annotations

import functools
import inspect
import math
import re
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from docstrings import markdown, without_limits

from flockenv.behaviours import BEHAVIOURS, ObstacleRepulsion
from flockenv.behaviours.behaviour import Behaviour, Moving
from flockenv.geometry.shapes import Circle
from flockenv.model.spawn import Spawn
from flockenv.physics.constraints import Constraint
from flockenv.physics.effects import EFFECTS, Effect
from flockenv.physics.effects.effect import LAWS
from flockenv.physics.effects.vicsek import METHODS
from flockenv.physics.integrators import Integrator
from flockenv.scene import Group, Scene
from flockenv.scene.presets import Model
from flockenv.scene.stability import drag_limit, limit, suggest_dt

__all__ = ["limits", "limits_of_preset", "link"]

TRIVIAL = re.compile(r"if (?:a|the) group does not exist(?:, naming the field)?")
"""What every kind with a field for a group refuses."""

FAR = ("torus", "periodic")
"""Words of a refusal of spaces in which a place has several images."""


def link(kind: str) -> str:
    """Return a link to the page of a behaviour or effect, from a page in another folder."""
    return f"[{kind}](../{'behaviours' if kind in BEHAVIOURS else 'effects'}/{kind}.md)"


def limits(model: type[Any]) -> list[str]:
    """Return the section about the limits of a kind."""
    text = without_limits(model.__doc__)[1]
    known = [markdown(text[:1].upper() + text[1:])] if text else []
    if issubclass(model, Integrator):
        return ["## Limits", _steps_of(model()), *known, *_refused_by(model)]
    effect = issubclass(model, Effect)
    facts = [_dimensions(model), *((*_needs(model), *_on_torus(model)) if effect else ())]
    if refused := "; ".join(_refusals(model)):
        facts.append(f"It is refused {markdown(refused)}.")
    return ["## Limits", *known, _bullets([*facts, *([_stable_step(model)] if effect else [])])]


def _bullets(facts: Iterable[str]) -> str:
    return "\n".join(f"* {' '.join(fact.split())}" for fact in facts)


# --- effects and constraints ------------------------------------------------------------------------------------------


def _dimensions(model: type[Any]) -> str:
    """Return the dimensions in which a kind works: its docstring names one alone, or it refuses the other."""
    only = re.search(r"\bin ([23])-D only", model.__doc__ or "", re.IGNORECASE)
    refused = {text[:6] for text in _refusals(model)} & {"in 2-D", "in 3-D"}
    if only or refused:
        return f"In {only[1] if only else 5 - int(refused.pop()[3])}-D only."
    return "In 2-D and 3-D."


def _needs(model: type[Effect]) -> Iterator[str]:
    """Yield what an effect needs in the scene, what it reads, and where its result goes."""
    if model.steering:
        yield "A steering force: with all others of the agent, and its drive, it is cut to the group's `max_force`."
    if model.bond_law:
        yield "It needs a network in its group."
    if model.obstacle_law and not model.pair_law:
        yield "In a scene without obstacles it does nothing."
    if model.aim_law:
        yield f"It is an aim and exerts no force: {_listed(_readers('aim'))} read the sum of all aims."
    if _is_medium(model):
        yield f"As a medium it moves nothing by itself: {_listed(_readers('medium'))} read the sum of all media."
    kind = model.model_fields["kind"].default
    for what, makers in (("aim", [k for k, e in EFFECTS.items() if e.aim_law]), ("medium", _media())):
        if kind in _readers(what):
            yield f"It reads the {what}, which is 0 without one of {_listed(makers)}."
    for name in model.recalls:
        yield f"Another effect must keep `{name}`: {_listed(k for k, e in EFFECTS.items() if name in e.keeps)}."
    if model.keeps:
        yield f"It stores {_code(model.keeps)} for every agent, updated at the end of each step."


def _on_torus(model: type[Effect]) -> Iterator[str]:
    """Yield what an effect refuses on a torus, and which image it uses, if it works there."""
    if model.far_law:
        yield "It reaches all agents at any distance, so it is refused on a torus."
    if model.pair_law and "radius" in model.model_fields:
        yield "On a torus `radius` is at most half of the shortest edge."
    if model.places and not any(word in text for text in _refusals(model) for word in FAR):
        yield f"On a torus the nearest image of {_code(model.places)} counts."


def _code(names: Iterable[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def _listed(kinds: Iterable[str]) -> str:
    return ", ".join(map(link, kinds))


def _is_medium(model: type[Effect]) -> bool:
    """Return True if an effect is, or may be, a velocity of the medium."""
    return bool(model.medium_law)


@functools.cache
def _media() -> tuple[str, ...]:
    return tuple(kind for kind, effect in EFFECTS.items() if _is_medium(effect))


@functools.cache
def _readers(what: str) -> tuple[str, ...]:
    """Return the kinds whose laws read `me.what`."""
    return tuple(kind for kind, effect in EFFECTS.items() if f"me.{what}" in _source(effect))


@functools.cache
def _source(effect: type[Effect]) -> str:
    """Return the source of the laws that a class holds."""
    laws: list[Any] = [getattr(effect, name, None) for name in LAWS]
    return "".join(inspect.getsource(law.py_func) for law in laws if hasattr(law, "py_func"))


def _refusals(model: type[Any]) -> list[str]:
    """Return what a kind refuses, beginning with "if", "in" or "for": the docstrings of its checks that have one."""
    checks = [
        vars(each)["check"] for each in model.__mro__ if "check" in vars(each) and each not in (Effect, Constraint)
    ]
    made = model.__pydantic_decorators__
    checks += [each.func for each in (*made.model_validators.values(), *made.field_validators.values())]
    texts = (" ".join((check.__doc__ or "").split()) for check in checks if check.__name__ != "_check_magnitudes")
    found = (re.sub(r"^Raise ValueError(?: also)? |\.$", "", text) for text in texts if "Raise ValueError" in text)
    return [re.sub(r"; warn (if .*)", r" (a warning \1)", text) for text in found if not TRIVIAL.fullmatch(text)]


def _stable_step(model: type[Effect]) -> str:
    """Return what an effect contributes to the longest stable step."""
    if model.aim_law or model.keep_law or model.kick_law or model.flow_law or (
        _is_medium(model) and "acts" not in model.model_fields
    ):  # fmt: skip
        return "It exerts no force, so it does not limit `dt`."
    text = _rates(model)
    if text.startswith("None"):
        return f"It names no stiffness{text.removeprefix('None')}: no stable step is computed from it."
    facts = [f"The stable step follows from {markdown(text)}{' (w: angular frequency)' * ('w^2' in text)}."]
    facts.append("A larger `dt` gives a warning" + (", a far larger one is refused." if model.always is True else "."))
    if model.derivative:
        facts.append("It does not limit the step of [linearly_implicit_euler](../methods/linearly_implicit_euler.md).")
    if model.linear_drag:
        facts.append("[exponential_drag](../methods/exponential_drag.md) integrates it exactly.")
    if model.contact:
        facts.append("A contact that bounces and lasts fewer than 30 steps gives a warning.")
    return " ".join(facts)


def _rates(model: type[Effect]) -> str:
    """Return what `rates` returns, in words; "None" for nothing."""
    if model.rates is Effect.rates:
        return "None"
    if issubclass(model, Behaviour) and model.rates in (Behaviour.rates, Moving.rates):
        slope = f"{model.steepness:g} " * (model.steepness != 1) if issubclass(model, Moving) else ""
        ramp = f", and w^2 = {slope}weight V / (m slow_radius) where it slows down" * (
            "slow_radius" in model.model_fields
        )
        return f"a damping of {'2 ' * model.copies}weight / m{ramp}"
    text = " ".join(inspect.cleandoc(model.rates.__doc__ or "").split("\n\n")[0].split()).rstrip(".")
    return re.sub(r"^Return |(?<=Return )(?:no oscillation,|w\^2 = 0,(?: as nothing oscillates,)?) and ", "", text)


# --- methods ----------------------------------------------------------------------------------------------------------


def _steps_of(method: Integrator) -> str:
    """Return the longest stable steps of an integration method, as stability.py computes them."""
    if method.stable_at_any_step:
        text = "It chooses substeps that are stable." if method.adaptive else "It is stable at any step."
        return f"{text} A force that jumps reduces its order, and a long step its accuracy."
    free, damped, drag = limit(method, 0.0), limit(method, 0.1), drag_limit(method)
    undamped = f"stable for h omega < {free:.3g}" if free else "unstable at any step"
    slows = "at any step" if math.isinf(drag) or method.splits_drag else f"for h c / m < {drag:.3g}"
    text = (
        f"An undamped oscillation of angular frequency omega is {undamped}; with 10 % of critical damping it is stable "
        f"for h omega < {damped:.3g}. Linear drag c is stable {slows}."
    )
    more = (
        " Both limits and the curve are for forces without a `derivative`. Forces with one do not limit `dt`; linear "
        "ones are integrated as by [implicit Euler](implicit_euler.md)."
    )
    return text + more * method.linearises


def _refused_by(method: type[Integrator]) -> list[str]:
    """Return the effects that refuse a method."""
    kind = method.model_fields["kind"].default
    return [] if kind in METHODS else [f"{link('vicsek')}, which is a map from step to step, refuses it."]


# --- presets ----------------------------------------------------------------------------------------------------------


def limits_of_preset(model: Model) -> list[str]:
    """Return the section about the limits of a preset: what follows from its numbers, and the limits of its effects."""
    effects = (*model.behaviours(False, None), *model.bodies)
    people = Group(count=100, spawn=Spawn(low=(0.0, 0.0), high=(9.0, 9.0)), **model.people)
    scene = Scene(groups=(people,), obstacles=(Circle(centre=(12.0, 0.0), radius=1.0),), effects=effects, dt=1e-3)
    step = suggest_dt(scene)
    facts = [
        next((text for each in effects if (text := _dimensions(type(each))) != "In 2-D and 3-D."), "In 2-D and 3-D."),
        (
            f"Near obstacles, a step of at most {step.dt:.3g} s is stable for these pedestrians with "
            f"{scene.integrator.kind}; {link(str(step.effect))} sets it."
        ),
    ]
    facts += [_wall(wall, people) for wall in effects if isinstance(wall, ObstacleRepulsion)]
    if not model.bodies:
        facts.append(f"It has no contact forces ({link('contact')}): bodies that are pressed together overlap.")
    facts += [f"{link(each.kind)}: {markdown(without_limits(type(each).__doc__)[1])}" for each in effects]
    return ["## Limits", _bullets(facts)]


def _wall(wall: ObstacleRepulsion, people: Group) -> str:
    """Return the speed below which a wall stops a mean pedestrian without drive: v^2 / 2 = A B exp(r / B) / m."""
    mass, radius = float(np.mean(people.masses(2))), float(np.mean(people.radii))
    push = wall.strength / mass + wall.acceleration
    speed = math.sqrt(2 * push * wall.decay * math.exp(radius * wall.bodies / wall.decay))
    return (
        f"A thin wall stops a mean pedestrian without drive, head-on, below {speed:.2g} m/s. With a drive the limit is "
        "lower. A faster one passes through."
    )
