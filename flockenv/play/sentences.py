"""Sentences: a scene in words, in which every value is a control, and the scene that such words describe.

sentences_of(scene)[4].text  # "Keep away from neighbours within 2 m, weight 1.5 N m."
read_words("Linear drag, rate 0.5 kg/s.", EFFECTS.values())  # {"kind": "drag", "rate": 0.5}

The words are those of the records. A sentence begins with the first clause of a record's docstring, in which `field` in
backticks is replaced by its value, or with its `sentence`, if it has one; names, units and values of all other fields
that differ from their defaults follow, after commas. So a new kind of effect has its sentence without further code, and
words are read back by the same rules. A value that is a record is a sentence in parentheses.
"""

from __future__ import annotations

import functools
import json
import math
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from flockenv.core.errors import KeyPath, key_path, nearest, parse_key_path, printable
from flockenv.physics.effects.effect import EFFECTS
from flockenv.play.controls import default_of, facts_of, records_in
from flockenv.scene import Scene
from flockenv.scene.yaml_io import load

__all__ = ["Part", "Sentence", "read_words", "scene_of", "sentences_of", "words_of"]

MOST_TEXT = 200_000
"""Characters of words that are read."""

LONGEST_HEAD = 110
"""Characters of a clause with a colon in it; a longer one ends there."""

FORMULA = re.compile(r", of magnitude W|[:,;] (?:S is|[A-Za-z]\w*'?(?:\^\d)? = |m dv = |dH/dt)")
NUMBER = re.compile(r"-?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?")
WORD = re.compile(r"[A-Za-z_#][\w.#/-]*")


@dataclass(frozen=True)
class Part:
    """Some text of a sentence, or a value in it."""

    text: str
    path: str | None = None  # of the value, in the scene; None: plain text
    unit: str = ""


@dataclass(frozen=True)
class Sentence:
    """What is said about one record of a scene."""

    path: str  # of the record: "" for the scene itself
    parts: tuple[Part, ...]
    removable: bool  # True if it is an item of a list, which an edit may remove

    @property
    def text(self) -> str:
        """The sentence as plain text."""
        return _text(self.parts)


def _text(parts: Iterable[Part]) -> str:
    return "".join(part.text + (f" {part.unit}" if part.unit else "") for part in parts)


# --- from a record to words -------------------------------------------------------------------------------------------


@functools.cache
def _template(model: type[BaseModel]) -> str:
    """Return the beginning of the sentences of a kind of record, with {field} for values and [...] for options."""
    given: str = getattr(model, "sentence", "")
    if given:
        return given
    text = " ".join((model.__doc__ or "").split("\n\n")[0].split())
    text = text.replace("[", "(").replace("]", ")").replace("{", "").replace("}", "")
    while (shorter := re.sub(r" ?\([^()]*\)", "", text)) != text:
        text = shorter
    text = FORMULA.split(text)[0]
    text = re.split(r"\.(?: |$)|;", text)[0]
    if len(text) > LONGEST_HEAD:
        text = text.split(":")[0]
    text = _once(re.sub(r"`(\w+)`", lambda found: _placeholder(model, found[1]), text))
    text = re.sub(r"\} (?:seconds|m|s|degrees)\b", "}", text)  # the value has its unit
    kind = model.model_fields["kind"].default if "kind" in model.model_fields else model.__name__
    return text or str(kind).replace("_", " ").capitalize()


def _placeholder(model: type[BaseModel], name: str) -> str:
    """Return the place of a field's value in a template; its name if it may have no value."""
    if name not in model.model_fields or default_of(model, name) is None:
        return name.replace("_", " ")
    return f"{{{name}}}"


def _once(text: str) -> str:
    """Return a template in which every field has its value once; further places name it."""
    seen: set[str] = set()

    def place(found: re.Match[str]) -> str:
        name = found[1]
        if name in seen:
            return f"the {name.replace('_', ' ')}"
        seen.add(name)
        return found[0]

    return re.sub(r"\{(\w+)\}", place, text).strip()


