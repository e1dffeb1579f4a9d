"""Policies with a network for each learner of a world: independent networks, in one file, behind one predict().

Independent learners (Tan 1993, ICML, 330) that share no parameters play together only: network k is that of learner k.
So they are one player, in files of the usual form whose tensors have one more axis, the first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.players.policy import MlpPolicy, Observation, State

__all__ = ["IndependentPolicy", "has_networks", "stack_networks"]

Floats = NDArray[np.float32]


def has_networks(tensors: Mapping[str, NDArray[Any]]) -> bool:
    """Return True if a policy's tensors are those of several networks."""
    return "action.bias" in tensors and tensors["action.bias"].ndim == 2


def stack_networks(networks: Sequence[Mapping[str, NDArray[Any]]]) -> dict[str, NDArray[Any]]:
    """Return the tensors of a policy whose learner k has network k; all networks have the same sizes."""
    return {name: np.stack([tensors[name] for tensors in networks]) for name in networks[0]}


class IndependentPolicy(MlpPolicy):
    """L networks for the L learners of a world; rows are those of whole worlds, learner after learner.

    Args:
        tensors: those of MlpPolicy, each with L as its first axis.
        card: as of MlpPolicy.
        seed: of the generator that samples, which all networks share.

    Raises:
        ValueError: as MlpPolicy; or the tensors are of different numbers of networks.
    """

    def __init__(self, tensors: Mapping[str, NDArray[Any]], card: Mapping[str, Any], seed: int | None = 0) -> None:
        learners = len(tensors["action.bias"])
        for name, tensor in tensors.items():
            if tensor.shape[:1] != (learners,) or learners == 0:
                count = tensor.shape[0] if tensor.ndim else 0
                raise ValueError(f"tensor {name!r} is of {count} networks, 'action.bias' of {learners}")
        self.networks = tuple(
            MlpPolicy({name: tensor[k] for name, tensor in tensors.items()}, card, seed) for k in range(learners)
        )
        super().__init__({name: tensor[0] for name, tensor in tensors.items()}, card, seed)
        self.learners = learners
        for network in self.networks:
            network._generator = self._generator

    def __repr__(self) -> str:
        return f"IndependentPolicy({self.learners} networks, {super().__repr__()})"

    def watch(self, world: Any) -> None:
        """Raise ValueError unless the rows of worlds are those of all their learners.

        world: whose task and worlds are compared.
        """
        if getattr(world, "learners", None) != self.learners:
            raise ValueError(f"policy: has a network for each of {self.learners} learners, which play together only")

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[Floats, State | None]:
        """Return actions (R, A) of observations (R, O), where row r is of learner r % L.

        observation: (R, O) or (O,) float32; state: what the last call returned, None at the start; episode_start: (R,),
        True for rows whose episode begins; deterministic: True for the mean action, if there is one.

        Raises:
            ValueError: R is not a multiple of L; `networks[k].predict` takes rows of learner k alone.
        """
        rows = self._rows(observation)
        if rows.ndim == 1 or len(rows) % len(self.networks):
            raise ValueError(
                f"observation: shape {rows.shape}, must have a row for each of {self.learners} learners, whose "
                "networks differ; networks[k].predict takes rows of learner k"
            )
        actions = np.empty((len(rows), self.action_size), np.float32)
        for k, network in enumerate(self.networks):
            actions[k :: self.learners] = network._act(rows[k :: self.learners], deterministic)
        return actions, state
