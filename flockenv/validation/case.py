"""Case: a scene of pedestrians as a function of the preset that moves them, with what is demanded of it."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from flockenv.stability import CoarseContactWarning, UnstableStepWarning

__all__ = ["Case", "Value", "quietly"]


@dataclass(frozen=True)
class Value:
    """What a case came to."""

    number: float
    holds: bool | None  # within its bound; none where there is none: it is reported
    note: str = ""
    series: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """What pictures are drawn from."""


@dataclass(frozen=True)
class Case:
    """A scene that models of crowds are tried in: its name, what happens, what is demanded, and how it is tried."""

    name: str
    title: str
    bound: str
    trial: Callable[[str], Value]
    presets: tuple[str, ...] = ()
    """Those that it is tried with; none = all."""

    def under(self, preset: str) -> bool:
        """Is it tried with a preset?"""
        return not self.presets or preset in self.presets


@contextmanager
def quietly() -> Iterator[None]:
    """Take no notice of contacts that a step resolves badly: presets come with the step they are used with."""
    with warnings.catch_warnings():
        for kind in (UnstableStepWarning, CoarseContactWarning):
            warnings.simplefilter("ignore", kind)
        yield
