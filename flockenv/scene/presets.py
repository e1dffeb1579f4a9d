"""Published models of pedestrians by name, with the values of their papers: a name becomes effects of a scene.

preset("helbing_farkas_vicsek_2000")  # a tuple of effects; in a file, an item of `effects`: {preset: helbing_2000}

A model covers locomotion, not destinations: add aims (`goal`, `course`, a journey). Pedestrians are the scene's groups:
`Group(count=100, **PRESETS[name].people)` has the masses, radii and speeds of the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from pydantic import Field, ValidationError

from flockenv.behaviours import (
    CircularRepulsion,
    Driving,
    EllipticalRepulsion,
    Heuristics,
    ObstacleRepulsion,
    Sidestep,
    WalkingGroup,
)
from flockenv.behaviours.steer import Steer
from flockenv.core.errors import KeyPath, key_path, nearest, parse_key_path, printable, refusals
from flockenv.core.record import Record
from flockenv.model.distribution import Spread
from flockenv.physics.effects import Contact, Effect, ObstacleContact
from flockenv.steering.arbitration import Blend

__all__ = ["ALIASES", "PRESETS", "Model", "Origins", "Preset", "expand_presets", "preset"]


@dataclass(frozen=True)
class Model:
    """A published model: its behaviours, contact forces, pedestrians, and sources."""

    source: str  # the paper
    behaviours: Callable[[bool, int | None], tuple[Effect, ...]] = field(repr=False)
    """(True if walls occlude, group for models of walking groups) -> behaviours."""
    bodies: tuple[Effect, ...] = ()  # contact forces of bodies
    people: Mapping[str, Any] = field(default_factory=dict)
    """Fields of a `Group`, as the paper has them."""
    symbols: Mapping[str, str] = field(default_factory=dict)
    """The paper's symbols and values."""
    note: str = ""
    """What is ours, what is quoted from memory, and what the paper leaves open."""

    @property
    def numbers(self) -> dict[str, float]:
        """The parameters of the behaviours, as kind_field: driving_tau, sidestep_gamma."""
        effects = self.behaviours(False, None)
        fields = {f"{each.kind}_{name}": getattr(each, name) for each in effects for name in type(each).model_fields}
        return {name: value for name, value in fields.items() if isinstance(value, float)}


def _helbing_molnar_1995(hidden: bool, group: int | None) -> tuple[Effect, ...]:
    return (
        Driving(tau=0.5),
        EllipticalRepulsion(acceleration=7.0, decay=0.3, step=2.0, fov=200.0, outside=0.5, radius=5.0, occluded=hidden),
        ObstacleRepulsion(acceleration=50.0, decay=0.2, bodies=False, radius=3.0, occluded=hidden),
    )


def _helbing_farkas_vicsek_2000(hidden: bool, group: int | None) -> tuple[Effect, ...]:
    return (
        Driving(tau=0.5),
        CircularRepulsion(strength=2000.0, decay=0.08, radius=1.6, occluded=hidden),
        ObstacleRepulsion(strength=2000.0, decay=0.08, radius=1.6, occluded=hidden),
    )


def _johansson_2007(repulsion: Callable[[bool], Effect]) -> Callable[[bool, int | None], tuple[Effect, ...]]:
    def behaviours(hidden: bool, group: int | None) -> tuple[Effect, ...]:
        wall = ObstacleRepulsion(acceleration=50.0, decay=0.2, bodies=False, radius=3.0, occluded=hidden)
        return (Driving(tau=0.5), repulsion(hidden), wall)

    return behaviours


def _moussaid_2009(hidden: bool, group: int | None) -> tuple[Effect, ...]:
    return (
        Driving(tau=0.54),
        Sidestep(acceleration=4.5, radius=8.0, occluded=hidden),
        ObstacleRepulsion(acceleration=3.0, decay=0.1, bodies=False, radius=2.0, occluded=hidden),
    )


def _moussaid_2010(hidden: bool, group: int | None) -> tuple[Effect, ...]:
    return (*_moussaid_2009(hidden, group), WalkingGroup(group=group, party=3))


def _moussaid_2011(hidden: bool, group: int | None) -> tuple[Effect, ...]:
    return (Heuristics(tau=0.5, radius=10.0, view=75.0),)


_WALKERS = {"mass": 80.0, "radius": 0.25, "desired_speed": Spread(mean=1.34, sd=0.26, low=0.3), "haste": 1.3}

_2007 = "Johansson, Helbing, Shukla, Adv. Complex Systems 10:271, 2007 (arXiv 0810.4587)"
_2007_NOTE = "the fit has no walls and no tau of its own: those are of 1995 (U0 = 10 m^2/s^2, R = .2 m, tau = .5 s)"

