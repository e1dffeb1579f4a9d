"""Context manager of all trials of crowds: it ignores warnings of coarse contacts."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from flockenv.core.warnings import CoarseContactWarning, UnstableStepWarning

__all__ = ["ignore_contact_warnings"]


@contextmanager
def ignore_contact_warnings() -> Iterator[None]:
    """Ignore warnings of steps that are long for contacts: presets have the time step of their papers."""
    with warnings.catch_warnings():
        for kind in (UnstableStepWarning, CoarseContactWarning):
            warnings.simplefilter("ignore", kind)
        yield
