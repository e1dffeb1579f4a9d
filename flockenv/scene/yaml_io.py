"""YAML <-> Scene: a strict reader with one-line errors (what and where), and a writer whose text reads back.

The reader takes YAML 1.2's plain scalars, not 1.1's: `1e-3` is a number, `no` a string, `010` and `.nan` are errors.
It builds numbers, strings, lists and mappings, and never an object: tags are errors.
"""

from __future__ import annotations

import functools
import json
import math
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from decimal import Decimal
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from flockenv.core.bundled import bundled_scenes
from flockenv.core.errors import KeyPath, key_path, nearest, parse_key_path, printable, refusals
from flockenv.core.yaml_paths import STANDARD_INPUT, has_yaml_suffix
from flockenv.scene import Scene
from flockenv.scene.presets import Preset, expand_presets

__all__ = ["MAX_BYTES", "ConfigError", "dump", "dump_scene", "keys_of", "load", "load_scene", "parse_scalar", "schema"]

MAX_BYTES = 1_000_000
"""Most bytes of a file that is read as a record."""

MAX_DEPTH = 32
MAX_LINES = 5  # of one error message; the rest is left out

M = TypeVar("M", bound=BaseModel)

_LOADER: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # libyaml if installed: ten times faster


class ConfigError(ValueError):
    """An invalid configuration: one line per mistake, with file, line, key, value and what is allowed."""


def load_scene(source: str | Path) -> Scene:
    """Return the scene of a YAML file or YAML text, see `load`, or of the name of a scene that ships, such as "boids".

    source: as of `load`; a name without a folder also finds a scene that ships.

    A file of that name in the current folder comes first.
    """
    return load(source, Scene, bundled_scenes())


def dump_scene(scene: Scene, models: Sequence[str] = (), brief: bool = False) -> str:
    """Return the scene as YAML text that reads back as an equal scene.

    models: presets to write by name, if all their effects are consecutive in the scene; brief: see `dump`.
    """
    return dump(scene, brief, {"effects": functools.partial(_name_presets, scene, models)} if models else {})


def _name_presets(scene: Scene, models: Sequence[str], effects: list[Any]) -> list[Any]:
    """Return the written effects of a scene, with those of presets replaced by the preset's name."""
    out = list(effects)
    for name in models:
        members = Preset(preset=name).effects()
        for k in range(len(out) - len(members), -1, -1):
            if scene.effects[k : k + len(members)] == members:
                out[k : k + len(members)] = [{"preset": name}]
                break
    return out


def schema(model: type[BaseModel] = Scene) -> dict[str, Any]:
    """Return the JSON Schema of a model, for editors that complete and check YAML."""
    out = {"$schema": "https://json-schema.org/draft/2020-12/schema", **model.model_json_schema()}
    if model is Scene:  # a list of effects in a file may name a preset
        listed = out["properties"]["effects"]
        listed["items"] = {"anyOf": [listed["items"], {"$ref": "#/$defs/Preset"}]}
        out["$defs"]["Preset"] = Preset.model_json_schema()
    return out


def load(source: str | Path, model: type[M], named: Mapping[str, Path] = MappingProxyType({})) -> M:
    """Return the `model` of a YAML file or text.

    source: a Path names a file or a pipe, `-` standard input; so does a str, unless it contains a line break, a `: `
    or a `{`: then it is the text itself. named: files that also have a name. Raise ConfigError, one line per mistake,
    before anything is built.
    """
    name, text = _read(source, named)
    reader = _Reader(name, text)
    try:
        data, origins = expand_presets(reader.document())
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(f"{name}:{reader.line(parse_key_path(str(error)))}: {error}") from None
    try:
        # Through JSON, because strict mode then takes a list for a tuple and 1 for 1.0, but not "1" for 1.
        return model.model_validate_json(json.dumps(data), strict=True)
    except ValidationError as error:
        wrong = sorted(
            (reader.line(origins.path(r.path or parse_key_path(str(r)))), origins.text(str(r)))
            for r in refusals(error, model, data)
        )
    lines = [f"{name}:{line}: {text}" for line, text in wrong[:MAX_LINES]]
    more = [f"{name}: and more mistakes"] if len(wrong) > MAX_LINES else []
    raise ConfigError("\n".join(lines + more))


def keys_of(source: str | Path) -> tuple[str, ...]:
    """Return the outermost keys of a YAML file or text; source and errors are those of `load`."""
    return tuple(_Reader(*_read(source, {})).document())


