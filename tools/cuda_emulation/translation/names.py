"""What names and operands of a kernel are in C. A register holds bits in an unsigned integer of its size."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from cuda_emulation.translation.source import SIZES, Array, Brace, KernelSource, Label, Registers

UNSIGNED = {1: "uint8_t", 2: "uint16_t", 4: "uint32_t", 8: "uint64_t"}
SIGNED = {1: "int8_t", 2: "int16_t", 4: "int32_t", 8: "int64_t"}

_SPECIAL = {
    "WARP_SZ": "32u",
    "%laneid": "t->lane",
    "%lanemask_eq": "(1u << t->lane)",
    "%lanemask_lt": "((1u << t->lane) - 1u)",
    "%lanemask_le": "((2u << t->lane) - 1u)",
    "%lanemask_gt": "(~((2u << t->lane) - 1u))",
    "%lanemask_ge": "(~((1u << t->lane) - 1u))",
    **{
        f"%{name}.{axis}": f"t->{name}[{k}]"
        for name in ("tid", "ntid", "ctaid", "nctaid")
        for k, axis in enumerate("xyz")
    },
}


@dataclass
class Scope:
    """Names between two braces."""

    number: int
    registers: dict[str, int] = field(default_factory=dict)


class Names:
    """The names of a kernel, as far as they are known where the translation has arrived.

    Attributes:
        used: Size of each variable in C that stands for a register.
        arrays: Local arrays by name.
        shared_bytes: Bytes of shared memory that the kernel itself declares.
    """

    def __init__(self, kernel: KernelSource) -> None:
        self.used: dict[str, int] = {}
        self.arrays: dict[str, Array] = {}
        self.shared_bytes = 0
        self._parameters = {parameter.name: parameter.offset for parameter in kernel.parameters}
        self._shared = dict.fromkeys(kernel.dynamic_shared, 0)
        self._scopes, self._count = [Scope(0)], 0
        self._labels = _labels_by_scope(kernel)

    def pass_brace(self, brace: Brace) -> None:
        """Enter or leave a scope."""
        if brace.opens:
            self._count += 1
            self._scopes.append(Scope(self._count))
        else:
            self._scopes.pop()

    def declare(self, registers: Registers) -> None:
        """Take note of registers."""
        self._scopes[-1].registers.update(dict.fromkeys(registers.names, registers.size))

    def declare_array(self, array: Array) -> None:
        """Take note of an array."""
        if array.space == "local":
            self.arrays[array.name] = array
            return
        self.shared_bytes = -(-self.shared_bytes // array.align) * array.align
        self._shared[array.name] = self.shared_bytes
        self.shared_bytes += array.size * array.count

    def label(self, name: str) -> str:
        """A label in C."""
        for scope in reversed(self._scopes):
            if name in self._labels[scope.number]:
                return f"L{scope.number}_{c_name(name)}"
        raise NotImplementedError(f"label {name}")

    def register(self, name: str) -> str:
        """A register in C."""
        for scope in reversed(self._scopes):
            if name in scope.registers:
                variable = f"{c_name(name)}_{scope.number}"
                self.used[variable] = scope.registers[name]
                return variable
        raise NotImplementedError(f"register {name}")

    def bits(self, operand: str, kind: str = "b32") -> str:
        """C expression of an operand's bits."""
        if operand in _SPECIAL:
            return _SPECIAL[operand]
        if operand.startswith("!"):
            return f"(!{self.bits(operand[1:], kind)})"
        if operand in self._shared:
            return f"{self._shared[operand]}u"
        if operand in self.arrays:
            return f"((uint64_t) (uintptr_t) {c_name(operand)})"
        if operand in self._parameters:
            return f"((uint64_t) (uintptr_t) (t->params + {self._parameters[operand]}))"
        return _literal(operand, kind) or self.register(operand)

    def value(self, operand: str, kind: str) -> str:
        """C expression of an operand as a number of its type."""
        bits = self.bits(operand, kind)
        if kind in ("f32", "f64"):
            return f"{'F' if kind == 'f32' else 'D'}({bits})"
        if kind[0] == "f":
            raise NotImplementedError(f"numbers of type {kind}")
        return f"({(SIGNED if kind[0] == 's' else UNSIGNED)[SIZES[kind]]}) ({bits})"

    def address(self, operand: str, space: str) -> str:
        """C expression of the place that ``[register + offset]`` or ``array[register]`` names."""
        if element := re.match(r"^([A-Za-z_$][\w$]*)\[(.*)\]$", operand):
            size = self.arrays[element[1]].size
            return f"((uint8_t *) {c_name(element[1])} + {size}ull * {self.bits(element[2], 'u32')})"
        match = re.match(r"^\[\s*([^+\s]+)\s*(?:\+\s*(-?\w+))?\s*\]$", operand)
        if match is None:
            raise NotImplementedError(f"address {operand}")
        base, offset = match[1], int(match[2] or "0", 0)
        if base in self._parameters:
            return f"(t->params + {self._parameters[base] + offset})"
        if space == "shared":
            return f"(t->shared + (uint32_t) {self.bits(base, 'u64')} + {offset})"
        return f"((uint8_t *) (uintptr_t) {self.bits(base, 'u64')} + {offset})"


def c_name(name: str) -> str:
    """A name with letters of C only."""
    return re.sub(r"\W", "_", name.replace("%", "r_").replace("$", "d_"))


def _literal(text: str, kind: str) -> str | None:
    if re.match(r"^0[fF][0-9a-fA-F]{8}$", text):
        return f"0x{text[2:]}u"
    if re.match(r"^0[dD][0-9a-fA-F]{16}$", text):
        return f"0x{text[2:]}ull"
    if re.match(r"^-?\d+\.\d*$", text):
        return f"BD({text})" if kind == "f64" else f"B({text}f)"
    if re.match(r"^-?(0x[0-9a-fA-F]+|\d+)U?$", text):
        size = SIZES[kind]
        bits = int(text.rstrip("U"), 0) & ((1 << (8 * size)) - 1)
        return f"0x{bits:x}{'ull' if size == 8 else 'u'}"
    return None


def _labels_by_scope(kernel: KernelSource) -> dict[int, set[str]]:
    """Names of labels by the number of their scope; jumps may go to labels further down."""
    labels: dict[int, set[str]] = {0: set()}
    stack = [0]
    for item in kernel.body:
        if isinstance(item, Brace) and item.opens:
            stack.append(len(labels))
            labels[stack[-1]] = set()
        elif isinstance(item, Brace):
            stack.pop()
        elif isinstance(item, Label):
            labels[stack[-1]].add(item.name)
    return labels
