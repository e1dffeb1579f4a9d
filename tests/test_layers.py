"""The order of imports: a package imports only those below it, and heavy packages stay in a few places."""

from __future__ import annotations

import ast
import functools
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent

LAYERS = (
    "core", "jit", "maths", "steering", "geometry", "model", "physics", "behaviours", "engine", "scene", "render",
    "tasks", "envs", "players", "evaluation", "jobs", "studies", "play", "cli", "agents",
    "tests",
)  # fmt: skip
"""The packages from bottom to top: a module imports its own package and those before it in this list."""

ONLY_IN = {
    "torch": ("flockenv/envs/sb3.py", "agents", "tests"),
    "stable_baselines3": ("flockenv/envs/sb3.py", "agents", "tests"),
    "sb3_contrib": ("agents", "tests"),
    "matplotlib": ("flockenv/render", "flockenv/evaluation", "flockenv/studies", "agents", "tests"),
    "pygame": ("flockenv/render", "tests"),
    "meshio": ("flockenv/scene/mesh_file.py", "tests"),
    "trimesh": ("flockenv/scene/mesh_repair.py", "tests"),
}
"""Libraries that only the given files and folders may import."""

INSIDE_FUNCTIONS = {"matplotlib", "meshio", "pygame", "trimesh"}
"""Packages that only functions import, because loading them is slow."""


class Import(NamedTuple):
    file: str
    line: int
    module: str
    lazy: bool  # inside a function
    typing: bool  # under `if TYPE_CHECKING`


def imports(root: Path) -> Iterator[Import]:
    """Yield every import of flockenv/, agents/ and tests/."""
    for folder in ("flockenv", "agents", "tests"):
        for path in sorted((root / folder).rglob("*.py")):
            yield from _imports_of(path.read_text(), path.relative_to(root).as_posix())


@functools.lru_cache(maxsize=2048)
def _imports_of(text: str, file: str) -> tuple[Import, ...]:
    """Return the imports of one file; cached by its text, because a planted fault changes one file of hundreds."""
    return tuple(_walk(ast.parse(text), file, False, False))


def _walk(node: ast.AST, file: str, lazy: bool, typing: bool) -> Iterator[Import]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.expr):
            continue  # expressions contain no imports
        if isinstance(child, ast.Import):
            yield from (Import(file, child.lineno, alias.name, lazy, typing) for alias in child.names)
        elif isinstance(child, ast.ImportFrom) and child.module:
            names = [f"{child.module}.{alias.name}" for alias in child.names]
            yield from (Import(file, child.lineno, name, lazy, typing) for name in names)
        elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
            yield from _walk(ast.Module(child.body, []), file, lazy, True)
            yield from _walk(ast.Module(child.orelse, []), file, lazy, typing)
        else:
            function = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef))
            yield from _walk(child, file, lazy or function, typing)


def part(module: str) -> str:
    """Return the package of a module or file.

    flockenv.physics.effects.drag -> physics; flockenv/physics/effects/drag.py -> physics; agents.ppo -> agents.
    """
    steps = module.removesuffix(".py").replace("/", ".").split(".")
    return steps[1] if steps[0] == "flockenv" and len(steps) > 1 else steps[0]


def rank(name: str) -> int:
    return LAYERS.index(name) if name in LAYERS else -1


def faults(root: Path) -> list[str]:
    """Return the breaches of the order of imports, one line each."""
    allowed = {"__init__.py", "py.typed", "__pycache__", *LAYERS}
    found = [f"flockenv/{each.name}: is no package of LAYERS" for each in (root / "flockenv").iterdir()
             if each.name not in allowed]  # fmt: skip
    for entry in imports(root):
        found += [f"{entry.file}:{entry.line}: {fault}" for fault in (_upward(entry), _misplaced(entry)) if fault]
    return found + [f"a circle of imports: {' -> '.join(circle)}" for circle in circles(root)]


def _upward(entry: Import) -> str:
    here, there = part(entry.file), part(entry.module)
    if entry.module.split(".")[0] not in ("flockenv", "agents", "tests") or here == "__init__":
        return ""
    if rank(there) < 0:  # the package itself: `from flockenv import Scene`
        return "" if rank(here) >= rank("cli") else f"imports {entry.module} through the package, not from its module"
    return f"{here} imports {there}, which stands above it" if rank(there) > rank(here) else ""


def _misplaced(entry: Import) -> str:
    package = entry.module.split(".")[0]
    if entry.typing or package not in ONLY_IN:
        return ""
    if not entry.file.startswith(ONLY_IN[package]):
        return f"{package} belongs in {' and '.join(ONLY_IN[package])}"
    if package in INSIDE_FUNCTIONS and not entry.lazy and not entry.file.startswith("tests"):
        return f"{package} must be imported inside the function that needs it"
    return ""


