"""Options as their dataclasses declare them: whether values are of these types, and what the types are in words."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import types
import typing
from collections.abc import Sequence
from typing import Any, Literal

from difftetvr.errors import DiffTetError, listed, shown

_IN_WORDS = {bool: "True or False", int: "a whole number", float: "a number", str: "a text", types.NoneType: "None"}
_IN_JSON = {**_IN_WORDS, bool: "true or false", types.NoneType: "null"}


def require_declared(
    options: Any, error: type[DiffTetError], label: str = "", names: Sequence[str] | None = None
) -> None:
    """Checks that the fields of a dataclass are what it declares; lists and numbers of NumPy become that.

    Args:
        options: An instance, frozen or not.
        error: What to raise where a field is something else.
        label: What stands before the names of fields in the sentence.
        names: The fields; None for all.
    """
    for name, declared in declared_types(type(options)).items():
        if names is None or name in names:
            value = require_value(getattr(options, name), declared, f"{label}{name}", error)
            object.__setattr__(options, name, value)


def require_value(value: Any, declared: Any, name: str, error: type[DiffTetError]) -> Any:
    """A value of a declared type, as :func:`as_declared` makes it of what was given, or a sentence.

    Args:
        value: Whatever was given.
        declared: What it must be.
        name: What it was given as.
        error: What to raise where it is not.
    """
    try:
        return as_declared(value, declared)
    except ValueError:
        raise error(f"The {name} is {shown(value)}; it must be {in_words(declared)}.") from None


def declared_types(kind: type) -> dict[str, Any]:
    """Types of a dataclass's fields by name."""
    hints = typing.get_type_hints(kind)
    return {item.name: hints[item.name] for item in dataclasses.fields(kind)}


def as_declared(value: Any, declared: Any) -> Any:
    """A value of a declared type: whole numbers are floats, too, lists and arrays tuples, and paths texts.

    Args:
        value: Whatever was given.
        declared: bool, int, float, str, None, a class, a literal, a tuple, or a union of these.

    Raises:
        ValueError: It is no such value; truth values are no numbers.
    """
    origin, arguments = typing.get_origin(declared), typing.get_args(declared)
    if origin in (typing.Union, types.UnionType):
        for choice in arguments:
            try:
                return as_declared(value, choice)
            except ValueError:
                continue
        raise ValueError
    value = _plain(value)
    if origin is tuple:
        if not isinstance(value, list | tuple) or len(value) != len(arguments):
            raise ValueError
        return tuple(as_declared(part, kind) for part, kind in zip(value, arguments))
    if origin is Literal:
        is_valid = isinstance(value, str | int) and value in arguments
    elif isinstance(value, bool):
        is_valid = declared is bool
    elif declared is float:
        # Those of JSON and of Python have no greatest value.
        is_valid = isinstance(value, float) or (isinstance(value, int) and abs(value) <= sys.float_info.max)
    else:
        value = os.fspath(value) if declared is str and isinstance(value, os.PathLike) else value
        is_valid = isinstance(value, declared)
    if not is_valid:
        raise ValueError
    return value


def in_words(declared: Any, *, is_json: bool = False) -> str:
    """What a value of a declared type looks like.

    Args:
        declared: As for :func:`as_declared`.
        is_json: Whether it is written as JSON instead of in Python.
    """
    origin, arguments = typing.get_origin(declared), typing.get_args(declared)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(in_words(choice, is_json=is_json) for choice in arguments)
    if origin is Literal:
        words = [json.dumps(value) if is_json else str(value) for value in arguments]
        return " or ".join(words) if is_json else listed(words, "or")
    if origin is tuple:
        if is_json:
            return f"[{', '.join(in_words(part, is_json=True) for part in arguments)}]"
        part = in_words(arguments[0])
        return f"{len(arguments)} {part[2:]}s" if part.startswith("a ") else f"{len(arguments)} times {part}"
    named = _IN_JSON if is_json else _IN_WORDS
    return named.get(declared) or f"a {declared.__name__}"


def _plain(value: Any) -> Any:
    """Arrays, tensors and their numbers as lists and numbers of Python; all else as it is."""
    if not hasattr(value, "tolist"):
        return value
    try:
        return value.tolist()
    except (RuntimeError, NotImplementedError, TypeError):
        raise ValueError from None
