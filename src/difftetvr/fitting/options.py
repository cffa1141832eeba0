"""Options: what they must be, and how they are read from JSON, checked against the types that their dataclass declares.

An error names an option by its whole path, such as ``exchange.share``, and says nothing of where the options come from:
who read them does.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import reprlib
import sys
import types
import typing
from typing import Any, ClassVar, Literal, TypeVar

from difftetvr.errors import FitError, shown

LARGEST_COUNT = 2**31 - 1
"""Greatest value of options that count something."""

_IN_WORDS = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", types.NoneType: "null"}

_Options = TypeVar("_Options")


def require(condition: bool, name: str, value: object, rule: str) -> None:
    """Checks an option.

    Raises:
        FitError: The condition does not hold; names option, value and rule.
    """
    if not condition:
        raise FitError(f"The option {name} is {value if isinstance(value, str) else shown(value)}; it must be {rule}.")


class OptionGroup:
    """Base of dataclasses whose options are one of those of a run.

    They are checked when they are made, which is before the run's options are; so they must know by themselves what
    they are called there.

    Attributes:
        prefix: What stands before their names in those of a run.
    """

    prefix: ClassVar[str] = ""

    def _require(self, condition: bool, name: str, rule: str) -> None:
        require(condition, f"{self.prefix}{name}", getattr(self, name), rule)


def options_from_json(kind: type[_Options], values: object, path: str = "") -> _Options:
    """An instance of a dataclass from JSON values by field name; fields that are not given keep their defaults.

    JSON knows no tuples: lists stand for them.

    Args:
        kind: Dataclass whose fields are bool, int, float, str, None, literals, tuples, unions of these, or such
            dataclasses.
        values: Parsed JSON.
        path: Name of the option that holds these, for errors.

    Raises:
        DiffTetError: It is no JSON object, an option is unknown, is missing, or its value has another type than its
            field, a FitError; or what the dataclass itself raises for values out of range.
    """
    if not isinstance(values, dict):
        subject = f"The option {path} is" if path else "The options are"
        raise FitError(f'{subject} no JSON object; write {{"option": value, ...}}.')
    declared = _declared(kind)
    options: dict[str, Any] = {}
    for name, value in values.items():
        full = f"{path}.{name}" if path else name
        if name not in declared:
            alike = difflib.get_close_matches(name, declared, 1)
            hint = f" (is it '{alike[0]}'?)" if alike else ""
            raise FitError(f"There is no option '{full}'; correct its name{hint} or remove it.")
        if dataclasses.is_dataclass(declared[name]):
            options[name] = options_from_json(declared[name], value, full)
            continue
        # Cut short: the value may be of any length and depth.
        require(_fits(value, declared[name]), full, reprlib.repr(value), _in_words(declared[name]))
        options[name] = tuple(value) if isinstance(value, list) else value
    for item in dataclasses.fields(kind):  # type: ignore[arg-type]
        if item.name not in options and not _has_default(item):
            raise FitError(f"The option '{item.name}' is missing{f' in {path}' if path else ''}; add it.")
    return kind(**options)


def _declared(kind: Any) -> dict[str, Any]:
    """Types of a dataclass's fields by name."""
    hints = typing.get_type_hints(kind)
    return {item.name: hints[item.name] for item in dataclasses.fields(kind)}


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
            isinstance(value, list | tuple)
            and len(value) == len(arguments)
            and all(_fits(v, t) for v, t in zip(value, arguments, strict=True))
        )
    if isinstance(value, bool) and declared is not bool:
        return False
    if declared is float and isinstance(value, int):
        # Those of JSON have no greatest value.
        return abs(value) <= sys.float_info.max
    return isinstance(value, declared)


def _in_words(declared: Any) -> str:
    """What a value of a declared type looks like in JSON."""
    origin, arguments = typing.get_origin(declared), typing.get_args(declared)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_in_words(choice) for choice in arguments)
    if origin is Literal:
        return " or ".join(json.dumps(value) for value in arguments)
    if origin is tuple:
        return f"[{', '.join(_in_words(part) for part in arguments)}]"
    return _IN_WORDS[declared]
