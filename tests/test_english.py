"""The words of this repository: plain English and the terms of the field, in docstrings, comments, messages, pages."""

from __future__ import annotations

import ast
import io
import re
import tokenize
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = ("flockenv", "agents", "benchmarks", "tests")

BANNED = (
    "who", "whoever", "whom", "whomever", "somebody", "nobody", "everybody", "anybody", "he", "him", "his", "himself",
    "she", "so many", "sooner", "is told", "are told", "was told", "were told", "is asked", "are asked", "is heard",
    "are heard", "is met", "are met", "a whole number", "of whom", "no less than", "wished for",
)  # fmt: skip
WORDS = sorted(BANNED, key=len, reverse=True)
BAN = re.compile(rf"none =|(?<![\w`'.-])(?:{'|'.join(WORDS)})(?![\w`'-])", re.I)
QUOTED = re.compile(r"`[^`]*`|\"\"\"|https?://\S+")
ITSELF = {"tests/test_english.py"}


def prose(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the texts of a file that people read, with the line that each begins in."""
    text = path.read_text(encoding="utf-8")
    if path.suffix != ".py":
        yield from enumerate(text.splitlines(), 1)
        return
    for token in tokenize.generate_tokens(io.StringIO(text).readline) if "#" in text else ():
        if token.type == tokenize.COMMENT:
            yield token.start[0], token.string
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and " " in node.value:
            yield node.lineno, node.value


def banned(path: Path) -> list[str]:
    """Return the banned words of a file, a line each."""
    name = path.relative_to(ROOT).as_posix()
    return [
        f"{name}:{line}: {found.group()!r}"
        for line, text in prose(path)
        for found in BAN.finditer(QUOTED.sub("", text))
    ]


def files() -> Iterator[Path]:
    """Yield every file that the words hold for."""
    for folder in FOLDERS:
        yield from sorted((ROOT / folder).rglob("*.py"))
    for folder, pattern in (("docs", "*.md"), ("configs", "**/*.yaml"), (".", "*.md")):
        yield from sorted(path for path in (ROOT / folder).glob(pattern) if "history" not in path.parts)


def questions(path: Path) -> Iterator[str]:
    """Yield the docstrings that are questions."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef, ast.Module)):
            first = (ast.get_docstring(node) or "").split("\n\n")[0]
            if first.endswith("?"):
                yield f"{path.relative_to(ROOT)}: {first}"


def test_no_text_has_a_banned_word() -> None:
    assert [line for path in files() if path.relative_to(ROOT).as_posix() not in ITSELF for line in banned(path)] == []


def test_docstrings_are_no_questions() -> None:
    assert [line for folder in FOLDERS for path in (ROOT / folder).rglob("*.py") for line in questions(path)] == []


@pytest.mark.parametrize("text", ["whoever is met", "Refuse a whole number", "default: none = all", "He is near"])
def test_a_banned_word_is_found(text: str) -> None:
    assert BAN.search(text)


@pytest.mark.parametrize("text", ["the others", "there", "`whom`", "a whole scene", "me.who"])
def test_other_words_are_not(text: str) -> None:
    assert not BAN.search(QUOTED.sub("", text))
