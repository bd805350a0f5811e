"""Records as JSON values and back: dataclasses, named tuples, enumerations, collections and small arrays.

The types of the fields decide what is read, so a file cannot name a class, and nothing in it is executed.
"""

from collections.abc import Mapping, Set
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from typing import Any, ClassVar, get_args, get_origin, get_type_hints

import numpy as np

from fcslam.records import frozen
from fcslam.storage.state_file import State


class Kept:
    """A part of a program whose state is that of some attributes."""

    KEPT: ClassVar[Mapping[str, Any]]
    """Their names and types."""

    def state(self) -> State:
        """The state that ``restore`` takes."""
        return {name: to_state(getattr(self, name)) for name in self.KEPT}

    def restore(self, state: State) -> None:
        """Take over a ``state``."""
        for name, kind in self.KEPT.items():
            setattr(self, name, from_state(kind, state[name]))


def to_state(value: Any) -> Any:
    """The value as lists, dictionaries with keys of text, numbers and text; ``from_state`` reads it by its type."""
    if is_dataclass(value):
        return {field.name: to_state(getattr(value, field.name)) for field in fields(value)}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, Mapping):
        return [[to_state(key), to_state(item)] for key, item in value.items()]
    if isinstance(value, Set):
        return sorted(map(to_state, value))
    return list(map(to_state, value)) if isinstance(value, list | tuple) else value


def from_state(kind: Any, state: Any) -> Any:
    """The value of this type that ``to_state`` gave; its arrays are read-only."""
    origin: Any = get_origin(kind) or kind
    inner = get_args(kind)
    if type(None) in inner:
        value = None if state is None else from_state(inner[0], state)
    elif origin is np.ndarray:
        value = frozen(state, get_args(inner[1])[0])
    elif hasattr(origin, "__dataclass_fields__"):
        value = origin(**{name: from_state(hint, state[name]) for name, hint in _hints(origin).items()})
    elif hasattr(origin, "_fields"):
        value = origin(*map(from_state, _hints(origin).values(), state))
    elif issubclass(origin, dict):
        value = {from_state(inner[0], key): from_state(inner[1], item) for key, item in state}
    elif issubclass(origin, tuple) and inner[-1] is not Ellipsis:
        value = tuple(map(from_state, inner, state))
    elif issubclass(origin, tuple | list | set | frozenset):
        value = origin(from_state(inner[0], item) for item in state)
    else:
        value = kind(state) if issubclass(kind, Enum) else state
    return value


@cache
def _hints(kind: type) -> dict[str, Any]:
    return get_type_hints(kind)
