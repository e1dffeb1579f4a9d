"""What every test runs under: no display, no randomness of the test runner's own."""

from __future__ import annotations

import os

import hypothesis

# Before anything imports pygame: a window is opened, but nowhere.
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
os.environ.setdefault("SDL_AUDIODRIVER", "dummy")

# Examples are the same in every run (a failure is nobody's bad luck), and a first call may compile for seconds.
hypothesis.settings.register_profile("flockenv", derandomize=True, deadline=None, database=None, max_examples=60)
hypothesis.settings.load_profile("flockenv")
