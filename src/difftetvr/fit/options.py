"""Options read from JSON, checked against the types that their dataclass declares."""

from __future__ import annotations

import dataclasses
import types
import typing
from typing import Any, Literal, TypeVar

from difftetvr.fit.errors import FitError

LARGEST_COUNT = 2**31 - 1
"""Greatest value of options that count something."""

_Options = TypeVar("_Options")


def require(condition: bool, name: str, value: object, rule: str) -> None:
    """Checks an option.

    Raises:
        FitError: The condition does not hold; names option, value and rule.
    """
    if not condition:
        raise FitError(f"The option {name} is {value}; it must be {rule}.")


def options_from_json(kind: type[_Options], values: object) -> _Options:
    """An instance of a dataclass from JSON values by field name; fields that are not given keep their defaults.

    JSON knows no tuples: lists stand for them.

    Args:
        kind: Dataclass whose fields are bool, int, float, str, None, literals, tuples, unions of these, or such
            dataclasses.
        values: Parsed JSON.

    Raises:
        FitError: It is no JSON object, an option is unknown, or its value has another type than its field.
    """
    if not isinstance(values, dict):
        raise FitError("The saved options are no JSON object; start anew with --overwrite.")
    declared = typing.get_type_hints(kind)
    options: dict[str, Any] = {}
    for name, value in values.items():
        if name not in declared:
            raise FitError(
                f"The saved options hold '{name}', which this version does not know; start anew with --overwrite."
            )
        if dataclasses.is_dataclass(declared[name]):
            options[name] = options_from_json(declared[name], value)
            continue
        options[name] = _with_tuples(value)
        if not _fits(options[name], declared[name]):
            raise FitError(
                f"The saved option {name} is {value!r}, which has the wrong type; start anew with --overwrite."
            )
    required = [f.name for f in dataclasses.fields(kind) if not _has_default(f)]  # type: ignore[arg-type]
    missing = [name for name in required if name not in options]
    if missing:
        raise FitError(f"The saved options lack '{missing[0]}'; start anew with --overwrite.")
    return kind(**options)


def _with_tuples(value: object) -> object:
    return tuple(_with_tuples(v) for v in value) if isinstance(value, list) else value


def _has_default(item: dataclasses.Field[Any]) -> bool:
    return item.default is not dataclasses.MISSING or item.default_factory is not dataclasses.MISSING


def _fits(value: object, declared: Any) -> bool:
    """Whether a value belongs to a declared type; whole numbers are floats, too, but truth values are no numbers."""
    origin, arguments = typing.get_origin(declared), typing.get_args(declared)
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, choice) for choice in arguments)
    if origin is Literal:
        return value in arguments
    if origin is tuple:
        return (
            isinstance(value, tuple)
            and len(value) == len(arguments)
            and all(_fits(v, t) for v, t in zip(value, arguments, strict=True))
        )
    if declared is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if declared is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, declared)
