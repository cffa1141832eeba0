"""Options: what they must be, and how they are read from JSON, checked against the types that their dataclass declares.

An error names an option by its whole path, such as ``exchange.share``, and says nothing of where the options come from:
who read them does.
"""

from __future__ import annotations

import dataclasses
import difflib
import reprlib
from typing import Any, ClassVar, TypeVar

from difftetvr.declared import as_declared, declared_types, in_words, require_declared
from difftetvr.errors import FitError, shown

LARGEST_COUNT = 2**31 - 1
"""Greatest value of options that count something."""

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

    def __post_init__(self) -> None:
        require_declared(self, FitError, f"option {self.prefix}")

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
    declared = declared_types(kind)
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
        try:
            options[name] = as_declared(value, declared[name])
        except ValueError:
            # Cut short: the value may be of any length and depth.
            require(False, full, reprlib.repr(value), in_words(declared[name], is_json=True))
    for item in dataclasses.fields(kind):  # type: ignore[arg-type]
        if item.name not in options and not _has_default(item):
            raise FitError(f"The option '{item.name}' is missing{f' in {path}' if path else ''}; add it.")
    return kind(**options)


def first_difference(
    first: Any, second: Any, free: frozenset[str], prefix: str = ""
) -> tuple[str, object, object] | None:
    """Name and both values of the first option in which two runs differ; None if there is none.

    Args:
        first, second: Their options.
        free: Names of those that may.
        prefix: What stands before the names.
    """
    for item in dataclasses.fields(first):
        name, mine, theirs = f"{prefix}{item.name}", getattr(first, item.name), getattr(second, item.name)
        if name in free or mine == theirs:
            continue
        within = first_difference(mine, theirs, free, f"{name}.") if dataclasses.is_dataclass(mine) else None
        return within or (name, mine, theirs)
    return None


def _has_default(item: dataclasses.Field[Any]) -> bool:
    return item.default is not dataclasses.MISSING or item.default_factory is not dataclasses.MISSING
