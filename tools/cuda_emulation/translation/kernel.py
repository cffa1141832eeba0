"""A kernel as a C function that runs one thread."""

from __future__ import annotations

from collections.abc import Callable

from cuda_emulation.translation.arithmetic import arithmetic, compare, convert, copy_sign, function
from cuda_emulation.translation.contraction import Contraction
from cuda_emulation.translation.memory import atomic, load, store
from cuda_emulation.translation.names import UNSIGNED, Names, c_name
from cuda_emulation.translation.source import (
    SIZES,
    Array,
    Brace,
    Instruction,
    KernelSource,
    Label,
    Registers,
    split_operands,
)

_IN_C = {"and": "&", "or": "|", "xor": "^"}
_BIT_FUNCTIONS = {"clz": "clz32", "brev": "brev32", "prmt": "prmt", "bfe": "bfe_u32"}
_WITHOUT_EFFECT = ("membar", "fence", "nanosleep", "prefetch")


class Kernel:
    """Translates a kernel."""

    def __init__(self, source: KernelSource, contracts: bool) -> None:
        """Translate.

        Args:
            source: The kernel.
            contracts: Whether multiplications and additions are fused as ptxas may do it.
        """
        self.source, self.names = source, Names(source)
        self.contraction = Contraction(self.names) if contracts else None
        self.sites, self.cooperation = 0, "ALONE"
        self.lines = [line for item in source.body if (line := self._item(item))]

    def code(self) -> str:
        """The function, and the entry that describes the kernel to the driver."""
        name = c_name(self.source.name)
        lines = [f"static void run_{name}(Thread *t) {{"]
        lines += [f"    {UNSIGNED[size]} {variable} = 0;" for variable, size in sorted(self.names.used.items())]
        for array in self.names.arrays.values():
            declared = f"{UNSIGNED[array.size]} {c_name(array.name)}[{array.count}]"
            lines.append(f"    {declared} __attribute__((aligned({array.align})));")
            lines.append(f"    memset({c_name(array.name)}, 0xCD, sizeof {c_name(array.name)});")
        lines += [f"    {line}" for line in self.lines]
        parameters = self.source.parameters
        offsets = ", ".join(str(parameter.offset) for parameter in parameters)
        sizes = ", ".join(str(parameter.size) for parameter in parameters)
        bytes_ = max((parameter.offset + parameter.size for parameter in parameters), default=0)
        description = f"offsets_{name}, sizes_{name}, {bytes_}, {self.names.shared_bytes}, {self.cooperation}"
        return "\n".join(
            [
                *lines,
                "}",
                f"static const uint32_t offsets_{name}[] = {{{offsets}}}, sizes_{name}[] = {{{sizes}}};",
                f"const Entry entry_{self.source.name} = {{run_{name}, {len(parameters)}, {description}}};",
            ]
        )

    def _item(self, item: Instruction | Label | Brace | Registers | Array) -> str:
        if isinstance(item, Instruction):
            return self._instruction(item)
        if isinstance(item, Label):
            if self.contraction:
                self.contraction.forget()
            return f"{self.names.label(item.name)}:;"
        if isinstance(item, Brace):
            self.names.pass_brace(item)
        elif isinstance(item, Registers):
            self.names.declare(item)
        else:
            self.names.declare_array(item)
        return ""

    def _instruction(self, instruction: Instruction) -> str:
        fused = self.contraction.fused(instruction) if self.contraction else None
        render = _RENDERERS.get(instruction.operation)
        if render is None:
            raise NotImplementedError(instruction.text)
        code = fused or render(self, instruction)
        return f"if ({self.names.bits(instruction.guard)}) {{ {code} }}" if instruction.guard else code

    def jump(self, instruction: Instruction) -> str:
        """``bra``."""
        return f"goto {self.names.label(instruction.operands[0])};"

    def move(self, instruction: Instruction) -> str:
        """``mov`` of registers, and of the parts of one into others or back."""
        names, kind = self.names, instruction.kind
        target, source = instruction.operands
        if target.startswith("{") and source.startswith("{"):
            raise NotImplementedError(instruction.text)
        if target.startswith("{"):
            targets = split_operands(target[1:-1])
            bytes_ = SIZES[kind] // len(targets)
            shifts = [
                f"({UNSIGNED[bytes_]}) ({names.bits(source, kind)} >> {8 * k * bytes_})" for k in range(len(targets))
            ]
            return " ".join(f"{names.register(x)} = {part};" for x, part in zip(targets, shifts))
        if source.startswith("{"):
            sources = split_operands(source[1:-1])
            bytes_, whole = SIZES[kind] // len(sources), UNSIGNED[SIZES[kind]]
            parts = [
                f"(({whole}) ({UNSIGNED[bytes_]}) {names.bits(x)} << {8 * k * bytes_})" for k, x in enumerate(sources)
            ]
            return f"{names.register(target)} = {' | '.join(parts)};"
        return f"{names.register(target)} = {names.bits(source, kind)};"

    def select(self, instruction: Instruction) -> str:
        """``selp``."""
        target, one, other, predicate = instruction.operands
        one, other = (self.names.bits(x, instruction.kind) for x in (one, other))
        return f"{self.names.register(target)} = {self.names.bits(predicate)} ? {one} : {other};"

    def logic(self, instruction: Instruction) -> str:
        """``and``, ``or``, ``xor`` and ``not``."""
        target, *operands = instruction.operands
        bits = [self.names.bits(x, instruction.kind) for x in operands]
        if instruction.operation == "not":
            return f"{self.names.register(target)} = {'!' if instruction.kind == 'pred' else '~'}{bits[0]};"
        return f"{self.names.register(target)} = {bits[0]} {_IN_C[instruction.operation]} {bits[1]};"

    def lookup(self, instruction: Instruction) -> str:
        """``lop3``: any function of three bits, by the table of its results."""
        target, *inputs, table = instruction.operands
        a, b, c = (self.names.bits(x, instruction.kind) for x in inputs)
        terms = [
            f"({'' if k & 4 else '~'}({a}) & {'' if k & 2 else '~'}({b}) & {'' if k & 1 else '~'}({c}))"
            for k in range(8)
            if int(table, 0) >> k & 1
        ]
        return f"{self.names.register(target)} = {' | '.join(terms) or '0'};"

    def shift(self, instruction: Instruction) -> str:
        """``shl`` and ``shr``."""
        target, value, distance = instruction.operands
        kind = instruction.kind
        if SIZES[kind] < 4:
            raise NotImplementedError(instruction.text)
        name = "sar" if instruction.operation == "shr" and kind[0] == "s" else instruction.operation
        arguments = f"{self.names.bits(value, kind)}, {self.names.bits(distance, 'u32')}"
        return f"{self.names.register(target)} = {name}{8 * SIZES[kind]}({arguments});"

    def bits(self, instruction: Instruction) -> str:
        """``popc``, ``clz``, ``brev``, ``bfind``, ``bfe``, ``prmt``."""
        operation, kind = instruction.operation, instruction.kind
        target, *operands = instruction.operands
        arguments = [self.names.bits(x, kind) for x in operands]
        if operation == "popc":
            name = f"__builtin_popcount{'ll' if SIZES[kind] == 8 else ''}"
        elif operation == "bfind":
            name, arguments = "bfind32", [*arguments, str(int(instruction.has("shiftamt")))]
        else:
            name = _BIT_FUNCTIONS[operation]
        if operation != "popc" and (SIZES[kind] != 4 or kind[0] == "s"):
            raise NotImplementedError(instruction.text)
        return f"{self.names.register(target)} = {name}({', '.join(arguments)});"

    def collective(self, instruction: Instruction) -> str:
        """``activemask``, ``match``, ``vote``, ``shfl`` and barriers."""
        names, operation = self.names, instruction.operation
        target, *operands = instruction.operands or ("",)
        bits = [names.bits(x) for x in operands]
        predicate = ""
        if operation == "activemask":
            name, mask, values = "ACTIVE_MASK", "0", []
        elif operation == "match" and instruction.has("any"):
            name, mask, values = "MATCH_ANY", bits[1], bits[:1]
        elif operation == "vote":
            name, mask, values = f"VOTE_{instruction.parts[2].upper()}", bits[1], bits[:1]
        elif operation == "shfl":
            name, mask, values = f"SHFL_{instruction.parts[2].upper()}", bits[3], bits[:3]
            target, _, predicate = target.partition("|")
        elif operation == "bar" and instruction.has("warp"):
            name, mask, values, target = "BAR_WARP", names.bits(target), [], ""
        elif operation in ("bar", "barrier") and not instruction.has("warp"):
            name, mask, values, target = "BAR_BLOCK", "0", [], ""
        else:
            raise NotImplementedError(instruction.text)
        self.sites += 1
        if self.cooperation != "IN_BLOCKS":
            self.cooperation = "IN_BLOCKS" if name == "BAR_BLOCK" else "IN_WARPS"
        where = f"&{names.register(predicate)}" if predicate else "NULL"
        call = f"t->collective(t, {self.sites}, {name}, (Operands) {{{', '.join([mask, *values])}}}, {where});"
        return f"{names.register(target)} = {call}" if target else call


