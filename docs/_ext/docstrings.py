"""Docstrings as reStructuredText and as Markdown.

A docstring of flockenv is plain text: `names` in backquotes, lists that begin with `* `, examples after `::`, and
formulas, in which `*`, `_` and `|` are themselves. So these are escaped where a markup language would read them as
markup. Records get a table of their fields, with units and bounds.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

from public_api import field_comments
from pydantic import BaseModel

from flockenv.play.controls import Facts, default_of, facts_of, records_in

if TYPE_CHECKING:
    from sphinx.application import Sphinx

__all__ = [
    "field_rows", "first_paragraph", "first_sentence", "markdown", "process", "signature", "skip", "table",
    "without_limits",
]  # fmt: skip

CODE = re.compile(r"(``.+?``|:[\w:]+:`[^`]+`|`[^`]+`)", re.DOTALL)


def markdown(text: str | None) -> str:
    """Return a docstring as Markdown."""
    text = inspect.cleandoc(text or "")
    text = re.sub(r"::$", ":", text, flags=re.MULTILINE)
    text = _outside_code(text, lambda part: re.sub(r"(?<!^)([*_])|^(\*)(?! )", r"\\\1\2", part, flags=re.MULTILINE))
    text = _outside_code(text, lambda part: part.replace("<", "&lt;"))
    return re.sub(r"^([+=#>])", r"\\\1", text, flags=re.MULTILINE)


def without_limits(text: str | None) -> tuple[str, str]:
    """Return a docstring without its paragraph "Limits: ...", and the text of that paragraph; "" if it has none."""
    paragraphs = inspect.cleandoc(text or "").split("\n\n")
    own = [each for each in paragraphs if each.startswith("Limits: ")]
    return "\n\n".join(each for each in paragraphs if each not in own), "".join(own).removeprefix("Limits: ")


def first_sentence(text: str | None) -> str:
    """Return the first sentence of a docstring as Markdown on one line."""
    paragraph = " ".join(inspect.cleandoc(text or "").split("\n\n")[0].split())
    return markdown(re.split(r"(?<=[a-z)\]`]\.)\s", paragraph)[0])


def first_paragraph(text: str) -> str:
    """Return the first paragraph of a docstring as reStructuredText on one line."""
    return " ".join(_rst(text.split("\n\n")[0].splitlines())).strip()


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def field_rows(model: type[BaseModel]) -> Iterator[tuple[str, str, str, str, str]]:
    """Yield name, unit, allowed values, default and meaning of each field of a record, without its kind."""
    for name, field in model.model_fields.items():
        if name == "kind":
            continue
        facts = facts_of(model, name)
        allowed = _allowed(facts) or _few([record.__name__ for record in records_in(field.annotation)])
        yield name, facts.unit, allowed, _default(model, name), facts.about


def _few(names: Sequence[str]) -> str:
    return ", ".join(names) if len(names) <= 6 else f"{', '.join(names[:4])}, ... ({len(names)} kinds)"


def _allowed(facts: Facts) -> str:
    """Return the values that a field may have: its choices or its bounds."""
    if facts.choices:
        return ", ".join(map(str, facts.choices))
    low = "" if facts.low is None else f"{'>' if facts.above else '>='} {facts.low:g}"
    high = "" if facts.high is None else f"<= {facts.high:g}"
    return f"{low}, {high}".strip(", ")


def _default(model: type[BaseModel], name: str) -> str:
    value = default_of(model, name)
    if value is ...:
        return "required" if model.model_fields[name].is_required() else "depends on others"
    return f"{value:g}" if isinstance(value, float) else "none" if value is None else str(value)


def process(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Turn a docstring into reStructuredText, and append the fields of a record, or those of a class with comments."""
    lines[:] = _rst(lines)
    if isinstance(thing, type) and issubclass(thing, BaseModel):
        lines += ["", *_rst_table(("field", "unit", "values", "default", "meaning"), field_rows(thing))]
    elif isinstance(thing, type):
        lines += ["", *_rst_table(("field", "meaning"), field_comments(thing).items())]


def skip(app: Sphinx, what: str, name: str, thing: Any, skipped: bool, options: Any) -> bool | None:
    """Leave out the numbered fields of named tuples, whose texts are Python's, and pydantic's settings of records."""
    text = getattr(thing, "__doc__", None) or ""
    return True if text.startswith("Alias for field number") or name.startswith("model_") else None


def signature(app: Sphinx, what: str, name: str, thing: Any, *rest: Any) -> tuple[str, str] | None:
    """Leave out the parameters of a record, which its table of fields has."""
    return ("(...)", "") if isinstance(thing, type) and issubclass(thing, BaseModel) else None


def _rst_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> Iterator[str]:
    """Yield a table of reStructuredText; nothing without rows."""
    rows = list(rows)
    if not rows:
        return
    yield from (".. list-table::", "   :header-rows: 1", "   :class: fields", "")
    for row in (head, *rows):
        for k, cell in enumerate(row):
            yield f"   {'* -' if k == 0 else '  -'} {_outside_code(cell, _escape_rst) or '..'}"
    yield ""


def _rst(lines: Sequence[str]) -> list[str]:
    """Return the lines of a docstring with what is no markup escaped; examples after `::` stay as they are."""
    found: list[str] = []
    for block, literal in _blocks(lines):
        if literal:
            found += block
        else:
            text = CODE.sub(
                lambda match: match[0] if match[0][0] == ":" else f"``{match[0].strip('`')}``", "\n".join(block)
            )
            found += _outside_code(text, _escape_rst).split("\n")
    return found


def _blocks(lines: Sequence[str]) -> Iterator[tuple[list[str], bool]]:
    """Yield runs of lines, and whether they are an example: indented lines after one that ends with `::`."""
    block: list[str] = []
    inside: int | None = None
    for line in lines:
        indent = len(line) - len(line.lstrip())
        if inside is not None and line.strip() and indent <= inside:
            yield block, True
            block, inside = [], None
        block.append(line)
        if inside is None and line.endswith("::"):
            yield block, False
            block, inside = [], indent
    yield block, inside is not None


def _outside_code(text: str, change: Callable[[str], str]) -> str:
    """Return a text with the parts outside of backquotes changed."""
    return "".join(part if k % 2 else change(part) for k, part in enumerate(CODE.split(text)))


def _escape_rst(part: str) -> str:
    return re.sub(r"(\\|(?<!^)(?<!^ )\*|^\*(?! )|[|`]|_(?=\W|$))", r"\\\1", part, flags=re.MULTILINE)
