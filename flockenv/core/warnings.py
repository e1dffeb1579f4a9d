"""Warnings of a simulation: it continues, but the result may not be the intended one."""

from __future__ import annotations

__all__ = [
    "CoarseContactWarning",
    "LookaheadWarning",
    "NoWayWarning",
    "OtherTaskWarning",
    "UnmetWarning",
    "UnsolvedContactsWarning",
    "UnstableStepWarning",
]


class UnstableStepWarning(UserWarning):
    """A scene's dt is beyond the largest stable step."""


class CoarseContactWarning(UserWarning):
    """A contact lasts so few steps that bodies leave it faster or slower than its law predicts."""


class LookaheadWarning(UserWarning):
    """An agent detects obstacles, or the place where to slow down, too late to stop there."""


class UnmetWarning(UserWarning):
    """A rod or rope does not have its length: the allowed number of sweeps did not suffice."""


class UnsolvedContactsWarning(RuntimeWarning):
    """Too many impacts in a step, contacts that the passes did not resolve, or too long a path round a torus."""


class NoWayWarning(UserWarning):
    """Agents start at positions from which no path leads to their target."""


class OtherTaskWarning(UserWarning):
    """A policy runs a task with arguments or scales that differ from those it was trained on."""
