"""From words on a command line to a command, or to a sentence about what is wrong with them."""

from __future__ import annotations

import contextlib
import difflib
import io
import itertools
import types
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import tyro
from tyro.conf import FlagCreatePairsOff, Positional
from tyro.constructors import (
    ConstructorRegistry,
    PrimitiveConstructorSpec,
    PrimitiveTypeInfo,
    UnsupportedTypeAnnotationError,
)

from difftetvr.cli.arguments import Argument, arguments_of, settings_of
from difftetvr.errors import FitError, listed

_NONE = "None"
_IN_WORDS = {int: "a whole number", float: "a number", str: "a name or a path", Path: "a path"}


def parse(kind: type, name: str, args: Sequence[str], default: Any = None) -> Any:
    """A command from arguments.

    Args:
        kind: Its dataclass.
        name: What it is called on the command line.
        args: The arguments after that.
        default: Holds the values of options that are not given, ``tyro.MISSING`` where they must be; None: as declared.

    Raises:
        FitError: An argument is not valid, or one is missing.
    """
    # With pairs (--move, --no-move) where options come from a file: it may say either, and arguments must turn it.
    settings = (FlagCreatePairsOff,) if default is None else ()
    words = _positionals_first(kind, args)
    registry = ConstructorRegistry()
    registry.primitive_rule(_union)
    registry.primitive_rule(_text)
    program = f"difftetvr {name}"
    try:
        # What tyro prints of a mistake is drawn for developers, in a box.
        with contextlib.redirect_stderr(io.StringIO()):
            return tyro.cli(kind, prog=program, args=words, default=default, config=settings, registry=registry)
    except SystemExit as leave:
        if not leave.code:
            raise  # It has printed what completes commands in a shell.
        with registry:
            raise FitError(_mistake(program, list(arguments_of(kind, default)), words, default is not None)) from None


def parse_if_valid(kind: type, name: str, args: Sequence[str], default: Any) -> Any | None:
    """As `parse` does; None where that raises an error, for whoever parses again and will say it."""
    try:
        return parse(kind, name, args, default)
    except FitError:
        return None


def _mistake(program: str, arguments: list[Argument], words: Sequence[str], pairs: bool) -> str:
    """A sentence about the first of the words that cannot be understood, or about what is missing.

    Args:
        program: What is called.
        arguments: What it takes.
        words: What it was given.
        pairs: Whether what is on or off may be turned both ways.
    """
    places = [argument for argument in arguments if Positional in argument.notes]
    options = {flag: a for a in arguments if a not in places for flag in a.flags(pairs)}
    left, missing = list(words), [argument for argument in arguments if argument.is_required]
    while left:
        flag, has_value, value = left.pop(0).partition("=")
        if flag.startswith("-") and not _is_number(flag):
            flag = flag.replace("_", "-")
            argument = options.get(flag)
            if argument is None:
                return _unknown(program, flag, list(options))
            values = [value] if has_value else _values(argument, left, options)
        elif places:
            flag += has_value + value
            argument, values = places[0], [flag]
            if not _takes_any(argument):
                del places[0]
        else:
            return f"'{flag}' is one argument too many; see '{program} --help'."
        if not _is_valid(argument, values):
            return _wrong(argument, values)
        missing = [other for other in missing if other is not argument]
    if missing:
        return f"'{program}' needs {listed([_shown(argument) for argument in missing])}; see '{program} --help'."
    return f"These arguments cannot be understood; see '{program} --help'."


def _unknown(program: str, flag: str, flags: list[str]) -> str:
    alike = difflib.get_close_matches(flag, flags, 1)
    hint = f" (is it '{alike[0]}'?)" if alike else ""
    return f"There is no option '{flag}'{hint}; see '{program} --help'."


def _values(argument: Argument, left: list[str], options: dict[str, Argument]) -> list[str]:
    """Takes the words of an option's value from those that are left."""
    counts = [0] if argument.declared is bool else _counts(_spec(argument))
    most = len(left) if "*" in counts else max(count for count in counts if isinstance(count, int))
    end = next((i for i, word in enumerate(left[:most]) if word.partition("=")[0] in options), most)
    values = left[:end]
    del left[:end]
    return values


def _is_valid(argument: Argument, values: list[str]) -> bool:
    if argument.declared is bool:
        return not values
    spec = _spec(argument)
    try:
        return _fits(values, spec) and spec.instance_from_str(values) is not tyro.MISSING
    except ValueError:
        return False


def _wrong(argument: Argument, values: list[str]) -> str:
    subject = _shown(argument) if Positional in argument.notes else f"--{argument.name}"
    if argument.declared is bool:
        return f"{subject} takes no value; leave out '{' '.join(values)}'."
    given = f"is '{' '.join(values)}'" if values else "has no value"
    return f"{subject} {given}; give {_in_words(argument.declared)}."


def _shown(argument: Argument) -> str:
    """An argument as the help shows it."""
    metavar = next((note.metavar for note in settings_of(argument.notes) if note.metavar), None)
    if Positional in argument.notes:
        return metavar or argument.name.upper()
    return f"--{argument.name}" + (f" {metavar}" if metavar else "")


