"""What the dataclass of a command declares: its arguments, by the names that they have on the command line."""

from __future__ import annotations

import dataclasses
import re
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import tyro
from tyro.conf import OmitArgPrefixes

Groups = dict[str, tuple[str, ...]]
"""Titles and the options under them, by their names on the command line without dashes; ``motion.*``: all that begin
so."""


@dataclass(frozen=True)
class Argument:
    """One argument of a command.

    Attributes:
        name: On the command line, without dashes and ``no-``, such as ``exchange.share``.
        declared: Its type.
        notes: What is noted for tyro beside the type.
        value: What it is where it is not given; dataclasses' or tyro's mark where it must be.
        owner: The dataclass that it is a field of.
        field: Name of that field.
    """

    name: str
    declared: Any
    notes: tuple[Any, ...]
    value: Any
    owner: type
    field: str

    @property
    def is_required(self) -> bool:
        """Whether it must be given."""
        return _is_missing(self.value)

    def flags(self, pairs: bool = False) -> list[str]:
        """How it is written where it has a name; one that is on or off only as what it is not already.

        Args:
            pairs: Whether it may be turned on and off again.
        """
        on = f"--{self.name}"
        if self.declared is not bool:
            return [*(alias for note in settings_of(self.notes) for alias in note.aliases or ()), on]
        off = "--" + re.sub(r"([^.]+)$", r"no-\1", self.name)
        return [on, off] if pairs else [off if self.value else on]


def arguments_of(kind: Any, default: Any = None, prefix: str = "") -> Iterator[Argument]:
    """The arguments that a command's dataclass declares, nested ones included, in their order.

    Args:
        kind: The dataclass, annotated for tyro.
        default: Holds the values of arguments that are not given; None: as declared.
        prefix: What stands before their names.
    """
    hints = typing.get_type_hints(kind, include_extras=True)
    for field in dataclasses.fields(kind):
        hint = hints[field.name]
        notes = getattr(hint, "__metadata__", ())
        declared = hint.__origin__ if notes else hint
        given = next((note.name for note in settings_of(notes) if note.name is not None), None)
        name = prefix + (field.name if given is None else given).replace("_", "-")
        value = _default_of(field) if default is None else getattr(default, field.name)
        if dataclasses.is_dataclass(declared):
            inner = prefix if given == "" or OmitArgPrefixes in notes else f"{name}."
            yield from arguments_of(declared, None if _is_missing(value) else value, inner)
        else:
            yield Argument(name, declared, notes, value, kind, field.name)


def settings_of(notes: tuple[Any, ...]) -> list[Any]:
    """What ``tyro.conf.arg`` has noted: name, metavar, aliases."""
    return [note for note in notes if hasattr(note, "metavar")]


def _default_of(field: dataclasses.Field[Any]) -> Any:
    return field.default_factory() if field.default_factory is not dataclasses.MISSING else field.default


def _is_missing(value: Any) -> bool:
    """Whether a value must be given: dataclasses' mark, or tyro's."""
    return value is dataclasses.MISSING or value is tyro.MISSING
