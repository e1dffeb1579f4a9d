"""Scene: what is simulated, as one record; its checks, where its agents begin, its presets, and YAML."""

from __future__ import annotations

from flockenv.scene.scene import MEMORY_LIMIT, AnyConstraint, AnyEffect, AnyIntegrator, AnyMember, Group, Scene

__all__ = ["MEMORY_LIMIT", "AnyConstraint", "AnyEffect", "AnyIntegrator", "AnyMember", "Group", "Scene"]
