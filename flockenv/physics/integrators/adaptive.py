"""What methods with steps of their own have in common: the numbers that their control is given."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from flockenv.physics.integrators.integrator import Integrator

__all__ = ["Adaptive"]


class Adaptive(Integrator):
    """A method that chooses steps of its own within dt, see `control`."""

    tolerance: float = Field(default=1e-4, gt=0, description="error of one step, m and m/s, of the worst agent")
    least: float = Field(
        default=0.0, ge=0, description="s, smallest step; a world that needs a smaller one is given up"
    )
    most: int = Field(
        default=100_000, ge=1, description="steps of its own within dt; a world that needs more is given up"
    )
    adaptive: ClassVar[bool] = True
