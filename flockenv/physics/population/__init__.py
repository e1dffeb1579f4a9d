"""Populations: births and deaths of agents in a fixed number of slots, some of which hold a living agent.

A group has `count` slots. An emitter fills its free slots with new agents, and a sink removes living ones; a reused
slot holds another agent, with an identity and a time of birth of its own.
"""

from __future__ import annotations

from flockenv.physics.population.emitters import Burst, Emitter
from flockenv.physics.population.lifecycle import create_initial, make_settler
from flockenv.physics.population.members import POPULATION, Member
from flockenv.physics.population.regions import PLACES, BoxPlace, Clearing, Disc, Place, Point, Segment, Surface
from flockenv.physics.population.sinks import Ageing, Crowding, Decay, Drain, Leaving, Threshold

__all__ = [
    "PLACES", "POPULATION", "Ageing", "BoxPlace", "Burst", "Clearing", "Crowding", "Decay", "Disc", "Drain", "Emitter",
    "Leaving", "Member", "Place", "Point", "Segment", "Surface", "Threshold", "create_initial", "make_settler",
]  # fmt: skip