def dump(
    record: BaseModel, brief: bool = False, written: Mapping[str, Callable[[Any], Any]] = MappingProxyType({})
) -> str:
    """Return the record as YAML text; raise ConfigError if that text would not read back as an equal record.

    Every field is written, also defaults, so that a file keeps its meaning when a default changes; `brief`: only fields
    that differ from their defaults, to be readable. Infinite defaults are left out, as YAML readers disagree about
    infinity. `written` maps names of fields to functions that convert their values for writing.
    """
    data = _drop_infinite(_drop_defaults(record) if brief else record.model_dump())
    text: str = yaml.dump(
        {name: written[name](value) if name in written else value for name, value in data.items()},
        Dumper=_Dumper,
        sort_keys=False,
        default_flow_style=None,
        allow_unicode=True,
        width=120,
    )
    try:
        same = load(text, type(record)) == record
    except ConfigError as error:
        raise ConfigError(f"{type(record).__name__} cannot be written as YAML: {error}") from None
    if not same:
        raise ConfigError(f"{type(record).__name__} cannot be written as YAML: its text reads back as another record")
    return text


def _drop_defaults(value: Any) -> Any:
    """Return a record's kind and the fields that differ from their defaults, also in the records within it."""
    if isinstance(value, BaseModel):
        fields, given = type(value).model_fields, dict(value)  # a default may depend on other values
        defaults = {name: f.get_default(call_default_factory=True, validated_data=given) for name, f in fields.items()}
        values = {name: getattr(value, name) for name in defaults}
        return {name: _drop_defaults(each) for name, each in values.items() if name == "kind" or each != defaults[name]}
    return [_drop_defaults(each) for each in value] if isinstance(value, (list, tuple)) else value


def _drop_infinite(value: Any) -> Any:
    """Return the value as lists and dicts, without infinite values: `dump` checks that those were defaults."""
    if isinstance(value, dict):
        return {key: _drop_infinite(v) for key, v in value.items() if not (isinstance(v, float) and math.isinf(v))}
    return [_drop_infinite(v) for v in value] if isinstance(value, (list, tuple)) else value


