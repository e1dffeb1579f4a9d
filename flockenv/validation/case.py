"""What trials of crowds share: they take no notice of how well a step resolves contacts."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager

from flockenv.stability import CoarseContactWarning, UnstableStepWarning

__all__ = ["quietly"]


@contextmanager
def quietly() -> Iterator[None]:
    """Take no notice of contacts that a step resolves badly: presets come with the step they are used with."""
    with warnings.catch_warnings():
        for kind in (UnstableStepWarning, CoarseContactWarning):
            warnings.simplefilter("ignore", kind)
        yield