def words_of(record: BaseModel, above: KeyPath = (), but: Sequence[str] = ()) -> tuple[Part, ...]:
    """Return the words about a record without a full stop; above: its path; but: fields that are left out."""
    model = type(record)
    said: set[str] = {"kind", *but}
    parts = list(_head(record, above, said))
    for name in model.model_fields:
        if name in said or getattr(record, name) == default_of(model, name):
            continue
        parts.append(Part(", "))
        parts += _named(record, name, (*above, name))
    return tuple(parts)


def _head(record: BaseModel, above: KeyPath, said: set[str]) -> Iterator[Part]:
    """Yield the parts of a record's template; add the fields with values in it to `said`."""
    template, model = _template(type(record)), type(record)
    for option in re.split(r"(\[[^\]]*\])", template):
        inner = option[1:-1] if option.startswith("[") else option
        names = re.findall(r"\{(\w+)\}", inner)
        if option.startswith("[") and all(getattr(record, name) == default_of(model, name) for name in names):
            continue
        for k, piece in enumerate(re.split(r"\{(\w+)\}", inner)):
            if k % 2:
                yield from _value(getattr(record, piece), model, piece, (*above, piece))
            elif piece:
                yield Part(piece)
        said.update(names)


def _named(record: BaseModel, name: str, path: KeyPath) -> Iterator[Part]:
    """Yield the title and the value of a field."""
    facts, value = facts_of(type(record), name), getattr(record, name)
    if value is True and (phrase := _phrase(type(record), name)):
        yield Part(phrase, key_path(path))
        return
    yield Part(facts.title + " ")
    yield from _value(value, type(record), name, path)


@functools.cache
def _phrase(model: type[BaseModel], name: str) -> str:
    """Return what holds if a switch is on: its description behind "True if" or "True:", "" without one."""
    found = re.match(r"True(?: if|:) ([^;,(]*)", facts_of(model, name).about)
    return found[1].strip() if found else ""


def _value(value: Any, model: type[BaseModel], name: str, path: KeyPath) -> Iterator[Part]:
    """Yield a value: a number with its unit, a word, a list or a record in parentheses."""
    unit = facts_of(model, name).unit
    if isinstance(value, BaseModel):
        yield Part("(")
        yield from words_of(value, path)
        yield Part(")")
    elif isinstance(value, tuple):
        yield from _list(value, path)
        if unit:
            yield Part(f" {unit}")
    elif isinstance(value, bool):
        yield Part("yes" if value else "no", key_path(path))
    else:
        yield Part(_scalar(value), key_path(path), unit if isinstance(value, (int, float)) else "")


def _list(value: tuple[Any, ...], path: KeyPath) -> Iterator[Part]:
    """Yield the items of a list, with commas, in parentheses."""
    yield Part("(")
    for k, item in enumerate(value):
        if k:
            yield Part(", ")
        if isinstance(item, BaseModel):
            yield Part("(")
            yield from words_of(item, (*path, k))
            yield Part(")")
        elif isinstance(item, tuple):
            yield from _list(item, (*path, k))
        else:
            yield Part(_scalar(item), key_path((*path, k)))
    yield Part(")")


