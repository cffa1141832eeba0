"""PTX as text: its kernels, and what stands in them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

SIZES = {
    **dict.fromkeys(("pred", "b8", "u8", "s8"), 1),
    **dict.fromkeys(("b16", "u16", "s16", "f16"), 2),
    **dict.fromkeys(("b32", "u32", "s32", "f32", "f16x2"), 4),
    **dict.fromkeys(("b64", "u64", "s64", "f64"), 8),
}
"""Bytes of a type."""

_LABEL = re.compile(r"\s*([A-Za-z_$%][\w$]*)\s*:(?!:)")
_ENTRY = re.compile(r"\.entry\s+([\w$]+)\s*(?:\((.*?)\))?\s*([^{;]*)\{", re.DOTALL)
_PARAMETER = re.compile(r"\.param\s*(?:\.align\s*(\d+))?\s*\.(\w+)\s+([\w$]+)(?:\[(\d+)\])?")
_DYNAMIC_SHARED = re.compile(r"\.extern\s+\.shared\s*(?:\.align\s*\d+)?\s*\.\w+\s+([\w$]+)\[\]")
_ARRAY = re.compile(r"\.(local|shared)\s*(?:\.align\s*(\d+))?\s*\.(\w+)\s+([\w$]+)(?:\[(\d+)\])?")
_REGISTERS = re.compile(r"\.reg\s*\.(\w+)\s*(.*)")
_IGNORED = (".pragma", ".loc ", ".file ", ".maxn", ".minn")


@dataclass(frozen=True)
class Instruction:
    """One instruction.

    Attributes:
        text: As it is written, for messages.
        guard: The predicate under which it is executed, perhaps behind ``!``; None for always.
        parts: Its name, split at points: operation, modifiers, type.
        operands: Its operands.
    """

    text: str
    guard: str | None
    parts: tuple[str, ...]
    operands: tuple[str, ...]

    @property
    def operation(self) -> str:
        """What it does."""
        return self.parts[0]

    @property
    def kind(self) -> str:
        """Type of its operands."""
        return self.parts[-1]

    def has(self, modifier: str) -> bool:
        """Whether its name has a part."""
        return modifier in self.parts

    def first_of(self, modifiers: tuple[str, ...], otherwise: str) -> str:
        """The first of its parts that is one of some."""
        return next((part for part in self.parts if part in modifiers), otherwise)


@dataclass(frozen=True)
class Label:
    """A place to jump to."""

    name: str


@dataclass(frozen=True)
class Brace:
    """Where names begin or cease to be known."""

    opens: bool


@dataclass(frozen=True)
class Registers:
    """Declares registers of one size."""

    size: int
    names: tuple[str, ...]


@dataclass(frozen=True)
class Array:
    """Declares an array in local or shared memory."""

    space: str
    name: str
    size: int
    count: int
    align: int


@dataclass(frozen=True)
class Parameter:
    """A parameter of a kernel, with its place in the buffer of all."""

    name: str
    offset: int
    size: int


@dataclass(frozen=True)
class KernelSource:
    """A kernel as it is written.

    Attributes:
        name: Its name.
        parameters: Its parameters.
        dynamic_shared: Names of the shared memory whose size a launch decides.
        body: What stands between its braces.
    """

    name: str
    parameters: tuple[Parameter, ...]
    dynamic_shared: tuple[str, ...]
    body: tuple[Instruction | Label | Brace | Registers | Array, ...]


def kernels_of(text: str) -> list[KernelSource]:
    """The kernels of a module."""
    text = re.sub(r"/\*.*?\*/", "", re.sub(r"//[^\n]*", "", text), flags=re.DOTALL)
    shared = tuple(match[1] for match in _DYNAMIC_SHARED.finditer(text))
    kernels, at = [], 0
    while match := _ENTRY.search(text, at):
        at = _closing_brace(text, match.end())
        body = tuple(_items(text[match.end() : at]))
        kernels.append(KernelSource(match[1], _parameters(match[2] or ""), shared, body))
    return kernels


def split_operands(text: str) -> tuple[str, ...]:
    """Operands, separated by commas that stand in no bracket."""
    parts, depth, start = [], 0, 0
    for place, character in enumerate(text):
        depth += (character in "{[(") - (character in "}])")
        if character == "," and depth == 0:
            parts.append(text[start:place].strip())
            start = place + 1
    return tuple(part for part in (*parts, text[start:].strip()) if part)


def _closing_brace(text: str, at: int) -> int:
    depth = 1
    while depth:
        depth += (text[at] == "{") - (text[at] == "}")
        at += 1
    return at - 1


def _parameters(text: str) -> tuple[Parameter, ...]:
    parameters, offset = [], 0
    for part in split_operands(text):
        match = _PARAMETER.match(part)
        if match is None:
            raise NotImplementedError(part)
        size = SIZES[match[2]]
        align = int(match[1] or size)
        offset = -(-offset // align) * align
        parameters.append(Parameter(match[3], offset, size * int(match[4] or 1)))
        offset += parameters[-1].size
    return tuple(parameters)


def _items(text: str) -> Iterator[Instruction | Label | Brace | Registers | Array]:
    at = 0
    while at < len(text):
        if text[at].isspace():
            at += 1
        elif text[at] in "{}":
            yield Brace(text[at] == "{")
            at += 1
        elif match := _LABEL.match(text, at):
            yield Label(match[1])
            at = match.end()
        else:
            end = text.index(";", at)
            statement = " ".join(text[at:end].split())
            if not statement.startswith(_IGNORED):
                yield _statement(statement)
            at = end + 1


def _statement(text: str) -> Instruction | Registers | Array:
    if match := _REGISTERS.match(text):
        names = [name.replace(" ", "") for name in match[2].split(",")]
        return Registers(SIZES[match[1]], tuple(name for spelled in names for name in _numbered(spelled)))
    if match := _ARRAY.match(text):
        size = SIZES[match[3]]
        return Array(match[1], match[4], size, int(match[5] or 1), int(match[2] or size))
    guard, rest = text[1:].split(None, 1) if text.startswith("@") else (None, text)
    name, _, operands = rest.partition(" ")
    return Instruction(text, guard, tuple(name.split(".")), split_operands(operands))


def _numbered(name: str) -> list[str]:
    """``%r<3>`` stands for ``%r0``, ``%r1``, ``%r2``."""
    match = re.match(r"(.*)<(\d+)>$", name)
    return [f"{match[1]}{number}" for number in range(int(match[2]))] if match else [name]
