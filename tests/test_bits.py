"""Results stay the same to the last bit: every shipped scene and task against stored hashes, on one and two threads.

Every fifth call uses two threads, so one run shows any difference between them. More calls would only take longer: two
threads wait for each other while other tests run beside them.

After an intended change, `python -m tests.test_bits` stores the hashes again; the commit explains what changed and why.
Hashes hold for the processor's instructions that they were made with; on other processors the tests are skipped.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest

from flockenv.envs.world import World
from flockenv.jit import cpu
from flockenv.jit.thread_pool import threads, use_threads
from flockenv.model.divergence import SimulationDiverged
from flockenv.scene.yaml_io import ConfigError, load_scene
from flockenv.tasks import TASKS

pytestmark = pytest.mark.filterwarnings("ignore")  # warnings of scenes are not tested here
ROOT = Path(__file__).resolve().parent.parent
STORED = Path(__file__).with_name("bits.json")
STEPS = 2000
"""Steps of a scene."""
WORLDS, DECISIONS = 64, 500


def scene_files() -> Iterator[str]:
    """Yield every shipped scene, by its path from the root."""
    for path in sorted((ROOT / "configs").rglob("*.yaml")):
        try:
            load_scene(path)
        except ConfigError:
            continue  # a config of training or of an experiment
        yield path.relative_to(ROOT).as_posix()


def of_scene(name: str, most: int = 2) -> str:
    """Return the hash of a scene's last state, on 1 and `most` threads; if it diverges, of that before the 50 steps."""
    scene = load_scene(ROOT / name)
    state = scene.start(0)
    with contextlib.suppress(SimulationDiverged):
        for k in range(STEPS // 50):
            use_threads(most if k % 5 == 4 else 1)
            state = scene.run(state, 50)
    return digest(state.x, state.v, state.alive, state.tick)


def of_task(name: str, most: int = 2) -> str:
    """Return the hash of all observations and rewards of a task under random actions, and of its last state."""
    world = World(TASKS[name](), WORLDS)
    rng, found = np.random.default_rng(0), hashlib.sha256()
    begin = np.ones(WORLDS, bool)
    for k in range(DECISIONS):
        use_threads(most if k % 5 == 4 else 1)
        if begin.any():
            found.update(world.reset(k, mask=begin).tobytes())
        step = world.step(rng.uniform(-1, 1, (WORLDS, world.learners, world.action_size)))
        found.update(digest(step.observation, step.reward).encode())
        begin = step.ended
    return digest(np.frombuffer(found.digest(), np.uint8), world.state.x, world.state.v)


def digest(*arrays: Any) -> str:
    """Return a hash of arrays, 16 hexadecimal digits."""
    return hashlib.sha256(b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()[:16]


def machine() -> str:
    """Return what bits depend on besides the code: the processor's instructions and numba's version."""
    return f"{digest(np.array(sorted(cpu.FEATURES)))}, numba {numba.__version__}"


def stored() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(STORED.read_text())
    return found


@pytest.fixture(autouse=True)
def one_thread_afterwards() -> Iterator[None]:
    before = threads()
    yield
    use_threads(before)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(stored()["bits"]))
def test_bits_equal_the_stored_ones(name: str) -> None:
    if machine() != stored()["machine"]:
        pytest.skip(f"stored on {stored()['machine']}, this is {machine()}")
    found = of_task(name) if name in TASKS else of_scene(name)
    assert found == stored()["bits"][name], "if intended: python -m tests.test_bits"


def test_every_shipped_scene_and_task_is_stored() -> None:
    assert set(stored()["bits"]) == {*scene_files(), *TASKS}


def write() -> None:
    """Compute and store all hashes, on one thread."""
    bits = {}
    for name in [*scene_files(), *TASKS]:
        bits[name] = of_task(name, 1) if name in TASKS else of_scene(name, 1)
        sys.stdout.write(f"{name} {bits[name]}\n")
    STORED.write_text(json.dumps({"machine": machine(), "bits": bits}, indent=1) + "\n")


if __name__ == "__main__":
    write()
