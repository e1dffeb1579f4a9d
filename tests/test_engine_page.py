"""docs/engine.md: the files and functions that it names exist, and its breakpoint is in a law."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
PAGE = (ROOT / "docs/engine.md").read_text(encoding="utf-8")


def test_files_and_functions_named_by_the_page_exist() -> None:
    named = re.findall(r"`(flockenv/[\w/]+\.py)`(?:, `(\w+)`)?", PAGE)
    assert len(named) > 8
    for path, function in named:
        assert f"def {function}" in (ROOT / path).read_text(encoding="utf-8") if function else (ROOT / path).exists()


def test_the_breakpoint_of_the_page_is_in_a_pair_law() -> None:
    path, line = re.search(r"b (\S+):(\d+)", PAGE).groups()  # type: ignore[union-attr]
    text = (ROOT / path).read_text(encoding="utf-8").splitlines()
    law = next(k for k in range(int(line) - 1, 0, -1) if text[k].startswith("def "))
    assert text[law - 1] == "@law" and "me: Me, other: Other" in text[law]
