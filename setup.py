"""What pyproject.toml cannot express: scenes join the wheel, and the links of the README become absolute in it."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


class BuildWithScenes(build_py):
    """Build the package, with the scenes of configs/scenes as flockenv/scenes."""

    def run(self) -> None:
        """Copy the modules and data, and then the scenes; an editable install reads those of the checkout."""
        super().run()
        if not self.editable_mode:
            folder = Path(self.build_lib) / "flockenv" / "scenes"
            self.mkpath(str(folder))
            for path in sorted((ROOT / "configs" / "scenes").glob("*.yaml")):
                self.copy_file(str(path), str(folder / path.name))


def absolute(text: str) -> str:
    """Return Markdown whose relative links and pictures point to the repository, at the tag of this version."""
    repository, tag = PROJECT["urls"]["Repository"], f"v{PROJECT['version']}"

    def replace(found: re.Match[str]) -> str:
        picture, label, target = found.groups()
        kind = "raw" if picture else "tree" if (ROOT / target).is_dir() else "blob"
        return f"{picture}[{label}]({repository}/{kind}/{tag}/{target})"

    return re.sub(r"(!?)\[([^\]]*)\]\((?!\w+:|#)([^)]+)\)", replace, text)


setup(
    cmdclass={"build_py": BuildWithScenes},
    long_description=absolute((ROOT / "README.md").read_text(encoding="utf-8")),
    long_description_content_type="text/markdown",
)
