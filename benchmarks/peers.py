"""Other packages and flockenv, turn by turn: `python -m benchmarks.peers`.

Pairs have the same number of agents, but for those "against many worlds".

Every package lives in a virtual environment of its own below ~/.cache/flockenv-peers, made when asked for
(`--install vmas,mesa`, or `--install all`: about 5 GB), and is run by a script of benchmarks/peers_scripts in a process
of its own; so is flockenv. The two processes of a pair live side by side and work in turns, never at the same time.

No other package computes exactly what flockenv computes. What each side does is said beside its rate; read it before
the ratio.
"""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from time import monotonic
from typing import IO, Annotated, Any

import typer

from benchmarks.floors import Machine, Work, machine
from benchmarks.measure import ROOT, Bench, Contestant, Numbers, Out, Quick, Rounds, Sample, command_line, number

__all__ = ["PAIRS", "PEERS", "PeerError", "Turns", "install", "start_script"]

SCRIPTS = Path(__file__).resolve().parent / "peers_scripts"
CACHE = Path("~/.cache/flockenv-peers")
DONE = "installed.json"  # in a virtual environment that is complete
PATIENCE = 300.0  # s, for a script to compile and answer
PIP_PATIENCE = 1800.0  # s
SAMPLE, QUICK_SAMPLE = 0.2, 0.1  # s; longer than in-process, a step of some peers takes that long
HEARD = 0.9  # of a core: below, something else was running

PEERS: Mapping[str, tuple[str, ...]] = {
    "vmas": ("torch==2.13.0", "vmas==1.5.2"),  # this torch: any other may bring gigabytes of CUDA
    "jaxmarl": ("jaxmarl==0.2.0", "jax==0.10.2", "jaxlib==0.10.2"),
    "mpe2": ("mpe2==1.1.1", "pettingzoo==1.27.0"),
    "sisl": ("pettingzoo[sisl]==1.27.0",),
    "mesa": ("mesa==3.3.1", "networkx>=3"),  # mesa.examples imports networkx, and does not say so
    "jupedsim": ("jupedsim==1.4.2",),
    "pysocialforce": ("pysocialforce==1.1.2",),
}
"""What is installed for each peer; newer ones may well be faster or slower: change the number and say so."""


@dataclass(frozen=True)
class Pair:
    """A peer's case and ours."""

    peer: str
    case: str
    ours: str


PAIRS = (
    Pair("vmas", "flocking_4", "flock_4"),
    Pair("vmas", "flocking_32", "flock_32"),
    Pair("vmas", "tag", "pursuit"),
    Pair("jaxmarl", "spread_3", "flock_3"),
    Pair("jaxmarl", "spread_32", "flock_32"),
    Pair("jaxmarl", "tag", "pursuit"),
    Pair("mpe2", "spread", "parallel_flock"),
    Pair("mpe2", "tag", "parallel_tag"),
    Pair("sisl", "pursuit", "parallel_pursuit"),
    Pair("mesa", "boids_100", "boids_100"),
    Pair("mesa", "boids_300", "boids_300"),
    Pair("jupedsim", "crowd", "crowd_1000"),
    Pair("pysocialforce", "crowd_100", "crowd_100"),
    Pair("pysocialforce", "crowd_500", "crowd_500"),
    *(
        Pair(peer, case, "flock_vector")
        for peer, case in (
            ("vmas", "flocking_4"),
            ("vmas", "flocking_32"),
            ("mpe2", "spread"),
            ("mesa", "boids_100"),
            ("sisl", "pursuit"),
        )
    ),
)
"""The last compare flockenv in many worlds with others as they come."""


class PeerError(Exception):
    """One line: a peer that cannot be installed, or a script that fails."""


# --- a process that works in turns ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Turns(Contestant):
    """A script that takes a sample at each request."""

    script: subprocess.Popen[str] | None = None
    seconds: float = SAMPLE

    def warm(self, seconds: float) -> int:
        """Take a sample that is not kept; a call is one sample, however many steps it takes."""
        self.sample(1)
        return 1

    def sample(self, calls: int) -> Sample:
        """Let it run for about `seconds` s, and wait for its answer."""
        assert self.script is not None and self.script.stdin is not None
        try:
            self.script.stdin.write(f"{self.seconds}\n")
            self.script.stdin.flush()
        except OSError:
            raise PeerError(f"{self.name}: the script has ended") from None
        answer = _answer(self.name, self.script)
        return Sample(answer["agent_steps"], answer["seconds"], answer["cpu_seconds"])


