"""Numbers: arithmetic, approximate functions, conversions and comparisons."""

from __future__ import annotations

from cuda_emulation.translation.names import SIGNED, UNSIGNED, Names
from cuda_emulation.translation.source import SIZES, Instruction

_SYMBOLS = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
_COMPARISONS = dict(zip(("eq", "ne", "lt", "le", "gt", "ge"), ("==", "!=", "<", "<=", ">", ">=")))
_COMPARISONS |= dict(zip(("lo", "ls", "hi", "hs"), ("<", "<=", ">", ">=")))  # of unsigned integers
_UNORDERED = {"ltu": ">=", "leu": ">", "gtu": "<=", "geu": "<"}  # true unless the opposite is
_ROUNDINGS = {"rpi": "ceil", "rmi": "floor", "rni": "rint", "rzi": "trunc"}
_ONLY_APPROXIMATE = ("rcp", "sqrt", "rsqrt", "ex2", "lg2")


def arithmetic(names: Names, instruction: Instruction) -> str:
    """``add``, ``mad``, ``min`` and the like."""
    by_kind = {"f32": _of_floats, "f64": _of_doubles}
    expression = by_kind.get(instruction.kind, _of_integers)(names, instruction)
    return f"{names.register(instruction.operands[0])} = {expression};"


def _of_floats(names: Names, instruction: Instruction) -> str:
    operation, flushes = instruction.operation, instruction.has("ftz")
    bits = [names.bits(operand, "f32") for operand in instruction.operands[1:]]
    numbers = [f"F({x})" for x in bits]
    if operation in ("min", "max"):
        inputs = ", ".join(f"flushed({x})" if flushes else x for x in bits)
        found = f"{operation}_f32({inputs})"
        is_nan = " || ".join(f"{x} != {x}" for x in numbers)
        return f"(({is_nan}) ? 0x7fffffffu : {found})" if instruction.has("NaN") else found
    if operation == "abs":
        return f"{bits[0]} & 0x7fffffffu"
    if operation == "div" and instruction.has("approx"):
        return f"div_approx({', '.join(bits)})"
    if flushes and operation in ("add", "sub", "mul", "fma", "neg"):
        return f"{operation}_ftz({', '.join(bits)})"
    if operation == "fma":
        return f"B(fmaf({', '.join(numbers)}))"
    if operation == "neg":
        return f"{bits[0]} ^ 0x80000000u"
    return f"B({numbers[0]} {_symbol(instruction)} {numbers[1]})"


def _of_doubles(names: Names, instruction: Instruction) -> str:
    operation = instruction.operation
    bits = [names.bits(operand, "f64") for operand in instruction.operands[1:]]
    numbers = [f"D({x})" for x in bits]
    if operation in ("min", "max"):
        return f"{operation}_f64({', '.join(bits)})"
    if operation == "abs":
        return f"{bits[0]} & 0x7fffffffffffffffull"
    if operation == "neg":
        return f"{bits[0]} ^ 0x8000000000000000ull"
    if operation == "fma":
        return f"BD(fma({', '.join(numbers)}))"
    return f"BD({numbers[0]} {_symbol(instruction)} {numbers[1]})"


def _of_integers(names: Names, instruction: Instruction) -> str:
    operation, kind = instruction.operation, instruction.kind
    size = SIZES[kind]
    if instruction.has("wide") or instruction.has("hi"):
        return _wide_product(names, instruction)
    bits = [names.bits(operand, kind) for operand in instruction.operands[1:]]
    values = [names.value(operand, kind) for operand in instruction.operands[1:]]
    unsigned = [f"({UNSIGNED[max(size, 4)]}) ({x})" for x in bits]
    cast = f"({UNSIGNED[size]})"
    if operation in ("add", "sub", "mul"):
        return f"{cast} ({unsigned[0]} {_SYMBOLS[operation]} {unsigned[1]})"
    if operation == "mad":
        return f"{cast} ({unsigned[0]} * {unsigned[1]} + {unsigned[2]})"
    if operation == "div":
        return f"({values[1]} == 0) ? {cast} -1 : {cast} ({values[0]} / {values[1]})"
    if operation == "rem":
        return f"({values[1]} == 0) ? {cast} {bits[0]} : {cast} ({values[0]} % {values[1]})"
    if operation == "neg":
        return f"{cast} -{unsigned[0]}"
    if operation == "abs":
        return f"({values[0]} < 0) ? {cast} -{unsigned[0]} : {bits[0]}"
    if operation in ("min", "max"):
        return f"({values[0]} {'<' if operation == 'min' else '>'} {values[1]}) ? {bits[0]} : {bits[1]}"
    raise NotImplementedError(instruction.text)


def _wide_product(names: Names, instruction: Instruction) -> str:
    """The product in an integer of twice the size, or its upper half."""
    kind, operands = instruction.kind, instruction.operands
    size = SIZES[kind]
    if size == 8:
        raise NotImplementedError(instruction.text)
    table = SIGNED if kind[0] == "s" else UNSIGNED
    factors = [f"({table[2 * size]}) {names.value(operand, kind)}" for operand in operands[1:3]]
    product = f"({UNSIGNED[2 * size]}) ({factors[0]} * {factors[1]})"
    if instruction.has("hi"):
        return f"({UNSIGNED[size]}) ({product} >> {8 * size})"
    return f"{product} + {names.bits(operands[3], f'u{16 * size}')}" if len(operands) > 3 else product