Renderer = Callable[[Kernel, Instruction], str]


def _with_names(render: Callable[[Names, Instruction], str]) -> Renderer:
    return lambda kernel, instruction: render(kernel.names, instruction)


_RENDERERS: dict[str, Renderer] = {
    **dict.fromkeys(("ret", "exit"), lambda kernel, instruction: "return;"),
    **dict.fromkeys(_WITHOUT_EFFECT, lambda kernel, instruction: ";"),
    "trap": lambda kernel, instruction: "abort();",
    "bra": Kernel.jump,
    **dict.fromkeys(("mov", "cvta"), Kernel.move),
    "selp": Kernel.select,
    "lop3": Kernel.lookup,
    **dict.fromkeys(("and", "or", "xor", "not"), Kernel.logic),
    **dict.fromkeys(("shl", "shr"), Kernel.shift),
    **dict.fromkeys(("popc", "clz", "brev", "bfind", "bfe", "prmt"), Kernel.bits),
    **dict.fromkeys(("activemask", "match", "vote", "shfl", "bar", "barrier"), Kernel.collective),
    **dict.fromkeys(
        ("add", "sub", "mul", "fma", "mad", "div", "rem", "neg", "abs", "min", "max"), _with_names(arithmetic)
    ),
    **dict.fromkeys(("rcp", "sqrt", "rsqrt", "ex2", "lg2"), _with_names(function)),
    "copysign": _with_names(copy_sign),
    "cvt": _with_names(convert),
    "setp": _with_names(compare),
    **dict.fromkeys(("ld", "ldu"), _with_names(load)),
    "st": _with_names(store),
    **dict.fromkeys(("atom", "red"), _with_names(atomic)),
}
"""How instructions become C, by the operation."""
