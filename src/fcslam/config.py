"""Typed settings: load, check and dump. Each package owns its model; field names contain the unit."""

import difflib
import math
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from fcslam.errors import InputError, printable
from fcslam.untrusted import MOST_TEXT_BYTES, read_text

LONGEST_QUOTE: Final = 300
"""Longer texts from a file are cut in messages."""


class StrictModel(BaseModel):
    """A frozen model of known keys and finite numbers."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class Settings(StrictModel):
    """Base class of all settings: frozen, no unknown keys, finite numbers only."""

    def __init__(self, **values: Any) -> None:
        """Check ``values``; keys that are not given have their defaults."""
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise _refusal(type(self), error, type(self).__name__) from error

    # For pydantic, this is not a constructor of its own: settings within settings are checked without it, so the
    # message names the whole key.
    __init__.__pydantic_base_init__ = True  # type: ignore[attr-defined]


SettingsType = TypeVar("SettingsType", bound=Settings)


def load(kind: type[SettingsType], path: Path, over: SettingsType | None = None) -> SettingsType:
    """Read a YAML file over the settings ``over``; None: the defaults of ``kind``."""
    try:
        content = parse_yaml(read_text(path, most=MOST_TEXT_BYTES))
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot read the configuration ({error}); give FILE, KEY=VALUE or `paper`") from error
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    if content is None:
        content = {}
    if not isinstance(content, dict):
        raise InputError(f"{path}: expected a mapping of keys; `fcslam tools config` prints a complete one")
    return parse(kind, content, str(path)) if over is None else changed(over, content, str(path))


def changed(settings: SettingsType, content: dict[str, Any], where: str) -> SettingsType:
    """The settings with the keys of ``content`` changed, checked as a whole; ``where`` names its origin in messages."""
    return parse(type(settings), _merged(settings.model_dump(), content), where)


def parse(kind: type[SettingsType], content: dict[str, Any], where: str) -> SettingsType:
    """Check ``content`` against ``kind``; ``where`` names its origin in messages."""
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise _refusal(kind, error, where) from error


def _refusal(kind: type[Settings], error: ValidationError, where: str) -> InputError:
    first = error.errors()[0]
    key = one_line(".".join(str(part) for part in first["loc"]))
    if first["type"] == "extra_forbidden":
        return InputError(f"{where}: unknown key '{key}'{_nearest(kind, first['loc'])}")
    if first["type"] == "value_error" and isinstance(first["input"], dict):  # keys that do not fit each other
        place = f"{where}: {key}" if key else where
        return InputError(f"{place}: {first['ctx']['error']}")
    return InputError(f"{where}: {key}: {one_line(first['msg'])} (given: {one_line(repr(first['input']))})")


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        nested = isinstance(value, dict) and isinstance(base.get(key), dict)
        merged[key] = _merged(base[key], value) if nested else value
    return merged


def dump(settings: Settings) -> str:
    """Complete YAML of ``settings``, with the description of each key as a comment above it."""
    return "\n".join(_lines(settings, indent=0)) + "\n"


def _lines(settings: Settings, indent: int) -> list[str]:
    pad = "  " * indent
    lines: list[str] = []
    plain = settings.model_dump(mode="json")
    for name, field in type(settings).model_fields.items():
        value = getattr(settings, name)
        if field.description:
            lines.append(f"{pad}# {field.description}")
        if isinstance(value, Settings):
            lines += [f"{pad}{name}:", *_lines(value, indent + 1)]
        else:
            lines.append(f"{pad}{name}: {_flow(plain[name])}")
    return lines


def _flow(value: Any) -> str:
    text: str = yaml.safe_dump(value, default_flow_style=True, width=math.inf)
    return text.removesuffix("\n...\n").strip()


def _nearest(kind: type[Settings], loc: tuple[int | str, ...]) -> str:
    """A hint with the known key, of any section, whose name is most similar to the unknown key at ``loc``."""
    asked = ".".join(str(part) for part in loc)
    keys = list(_keys(kind))
    names = difflib.get_close_matches(_name(asked), [_name(key) for key in keys], n=1, cutoff=0.6)
    near = difflib.get_close_matches(asked, [key for key in keys if _name(key) in names], n=1, cutoff=0.0)
    return f"; did you mean '{near[0]}'?" if near else f"; known keys: {', '.join(kind.model_fields)}"


def _name(key: str) -> str:
    return key.rpartition(".")[2]


def _keys(kind: type[Settings], section: str = "") -> Iterator[str]:
    for name, field in kind.model_fields.items():
        yield section + name
        if isinstance(field.annotation, type) and issubclass(field.annotation, Settings):
            yield from _keys(field.annotation, f"{section}{name}.")


class _PlainLoader(yaml.SafeLoader):
    """Refuses what expands a short text without end, and a mapping with a key twice, of which the last would count."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise _refused("aliases are not read", self.peek_event())  # type: ignore[no-untyped-call]
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = Counter((key.tag, key.value) for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        for (tag, key), count in keys.items():
            if tag == "tag:yaml.org,2002:merge":
                raise _refused("merge keys (<<) are not read", node)
            if count > 1:
                raise _refused(f"the key '{key}' occurs twice", node)
        return super().construct_mapping(node, deep)

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        # Python converts long integers slowly, and back to text not at all
        if node.tag.endswith((":int", ":float")) and len(node.value) > 100:
            raise _refused(f"a number of {len(node.value)} characters; the limit is 100", node)
        return super().construct_object(node, deep)


def _refused(reason: str, where: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=reason, problem_mark=where.start_mark)


def parse_yaml(text: str | bytes) -> Any:
    """Content of YAML text of unknown origin."""
    if len(text) > MOST_TEXT_BYTES:
        raise ValueError(f"{len(text)} characters of YAML; the limit is {MOST_TEXT_BYTES}")
    try:
        return yaml.load(text, _PlainLoader)
    except Exception as error:  # beside its own errors, those of its constructors: recursion, dates, numbers, ...
        raise ValueError(f"not valid YAML ({one_line(str(error))})") from error


def one_line(text: str) -> str:
    """The text on one line of at most ``LONGEST_QUOTE`` characters, for a message that quotes a file."""
    line = printable(" ".join(text.split()))
    return line if len(line) <= LONGEST_QUOTE else f"{line[: LONGEST_QUOTE - 3]}..."
