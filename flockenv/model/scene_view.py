"""SceneView: the attributes of a scene that effects, constraints and populations read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from flockenv.geometry.shapes import Circle, Shape
    from flockenv.geometry.space import Space
    from flockenv.model.group import Group
    from flockenv.model.state import Body, State

__all__ = ["SceneView"]


class SceneView(Protocol):
    """A scene without its step, as its parts read it; `flockenv.scene.Scene` is one.

    Members whose types are defined in packages above this one (effects, the method) are `Any` here.
    """

    @property
    def dimension(self) -> int:
        """Dimension D, 2 or 3."""

    @property
    def dtype(self) -> str:
        """The precision of all numbers."""

    @property
    def dt(self) -> float:
        """Length of a physics step, s."""

    @property
    def space(self) -> Space:
        """The space of the agents."""

    @property
    def groups(self) -> Sequence[Group]:
        """The groups of agents, in order."""

    @property
    def effects(self) -> Sequence[Any]:
        """The effects that act on agents."""

    @property
    def obstacles(self) -> Sequence[Shape]:
        """Obstacles, the same in every world."""

    @property
    def integrator(self) -> Any:
        """The integration method."""

    @property
    def constraints(self) -> Sequence[Any]:
        """Constraints, applied at the end of every step."""

    @property
    def population(self) -> Sequence[Any]:
        """Sinks and emitters."""

    @property
    def agents(self) -> int:
        """Number of agents, N."""

    @property
    def starts(self) -> tuple[int, ...]:
        """The index of the first agent of each group, and N."""

    @property
    def roles(self) -> tuple[str, ...]:
        """The role of each agent, (N,)."""

    @property
    def edges(self) -> NDArray[Any]:
        """Pairs of agents along the edges of networks, (E, 2)."""

    @property
    def edge_springs(self) -> NDArray[Any]:
        """Where in State.bonds the springs of those edges lie, (E,)."""

    @property
    def living(self) -> tuple[int, ...]:
        """Number of agents of each group that live at the start."""

    @property
    def circles(self) -> tuple[Circle, ...]:
        """Round solid obstacles that do not move: part of the state."""

    @property
    def shapes(self) -> tuple[Shape, ...]:
        """The obstacles that are not in the state."""

    @property
    def contact_distance(self) -> float:
        """Sum of the two largest radii, m: agents further apart do not touch."""

    @property
    def body(self) -> Body:
        """The bodies of all groups."""

    @property
    def parts(self) -> Any:
        """The kernel plan of this scene."""

    @property
    def coupling(self) -> Any:
        """Pairs of agents of which one's acceleration depends on the other, for implicit methods."""

    @property
    def table(self) -> Any:
        """The bonds of all effects."""

    def model_copy(self, *, update: Mapping[str, Any] | None = None) -> SceneView:
        """Return a copy with the fields in `update` changed, validated as a new scene."""

    def table_of(self, effect: Any) -> NDArray[Any]:
        """Return the table that the laws of an effect read."""

    def inner(self, state: State, name: str) -> NDArray[Any]:
        """Return an inner state of the agents, by name, (B, N)."""

    def rates(self, state: State, drive: ArrayLike | None = None, times: ArrayLike | None = None) -> Any:
        """Return accelerations and the velocity of the medium, (B, N, D)."""
