"""What the scripts share: which environments, how many steps, and how a row of the log is printed."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version

IDS = ("flockenv/Pursuit-v0", "flockenv/Crossing-v0", "flockenv/Bottleneck-v0")
STEPS = int(sys.argv[1]) if len(sys.argv) > 1 else 10_000


@contextmanager
def row(package: str, what: str, env: str, lines: int = 0) -> Iterator[dict[str, int]]:
    """Print what was played in this block: `steps` of what it yields, or STEPS; an error ends the script.

    lines: those that an environment of the client's own examples would not need, beside `import flockenv`.
    """
    began, played = time.perf_counter(), {"steps": STEPS}
    yield played
    client = f"{package} {version(package)}"
    name = env.removeprefix("flockenv:").removeprefix("flockenv/")
    seconds = round(time.perf_counter() - began, 1)
    told = {"client": client, "what": what, "env": name, "lines": lines, **played, "seconds": seconds}
    print(json.dumps(told), flush=True)
