"""The warnings of a simulation: what is computed all the same, and may not be what was meant."""

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
    """A contact is over in so few steps that bodies come out of it faster or slower than its law says."""


class LookaheadWarning(UserWarning):
    """Somebody notices obstacles, or where to slow down, too late to stop there."""


class UnmetWarning(UserWarning):
    """A rod or rope is not as long as it should be: the sweeps that were allowed did not suffice."""


class UnsolvedContactsWarning(RuntimeWarning):
    """More impacts in a step than are allowed, contacts that passes have not solved, too long a path round a torus."""


class NoWayWarning(UserWarning):
    """Agents begin where no way leads to their target."""


class OtherTaskWarning(UserWarning):
    """A policy is to play a task with other arguments or scales than the one that it was trained on."""
