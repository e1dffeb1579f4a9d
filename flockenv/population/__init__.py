"""Populations: who is born and who dies, over a fixed table of agents of whom some live.

A group has as many slots as its count says. An emitter brings the dead ones of a group to life, and a sink lets the
living die; a slot that is used again holds somebody else: another identity, another time of birth.
"""

from __future__ import annotations

from flockenv.population.emitters import Burst, Emitter
from flockenv.population.members import POPULATION, Member
from flockenv.population.places import PLACES, BoxPlace, Clearing, Disc, Place, Point, Segment, Surface
from flockenv.population.settle import beget, settler
from flockenv.population.sinks import Ageing, Crowding, Decay, Drain, Leaving, Threshold

__all__ = [
    "PLACES", "POPULATION", "Ageing", "BoxPlace", "Burst", "Clearing", "Crowding", "Decay", "Disc", "Drain", "Emitter",
    "Leaving", "Member", "Place", "Point", "Segment", "Surface", "Threshold", "beget", "settler",
]  # fmt: skip
