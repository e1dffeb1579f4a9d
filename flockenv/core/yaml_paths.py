"""Names of YAML files as every command reads them, and the title of what is in a file."""

from __future__ import annotations

from pathlib import Path

__all__ = ["STANDARD_INPUT", "has_yaml_suffix", "title_of"]

STANDARD_INPUT = "-"
"""The name of a file that stands for standard input."""


def has_yaml_suffix(name: str) -> bool:
    """Return True if a file's name ends in .yaml or .yml, in upper or lower case."""
    return name.lower().endswith((".yaml", ".yml"))


def title_of(file: str) -> str:
    """Return the title of a file's content: its name without folder and suffix."""
    return "standard input" if file == STANDARD_INPUT else Path(file).stem