PRESETS: dict[str, Model] = {
    "helbing_molnar_1995": Model(
        "Helbing, Molnar, Phys. Rev. E 51:4282, 1995",
        _helbing_molnar_1995,
        people=_WALKERS,
        symbols={
            "V0": "2.1 m^2/s^2", "sigma": ".3 m", "U0": "10 m^2/s^2", "R": ".2 m", "2 phi": "200 degrees", "c": ".5",
            "dt": "2 s", "tau": ".5 s", "v0": "N(1.34, .26) m/s", "v_max": "1.3 v0",
        },
        note="v_max is the group's `haste`; the step is v_j dt, with the other's actual velocity, not its desired one",
    ),
    "helbing_farkas_vicsek_2000": Model(
        "Helbing, Farkas, Vicsek, Nature 407:487, 2000",
        _helbing_farkas_vicsek_2000,
        bodies=(
            Contact(stiffness=1.2e5, friction=2.4e5),
            ObstacleContact(stiffness=1.2e5, friction=2.4e5),
        ),
        people={"mass": 80.0, "radius": Spread(low=0.25, high=0.35), "desired_speed": 1.0},
        symbols={
            "A": "2000 N", "B": ".08 m", "k": "1.2e5 kg/s^2", "kappa": "2.4e5 kg/(m s)", "tau": ".5 s", "m": "80 kg",
            "2 r": "U[.5, .7] m", "v0": ".6, 1, 1.5, up to 5 and more m/s (relaxed, normal, nervous, panic)",
        },
        note="no view weight: it sees behind as well as ahead. Stiff: explicit Euler takes dt < 1 ms",
    ),
    "johansson_2007_circular": Model(
        _2007,
        _johansson_2007(
            lambda hidden: CircularRepulsion(
                acceleration=0.42, decay=1.65, bodies=False, anisotropy=0.12, radius=12.0, occluded=hidden
            )
        ),
        people=_WALKERS,
        symbols={"A": ".42 +- .26 m/s^2", "B": "1.65 +- 1.01 m", "lambda": ".12 +- .07"},
        note=_2007_NOTE,
    ),
    "johansson_2007_elliptical_1": Model(
        _2007,
        _johansson_2007(
            lambda hidden: EllipticalRepulsion(
                acceleration=0.11, decay=1.19, step=0.5, anisotropy=0.16, radius=10.0, occluded=hidden
            )
        ),
        people=_WALKERS,
        symbols={"A": ".11 +- .01 m/s^2", "B": "1.19 +- .45 m", "lambda": ".16 +- .04", "dt": ".5 s"},
        note=_2007_NOTE + "; dt is Menge's",
    ),
    "johansson_2007_elliptical_2": Model(
        _2007,
        _johansson_2007(
            lambda hidden: EllipticalRepulsion(
                acceleration=0.04, decay=3.22, step=0.5, relative=True, anisotropy=0.06, radius=15.0, occluded=hidden
            )
        ),
        people=_WALKERS,
        symbols={"A": ".04 +- .01 m/s^2", "B": "3.22 +- .67 m", "lambda": ".06 +- .04", "dt": ".5 s"},
        note=_2007_NOTE,
    ),
    "moussaid_2009": Model(
        "Moussaid et al., Proc. R. Soc. B 276:2755, 2009",
        _moussaid_2009,
        people={"mass": 80.0, "radius": 0.25, "desired_speed": Spread(mean=1.29, sd=0.19, low=0.3)},
        symbols={
            "A": "4.5 +- .3 m/s^2", "gamma": ".35 +- .01 s", "n": "2.0 +- .1", "n'": "3.0 +- .7",
            "lambda": "2.0 +- .2 s/m", "tau": ".54 +- .05 s", "v0": "1.29 +- .19 m/s", "a": "3 m/s^2", "b": ".1 m",
        },
        note="A, tau, v0, and the wall's a and b are those of programs after the paper, see docs/social_forces.md; the "
        "bias eps = .005 is quoted from memory; none is checked in the paper",
    ),
    "moussaid_2010_groups": Model(
        "Moussaid et al., PLoS ONE 5:e10047, 2010",
        _moussaid_2010,
        people={"mass": 80.0, "radius": 0.25, "desired_speed": Spread(mean=1.29, sd=0.19, low=0.3)},
        symbols={"beta1": "4", "beta2": "3", "beta3": "1", "d0": ".8 m", "N": "3"},
        note="beta1 to beta3 are from memory (PySocialForce has 4, 3, 1, in older versions 3, 2, 1), and so is d0; the "
        "forces on all others are those of 2009",
    ),
    "moussaid_2011": Model(
        "Moussaid, Helbing, Theraulaz, PNAS 108:6884, 2011",
        _moussaid_2011,
        bodies=(Contact(stiffness=5e3), ObstacleContact(stiffness=5e3)),
        people={"mass": Spread(low=60.0, high=100.0), "radius": Spread(low=60 / 320, high=100 / 320),
                "desired_speed": Spread(mean=1.3, sd=0.2, low=0.3)},
        symbols={
            "tau": ".5 s", "phi": "75 degrees", "d_max": "10 m", "k": "5e3 kg/s^2", "m": "U[60, 100] kg",
            "r": "m / 320", "v0": "N(1.3, .2) m/s",
        },
    ),
}  # fmt: skip
"""Published models of pedestrians by name, each with its source."""