@contextmanager
def start_script(
    name: str, python: Path, script: str, case: str, threads: int, seconds: float,
    variables: Mapping[str, str] | None = None, most: Machine | None = None,
) -> Iterator[Turns]:  # fmt: skip
    """Start a script and wait until it is ready; stop it in the end. Raises PeerError in one line if it fails.

    variables: of its environment, beside those that every script has.
    most: what the machine does at most: then what a script says of its work becomes its floor.
    """
    command = [str(python), str(SCRIPTS / script), case, "--threads", str(threads), "--turns"]
    with tempfile.TemporaryDirectory() as folder, Path(folder, "stderr").open("w+", encoding="utf-8") as errors:
        try:
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=errors, text=True,
                env=_environment(threads) | dict(variables or {}),
                cwd=folder,  # PySocialForce writes a log where it is run
                start_new_session=True,  # Ctrl-C is for us alone: we end it, when this sample is thrown away
            )  # fmt: skip
        except OSError as error:
            raise PeerError(f"{name}: cannot be started: {error}") from None
        try:
            about = _answer(name, process)
            versions = ", ".join(f"{package} {version}" for package, version in about["versions"].items())
            floor = most.floor(Work(**about["work"]), threads) if most and about["work"] else None
            yield Turns(name, lambda: None, 0, floor, f"{about['does']} [{versions}]", process, seconds)
        except PeerError as error:
            raise PeerError(f"{error}{_last_line(errors)}") from None
        finally:
            process.kill()
            process.communicate()


def _environment(threads: int) -> dict[str, str]:
    """Return the environment of a script: this checkout for flockenv's own, and no more threads than allowed."""
    pools = {f"{name}_NUM_THREADS": str(threads) for name in ("OMP", "MKL", "OPENBLAS", "NUMBA")}
    # a JaxMARL dependency asks for a GPU otherwise; no pygame greeting among the JSON
    return {**os.environ, **pools, "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu", "PYGAME_HIDE_SUPPORT_PROMPT": "1"}


def _answer(name: str, process: subprocess.Popen[str]) -> Numbers:
    """Return the next line that is JSON; packages may print what they like before it."""
    assert process.stdout is not None
    until = monotonic() + PATIENCE
    with selectors.DefaultSelector() as waiting:
        waiting.register(process.stdout, selectors.EVENT_READ)
        while (left := until - monotonic()) > 0:
            if not waiting.select(left):
                continue
            line = process.stdout.readline()
            if not line:
                raise PeerError(f"{name}: the script ended")
            if line.startswith("{"):
                answer: Numbers = json.loads(line)
                return answer
    raise PeerError(f"{name}: no answer within {PATIENCE:g} s")


def _last_line(errors: IO[str]) -> str:
    """Return what a script said last on stderr."""
    errors.seek(0)
    lines = errors.read().strip().splitlines()
    return f": {lines[-1].strip()[:200]}" if lines else ""


# --- virtual environments -------------------------------------------------------------------------------------------


def python_of(folder: Path) -> Path:
    """Return the Python of a virtual environment."""
    return folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")


def install(peer: str, cache: Path) -> None:
    """Make a peer's virtual environment, or complete one that was begun. Raises PeerError in one line."""
    folder = cache / peer
    folder.mkdir(parents=True, exist_ok=True)
    python = python_of(folder)
    if not python.exists():
        _run(peer, [sys.executable, "-m", "venv", str(folder)])
    _run(peer, [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *PEERS[peer]])
    (folder / DONE).write_text(json.dumps(PEERS[peer]) + "\n", encoding="utf-8")


def _run(peer: str, command: Sequence[str]) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PIP_PATIENCE)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise PeerError(f"{peer}: cannot be installed here: {error}") from None
    if done.returncode:
        lines = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        wrong = [line for line in lines if "ERROR" in line] or lines or ["no word of why"]
        raise PeerError(f"{peer}: cannot be installed here: {wrong[-1].strip()[:200]}")


