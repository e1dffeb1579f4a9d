"""Configuration of the site: `python -m sphinx -W -b html docs OUT`, with the packages of the extra `docs`.

Pages about environments, behaviours, effects, methods, constraints, presets, scenes and the API are written into
docs/generated/ by docs/_ext/pages.py when a build begins. Nothing is fetched from a network, neither by the build nor
by its pages.
"""

from __future__ import annotations

import os
import re
import sys
import tomllib
from pathlib import Path

os.environ["NUMBA_DISABLE_JIT"] = "1"  # functions stay functions of Python, whose signatures autodoc reads
ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "_ext")]

_about = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
project = "flockenv"
version = release = _about["version"]
author = "flockenv contributors"
project_copyright = f"2026, {author}"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "pages"]
exclude_patterns = ["_ext", "_build", "**/jobs"]
smartquotes = False  # quotes in prose are often those of code
html_theme = "furo"
html_theme_options = {
    "source_repository": _about["urls"]["Repository"],
    "source_branch": "main",
    "source_directory": "docs/",
}
html_title = f"flockenv {release}"
html_copy_source = False
html_show_sourcelink = False

# the addresses of the project itself are assumed: nothing is published yet
linkcheck_ignore = [re.escape(_about["urls"][name].rstrip("/")) for name in ("Repository", "Documentation")]

myst_heading_anchors = 4  # links to headings, as code hosts have them: players.md#seeds
myst_enable_extensions = ["html_image"]  # <img width=...> in pages

napoleon_numpy_docstring = False  # docstrings have Args: and Raises:
autodoc_default_options = {"members": True, "member-order": "bysource", "show-inheritance": True}
autodoc_typehints = "signature"
python_maximum_signature_line_length = 100
python_use_unqualified_type_names = True
