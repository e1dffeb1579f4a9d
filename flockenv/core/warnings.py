"""Warnings that the result of a simulation, which continues, may not be the intended one."""

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
    """An agent detects an obstacle, or starts to slow down for a target, too late to stop in time."""


class UnmetWarning(UserWarning):
    """A rod or rope does not have its length after the allowed number of sweeps."""


class UnsolvedContactsWarning(RuntimeWarning):
    """A step has too many impacts, contacts that the passes did not resolve, or too long a path on a torus."""


class NoWayWarning(UserWarning):
    """Agents start at positions from which no path leads to their target, or to a later stage of their journey."""


class OtherTaskWarning(UserWarning):
    """A policy runs a task with arguments or scales that differ from those it was trained on."""
