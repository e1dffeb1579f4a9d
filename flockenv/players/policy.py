"""Policies: map rows of observations to rows of actions, hand-written or learned, with SB3's predict().

A learned policy is two files that hold no code: `X.safetensors` (the actor's weights) and `X.json` beside it (the card:
activation, sizes, the task, its arguments, the slots of its rows, SHA-256 of the weights, and how they were trained).
It runs in numpy alone.

A policy plays any task whose rows have the slots of its card: the same names, shapes and units in the same order. Other
arguments (such as more agents) and other scales, which change the quantity that a number stands for, are allowed with
a warning.
"""

from __future__ import annotations

import hashlib
import json
import os
import warnings
from collections.abc import Callable, Mapping
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from flockenv.core.atomic_files import write_all_or_none
from flockenv.core.errors import nearest, printable, printable_path
from flockenv.core.warnings import OtherTaskWarning

if TYPE_CHECKING:
    from flockenv.tasks import Layout, Task

__all__ = [
    "ACTIVATIONS", "MlpPolicy", "OtherSlotsError", "Policy", "RandomPolicy", "describe", "read_card", "save_policy",
]  # fmt: skip

Observation = NDArray[Any] | dict[str, NDArray[Any]]
State = tuple[NDArray[Any], ...]
Floats = NDArray[np.float32]
Layer = tuple[Floats, Floats]

CARD_VERSION = 1
MOST_SAID = 6
"""Differences from a card that a warning lists."""
ONE_THREAD = 2**18
"""Multiplications per matrix product up to which OpenBLAS stays on one thread (its interface/gemm.c).

Rows are processed in blocks of that size: so small a product gains nothing from threads, and if other work shares the
cores, waiting threads were measured to cost two hundred times the product itself."""

LOG_STD = (-20.0, 2.0)
"""Range of the logarithm of a squashed actor's standard deviation, that of Stable-Baselines3's SAC."""

LARGEST_CARD, LARGEST_WEIGHTS = 8 << 20, 256 << 20
"""Bytes: larger files are not read."""


class OtherSlotsError(ValueError):
    """The observations of a task have other slots than those that a policy was trained on, or it has other learners."""


@runtime_checkable
class Policy(Protocol):
    """Signature of Stable-Baselines3's predict(), so that hand-written rules and PPO models are interchangeable."""

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[NDArray[Any], State | None]:
        """Return actions for observations, (R, O) float32 -> (R, A) float32 (or one row, (O,) -> (A,)), and a state.

        observation: (R, O) or (O,) float32; state: what the last call returned, None at the start; episode_start:
        (R,), True for rows whose episode begins; deterministic: True for the mean action, if there is one.
        """
        ...


class RandomPolicy:
    """Actions uniform in [-1, 1]: the lower baseline of every table.

    Args:
        action_size: A, how many numbers an action has.
        seed: of its own generator; None draws one. The attribute `seed` records it.
    """

    def __init__(self, action_size: int, seed: int | None = None) -> None:
        if action_size < 1:
            raise ValueError(f"action_size: {action_size!r}, must be at least 1")
        self.action_size = action_size
        self.seed, self._generator = _new_generator(seed)

    def __repr__(self) -> str:
        return f"RandomPolicy({self.action_size}, seed={self.seed})"

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[Floats, State | None]:
        """Return a new draw per row; `deterministic` is ignored, as the mean action would be zero.

        observation: (R, O) or (O,) float32; state: is returned as None; episode_start: not used.
        """
        shape = (*np.asarray(observation).shape[:-1], self.action_size)
        return self._generator.uniform(-1.0, 1.0, shape).astype(np.float32), state


ACTIVATIONS: Mapping[str, Callable[..., Floats]] = {
    "tanh": np.tanh,
    "relu": lambda x, out: np.maximum(x, np.float32(0), out=out),
}
"""Activation functions of networks by name; each writes into `out`."""


SQUASHES: Mapping[str, Callable[..., Floats]] = {"tanh": np.tanh}