def _scalar(value: Any) -> str:
    """Return a number or a word as text that reads back as itself."""
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ValueError(f"{value}: only finite numbers can be put in words")
        return str(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
    text = str(value)
    plain = WORD.fullmatch(text) is not None and text not in ("none", "yes", "no")
    return text if plain else json.dumps(text)


def sentences_of(scene: Scene) -> list[Sentence]:
    """Return what is said about a scene: its clock, space, groups, effects one by one, obstacles, and the rest.

    A `Steer` has a sentence about itself, and one for each of its behaviours.
    """
    lists = ("groups", "effects", "obstacles", "constraints", "population")
    found = [_sentence(scene, (), ("space", "integrator", *lists))]
    found += [_sentence(scene.space, ("space",)), _sentence(scene.integrator, ("integrator",))]
    for name in lists:
        for k, item in enumerate(getattr(scene, name)):
            has_parts = "behaviours" if getattr(item, "components", ()) else ""
            found.append(_sentence(item, (name, k), (has_parts,), True))
            if has_parts:
                parts = enumerate(item.behaviours)
                found += [_sentence(each, (name, k, has_parts, j), (), True) for j, each in parts]
    return found


def _sentence(record: BaseModel, path: KeyPath, but: Sequence[str] = (), removable: bool = False) -> Sentence:
    return Sentence(key_path(path), (*words_of(record, path, but), Part(".")), removable)


# --- from words to a record -------------------------------------------------------------------------------------------


def read_words(text: str, models: Iterable[type[BaseModel]] = ()) -> dict[str, Any]:
    """Return the fields of the record that a sentence describes, as JSON; models: its possible kinds (all effects).

    Raises ValueError, in one line, for words that no kind begins with, or that name no field.
    """
    if len(text) > MOST_TEXT:
        raise ValueError(f"words: {len(text):,} characters; at most {MOST_TEXT:,} are read")
    reader = _Reader(" ".join(text.split()).removesuffix("."))
    data = reader.record(tuple(models) or tuple(EFFECTS.values()))
    reader.end()
    return data


def scene_of(sentences: Iterable[tuple[str, str]]) -> Scene:
    """Return the scene that sentences describe: the path and the text of each, in the order of `sentences_of`.

    Raises ValueError, in one line, for words that cannot be read, and for scenes that cannot be.
    """
    data: dict[str, Any] = {}
    for path, text in sentences:
        steps = parse_key_path(path)
        read = read_words(text, _models_at(steps))
        if not steps:
            data |= read
        elif len(steps) == 1:
            data[str(steps[0])] = read
        elif len(steps) == 2:
            data.setdefault(str(steps[0]), []).append(read)
        else:
            data[str(steps[0])][-1].setdefault(str(steps[2]), []).append(read)
    return load(json.dumps(data), Scene)


def _models_at(steps: KeyPath) -> tuple[type[BaseModel], ...]:
    """Return the kinds of record that may stand at a path of a scene."""
    models: tuple[type[BaseModel], ...] = (Scene,)
    for step in steps:
        if isinstance(step, str):
            fields = [model.model_fields[step] for model in models if step in model.model_fields]
            models = tuple(dict.fromkeys(each for field in fields for each in records_in(field.annotation)))
    if not models:
        raise ValueError(f"path = {printable(key_path(steps))}: no record can stand there")
    return models


class _Reader:
    """Reads a text from left to right, as `words_of` writes it."""

    def __init__(self, text: str) -> None:
        self._text, self._at = text, 0

    def _rest(self) -> str:
        return self._text[self._at :]

    def _skip(self, literal: str) -> bool:
        """Go past a literal if it is next; upper and lower case are equal."""
        if self._text[self._at : self._at + len(literal)].lower() != literal.lower():
            return False
        self._at += len(literal)
        return True

    def _refuse(self, reason: str) -> ValueError:
        return ValueError(f"words: at {printable(self._rest()[:40])}: {reason}")

    def end(self) -> None:
        """Raise ValueError if anything is left."""
        if self._rest():
            raise self._refuse("this is not understood; a comma and the name of a value may follow here")

    def record(self, models: Sequence[type[BaseModel]]) -> dict[str, Any]:
        """Read a record of one of these kinds: the one whose beginning is the longest that fits."""
        start, best = self._at, None
        for model in models:
            self._at = start
            try:
                data, said = self._head(model)
            except ValueError:
                continue
            if best is None or self._at > best[0]:
                best = self._at, model, data, said
        self._at = start
        if best is None:
            names = [re.sub(r"\{\w+\}|[\[\]]", "...", _template(model)) for model in models]
            close = nearest(self._rest()[:60], names)
            raise self._refuse(f"no sentence begins like this{close}")
        self._at, model, data, said = best
        self._tail(model, data, said)
        if "kind" in model.model_fields:
            data = {"kind": model.model_fields["kind"].default, **data}
        return data

    def _head(self, model: type[BaseModel]) -> tuple[dict[str, Any], set[str]]:
        """Read what a template begins with."""
        data: dict[str, Any] = {}
        for option in re.split(r"(\[[^\]]*\])", _template(model)):
            start = self._at
            try:
                self._pieces(option.strip("[]"), model, data)
            except ValueError:
                if not option.startswith("["):
                    raise
                self._at = start
        return data, set(data)

    def _pieces(self, template: str, model: type[BaseModel], data: dict[str, Any]) -> None:
        read: dict[str, Any] = {}
        for k, piece in enumerate(re.split(r"\{(\w+)\}", template)):
            if k % 2:
                read[piece] = self._value(model, piece)
            elif not self._skip(piece):
                raise self._refuse(f"must be {printable(piece)}")
        data |= read

    def _tail(self, model: type[BaseModel], data: dict[str, Any], said: set[str]) -> None:
        """Read the values that are named after commas."""
        titles = {facts_of(model, name).title: name for name in model.model_fields if name != "kind"}
        while self._rest().startswith(", "):
            self._at += 2
            if (switched := self._switch(model, said)) is not None:
                data[switched] = True
                continue
            fits = [title for title in titles if self._rest().lower().startswith(f"{title} ".lower())]
            if not fits:
                word = WORD.match(self._rest())
                hint = nearest(word[0] if word else "", titles) or ";"
                raise self._refuse(f"names no value{hint} allowed here: {', '.join(titles)}")
            title = max(fits, key=len)
            if titles[title] in said:
                raise self._refuse(f"{title} is given twice")
            self._at += len(title) + 1
            data[titles[title]] = self._value(model, titles[title])
            said.add(titles[title])

    def _switch(self, model: type[BaseModel], said: set[str]) -> str | None:
        """Read the phrase of a switch that is on, and return its name; None if there is none here."""
        phrases = {phrase: name for name in model.model_fields if (phrase := _phrase(model, name))}
        fits = [phrase for phrase in phrases if self._rest().lower().startswith(phrase.lower())]
        if not fits or phrases[max(fits, key=len)] in said:
            return None
        self._skip(max(fits, key=len))
        said.add(phrases[max(fits, key=len)])
        return phrases[max(fits, key=len)]

    def _value(self, model: type[BaseModel], name: str) -> Any:
        """Read the value of a field, and its unit, which may be left out."""
        value = self._item(records_in(model.model_fields[name].annotation))
        if unit := facts_of(model, name).unit:
            self._skip(f" {unit}")
        return value

    def _item(self, models: Sequence[type[BaseModel]]) -> Any:
        """Read a number, a word, a list or a record."""
        if self._rest().startswith("("):
            return self._parentheses(models)
        if self._rest().startswith('"'):
            text, length = json.JSONDecoder().raw_decode(self._rest())
            self._at += length
            return text
        if found := NUMBER.match(self._rest()):
            self._at += found.end()
            return float(found[0]) if re.search(r"[.e]", found[0]) else int(found[0])
        if found := WORD.match(self._rest()):
            word = found[0].rstrip(".")
            self._at += len(word)
            return {"yes": True, "no": False, "none": None}.get(word, word)
        raise self._refuse("must be a value")

    def _parentheses(self, models: Sequence[type[BaseModel]]) -> Any:
        """Read what is in parentheses: a record if it begins like one, else a list."""
        start = self._at
        self._at += 1
        if models:
            try:
                data = self.record(models)
                if self._skip(")"):
                    return data
            except ValueError:
                pass
            self._at = start + 1
        items: list[Any] = []
        while not self._skip(")"):
            if items and not self._skip(", "):
                raise self._refuse("must be a comma or a closing parenthesis")
            items.append(self._item(models))
        return items
