"""Memory: loads, stores and atomics. All threads run on one core, so atomics are plain."""

from __future__ import annotations

import re

from cuda_emulation.translation.names import SIGNED, UNSIGNED, Names
from cuda_emulation.translation.source import SIZES, Instruction, split_operands

_SPACES = ("param", "global", "local", "shared", "const")
_VECTOR = re.compile(r"v(\d)$")


def load(names: Names, instruction: Instruction) -> str:
    """``ld``."""
    data, pointer = instruction.operands
    kind = instruction.kind
    size = SIZES[kind]
    lines = []
    for place, register in _places(_registers(instruction, data), size):
        loaded = f"LOAD({UNSIGNED[size]}, {place})"
        if kind[0] == "s":  # to be widened by its sign
            loaded = f"({SIGNED[size]}) {loaded}"
        lines.append(f"{names.register(register)} = {loaded};")
    return _at(names, instruction, pointer, lines)


def store(names: Names, instruction: Instruction) -> str:
    """``st``."""
    pointer, data = instruction.operands
    kind = instruction.kind
    size = SIZES[kind]
    places = _places(_registers(instruction, data), size)
    lines = [f"STORE({UNSIGNED[size]}, {place}, {names.bits(register, kind)});" for place, register in places]
    return _at(names, instruction, pointer, lines)


def atomic(names: Names, instruction: Instruction) -> str:
    """``atom``, which answers with the old value, and ``red``, which does not."""
    kind = instruction.first_of(tuple(SIZES), "")
    size = SIZES[kind]
    has_target = instruction.operation == "atom" and instruction.operands[0] != "_"
    pointer, data, *more = instruction.operands[instruction.operation == "atom" :]
    target = f"{names.register(instruction.operands[0])} = " if has_target else "(void) "
    lines = []
    for place, register in _places(_registers(instruction, data), size):
        new = _changed(names, instruction, kind, [register, *more])
        lines.append(f"{target}ATOMIC({UNSIGNED[size]}, {place}, {new});")
    return _at(names, instruction, pointer, lines)


def _changed(names: Names, instruction: Instruction, kind: str, operands: list[str]) -> str:
    """C expression of the new value, of ``old`` and operands."""
    x, *more = (names.bits(operand, kind) for operand in operands)
    operation = instruction.first_of(("add", "min", "max", "and", "or", "xor", "exch", "cas"), "")
    if operation == "add":  # of floats in memory flushes subnormal numbers
        sums = {"f32": f"add_ftz(old, {x})", "f64": f"BD(D(old) + D({x}))"}
        return sums.get(kind, f"old + {x}")
    if operation in ("min", "max") and kind[0] in "us":
        cast = f"({(SIGNED if kind[0] == 's' else UNSIGNED)[SIZES[kind]]})"
        return f"({cast} old {'<' if operation == 'min' else '>'} {cast} ({x})) ? old : {x}"
    if operation == "cas":
        return f"old == {x} ? {more[0]} : old"
    simple = {"exch": x, "and": f"old & {x}", "or": f"old | {x}", "xor": f"old ^ {x}"}
    if operation not in simple:
        raise NotImplementedError(instruction.text)
    return simple[operation]


def _registers(instruction: Instruction, data: str) -> tuple[str, ...]:
    registers = split_operands(data[1:-1]) if data.startswith("{") else (data,)
    if len(registers) != _vector_size(instruction):
        raise NotImplementedError(instruction.text)
    return registers


def _vector_size(instruction: Instruction) -> int:
    return next((int(match[1]) for match in map(_VECTOR.match, instruction.parts) if match), 1)


def _places(registers: tuple[str, ...], size: int) -> list[tuple[str, str]]:
    return [(f"p + {k * size}", register) for k, register in enumerate(registers)]


def _at(names: Names, instruction: Instruction, pointer: str, lines: list[str]) -> str:
    """Code that works at a place ``p``."""
    space = instruction.first_of(_SPACES, "global")
    size = _vector_size(instruction) * SIZES[instruction.first_of(tuple(SIZES), "")]
    check = f"ALIGNED(p, {size}); " if space in ("global", "shared") else ""
    return f"{{ uint8_t *p = (uint8_t *) {names.address(pointer, space)}; {check}{' '.join(lines)} }}"