def circles(root: Path) -> list[list[str]]:
    """Return a circle among imports, if there is one; imports for types count, imports inside functions do not."""
    modules = {
        path.relative_to(root).with_suffix("").as_posix().replace("/", ".").removesuffix(".__init__")
        for path in (root / "flockenv").rglob("*.py")
    }
    edges: dict[str, set[str]] = {module: set() for module in modules}
    for entry in imports(root):
        here = entry.file.removesuffix(".py").replace("/", ".").removesuffix(".__init__")
        there = entry.module if entry.module in modules else entry.module.rpartition(".")[0]
        if here in modules and there in modules - {here} and not entry.lazy:
            edges[here].add(there)
    while free := {module for module in edges if not edges[module]}:  # a module that imports nothing is in no circle
        edges = {module: targets - free for module, targets in edges.items() if module not in free}
    return [_follow(edges, min(edges))] if edges else []


def _follow(edges: dict[str, set[str]], module: str) -> list[str]:
    path = [module]
    while min(edges[path[-1]]) not in path:
        path.append(min(edges[path[-1]]))
    return [*path[path.index(min(edges[path[-1]])) :], min(edges[path[-1]])]


def test_no_module_imports_upwards_and_heavy_packages_stay_in_place() -> None:
    assert faults(ROOT) == []


@pytest.mark.parametrize(
    ("file", "planted", "fault"),
    [
        ("flockenv/model/state.py", "from flockenv.scene import Scene", "model imports scene, which stands above it"),
        ("flockenv/scene/scene.py", "from agents import tune", "scene imports agents, which stands above it"),
        (
            "flockenv/engine/step.py",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from flockenv.scene import Scene",
            "engine imports scene, which stands above it",
        ),
        ("flockenv/players/policy.py", "import torch.nn", "torch belongs in flockenv/envs/sb3.py and agents"),
        (
            "flockenv/players/policy.py",
            "def f():\n    import torch",
            "torch belongs in flockenv/envs/sb3.py and agents",
        ),
        (
            "flockenv/cli/main.py",
            "from stable_baselines3 import PPO",
            "stable_baselines3 belongs in flockenv/envs/sb3.py",
        ),
        ("flockenv/render/gif.py", "import matplotlib.pyplot", "matplotlib must be imported inside the function"),
        ("flockenv/maths/vectors.py", "import flockenv.jit\nimport flockenv", "imports flockenv through the package"),
        ("flockenv/scene/placement.py", "import flockenv.scene.yaml_io", "a circle of imports: flockenv.scene"),
        ("flockenv/helpers.py", "", "flockenv/helpers.py: is no package of LAYERS"),
    ],
)
def test_a_planted_fault_is_found(tmp_path: Path, file: str, planted: str, fault: str) -> None:
    for folder in ("flockenv", "agents"):
        shutil.copytree(ROOT / folder, tmp_path / folder, ignore=shutil.ignore_patterns("__pycache__", "weights"))
    with (tmp_path / file).open("a") as source:
        source.write(f"\n{planted}\n")
    assert any(fault in line for line in faults(tmp_path)), faults(tmp_path)


@pytest.mark.parametrize(
    "statement",
    [
        "import flockenv",
        "import gymnasium, flockenv; gymnasium.spec('flockenv/Pursuit-v0')",
        "from flockenv.cli.main import main; assert main(['--help']) == 0",
        "from flockenv.cli.main import main; assert main(['run', '--help']) == 0",
    ],
)
def test_importing_the_library_and_its_help_load_no_heavy_package(statement: str) -> None:
    heavy = ["torch", "stable_baselines3", "matplotlib", "numba", "scipy", "shapely", "pygame"]
    code = f"{statement}\nimport sys; print(sorted(set({heavy}) & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_the_library_loads_without_torch() -> None:
    """With torch and stable-baselines3 blocked, every module but sb3.py can be imported."""
    modules = [
        path.relative_to(ROOT).with_suffix("").as_posix().replace("/", ".")
        for path in sorted((ROOT / "flockenv").rglob("*.py"))
        if path.name not in ("__init__.py", "sb3.py")
    ]
    code = (
        "import sys, importlib; sys.modules['torch'] = sys.modules['stable_baselines3'] = None\n"
        f"for name in {modules}: importlib.import_module(name)\nprint('loaded')"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout == "loaded\n", done.stderr


FIRST = """
import os, sys, numba, numpy, pydantic
for name in sys.argv[1:]:
    if (child := os.fork()) == 0:
        sys.stderr = open(os.devnull, "w")
        __import__(name)
        os._exit(0)
    if os.waitpid(child, 0)[1]:
        print(name)
"""


@pytest.mark.slow
def test_every_package_and_its_last_module_can_be_imported_first() -> None:
    folders = [path.parent for path in sorted((ROOT / "flockenv").rglob("__init__.py"))]
    files = [path for folder in folders for path in (folder, max(folder.glob("*.py")))]
    names = sorted({".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__") for path in files})
    run = subprocess.run([sys.executable, "-c", FIRST, *names], cwd=ROOT, text=True, stdout=subprocess.PIPE, check=True)
    assert run.stdout == "", "modules that cannot be imported first"