ALIASES = {
    "helbing_1995": "helbing_molnar_1995",
    "helbing_2000": "helbing_farkas_vicsek_2000",
    "moussaid_2010": "moussaid_2010_groups",
}
"""Shorter names."""


def _find_model(name: str) -> Model:
    full = ALIASES.get(name, name)
    if full not in PRESETS:
        raise ValueError(
            f"preset = {printable(name)}: unknown{nearest(name, [*PRESETS, *ALIASES]) or ';'} "
            f"allowed: {', '.join(PRESETS)}"
        )
    return PRESETS[full]


def preset(name: str, group: int | None = None, contacts: bool = True, occluded: bool = False) -> tuple[Effect, ...]:
    """Return the effects of a published model: the behaviours of a group (None: all groups), and the contact forces.

    Contacts act between all groups: of two presets for two groups give one `contacts=False`. occluded: True if walls
    hide pedestrians and walls. Raise ValueError, in one line, for an unknown name.
    """
    model = _find_model(name)
    behaviours = model.behaviours(occluded, group)
    bodies = model.bodies if contacts else ()
    if group is None:
        return (*behaviours, *bodies)
    return (Steer(group=group, arbitration=Blend(), behaviours=behaviours), *bodies)


class Preset(Record):
    """An item of a file's `effects` that stands for the effects of a published model."""

    preset: str = Field(description=f"its name: {', '.join(PRESETS)}", json_schema_extra={"enum": [*PRESETS, *ALIASES]})
    group: int | None = Field(default=None, ge=0, description="group of its behaviours (default: all)")
    contacts: bool = Field(default=True, description="True: the model's contact forces, once for all groups")
    occluded: bool = Field(default=False, description="True: walls hide pedestrians and walls")

    def effects(self) -> tuple[Effect, ...]:
        """Return the effects that it stands for."""
        return preset(self.preset, self.group, self.contacts, self.occluded)


# --- in a file --------------------------------------------------------------------------------------------------------


class Origins(dict[KeyPath, list[int]]):
    """For each list of effects with presets: the index in the file of each item of the expanded list."""

    def path(self, path: KeyPath) -> KeyPath:
        """Return the key path in the file."""
        for k in range(1, len(path)):
            step = path[k]
            if path[:k] in self and isinstance(step, int) and step < len(self[path[:k]]):
                return (*path[:k], self[path[:k]][step], *path[k + 1 :])
        return path

    def text(self, text: str) -> str:
        """Return a message with its leading key path replaced by that in the file.

        text: begins with a key path, such as `effects[2].radius`.
        """
        path = parse_key_path(text)
        for k in range(len(path), 0, -1):
            before, after = key_path(path[:k]), key_path(self.path(path[:k]))
            if text.startswith(before) and before != after:
                return after + text[len(before) :]
        return text


def expand_presets(data: Any) -> tuple[Any, Origins]:
    """Return the data of a file with every preset in a list of effects replaced by its effects, and their origins.

    Contact effects that two presets share are included once. Raise ValueError, beginning with the key path, if their
    contacts differ.
    """
    origins = Origins()
    return _expand(data, (), origins), origins


def _expand(value: Any, path: KeyPath, origins: Origins) -> Any:
    if isinstance(value, dict):
        return {key: _expand(inner, (*path, key), origins) for key, inner in value.items()}
    if not isinstance(value, list):
        return value
    if not path or path[-1] != "effects" or not any(isinstance(item, dict) and "preset" in item for item in value):
        return [_expand(item, (*path, k), origins) for k, item in enumerate(value)]
    out: list[Any] = []
    origins[path] = []
    bodies: list[Any] = []
    for k, item in enumerate(value):
        effects = [item]
        if isinstance(item, dict) and "preset" in item:
            effects = [effect.model_dump(mode="json") for effect in _read_preset(item, (*path, k)).effects()]
            contacts = [each for each in effects if each["kind"] in ("contact", "obstacle_contact")]
            if contacts and bodies and contacts != bodies:
                raise ValueError(
                    f"{key_path((*path, k))}.preset = {item['preset']}: its contacts differ from those of a "
                    "preset before it; give contacts: false to one of them"
                )
            effects = [each for each in effects if each not in bodies]
            bodies = contacts or bodies
        out += effects
        origins[path] += [k] * len(effects)
    return out


def _read_preset(item: dict[str, Any], path: KeyPath) -> Preset:
    """Return an item of a file as a preset; raise ValueError, beginning with its key path, if it is invalid."""
    try:
        out = Preset.model_validate(item, strict=True)
        _find_model(out.preset)
        return out
    except ValidationError as error:
        raise ValueError(f"{key_path(path)}.{refusals(error, Preset, item)[0]}") from None
    except ValueError as error:
        raise ValueError(f"{key_path(path)}.{error}") from None
