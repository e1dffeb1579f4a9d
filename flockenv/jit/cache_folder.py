"""The folder of cached machine code."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from flockenv.jit.private_folder import ensure_private, first_private

__all__ = [
    "cache_folder",
]


def cache_folder() -> Path:
    """Return the checked folder of cached machine code; FLOCKENV_CACHE sets another one.

    The folder is under the system's temporary one if the home folder cannot be written or is not private.

    Raises:
        OSError: the folder in FLOCKENV_CACHE can be changed by other users, or no folder can be written.
    """
    named = os.environ.get("FLOCKENV_CACHE")
    if named:
        try:
            return ensure_private(Path(named))
        except OSError as error:
            reason = error.strerror or error
            raise type(error)(f"FLOCKENV_CACHE = {named}: refused for compiled kernels: {reason}") from error
    home = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or os.path.expanduser("~/.cache")
    user = os.geteuid() if hasattr(os, "geteuid") else "cache"
    return first_private(Path(home) / "flockenv", Path(tempfile.gettempdir()), f"flockenv-{user}")