def _in_words(declared: Any) -> str:
    """What a value of a type may be."""
    origin, parts = typing.get_origin(declared), typing.get_args(declared)
    if origin in (typing.Union, types.UnionType):
        words = [word for part in parts if part is not types.NoneType for word in _alternatives(part)]
        return listed(words, "or")
    if origin is Literal:
        return f"one of {', '.join(_alternatives(declared))}"
    if origin is tuple and parts[-1] is Ellipsis:
        return f"one or more, each {_in_words(parts[0])}"
    if origin is tuple:
        return f"{len(parts)} {'whole numbers' if parts[0] is int else 'numbers'}"
    return _IN_WORDS.get(declared, "another value")


def _alternatives(declared: Any) -> list[str]:
    is_literal = typing.get_origin(declared) is Literal
    return [str(choice) for choice in typing.get_args(declared)] if is_literal else [_in_words(declared)]


def _spec(argument: Argument) -> PrimitiveConstructorSpec[Any]:
    """How a value is made of words."""
    spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(argument.declared, set(argument.notes)))
    assert isinstance(spec, PrimitiveConstructorSpec)
    return spec


def _takes_any(argument: Argument) -> bool:
    return "*" in _counts(_spec(argument))


def _counts(spec: PrimitiveConstructorSpec[Any]) -> tuple[int | Literal["*"], ...]:
    """Numbers of words that a value may have."""
    return spec.nargs if isinstance(spec.nargs, tuple) else (spec.nargs,)


def _positionals_first(kind: type, args: Sequence[str]) -> list[str]:
    """Arguments in an order in which options that take one word or several cannot take positional ones for theirs."""
    several = {f"--{a.name}": count for a in arguments_of(kind) if (count := _several(a.declared))}
    left = list(args)
    moved: list[str] = []
    for at in reversed([i for i, word in enumerate(left) if word in several]):
        numbers = list(itertools.takewhile(_is_number, left[at + 1 : at + 1 + several[left[at]]]))
        words = max(1, len(numbers))
        moved[:0] = left[at : at + 1 + words]
        del left[at : at + 1 + words]
    return left + moved


def _several(declared: Any) -> int:
    """Numbers that an option takes which may also be one word; 0 for all others."""
    parts = typing.get_args(declared) if typing.get_origin(declared) in (typing.Union, types.UnionType) else ()
    return max((len(typing.get_args(part)) for part in parts if typing.get_origin(part) is tuple), default=0)


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _union(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | UnsupportedTypeAnnotationError | None:
    """A value of one of several types, plainly described.

    None, with which options that a file gives are left open again, is taken but not mentioned.
    """
    if info.type_origin not in (typing.Union, types.UnionType):
        return None
    specs = []
    for part in typing.get_args(info.type):
        spec = ConstructorRegistry.get_primitive_spec(PrimitiveTypeInfo.make(part, info.markers))
        if not isinstance(spec, PrimitiveConstructorSpec):
            return spec
        specs.append(spec)
    # None comes first: a text or a path could be made of it as well.
    specs.sort(key=lambda spec: spec.choices != (_NONE,))
    metavar = "|".join(spec.metavar.strip("{}").replace(",", "|") for spec in specs if spec.choices != (_NONE,))

    def value_of(words: list[str]) -> Any:
        for spec in specs:
            with contextlib.suppress(ValueError):
                if _fits(words, spec):
                    return spec.instance_from_str(words)
        raise ValueError(f"give {metavar}")

    def spec_of(value: Any) -> PrimitiveConstructorSpec[Any]:
        return next(spec for spec in specs if spec.is_instance(value))

    counts = {count for spec in specs for count in _counts(spec)}
    numbers = sorted(count for count in counts if count != "*")
    return PrimitiveConstructorSpec(
        nargs="*" if "*" in counts else numbers[0] if len(numbers) == 1 else tuple(numbers),
        metavar=metavar,
        instance_from_str=value_of,
        is_instance=lambda value: any(spec.is_instance(value) for spec in specs),
        str_from_instance=lambda value: spec_of(value).str_from_instance(value),
        choices=sum((spec.choices or () for spec in specs), ()) if all(spec.choices for spec in specs) else None,
    )


def _fits(words: list[str], spec: PrimitiveConstructorSpec[Any]) -> bool:
    """Whether words can be a value, by their number and the choices there are."""
    counts = _counts(spec)
    return (len(words) in counts or "*" in counts) and (spec.choices is None or set(words) <= set(spec.choices))


def _text(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    """A text or a path, which is not empty: an empty path would be the current folder."""
    kind = info.type
    if kind not in (str, Path):
        return None

    def value_of(words: list[str]) -> Any:
        if not words[0]:
            raise ValueError("give a text")
        return kind(words[0])

    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=_IN_WORDS[kind],
        instance_from_str=value_of,
        is_instance=lambda value: isinstance(value, kind),
        str_from_instance=lambda value: [str(value)],
    )
