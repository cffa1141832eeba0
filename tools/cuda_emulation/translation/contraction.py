"""Fused multiplications and additions, where ptxas may make them of separate ones.

It does so (``-fmad=true``) with what PTX leaves open, that is without ``.rn``; here within blocks without jumps.
Results must not depend on it: where a sign matters, kernels of the project ask for the fused operation themselves.
"""

from __future__ import annotations

import re

from cuda_emulation.translation.names import Names
from cuda_emulation.translation.source import Instruction

Product = tuple[str, str, str]  # type, factors


class Contraction:
    """Remembers products, and what becomes of sums with them."""

    def __init__(self, names: Names) -> None:
        self._names = names
        self._products: dict[str, Product] = {}

    def forget(self) -> None:
        """At a label: other code may come in."""
        self._products = {}

    def fused(self, instruction: Instruction) -> str | None:
        """Code of a sum as a fused one; None for other instructions, which it remembers if they are products."""
        is_open = instruction.kind in ("f32", "f64") and not instruction.has("rn") and instruction.guard is None
        code = self._sum(instruction) if is_open and instruction.operation in ("add", "sub") else None
        if instruction.operation in ("bra", "ret", "exit"):
            self.forget()
        elif instruction.operation not in ("st", "red") and instruction.operands:
            for target in re.findall(r"%\w+", instruction.operands[0]):
                self._overwrite(target)
        if is_open and instruction.operation == "mul" and instruction.operands[0] not in instruction.operands[1:]:
            target, one, other = instruction.operands
            self._products[target] = (instruction.kind, one, other)
        return code

    def _overwrite(self, target: str) -> None:
        self._products.pop(target, None)
        self._products = {name: product for name, product in self._products.items() if target not in product[1:]}

    def _sum(self, instruction: Instruction) -> str | None:
        kind, (target, one, other) = instruction.kind, instruction.operands
        bits = [self._names.bits(operand, kind) for operand in (one, other)]
        is_difference = instruction.operation == "sub"
        for place, operand in enumerate((one, other)):
            product = self._products.get(operand)
            if product is None or product[0] != kind:
                continue
            a, b = (self._names.bits(factor, kind) for factor in product[1:])
            addend = bits[1 - place]
            if is_difference and place == 0:
                addend = _negative(kind, addend)
            elif is_difference:
                a = _negative(kind, a)
            return f"{self._names.register(target)} = {_fused(kind, a, b, addend)};"
        return None


def _negative(kind: str, bits: str) -> str:
    return f"neg_ftz({bits})" if kind == "f32" else f"BD(-D({bits}))"


def _fused(kind: str, a: str, b: str, c: str) -> str:
    return f"fma_ftz({a}, {b}, {c})" if kind == "f32" else f"BD(fma(D({a}), D({b}), D({c})))"
