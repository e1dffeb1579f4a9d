"""Scene: a simulation as one record; its checks, initial state, presets, and YAML."""

from __future__ import annotations

from flockenv.scene.scene import MEMORY_LIMIT, AnyConstraint, AnyEffect, AnyIntegrator, AnyMember, Group, Scene

__all__ = ["MEMORY_LIMIT", "AnyConstraint", "AnyEffect", "AnyIntegrator", "AnyMember", "Group", "Scene"]