class _Dumper(yaml.SafeDumper):
    """Writer for `_Reader`: quotes every string that `_Reader` would read as something else."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _represent_text(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    try:
        plain = parse_scalar(text) == text
    except ValueError:
        plain = False
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=None if plain else "'")


_Dumper.add_representer(str, _represent_text)


def _read(source: str | Path, named: Mapping[str, Path]) -> tuple[str, str]:
    """Return a name for messages, and the text."""
    if isinstance(source, str) and re.search(r"\n|: |\{|:$", source):
        return "text", source.removeprefix("\ufeff")
    if str(source) == STANDARD_INPUT:
        return "standard input", _decode("standard input", sys.stdin.buffer.read(MAX_BYTES + 1))
    path = Path(source)
    name = repr(str(source))[1:-1]
    try:
        if str(source) in named and not path.is_file():
            path = named[str(source)]
        if not (path.is_file() or path.is_fifo()):  # a shell's <(...) is a pipe
            raise ConfigError(f"{name}: no such file{_nearest_file(path, named)}")
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"{name}: cannot be read: {getattr(error, 'strerror', None) or error}") from None
    return name, _decode(name, content)


def _nearest_file(path: Path, named: Mapping[str, Path]) -> str:
    if path.exists():
        return " (it is a folder)" if path.is_dir() else " (it is a device)"
    siblings = [p.name for p in path.parent.iterdir()] if path.parent.is_dir() else []
    known = () if has_yaml_suffix(path.name) or len(path.parts) > 1 else named
    return nearest(path.name, [*filter(has_yaml_suffix, siblings), *known])


def _decode(name: str, content: bytes) -> str:
    if len(content) > MAX_BYTES:
        raise ConfigError(f"{name}: larger than {MAX_BYTES} bytes, the most that is read")
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise ConfigError(f"{name}: UTF-16 text; save it as UTF-8")
    if b"\0" in content:
        raise ConfigError(f"{name}: binary data, not YAML text")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{name}: not UTF-8 text: byte {error.start} is {content[error.start]:#04x}") from None


_NUMBER = re.compile(r"[-+]?(?=\.?[0-9])(?P<whole>[0-9]+(?:_[0-9]+)*)?(?P<point>\.[0-9]*)?(?P<power>[eE][-+]?[0-9]+)?")
_WORDS: dict[str, bool | None] = {"": None, "~": None, "null": None, "true": True, "false": False}


def parse_scalar(text: str) -> str | int | float | bool | None:
    """Return the value of an unquoted scalar; raise ValueError for an ambiguous one.

    text: without the blanks around it.
    """
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if re.fullmatch(r"[-+]?\.(inf|nan)", text, re.IGNORECASE):
        raise ValueError(f"{text} is not a number that can be used: write a finite one")
    found = _NUMBER.fullmatch(text)
    if not found:
        return text
    integer_part, digits = found["whole"] or "", text.replace("_", "")
    if found["point"] is None and found["power"] is None and re.match("0[0-9]", integer_part):
        raise ValueError(
            f"{printable(text)[1:-1]} begins with 0, which some read as octal: write {digits.lstrip('+-0') or 0}"
        )
    if len(text) > 400 or math.isinf(float(digits)):
        raise ValueError(f"{printable(text)} is too large or too long for a number")
    if found["point"] is None and (found["power"] is None or float(digits).is_integer()):
        return int(Decimal(digits))
    return float(digits)


def _line_of(event: yaml.Event) -> int:
    return int(event.start_mark.line) + 1 if event.start_mark else 1


class _Reader:
    """Reader of one YAML document: builds plain data from the parser's events, and records the line of every key."""

    def __init__(self, name: str, text: str) -> None:
        self._name = name
        self._lines: dict[KeyPath, int] = {(): 1}
        if len(text) > MAX_BYTES:
            raise ConfigError(f"{name}: larger than {MAX_BYTES} bytes, the most that is read")
        self._events = self._parse(text)

    def line(self, path: KeyPath) -> int:
        """Return the line of a key, or of the nearest block around it."""
        while path not in self._lines:
            path = path[:-1]
        return self._lines[path]

    def document(self) -> dict[str, Any]:
        """Return the document; raise ConfigError unless there is exactly one and it is a block of keys."""
        next(self._events)  # start of the stream
        first = next(self._events)
        if isinstance(first, yaml.StreamEndEvent):
            raise ConfigError(f"{self._name}: empty")
        data = self._read_value(next(self._events), ())
        next(self._events)  # end of the document
        if not isinstance(next(self._events), yaml.StreamEndEvent):
            raise ConfigError(f"{self._name}: holds more than one document (---)")
        if not isinstance(data, dict):
            raise ConfigError(
                f"{self._name}: {'empty' if data is None else 'a list or a word'}, not a block of `key: value`"
            )
        return data

    def _parse(self, text: str) -> Iterator[yaml.Event]:
        try:
            yield from yaml.parse(text, Loader=_LOADER)
        except yaml.MarkedYAMLError as error:
            mark = error.problem_mark or error.context_mark
            problem = " ".join(f"{error.problem or error.context}".split())
            raise ConfigError(f"{self._name}:{mark.line + 1 if mark else 1}: not YAML: {problem}") from None
        except (yaml.YAMLError, UnicodeEncodeError) as error:
            reason = getattr(error, "reason", "a character that YAML does not allow")
            before = text[: getattr(error, "position", None) or getattr(error, "start", 0)]
            raise ConfigError(f"{self._name}:{before.count(chr(10)) + 1}: not YAML text: {reason}") from None

    def _error(self, event: Any, reason: str) -> ConfigError:
        return ConfigError(f"{self._name}:{_line_of(event)}: {reason}")

    def _read_value(self, event: Any, path: KeyPath) -> Any:
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            raise self._error(event, f"{key_path(path)}: anchors and aliases are not read: write the value out")
        if event.tag is not None:
            raise self._error(
                event, f"{key_path(path)}: the tag {printable(event.tag)[1:-1]} is not read: write a plain value"
            )
        if len(path) > MAX_DEPTH:
            raise self._error(event, f"nested more than {MAX_DEPTH} deep")
        if isinstance(event, yaml.MappingStartEvent):
            return self._read_mapping(path)
        if isinstance(event, yaml.SequenceStartEvent):
            return self._read_sequence(path)
        if event.style:  # quoted, or a block of text
            return event.value
        try:
            return parse_scalar(event.value)
        except ValueError as error:
            raise self._error(event, f"{key_path(path)}: {error}") from None

    def _read_sequence(self, path: KeyPath) -> list[Any]:
        items: list[Any] = []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            item_path = (*path, len(items))
            self._lines[item_path] = _line_of(event)
            items.append(self._read_value(event, item_path))
        return items

    def _read_mapping(self, path: KeyPath) -> dict[str, Any]:
        block: dict[str, Any] = {}
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            item_path = (*path, self._read_key(event, path))
            if item_path in self._lines:
                first = self._lines[item_path]
                raise self._error(event, f"{key_path(item_path)}: given twice, first on line {first}")
            self._lines[item_path] = _line_of(event)
            block[str(item_path[-1])] = self._read_value(next(self._events), item_path)
        return block

    def _read_key(self, event: Any, path: KeyPath) -> str:
        if not isinstance(event, yaml.ScalarEvent) or event.tag is not None or event.anchor is not None:
            raise self._error(event, f"{key_path(path) or 'the document'}: a key must be a plain word")
        if event.value == "<<":
            raise self._error(event, f"{key_path((*path, '<<'))}: merge keys (<<) are not read: write the values out")
        return str(event.value)
