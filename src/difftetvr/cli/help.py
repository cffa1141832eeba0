"""What ``--help`` shows: the options of a command, in groups, those that most people use first."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import docstring_parser
from rich.console import Console, Group, RenderableType
from rich.padding import Padding
from rich.table import Table
from rich.text import Text
from tyro.conf import Positional

from difftetvr.cli.arguments import Groups, arguments_of, settings_of

_REST = "Options"
_FLAG_WIDTH = 30
_NARROW, _INDENT = 60, 2
_PLACEHOLDERS = {bool: "", int: "N", float: "X", str: "NAME", Path: "FILE"}


@dataclass(frozen=True)
class Option:
    """One argument of a command.

    Attributes:
        name: On the command line, without dashes and ``no-``, such as ``exchange.share``.
        flags: As it is written: ``-o FILE, --output FILE``, ``--no-move``, ``CAPTURE``.
        text: What it does, and its default.
        is_positional: Whether it is known by its place.
        is_required: Whether it must be given.
    """

    name: str
    flags: str
    text: str
    is_positional: bool
    is_required: bool


def print_help(console: Console, command: str, kind: type, default: Any = None) -> None:
    """Prints the help of a command, wrapped to the terminal.

    Args:
        console: Where to.
        command: Its name.
        kind: Its dataclass; where it has ``groups``, its options are shown under those titles.
        default: Holds the values of options that are not given; None: as declared.
    """
    options = list(options_of(kind, default))
    named = [option.flags.split(",")[0] for option in options if option.is_required and not option.is_positional]
    placed = [option.flags if option.is_required else f"[{option.flags}]" for option in options if option.is_positional]
    about = _joined(docstring_parser.parse(kind.__doc__ or "").description or "")
    _print(console, Text(" ".join(["usage: difftetvr", command, *placed, *named, "[OPTIONS]"])), "", Text(about))
    short = [len(option.flags) for option in options if len(option.flags) <= _FLAG_WIDTH]
    for title, members in _grouped(options, getattr(kind, "groups", {})):
        _print_section(console, title, [(option.flags, option.text) for option in members], max(short))


def print_overview(console: Console, commands: dict[str, type]) -> None:
    """Prints what the commands are for.

    Args:
        console: Where to.
        commands: Their dataclasses by name.
    """
    lines = [(name, _joined((kind.__doc__ or "").split("\n\n")[0])) for name, kind in commands.items()]
    about = "Differentiable volume rendering of tetrahedral meshes, and their reconstruction from images."
    _print(console, Text("usage: difftetvr COMMAND [OPTIONS]"), "", Text(about))
    _print_section(console, "Commands", lines, max(len(name) for name in commands))
    first = [
        ("difftetvr fit tooth -o OUT", "reconstruct the built-in CT scan; OUT/model.vtu opens in ParaView"),
        ("difftetvr fit PHOTOS -o OUT", "or photographs: NeRF-synthetic, transforms.json, COLMAP"),
        ("difftetvr render MESH -o P.png", "a picture of a reconstruction, or of a simulation"),
    ]
    _print_section(console, "To begin with", first, _FLAG_WIDTH)
    tail = "'difftetvr COMMAND --help' lists a command's options, 'difftetvr --version' tells the version."
    _print(console, "", Text(tail))


def options_of(kind: Any, default: Any = None) -> Iterator[Option]:
    """What is shown of the arguments of a command, in their order.

    Args:
        kind: Its dataclass, annotated for tyro.
        default: Holds the values of options that are not given, and both --move and --no-move are shown; None: as
            declared.
    """
    for argument in arguments_of(kind, default):
        name, value, settings = argument.name, argument.value, settings_of(argument.notes)
        shown = next((note.metavar for note in settings if note.metavar), None)
        shown = shown or _placeholder(argument.declared, argument.field)
        text = _joined(_texts(argument.owner).get(argument.field, ""))
        if Positional in argument.notes:
            yield Option(name, shown, text, True, argument.is_required)
        elif argument.declared is bool:
            flags = ", ".join(argument.flags(pairs=default is not None))
            yield Option(name, flags, f"{text} (default: {'on' if value else 'off'})", False, False)
        else:
            flags = ", ".join(f"{flag} {shown}" for flag in argument.flags())
            text += " (required)" if argument.is_required else _default_text(value, text)
            yield Option(name, flags, text, False, argument.is_required)


def _grouped(options: list[Option], titles: Groups) -> Iterator[tuple[str, list[Option]]]:
    """Titles with their options; an option stands under the first that names it."""
    left = [option for option in options if not option.is_positional]
    groups: dict[str, list[Option]] = {"Arguments": [option for option in options if option.is_positional], _REST: []}
    for title, patterns in titles.items():
        groups[title] = [option for pattern in patterns for option in left if _matches(option.name, pattern)]
        left = [option for option in left if option not in groups[title]]
    groups[_REST] = left
    return ((title, members) for title, members in groups.items() if members)


def _matches(name: str, pattern: str) -> bool:
    return name.startswith(pattern[:-1]) if pattern.endswith("*") else name == pattern


def _print(console: Console, *lines: RenderableType) -> None:
    """Prints lines that wrap at the terminal's width, which other output does not."""
    for line in lines:
        console.print(line, soft_wrap=False)


