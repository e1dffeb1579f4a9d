"""SceneView: what effects, constraints and populations read of the scene that they are part of."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from flockenv.geometry.shapes import Circle, Shape
    from flockenv.geometry.space import Space
    from flockenv.model.group import Group
    from flockenv.model.state import Body, State

__all__ = ["SceneView"]


class SceneView(Protocol):
    """A scene as its parts see it: a record without the step. `flockenv.scene.Scene` is one.

    Members of packages above this one (effects, the method) are `Any` here: a part may ask them for their own names.
    """

    @property
    def dimension(self) -> int:
        """D, 2 or 3."""

    @property
    def dtype(self) -> str:
        """The precision of everything."""

    @property
    def dt(self) -> float:
        """s, one physics step."""

    @property
    def space(self) -> Space:
        """Where agents are."""

    @property
    def groups(self) -> Sequence[Group]:
        """Agents, group after group."""

    @property
    def effects(self) -> Sequence[Any]:
        """What acts on agents."""

    @property
    def obstacles(self) -> Sequence[Shape]:
        """The same in every world."""

    @property
    def integrator(self) -> Any:
        """The method."""

    @property
    def constraints(self) -> Sequence[Any]:
        """What every step must end with."""

    @property
    def population(self) -> Sequence[Any]:
        """Sinks and emitters."""

    @property
    def agents(self) -> int:
        """N."""

    @property
    def starts(self) -> tuple[int, ...]:
        """The first agent of each group, and N."""

    @property
    def living(self) -> tuple[int, ...]:
        """How many agents of each group live at the start."""

    @property
    def circles(self) -> tuple[Circle, ...]:
        """Round solid obstacles that stand still: part of the state."""

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """The other obstacles."""

    @property
    def touching(self) -> float:
        """The two largest radii, summed, m: agents further apart do not touch."""

    @property
    def body(self) -> Body:
        """The bodies of all groups."""

    @property
    def parts(self) -> Any:
        """What the kernel of this scene depends on."""

    @property
    def coupling(self) -> Any:
        """Which agents' accelerations depend on which, for methods that solve equations."""

    @property
    def table(self) -> Any:
        """Bonds."""

    def table_of(self, effect: Any) -> NDArray[Any]:
        """Return the numbers that the laws of a tabled effect look up."""

    def inner(self, state: State, name: str) -> NDArray[Any]:
        """Return a number that agents keep, by name, (B, N)."""

    def rates(self, state: State, drive: ArrayLike | None = None, times: ArrayLike | None = None) -> Any:
        """Return accelerations and the velocity of the medium, (B, N, D)."""
