"""The base class of methods with adaptive substeps, with the settings of step-size control."""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from flockenv.physics.integrators.integrator import Integrator

__all__ = ["Adaptive"]


class Adaptive(Integrator):
    """Base class of methods that choose substeps within dt, see `step_size`."""

    tolerance: float = Field(default=1e-4, gt=0, description="error of one substep, m and m/s, of the worst agent")
    least: float = Field(
        default=0.0, ge=0, description="s, smallest substep; a world that needs a smaller one diverges"
    )
    most: int = Field(
        default=100_000, ge=1, description="largest number of substeps within dt; a world that needs more diverges"
    )
    adaptive: ClassVar[bool] = True
    stable_at_any_step: ClassVar[bool] = True
