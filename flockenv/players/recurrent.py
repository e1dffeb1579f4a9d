"""A policy with an LSTM before its other layers, in numpy: what it saw earlier in an episode changes its actions."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flockenv.players.policy import MlpPolicy, Observation, State

__all__ = ["RecurrentPolicy", "has_lstm"]

Floats = NDArray[np.float32]

PREFIX = "lstm."
GATES = 4
"""Input, forget, cell and output gate: rows of the LSTM's tensors, in the order of torch."""


def has_lstm(tensors: Mapping[str, NDArray[Any]]) -> bool:
    """Return True if a policy's tensors contain those of an LSTM."""
    return any(name.startswith(PREFIX) for name in tensors)


class RecurrentPolicy(MlpPolicy):
    """The actor of sb3-contrib's RecurrentPPO with one LSTM layer (Hochreiter and Schmidhuber 1997), equal to 1e-6.

    Args:
        tensors: those of MlpPolicy, whose first layer takes the LSTM's output (H,); and `lstm.weight_ih` (4 H, O),
            `lstm.weight_hh` (4 H, H), `lstm.bias` (4 H,), the sum of torch's two.
        card: as of MlpPolicy.
        seed: as of MlpPolicy.

    Raises:
        ValueError: a tensor is missing, unknown, not finite, or its shape or type does not match the other layers.
    """

    def __init__(self, tensors: Mapping[str, NDArray[Any]], card: Mapping[str, Any], seed: int | None = 0) -> None:
        super().__init__({k: v for k, v in tensors.items() if not k.startswith(PREFIX)}, card, seed)
        self.units = self.observation_size  # of the layers after the LSTM
        weight_ih, weight_hh, self._bias = _checked(tensors, self.units)
        self._weight_ih, self._weight_hh = (np.ascontiguousarray(weight.T) for weight in (weight_ih, weight_hh))
        self.observation_size = int(weight_ih.shape[1])

    def __repr__(self) -> str:
        return f"RecurrentPolicy({self.observation_size} -> lstm {self.units}, then {super().__repr__()})"

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[Floats, State]:
        """Return actions, (R, O) -> (R, A) or (O,) -> (A,), and the LSTM's state: output and cell, each (1, R, H).

        state: that of the call before; None: zeros. It is zero where `episode_start`, (R,), is True.
        """
        rows = self._rows(observation)
        table = rows.reshape(-1, self.observation_size)
        output, cell = self._step(table, *self._state_of(len(table), state, episode_start))
        return self._act(output, deterministic).reshape(*rows.shape[:-1], self.action_size), (output[None], cell[None])

    def _state_of(self, rows: int, state: State | None, begins: NDArray[Any] | None) -> tuple[Floats, Floats]:
        """Return output and cell (R, H) of the step before; raise ValueError if they are of other rows."""
        shape = (1, rows, self.units)
        if state is None:
            return np.zeros(shape[1:], np.float32), np.zeros(shape[1:], np.float32)
        if len(state) != 2 or any(np.shape(part) != shape for part in state):
            raise ValueError(f"state: shapes {[np.shape(part) for part in state]}, must be two of {shape}")
        goes_on = np.ones((rows, 1), np.bool_) if begins is None else ~np.reshape(begins, (-1, 1)).astype(np.bool_)
        output, cell = (np.where(goes_on, part[0], np.float32(0)) for part in state)
        return output, cell

    def _step(self, rows: Floats, output: Floats, cell: Floats) -> tuple[Floats, Floats]:
        """Return output and cell (R, H) after the rows (R, O)."""
        gates = rows @ self._weight_ih + output @ self._weight_hh + self._bias
        enter, forget, new, leave = np.split(gates, GATES, axis=1)
        cell = _sigmoid(forget) * cell + _sigmoid(enter) * np.tanh(new)
        return _sigmoid(leave) * np.tanh(cell), cell


def _sigmoid(x: Floats) -> Floats:
    """Return the logistic function; by tanh, it does not overflow."""
    half = np.float32(0.5)
    result: Floats = half + half * np.tanh(half * x)
    return result


def _checked(tensors: Mapping[str, NDArray[Any]], units: int) -> tuple[Floats, Floats, Floats]:
    """Return the LSTM's tensors; raise ValueError, in one line, for those that MlpPolicy would refuse in a layer."""
    names = [f"{PREFIX}{name}" for name in ("weight_ih", "weight_hh", "bias")]
    if odd := sorted(set(names) ^ {name for name in tensors if name.startswith(PREFIX)}):
        raise ValueError(f"tensor {odd[0]!r} is {'missing' if odd[0] in names else 'not one of an LSTM'}")
    first = tensors[names[0]]
    sizes = ((GATES * units, first.shape[-1] if first.ndim else 0), (GATES * units, units), (GATES * units,))
    for name, shape in zip(names, sizes, strict=True):
        tensor = tensors[name]
        if tensor.dtype != np.float32:
            raise ValueError(f"tensor {name!r} is {tensor.dtype}, must be float32")
        if not np.isfinite(tensor).all():
            raise ValueError(f"tensor {name!r} holds NaN or infinity")
        if tensor.shape != shape or 0 in shape:
            raise ValueError(f"tensor {name!r} has shape {tensor.shape}, the other layers require {shape}")
    weight_ih, weight_hh, bias = (tensors[name] for name in names)
    return weight_ih, weight_hh, bias