def _print_section(console: Console, title: str, lines: list[tuple[str, str]], width: int) -> None:
    """A title, and flags with their texts in two columns; flags that are too long stand above their text."""
    if console.width < _NARROW:
        width = _INDENT  # all flags stand above their texts
    rows: list[RenderableType] = []
    _print(console, "", Text(title, style="bold"))
    for flags, text in lines:
        row = Table.grid(padding=(0, 2, 0, 0))
        row.add_column(width=width)
        row.add_column()
        if len(flags) > width:
            rows.append(Text(flags, style="cyan", overflow="fold"))
            flags = ""
        row.add_row(Text(flags, style="cyan"), Text(text, overflow="fold"))
        rows.append(row)
    _print(console, Padding(Group(*rows), (0, 0, 0, 2)))


@cache
def _texts(kind: type) -> dict[str, str]:
    """What is written below each field, or about it in the docstring, of the class and of those it derives from."""
    texts: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        if dataclasses.is_dataclass(base):
            found = docstring_parser.parse_from_object(base).params
            texts |= {param.arg_name: param.description for param in found if param.description}
    return texts


def _placeholder(declared: Any, name: str) -> str:
    """What stands for a value of a type."""
    origin, parts = typing.get_origin(declared), typing.get_args(declared)
    if origin in (typing.Union, types.UnionType):
        return "|".join(_placeholder(part, name) for part in parts if part is not types.NoneType)
    if origin is Literal:
        return "|".join(str(part) for part in parts)
    if origin is tuple:
        return f"{_placeholder(parts[0], name)} ..." if parts[-1] is Ellipsis else _letters(name, parts)
    return "FILE" if name in ("transfer_function", "initial_mesh") else _PLACEHOLDERS.get(declared, "VALUE")


def _letters(name: str, parts: tuple[Any, ...]) -> str:
    """Names of the numbers of a fixed-size tuple."""
    if "background" in name:
        return "R G B"
    if name == "clip":
        return "A B C D"
    if len(parts) == 3:
        return "NX NY NZ" if parts[0] is int else "X Y Z"
    return "X Y Z X Y Z" if len(parts) == 6 else " ".join(_PLACEHOLDERS.get(part, "VALUE") for part in parts)


def _default_text(value: Any, text: str) -> str:
    if value is None or value == () or "efault:" in text:
        return ""
    values = value if isinstance(value, tuple) else [value]
    words = " ".join(f"{v:g}" if isinstance(v, float) else str(v) for v in values)
    return f" (default: {words})"


def _joined(text: str) -> str:
    """A text without its line breaks, but for those between paragraphs."""
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))
