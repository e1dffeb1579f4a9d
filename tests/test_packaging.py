"""Distributions: the wheel contains flockenv alone and works without the repository; the sdist is the repository."""

from __future__ import annotations

import email
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email.message import Message
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import Version

from flockenv.tasks import TASKS
from tests.clients.__main__ import CLIENTS

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
README_TEST = (
    "python3 -m venv .venv && .venv/bin/pip install -q -c configs/constraints.txt -e '.[train,test]' "
    "&& .venv/bin/python -m pytest -q"
)

MADE = ("__pycache__", "generated", "_build")
"""Folders that are made, perhaps at this moment: the site may be built beside these tests."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a wheel built from a copy, so that no build/ or egg-info is left in the repository; needs no network."""
    source, target = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "setup.py", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    for name in ("flockenv", "agents", "configs", "docs", "tests"):
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns(*MADE))
    build = f"from setuptools import build_meta; build_meta.build_wheel({str(target)!r})"
    done = subprocess.run([sys.executable, "-c", build], cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (built,) = target.glob("*.whl")
    return built


FOLDERS = (".ci", ".github", "agents", "benchmarks", "configs", "docs", "flockenv", "release", "tests")
FILES = (
    "CODE_OF_CONDUCT.md", "SECURITY.md",
    "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "MANIFEST.in", "README.md", "pyproject.toml",
    "setup.py", ".gitignore", ".pre-commit-config.yaml",
)  # fmt: skip
"""Folders and files of the repository."""


@pytest.fixture(scope="module")
def sdist(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the unpacked source distribution of a copy of the repository."""
    source, target = tmp_path_factory.mktemp("repository"), tmp_path_factory.mktemp("sdist")
    for name in FILES:
        shutil.copy(ROOT / name, source)
    for name in FOLDERS:
        shutil.copytree(ROOT / name, source / name, ignore=shutil.ignore_patterns(*MADE))
    build = f"from setuptools import build_meta; build_meta.build_sdist({str(target)!r})"
    done = subprocess.run([sys.executable, "-c", build], cwd=source, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (built,) = target.glob("*.tar.gz")
    with tarfile.open(built) as archive:
        archive.extractall(target, filter="data")
    return target / built.name.removesuffix(".tar.gz")


@pytest.fixture(scope="module")
def metadata(wheel: Path) -> Message:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return email.message_from_bytes(archive.read(name))


def test_the_wheel_contains_flockenv_alone(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.split("/")[0] for name in names}
    assert tops == {"flockenv", f"flockenv-{PROJECT['version']}.dist-info"}
    sources = {path.relative_to(ROOT).as_posix() for path in (ROOT / "flockenv").rglob("*.py")}
    files = {f"players/weights/{task}.{suffix}" for task in TASKS for suffix in ("json", "md", "safetensors")}
    seeds = (ROOT / "flockenv" / "players" / "weights" / "seeds").glob("*")
    files |= {f"players/weights/seeds/{path.name}" for path in seeds}
    files |= {f"players/tuned/{task}.json" for task in TASKS} | {"py.typed"}
    for folder in ("render/page", "play/pictures"):
        files |= {f"{folder}/{path.name}" for path in (ROOT / "flockenv" / folder).iterdir()}
    files |= {f"scenes/{path.name}" for path in (ROOT / "configs" / "scenes").glob("*.yaml")}
    assert {name for name in names if name.startswith("flockenv/")} == sources | {f"flockenv/{f}" for f in files}
    assert wheel.stat().st_size < 5_000_000
    assert any(name.endswith("licenses/LICENSE") for name in names)


def test_the_sdist_contains_all_files_of_the_repository(sdist: Path) -> None:
    made = {"PKG-INFO", "setup.cfg"}
    files = {path.relative_to(sdist).as_posix() for path in sdist.rglob("*") if path.is_file()}
    kept = {
        path.relative_to(ROOT).as_posix()
        for name in FOLDERS
        for path in (ROOT / name).rglob("*")
        if path.is_file() and {*MADE}.isdisjoint(path.relative_to(ROOT).parts)
    }
    assert {name for name in files - made if ".egg-info/" not in name} == kept | set(FILES)
    assert {"prune docs/generated", "prune docs/_build"} <= set((ROOT / "MANIFEST.in").read_text().splitlines())
    if (ROOT / ".git").exists():
        tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        assert set(tracked.split("\n")) - {""} <= kept | set(FILES)


@pytest.mark.slow
def test_all_tests_of_the_sdist_are_collected_and_two_files_pass(sdist: Path) -> None:
    """Test files import and open nothing that is missing from the sdist; the checkout is not on the path."""

    def tested(*options: str) -> str:
        command = [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *options]
        environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
        done = subprocess.run(command, cwd=sdist, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout[-2000:]
        return done.stdout

    assert "error" not in tested("--collect-only").splitlines()[-1]
    assert " passed" in tested("tests/test_config.py", "tests/test_readme.py")


def test_the_base_dependencies_do_not_include_torch(metadata: Message) -> None:
    needed = metadata.get_all("Requires-Dist") or []
    base = {re.split(r"[\s<>=!~;\[]", line)[0].lower() for line in needed if "extra ==" not in line}
    assert base == {
        *("numpy", "scipy", "numba", "gymnasium", "pettingzoo", "pydantic", "pyyaml", "typer", "rich"),
        *("matplotlib", "pillow", "safetensors", "shapely", "filelock"),
    }
    extras = {"train", "test", "render", "play", "docs", "ray", "rllib", "browser", "video", "parquet", "mesh"} | {
        "measures"
    }
    assert set(metadata.get_all("Provides-Extra") or []) == extras
    assert "gymnasium<2,>=1.2.2" in needed


def test_links_and_pictures_of_the_description_are_absolute(metadata: Message) -> None:
    """On a registry's page there is no repository beside the README."""
    payload, tree = metadata.get_payload(decode=True), f"{PROJECT['urls']['Repository']}/"
    assert isinstance(payload, bytes)
    text = payload.decode("utf-8")
    assert metadata["Description-Content-Type"] == "text/markdown"
    pictures, links = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text), re.findall(r"(?<!!)\[[^\]]*\]\(([^)]+)\)", text)
    version = f"v{PROJECT['version']}"
    assert len(pictures) > 3 and all(each.startswith(f"{tree}raw/{version}/") for each in pictures)
    assert len(links) > 20 and all(each.startswith(("https://", "#")) for each in links)
    assert f"{tree}blob/{version}/docs/play.md" in links and f"{tree}tree/{version}/configs/scenes" in links
    assert re.sub(rf"\({re.escape(tree)}(raw|blob|tree)/{re.escape(version)}/", "(", text).strip() == (
        (ROOT / "README.md").read_text(encoding="utf-8").strip()
    )


def test_the_metadata_has_the_addresses_of_the_project(metadata: Message) -> None:
    urls = dict(line.split(", ") for line in metadata.get_all("Project-URL") or [])
    assert {"Homepage", "Repository", "Documentation", "Issues", "Changelog"} <= urls.keys()
    assert f'repository-code: "{urls["Repository"]}"' in (ROOT / "CITATION.cff").read_text()
    assert urls["Documentation"] == re.sub(r"github\.com/(\w+)/", r"\1.github.io/", urls["Repository"]) + "/"


@pytest.fixture(scope="module")
def site(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the wheel's content, as installed."""
    folder = tmp_path_factory.mktemp("site")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(folder)
    return folder


def run_installed(site: Path, code: str, folder: Path) -> str:
    """Run code in an empty folder with the installed flockenv; return what it prints."""
    env = {**os.environ, "PYTHONPATH": str(site), "PYTHONSAFEPATH": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_scenes_of_the_wheel_are_read_by_name(site: Path, tmp_path: Path) -> None:
    code = (
        "from flockenv.core.bundled import bundled_scenes; from flockenv.scene.yaml_io import load_scene;"
        "from pathlib import Path; import flockenv;"
        "home = Path(flockenv.__file__).parent / 'scenes';"
        "assert all(path.parent == home for path in bundled_scenes().values()), bundled_scenes();"
        "print(*bundled_scenes()); assert load_scene('boids').agents == 300;"
        "from flockenv.cli.main import main; assert main(['run', 'particles', '--duration', '0']) == 0"
    )
    names = run_installed(site, code, tmp_path).splitlines()[0].split()
    assert names == sorted(path.stem for path in (ROOT / "configs" / "scenes").glob("*.yaml"))


def test_the_wheel_works_without_the_checkout(site: Path, tmp_path: Path) -> None:
    """Files that are not Python code are found in it."""
    code = (
        "import flockenv, gymnasium, pettingzoo, importlib.resources as r; from flockenv.cli.main import main;"
        "assert gymnasium.spec('flockenv/Pursuit-v0') and 'flockenv/Flock-v1' in pettingzoo.parallel_registry;"
        "assert '__DATA__' in (r.files('flockenv.render') / 'page' / 'page.html').read_text();"
        "from flockenv.players import load_player; from flockenv.tasks import Pursuit; import numpy as np;"
        "task = Pursuit(); rows = np.zeros((1, task.layout.size), np.float32);"
        "assert all(load_player(name, task).predict(rows)[0].shape == (1, 2) for name in ('rules', 'textbook', 'ppo'));"
        "assert load_player('rules', task).rules != load_player('textbook', task).rules;"
        "assert main(['list']) == 0; print(flockenv.__file__)"
    )
    assert run_installed(site, code, tmp_path).splitlines()[-1].startswith(str(site))


def test_the_version_is_the_same_in_all_files(metadata: Message) -> None:
    import flockenv

    citation = (ROOT / "CITATION.cff").read_text()
    assert metadata["Version"] == PROJECT["version"] == flockenv.__version__
    assert f"\nversion: {flockenv.__version__}\n" in citation
    newest = re.findall(r"^## (.*)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)[0]
    assert "unreleased" in newest.lower() or flockenv.__version__ in newest


def test_ci_runs_the_command_of_the_readme() -> None:
    assert README_TEST in (ROOT / ".ci" / "run").read_text()
    assert README_TEST in (ROOT / "README.md").read_text()


def test_ci_installs_the_packages_of_all_extras_but_ray() -> None:
    """Tests skip without a package, so that one which is never installed is never tested."""
    extras = PROJECT["optional-dependencies"]
    packages = {extra: {Requirement(line).name for line in lines} for extra, lines in extras.items()}
    installed = re.findall(r"-e '\.\[(.*?)\]'", (ROOT / ".ci" / "run").read_text())
    brought = set().union(*(packages[extra] for each in installed for extra in each.split(",")))
    assert {extra for extra, names in packages.items() if not names <= brought} == {"ray", "rllib"}


@pytest.mark.skipif(sys.platform == "win32", reason="the stages of CI need a POSIX shell")
@pytest.mark.parametrize(("extra", "code"), [("docs", 1), ("measures", 1), ("browser", 0)])
def test_ci_fails_if_the_site_or_an_oracle_cannot_be_installed(extra: str, code: int, tmp_path: Path) -> None:
    """Chromium and playwright may be missing: tests of pages then skip with a line."""
    stage = re.search(r"^packages\(\) \{.*?^\}", (ROOT / ".ci" / "run").read_text(), re.DOTALL | re.MULTILINE)
    assert stage
    pip = tmp_path / ".venv" / "bin" / "pip"
    pip.parent.mkdir(parents=True)
    pip.write_text(f'#!/bin/sh\ncase "$*" in *{extra}*) exit 1;; esac\n')
    pip.chmod(0o700)
    done = subprocess.run(["bash", "-c", f"false & chromium=$!\n{stage[0]}\npackages"], cwd=tmp_path, check=False)
    assert done.returncode == code


def test_installed_versions_are_those_of_the_constraints() -> None:
    """Otherwise tests that pass here may fail in a fresh clone."""
    from importlib.metadata import PackageNotFoundError, version

    pins = dict(line.split("==") for line in (ROOT / "configs" / "constraints.txt").read_text().split())
    wrong = {}
    for name, pin in pins.items():
        try:
            if version(name).split("+")[0] != pin:
                wrong[name] = (version(name), pin)
        except PackageNotFoundError:
            continue  # only another extra needs it
    assert not wrong


def test_every_dependency_is_pinned() -> None:
    pins = {line.split("==")[0].lower() for line in (ROOT / "configs" / "constraints.txt").read_text().split()}
    pins = {name.replace("_", "-") for name in pins}
    extras = PROJECT["optional-dependencies"]
    tested = [line for name in ("train", "test", "parquet", "measures") for line in extras[name]]
    wanted = {re.split(r"[<>=]", line)[0].lower() for line in PROJECT["dependencies"] + tested}
    assert wanted - pins == {"pillow"}  # not pinned: other packages often pin it


def bounds() -> dict[str, SpecifierSet]:
    """Return the versions that the package and its extras allow, without tools.

    The extra `rllib` is left out: it needs a later Ray than the extra `ray`, so one file cannot pin both. Its lowest
    Ray is that of configs/constraints-ray.txt, which tests/test_rllib.py installs.
    """
    extras = PROJECT["optional-dependencies"]
    lines = [line for name in extras if name != "rllib" for line in extras[name]] + PROJECT["dependencies"]
    wanted = map(Requirement, lines)
    return {each.name.lower(): each.specifier for each in wanted if each.name not in TOOLS}


TOOLS = ("ruff", "mypy", "types-PyYAML", "setuptools")


def test_the_lowest_versions_are_the_lower_bounds() -> None:
    """.ci/lowest installs them; a bound that is not tried may be wrong."""
    text = (ROOT / "configs" / "constraints-lowest.txt").read_text()
    pins = {name.lower().replace("_", "-"): Version(pin) for name, pin in (line.split("==") for line in text.split())}
    lowest = {
        name: next(Version(each.version) for each in specifier if each.operator == ">=")
        for name, specifier in bounds().items()
    }
    assert {name: pins.get(name) for name in lowest} == lowest
    script = (ROOT / ".ci" / "lowest").read_text()
    assert "configs/constraints-lowest.txt" in script
    installed = {extra for names in re.findall(r"-e '\.\[(.*?)\]'", script) for extra in names.split(",")}
    assert installed == PROJECT["optional-dependencies"].keys() - {"rllib"}
    ray = re.search(r"^ray==(.*)", (ROOT / "configs" / "constraints-ray.txt").read_text(), re.MULTILINE)
    assert ray and f"ray[rllib]>={'.'.join(ray[1].split('.')[:2])},<3" in PROJECT["optional-dependencies"]["rllib"]


def test_the_conda_recipe_needs_what_the_package_needs() -> None:
    recipe = yaml.safe_load((ROOT / "release" / "conda" / "recipe.yaml").read_text())
    lines = (line.split(" ", 1) for line in recipe["requirements"]["run"])
    listed = {name.removesuffix("-base"): versions for name, versions in lines}
    assert listed.pop("python") == ">=${{ python_min }}"
    wanted = {each.name.lower(): each.specifier for each in map(Requirement, PROJECT["dependencies"])}
    assert {name: SpecifierSet(text) for name, text in listed.items()} == wanted
    assert recipe["about"]["documentation"] == PROJECT["urls"]["Documentation"]
    context = recipe["context"]
    assert (context["version"], f">={context['python_min']}") == (PROJECT["version"], PROJECT["requires-python"])


def test_the_workflow_tries_the_pythons_of_the_classifiers_and_both_ends_of_the_versions() -> None:
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())
    marked = [line.rsplit(" ", 1)[1] for line in PROJECT["classifiers"] if re.search(r":: 3\.\d+$", line)]
    assert workflow["jobs"]["newest"]["strategy"]["matrix"]["python"] == marked
    assert workflow["jobs"]["wheel"]["strategy"]["matrix"]["python"] == marked
    ran = [step.get("run", "") for job in workflow["jobs"].values() for step in job["steps"]]
    assert {"bash .ci/lowest", "bash .ci/run", "bash .ci/wheel python"} <= set(ran) and any(
        "sphinx -W" in command for command in ran
    )
    (tests,) = [step["run"] for step in workflow["jobs"]["newest"]["steps"] if "pytest" in step.get("run", "")]
    pins = f"tests/{Path(__file__).name}::{test_installed_versions_are_those_of_the_constraints.__name__}"
    assert tests.endswith(f" --deselect {pins}"), "without constraints the versions are others"
    for path in (ROOT / ".github").rglob("*.yml"):
        assert yaml.safe_load(path.read_text())


def test_the_workflow_plays_every_client_checks_links_and_deploys_the_site_that_it_built() -> None:
    jobs = yaml.safe_load((ROOT / ".github" / "workflows" / "ci.yml").read_text())["jobs"]
    assert jobs["clients"]["strategy"]["matrix"]["client"] == CLIENTS
    assert jobs["clients"]["steps"][-1]["run"] == "python -m tests.clients ${{ matrix.client }} --steps 1000"
    assert "-b linkcheck docs " in jobs["links"]["steps"][-1]["run"]
    *_, built, upload = jobs["docs"]["steps"]
    assert built["run"].endswith(f" {upload['with']['path']}") and "upload-pages-artifact" in upload["uses"]
    pages = jobs["pages"]
    assert pages["needs"] == "docs"
    assert pages["if"] == "github.event_name == 'push' && github.ref == 'refs/heads/main'"
    assert pages["permissions"] == {"pages": "write", "id-token": "write"}
    assert pages["steps"][-1]["uses"].startswith("actions/deploy-pages@")


def test_no_file_is_large_and_neither_are_all_together() -> None:
    """At most 2 MB each and 20 MB in all; without git nothing is tested."""
    done = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True, check=False)
    sizes = {name: (ROOT / name).stat().st_size for name in done.stdout.split("\0") if (ROOT / name).is_file()}
    assert {name: size for name, size in sizes.items() if size > 2_000_000} == {}
    assert sum(sizes.values()) <= 20_000_000


def test_the_top_level_contains_only_allowed_files_and_folders() -> None:
    """Tracked files are tested, so without git nothing is tested."""
    done = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=False)
    tops = {line.split("/")[0] for line in done.stdout.splitlines()}
    allowed = {
        *("pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md", "CITATION.cff", "MANIFEST.in"),
        *("setup.py", "CODE_OF_CONDUCT.md", "SECURITY.md", "release"),
        *("flockenv", "agents", "configs", "tests", "docs", "benchmarks"),
    }
    assert {top for top in tops if not top.startswith(".")} <= allowed
