"""Appearance of the agents of a group in pictures, GIFs and replays, as data."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flockenv.core.record import Record

__all__ = ["Appearance"]

Colour = Annotated[str, Field(pattern=r"^#[0-9a-fA-F]{6}$")]
Share = Annotated[float, Field(ge=0, le=1)]
Size = Annotated[float, Field(ge=0)]


class Appearance(Record):
    """Points, discs, polygons, metaballs or billboards whose colour, opacity and size may depend on one quantity.

    `by` names it: age, speed, strain or an inner state. `over` is its range: from the first to the last colour, opacity
    and size, which are interpolated.
    """

    sentence: ClassVar[str] = "drawn as {form}"

    form: Literal["point", "disc", "polygon", "metaball", "billboard"] = Field(
        default="point",
        description="a dot, always visible; a disc of its true size; a polygon that points ahead; a disc that melts "
        "into its neighbours, as drops of a liquid do; a billboard, a soft disc that faces the viewer, as of smoke",
    )
    vertices: tuple[tuple[float, float], ...] = Field(
        default=((1.0, 0.0), (-0.8, 0.6), (-0.8, -0.6)), min_length=3, max_length=64,
        description="corners of a polygon, x ahead, in units of its size",
    )  # fmt: skip
    by: Literal["age", "speed", "strain", "inner"] | None = Field(
        default=None,
        description="quantity on which the appearance depends; strain: the mean of |l / L - 1| over the edges of the "
        "agent's network that end at it, L the rest length (default: none)",
    )
    of: str | None = Field(default=None, description="name of the inner state; only if by = inner")
    over: tuple[float, float] = Field(
        default=(0.0, 1.0), description="s, m/s, 1, or the unit of the inner state: range of that quantity"
    )
    colours: tuple[Colour, ...] = Field(
        default=(), description="#rrggbb, first to last, evenly spaced (default: the colour of its role)"
    )
    opacity: tuple[Share, Share] = Field(default=(1.0, 1.0), description="from, to; 0 = invisible")
    size: tuple[Size, Size] | None = Field(default=None, description="m, from, to (default: the body's radius)")
    trail: float = Field(default=0.0, ge=0, description="s, duration of the trail drawn behind it")

    @model_validator(mode="after")
    def _check_consistent(self) -> Appearance:
        """Raise ValueError if `over` is empty, or `by` and the fields that need it do not fit together."""
        if not self.over[0] < self.over[1]:
            raise ValueError(f"over = {self.over}: the first number must be below the second")
        changes = len(self.colours) > 1 or self.opacity[0] != self.opacity[1]
        changes |= self.size is not None and self.size[0] != self.size[1]
        if changes and self.by is None:
            raise ValueError("by: missing; colours, opacity or size depend on age, speed, strain or an inner state")
        if (self.by == "inner") != (self.of is not None):
            raise ValueError(f"of = {self.of}: is needed if by = inner, to name the inner state, and only then")
        return self

    def shade(
        self, age: NDArray[np.float64], speed: NDArray[np.float64], shown: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Return the position of each agent's value within `over`, (N,) from 0 to 1; shown: strain or inner state.

        age: (N,) s; speed: (N,) m/s.
        """
        value = {"age": age, "speed": speed, "strain": shown, "inner": shown}.get(self.by or "")
        if value is None:
            return np.zeros(len(age))
        value = np.clip(np.nan_to_num(value), *self.over)  # first, so that no difference overflows
        return np.asarray((value - self.over[0]) / (self.over[1] - self.over[0]))

    @property
    def reads_scene(self) -> bool:
        """True if its quantity is known to the scene only, not to a snapshot's positions and velocities."""
        return self.by in ("strain", "inner")

    def colour(self, shade: float, usual: str) -> tuple[int, int, int]:
        """Return the colour at a shade, red, green and blue from 0 to 255; usual: the colour of the role."""
        names = self.colours or (usual,)
        place = shade * (len(names) - 1)
        k = min(int(place), len(names) - 2) if len(names) > 1 else 0
        ends = [[int(name[j : j + 2], 16) for j in (1, 3, 5)] for name in (names[k], names[min(k + 1, len(names) - 1)])]
        r, g, b = (round(first + (last - first) * (place - k)) for first, last in zip(*ends, strict=True))
        return r, g, b

    def opacity_at(self, shade: float) -> float:
        """Return the opacity at a shade."""
        return self.opacity[0] + (self.opacity[1] - self.opacity[0]) * shade

    def size_at(self, shade: float, radius: float) -> float:
        """Return the size at a shade, m; radius: the body's, m."""
        return radius if self.size is None else self.size[0] + (self.size[1] - self.size[0]) * shade