class MlpPolicy:
    """The actor of an MLP policy in plain numpy: float32 throughout, equal to SB3's to 1e-6 and needing no torch.

    Args:
        tensors: `policy.0.weight`, `policy.0.bias`, `policy.1.weight`, ... (hidden layers), `action.weight`,
            `action.bias`, `log_std`; weights are (out, in) as in torch. A squashed actor has a layer `log_std.weight`,
            `log_std.bias` instead of `log_std`.
        card: needs `activation`, "tanh" or "relu"; and `squash`, "tanh", for a squashed actor, whose action is the
            tanh of its output (Haarnoja et al. 2018, arXiv 1801.01290); the rest is information.
        seed: of the generator that samples when not deterministic; None draws one.

    Raises:
        ValueError: a tensor is missing, unknown, not finite, or its shape or type does not match the other layers.
    """

    def __init__(self, tensors: Mapping[str, NDArray[Any]], card: Mapping[str, Any], seed: int | None = 0) -> None:
        self.card = dict(card)
        self._activation = ACTIVATIONS[_check_known(card.get("activation"), ACTIVATIONS, "activation")]
        self._squash = SQUASHES[_check_known(card["squash"], SQUASHES, "squash")] if "squash" in card else None
        self._hidden, self._head = _layers(tensors, self._squash is not None)
        self._log_std = tensors["log_std"] if self._squash is None else None
        self._block = max(1, ONE_THREAD // max(weight.size for weight, _ in [*self._hidden, self._head]))
        self.observation_size = int([*self._hidden, self._head][0][0].shape[0])
        self.action_size = len(tensors["action.bias"])
        self.seed, self._generator = _new_generator(seed)
        self.differences: tuple[str, ...] = ()
        """Differences between the task that it plays and the one that it was trained on, a phrase each."""
        self.learners: int | None = None
        """Number of learners of a world, if each has a network of its own."""

    @property
    def layers(self) -> list[Layer]:
        """Weights (in, out) and biases of all layers, the last one last."""
        return [*self._hidden, self._head]

    def __repr__(self) -> str:
        sizes = [self.observation_size, *(len(bias) for _, bias in self._hidden), self.action_size]
        return f"MlpPolicy({' -> '.join(map(str, sizes))}, {self.card['activation']}, seed={self.seed})"

    @classmethod
    def load(cls, path: str | os.PathLike[str], task: Task | None = None, seed: int | None = 0) -> MlpPolicy:
        """Read `X.safetensors` and the card beside it; with a task, check that its observations match the card.

        path: of either file; task: that it is to play; seed: of the generator that samples when not deterministic; None
        draws one.

        Warns with OtherTaskWarning, in one line, if the task has other arguments or scales than the card's;
        `differences` lists them all.

        Raises:
            ValueError: the file is missing, truncated, altered, foreign or made for other slots; one line.
        """
        path = Path(path)
        try:
            card = read_card(path.with_suffix(".json"))
            policy = cls._of_card(_read_tensors(path, card), card, task, seed)
            _check_sizes(policy)
            _check_learners(policy, task)
            policy.differences = () if task is None else _differences(card, task)
        except ValueError as error:
            kind = OtherSlotsError if isinstance(error, OtherSlotsError) else ValueError
            raise kind(f"policy {printable_path(path)}: {error}") from None
        if policy.differences:
            differences, more = policy.differences[:MOST_SAID], len(policy.differences) - MOST_SAID
            text = "; ".join([*differences, *([f"and {more} more"] if more > 0 else [])])
            warnings.warn(f"policy {printable_path(path)}: {text}", OtherTaskWarning, stacklevel=2)
        return policy

    @classmethod
    def _of_card(
        cls, tensors: Mapping[str, NDArray[Any]], card: Mapping[str, Any], task: Task | None, seed: int | None
    ) -> MlpPolicy:
        """Return the policy of a card, which may be a hybrid of a network and rules."""
        if "hybrid" not in card:
            return cls.of_tensors(tensors, card, seed)
        from flockenv.players.hybrid import HybridPolicy  # a layer above this file

        return HybridPolicy.of(tensors, card, task, seed)

    @staticmethod
    def of_tensors(tensors: Mapping[str, NDArray[Any]], card: Mapping[str, Any], seed: int | None = 0) -> MlpPolicy:
        """Return the policy of some tensors: one network, with an LSTM or not, or one for each learner.

        seed: of the generator that samples when not deterministic; None draws one.

        The card's hybrid is left out.
        """
        from flockenv.players.independent import IndependentPolicy, has_networks  # layers above this file
        from flockenv.players.recurrent import RecurrentPolicy, has_lstm

        if has_networks(tensors):
            return IndependentPolicy(tensors, card, seed)
        return (RecurrentPolicy if has_lstm(tensors) else MlpPolicy)(tensors, card, seed)

    def predict(
        self,
        observation: Observation,
        state: State | None = None,
        episode_start: NDArray[Any] | None = None,
        deterministic: bool = False,
    ) -> tuple[Floats, State | None]:
        """Return the mean action, or a Gaussian sample, clipped to [-1, 1]: (O,) -> (A,), (R, O) -> (R, A).

        observation: (R, O) or (O,) float32; state: what the last call returned, None at the start; episode_start: (R,),
        True for rows whose episode begins; deterministic: True for the mean action, if there is one.

        If the actor is squashed, that of the mean, or of a sample, before the tanh.
        """
        rows = self._rows(observation)
        action = self._act(rows.reshape(-1, rows.shape[-1]), deterministic)
        return action.reshape(*rows.shape[:-1], self.action_size), state

    def _rows(self, observation: Observation) -> Floats:
        """Return observations as float32; raise ValueError for another shape than (O,) or (R, O)."""
        rows = np.asarray(observation, dtype=np.float32)
        if rows.ndim not in (1, 2) or rows.shape[-1] != self.observation_size:
            size = self.observation_size
            raise ValueError(f"observation: shape {rows.shape}, must be ({size},) or (rows, {size})")
        return rows

    def _act(self, rows: Floats, deterministic: bool) -> Floats:
        """Return the actions (R, A) of the inputs (R, I) of the first layer."""
        blocks = [self._output(rows[k : k + self._block]) for k in range(0, len(rows), self._block)]
        output = np.concatenate(blocks or [np.zeros((0, len(self._head[1])), np.float32)])
        action, log_std = output[:, : self.action_size], self._log_std
        if log_std is None:
            log_std = np.clip(output[:, self.action_size :], *LOG_STD)
        if not deterministic:
            action += np.exp(log_std) * self._generator.standard_normal(action.shape, dtype=np.float32)
        return np.clip(action, -1.0, 1.0, out=action) if self._squash is None else self._squash(action)

    def _output(self, rows: Floats) -> Floats:
        for weight, bias in self._hidden:
            rows = rows @ weight
            rows += bias
            self._activation(rows, out=rows)
        output: Floats = rows @ self._head[0]
        output += self._head[1]
        return output


def save_policy(path: str | os.PathLike[str], tensors: Mapping[str, NDArray[Any]], card: Mapping[str, Any]) -> None:
    """Write the weights and the card beside them, both or neither; entries of the card that can be derived are added.

    Args:
        path: ends in .safetensors; the card gets the same name ending in .json.
        tensors: as MlpPolicy takes them, float32.
        card: `activation` is needed; a later load checks the result of `describe` in it against its task; `steps`,
            `wall_time_s` and all else are information. `version`, `sha256`, `observation_size` and
            `action_size` are filled in.

    Raises:
        ValueError: anything for which MlpPolicy.load raises it; nothing is written then.
    """
    from safetensors.numpy import save

    path = Path(path)
    if path.suffix != ".safetensors":
        raise ValueError(f"policy {printable_path(path)}: the file name must end in .safetensors")
    tensors = {name: np.ascontiguousarray(tensor) for name, tensor in tensors.items()}
    policy = MlpPolicy.of_tensors(tensors, card)
    data = save(tensors)
    derived = {
        "version": CARD_VERSION,
        "sha256": hashlib.sha256(data).hexdigest(),
        "observation_size": policy.observation_size,
        "action_size": policy.action_size,
        **({"networks": policy.learners} if policy.learners else {}),
    }
    for key in derived.keys() & card.keys() - {"sha256"}:
        if card[key] != derived[key]:
            raise ValueError(
                f"policy {printable_path(path)}: card: {key} = {card[key]!r}, the weights say {derived[key]!r}"
            )
    text = json.dumps({**card, **derived}, indent=1, allow_nan=False) + "\n"
    write_all_or_none(path.parent, {
        path.name: lambda part: part.write_bytes(data),
        path.with_suffix(".json").name: lambda part: part.write_bytes(text.encode()),
    })  # fmt: skip


def read_card(path: Path) -> dict[str, Any]:
    """Read a card strictly: no duplicate keys, no NaN, and of the supported version.

    path: of the JSON file beside the weights.
    """
    try:
        text = _read_file(path, LARGEST_CARD)
        card = json.loads(text, object_pairs_hook=_check_unique, parse_constant=_reject_constant)
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise ValueError(f"the card {path.name!r} is not JSON: {error}") from None
    if not isinstance(card, dict):
        raise ValueError(f"the card {path.name!r} holds a {type(card).__name__}, must be an object")
    missing = [key for key in ("version", "sha256", "activation", "observation_size", "action_size") if key not in card]
    if missing:
        raise ValueError(f"the card {path.name!r} lacks {missing[0]!r}")
    if card["version"] != CARD_VERSION:
        raise ValueError(f"the card {path.name!r} has version {card['version']!r}; this flockenv reads {CARD_VERSION}")
    return card


def _read_tensors(path: Path, card: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    data = _read_file(path, LARGEST_WEIGHTS)
    if hashlib.sha256(data).hexdigest() != card["sha256"]:
        raise ValueError(f"the weights ({len(data)} bytes) are not those of the card: their SHA-256 differs")
    try:
        return dict(load(data))
    except (SafetensorError, KeyError) as error:
        raise ValueError(f"not a safetensors file: {error}") from None


def _read_file(path: Path, largest: int) -> bytes:
    try:
        if path.stat().st_size > largest:
            raise ValueError(f"{path.name!r} has {path.stat().st_size} bytes, at most {largest} are read")
        return path.read_bytes()
    except OSError as error:
        raise ValueError(f"{path.name!r} cannot be read: {error.strerror}") from None


def _check_sizes(policy: MlpPolicy) -> None:
    """Raise ValueError if the sizes of the weights differ from those in the card."""
    for key, size in {"observation_size": policy.observation_size, "action_size": policy.action_size}.items():
        if policy.card[key] != size:
            raise ValueError(f"the card says {key} = {policy.card[key]!r}, the weights are for {size}")


def _check_learners(policy: MlpPolicy, task: Task | None) -> None:
    """Raise OtherSlotsError if a policy has a network for each learner, and the task has another number of them."""
    if task is not None and policy.learners is not None and policy.learners != task.learners:
        text = f"has a network for each of {policy.learners} learners, task {task.name!r} has {task.learners}"
        raise OtherSlotsError(text)


def describe(task: Task) -> dict[str, Any]:
    """Return a card's entries on the task that a policy is trained on: name, arguments, and the slots of its rows."""
    return {
        "task": task.name,
        "arguments": task.model_dump(mode="json"),
        "layout": task.layout.digest,
        "observation": _slots(task.layout),
        "action": _slots(task.action_layout),
    }


def _slots(layout: Layout) -> list[dict[str, Any]]:
    return [
        {"name": s.name, "shape": list(s.shape), "scale": float(s.scale), "unit": s.unit, "low": float(s.low)}
        for s in layout.slots
    ]


def _differences(card: Mapping[str, Any], task: Task) -> tuple[str, ...]:
    """Return the differences of a card and a task, a phrase each; raise ValueError if the slots do not match."""
    if "observation" not in card:
        return _differences_of_digest(card, task)
    differences = []
    for kind, layout in (("observation", task.layout), ("action", task.action_layout)):
        for trained, here in zip_longest(_slots_of(card, kind), _slots(layout)):
            if trained is None or here is None or any(trained[key] != here[key] for key in ("name", "shape", "unit")):
                texts = _describe_slot(trained), _describe_slot(here)
                raise OtherSlotsError(f"made for {kind} {texts[0]}, task {task.name!r} has {texts[1]} there")
            differences += [
                f"{kind} {here['name']} has {key} {here[key]:g} {here['unit']}, trained with {trained[key]:g}"
                for key in ("scale", "low")
                if trained[key] != here[key]
            ]
    if card.get("task") != task.name:
        return (f"plays task {task.name!r}, trained on {card.get('task')!r}", *differences)
    now = task.model_dump(mode="json")
    trained_on = card["arguments"] if isinstance(card.get("arguments"), dict) else {}
    defaults = type(task).model_construct().model_dump(mode="json")
    trained = {key: trained_on.get(key, defaults.get(key)) for key in now}  # a card may be older than an argument
    changed = [key for key in now if trained[key] != now[key]]
    return (
        *(f"{key} = {printable(now[key])}, trained with {printable(trained[key])}" for key in changed),
        *differences,
    )


def _differences_of_digest(card: Mapping[str, Any], task: Task) -> tuple[str, ...]:
    """Return the differences of a task and a card that has a digest of its slots instead of a list."""
    sizes = {"observation_size": task.layout.size, "action_size": task.action_layout.size}
    for key, size in sizes.items():
        if card[key] != size:
            raise OtherSlotsError(f"made for {key} = {card[key]}, task {task.name!r} has {size}")
    if card.get("layout") != task.layout.digest:
        digests = f"{card.get('layout')!r}, task {task.name!r} has {task.layout.digest!r}"
        raise OtherSlotsError(f"made for observation layout {digests}, and the card does not list its slots")
    return ("the card does not list the arguments of its task",)


_SLOT_TYPES: Mapping[str, type | tuple[type, ...]] = {
    "name": str, "shape": list, "scale": (int, float), "unit": str, "low": (int, float),
}  # fmt: skip


def _slots_of(card: Mapping[str, Any], kind: str) -> list[dict[str, Any]]:
    """Return the slots that a card lists; ValueError if it lists anything else."""
    slots = card.get(kind)
    if not isinstance(slots, list) or not all(isinstance(slot, dict) for slot in slots):
        raise ValueError(f"the card's {kind!r} is {printable(slots)}, must be a list of slots")
    for slot in slots:
        wrong = next((key for key, kinds in _SLOT_TYPES.items() if not isinstance(slot.get(key), kinds)), None)
        if wrong is not None:
            raise ValueError(f"the card's {kind!r} has a slot whose {wrong!r} is {printable(slot.get(wrong))}")
    return slots


def _describe_slot(slot: Mapping[str, Any] | None) -> str:
    if slot is None:
        return "nothing"
    return f"{printable(slot['name'])} of shape {printable(tuple(slot['shape']))} in {printable(slot['unit'])}"


def _layers(tensors: Mapping[str, NDArray[Any]], is_squashed: bool) -> tuple[list[Layer], Layer]:
    """Check every tensor and return the layers as (in, out) weights and biases: the hidden ones, and the last.

    The last layer of a squashed actor puts out means and logarithms of standard deviations side by side.
    """
    depth = sum(name.startswith("policy.") and name.endswith(".weight") for name in tensors)
    names = [f"policy.{i}" for i in range(depth)] + ["action"]
    deviations = {"log_std.weight", "log_std.bias"} if is_squashed else {"log_std"}
    expected = {f"{name}.{part}" for name in names for part in ("weight", "bias")} | deviations
    if expected != tensors.keys():
        name = sorted(expected ^ tensors.keys())[0]
        raise ValueError(f"tensor {name!r} is {'missing' if name in expected else 'not one of an MLP actor'}")
    for name, tensor in tensors.items():
        if tensor.dtype != np.float32:
            raise ValueError(f"tensor {name!r} is {tensor.dtype}, must be float32")
        if not np.isfinite(tensor).all():
            raise ValueError(f"tensor {name!r} holds NaN or infinity")
    layers: list[Layer] = []
    for name in names:
        weight, bias = tensors[f"{name}.weight"], tensors[f"{name}.bias"]
        inputs = layers[-1][1].shape[0] if layers else weight.shape[-1] if weight.ndim else 0
        _check_shape(f"{name}.weight", weight, (weight.shape[0] if weight.ndim else 0, inputs))
        _check_shape(f"{name}.bias", bias, weight.shape[:1])
        layers.append((np.ascontiguousarray(weight.T), bias))
    *hidden, (weight, bias) = layers
    if not is_squashed:
        _check_shape("log_std", tensors["log_std"], bias.shape)
        return hidden, (weight, bias)
    _check_shape("log_std.weight", tensors["log_std.weight"], weight.shape[::-1])
    _check_shape("log_std.bias", tensors["log_std.bias"], bias.shape)
    both = np.concatenate([weight, tensors["log_std.weight"].T], axis=1)
    return hidden, (np.ascontiguousarray(both), np.concatenate([bias, tensors["log_std.bias"]]))


def _check_shape(name: str, tensor: NDArray[Any], shape: tuple[int, ...]) -> None:
    if tensor.shape != shape or 0 in shape:
        raise ValueError(f"tensor {name!r} has shape {tensor.shape}, the other layers require {shape}")


def _check_known(value: Any, allowed: Mapping[str, Any], what: str) -> str:
    if not isinstance(value, str) or value not in allowed:
        raise ValueError(f"{what}: {value!r}{nearest(str(value)[:200], allowed)}; allowed: {_quote_names(allowed)}")
    return value


def _quote_names(names: Mapping[str, Any]) -> str:
    return ", ".join(map(repr, names)) or "no name"


def _new_generator(seed: int | None) -> tuple[int, np.random.Generator]:
    if seed is None:
        seed = int(np.random.SeedSequence().generate_state(1, np.uint64)[0])
    return seed, np.random.default_rng(seed)


def _check_unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    keys = [key for key, _ in pairs]
    if len(set(keys)) < len(keys):
        raise ValueError(f"the card names {next(k for k in keys if keys.count(k) > 1)!r} twice")
    return dict(pairs)


def _reject_constant(text: str) -> Any:
    raise ValueError(f"the card holds {text}, which is not JSON")