# --- the benchmark --------------------------------------------------------------------------------------------------


def main(
    peers: Annotated[str, typer.Option(help=f"Packages to run: {', '.join(PEERS)}. [those installed]")] = "",
    to_install: Annotated[str, typer.Option("--install", help="Packages to install first, or `all`.")] = "",
    cache: Annotated[Path, typer.Option(help="Folder of the virtual environments.")] = CACHE,
    threads: Annotated[int, typer.Option(min=1, help="Cores for each side.")] = 1,
    quick: Quick = False,
    rounds: Rounds = None,
    out: Out = None,
) -> None:
    """Measure other packages beside flockenv, each pair in turns: ratios, and what each side does, in words."""
    wanted = _choose_peers("--install", to_install)
    chosen = _choose_peers("--peers", peers) or (wanted or list(PEERS))
    cache = cache.expanduser()
    with Bench("peers", quick, rounds, out) as bench:
        bench.extra["threads"] = threads
        most = machine(bench, threads)
        for peer in wanted:
            typer.echo(f"installing {peer}: {', '.join(PEERS[peer])}", err=True)
            _try_or_note(bench, lambda peer=peer: install(peer, cache))
        present = [peer for peer in chosen if (cache / peer / DONE).is_file() and python_of(cache / peer).exists()]
        missing = [peer for peer in chosen if peer not in present]
        for pair in (pair for pair in PAIRS if pair.peer in present):
            _try_or_note(bench, lambda pair=pair: _race(bench, pair, cache, threads, most))
        if missing:
            bench.note(f"not installed: {', '.join(missing)} (--install {','.join(missing)})")
        _note_remarks(bench, threads)


def _choose_peers(option: str, text: str) -> list[str]:
    """Return the peers that an option names; an unknown one is a usage error."""
    names = list(PEERS) if text == "all" else [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in PEERS:
            raise typer.BadParameter(f"{option} {name[:50]!r}: unknown; allowed: {', '.join(PEERS)}")
    return list(dict.fromkeys(names))


def _try_or_note(bench: Bench, work: Any) -> None:
    """Call `work`; if a peer fails in it, add a note and go on."""
    try:
        work()
    except PeerError as error:
        bench.note(str(error))


def _race(bench: Bench, pair: Pair, cache: Path, threads: int, most: Machine | None) -> None:
    """Measure one pair; ratios are flockenv's rate over the peer's."""
    title = f"{pair.peer} {pair.case}" + " (against many worlds)" * (pair.ours == "flock_vector")
    script = f"run_{pair.peer}.py"
    seconds = QUICK_SAMPLE if bench.quick else SAMPLE
    typer.echo(f"starting {title}", err=True)
    with (
        start_script(pair.peer, python_of(cache / pair.peer), script, pair.case, threads, seconds) as theirs,
        start_script("flockenv", Path(sys.executable), "run_ours.py", pair.ours, threads, seconds, None, most) as ours,
    ):
        bench.race(title, [theirs, ours], baseline=pair.peer)


def _note_remarks(bench: Bench, threads: int) -> None:
    """Add what a reader should know: how the sides were kept apart, disturbances, and all ratios in one line."""
    if not bench.results:
        return
    cores = "1 core" if threads == 1 else f"{threads} cores"
    bench.note(
        f"Each side is a process of its own on {cores}; they work in turns. Substeps are not counted, and scripted "
        "agents only where a row says so. Actions are drawn before; ours and the PettingZoo peers' episodes have 300 "
        "steps and their resets are timed, JaxMARL resets inside its step (every 25), VMAS is never reset."
    )
    disturbed = sorted({r.race for r in bench.results if r.cores is not None and r.cores < HEARD})
    if disturbed:
        bench.note(f"Something else was running (less than {HEARD:.0%} of a core was had): {', '.join(disturbed)}.")
    ratios = [
        f"{title} {number(ours.ratio)}"
        for title, group in groupby(bench.results, key=lambda r: r.race)
        for ours in group
        if ours.name == "flockenv" and ours.ratio is not None
    ]
    if ratios:
        bench.note(f"flockenv's rate over the peer's: {'; '.join(ratios)}.")


if __name__ == "__main__":
    command_line(main)()