def _symbol(instruction: Instruction) -> str:
    if instruction.operation not in _SYMBOLS:
        raise NotImplementedError(instruction.text)
    return _SYMBOLS[instruction.operation]


def function(names: Names, instruction: Instruction) -> str:
    """``rcp``, ``sqrt`` and the like. Of float64 there is an exact root, but none of its inverse."""
    operation, kind, is_approximate = instruction.operation, instruction.kind, instruction.has("approx")
    target, bits = names.register(instruction.operands[0]), names.bits(instruction.operands[1], kind)
    if kind == "f32" and is_approximate and operation in _ONLY_APPROXIMATE:
        return f"{target} = {operation}_approx({bits});"
    if kind == "f64" and is_approximate and operation == "rcp":
        return f"{target} = rcp_approx_f64({bits});"
    if is_approximate or operation not in ("rcp", "sqrt"):
        raise NotImplementedError(instruction.text)
    number, pack = (f"F({bits})", "B") if kind == "f32" else (f"D({bits})", "BD")
    root = "sqrtf" if kind == "f32" else "sqrt"
    return f"{target} = {pack}({f'1 / {number}' if operation == 'rcp' else f'{root}({number})'});"


def copy_sign(names: Names, instruction: Instruction) -> str:
    """``copysign``: the sign of one number and the size of another."""
    kind = instruction.kind
    sign, size = (names.bits(operand, kind) for operand in instruction.operands[1:])
    mask = {"f32": "0x80000000u", "f64": "(1ull << 63)"}[kind]
    return f"{names.register(instruction.operands[0])} = ({sign} & {mask}) | ({size} & ~{mask});"


def convert(names: Names, instruction: Instruction) -> str:
    """``cvt``. A register may be wider than the type that is read from it."""
    *_, to, of = instruction.parts
    target, operand = names.register(instruction.operands[0]), instruction.operands[1]
    flushes, rounding = instruction.has("ftz"), instruction.first_of(tuple(_ROUNDINGS), "")
    number = f"FZ({names.bits(operand, of)})" if flushes and of == "f32" else names.value(operand, of)
    if of[0] == "f" and to[0] == "f":
        number = f"{_ROUNDINGS[rounding]}((double) {number})" if rounding else f"(double) {number}"
        bits = f"B((float) ({number}))" if to == "f32" else f"BD({number})"
        return f"{target} = {f'flushed({bits})' if flushes and to == 'f32' else bits};"
    if of[0] == "f":
        if SIZES[to] < 4:
            raise NotImplementedError(instruction.text)
        rounded = f"{_ROUNDINGS[rounding or 'rzi']}((double) {number})"
        return f"{target} = to_{'s' if to[0] == 's' else 'u'}{8 * SIZES[to]}({rounded});"
    if to[0] == "f":
        return f"{target} = {f'B((float) ({number}))' if to == 'f32' else f'BD((double) ({number}))'};"
    return f"{target} = ({(SIGNED if to[0] == 's' else UNSIGNED)[SIZES[to]]}) ({number});"


def compare(names: Names, instruction: Instruction) -> str:
    """``setp``: one predicate or two, the second the opposite, each perhaps combined with a third."""
    kind, operands = instruction.kind, instruction.operands
    if instruction.has("ftz"):
        a, b = (f"FZ({names.bits(operand, kind)})" for operand in operands[1:3])
    else:
        a, b = (names.value(operand, kind) for operand in operands[1:3])
    test = _comparison(instruction, a, b)
    logic = {"and": "&", "or": "|", "xor": "^"}.get(instruction.first_of(("and", "or", "xor"), ""))
    combined = f" {logic} {names.bits(operands[3])}" if logic else ""
    first, _, second = operands[0].partition("|")
    first_code = f"{names.register(first)} = {test}{combined};" if first != "_" else ""
    if not second or second == "_":
        return first_code
    return f"{{ uint8_t opposite = !{test}{combined}; {first_code} {names.register(second)} = opposite; }}"


def _comparison(instruction: Instruction, a: str, b: str) -> str:
    comparison = instruction.parts[1]
    if instruction.kind not in ("f32", "f64"):
        return f"({a} {_COMPARISONS[comparison]} {b})"
    if comparison == "ne":  # false where there is a NaN, unlike in C
        return f"({a} < {b} || {a} > {b})"
    if comparison in _UNORDERED:
        return f"(!({a} {_UNORDERED[comparison]} {b}))"
    special = {
        "num": f"({a} == {a} && {b} == {b})",
        "nan": f"({a} != {a} || {b} != {b})",
        "equ": f"(!({a} < {b} || {a} > {b}))",
        "neu": f"(!({a} == {b}))",
    }
    return special.get(comparison) or f"({a} {_COMPARISONS[comparison]} {b})"
