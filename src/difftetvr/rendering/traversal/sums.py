"""Sums that many rays add to (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from difftetvr.backend import Backend


@dataclass
class Copies:
    """Where the copies of a buffer are, in device values: kernels are the same for all lengths of it.

    Attributes:
        count: Number of copies.
        lane: Numbers of the floats of one copy.
        floats: How many these are.
        records: How many records.
    """

    count: int
    lane: Any
    floats: Any
    records: Any

    @staticmethod
    def of(backend: Backend, count: int, floats: int, width: int) -> Copies | None:
        """So many copies of some floats in records of some width; None where there is but one."""
        if count == 1:
            return None
        return Copies(count, backend.lanes(floats), backend.constant(floats), backend.constant(floats // width))


@dataclass
class Sums:
    """A flat buffer of records.

    Attributes:
        buffer: The records of all copies.
        copies: Where these are; None where there is one for all.
        copy: Which one each lane adds to.
        mode: How additions to one record are reduced.
    """

    buffer: Any
    copies: Copies | None
    copy: Any | None
    mode: dr.ReduceMode

    @staticmethod
    def zeros(backend: Backend, floats: int, copies: Copies | None, mode: dr.ReduceMode) -> Sums:
        """Nothing yet, so many floats in each copy."""
        count = 1 if copies is None else copies.count
        return Sums(dr.zeros(backend.Float, count * floats), copies, None, mode)

    def of_copy(self, copy: Any | None) -> Sums:
        """The same for lanes that each add to a copy of their own."""
        return replace(self, copy=copy)

    def add(self, record: Any, index: Any, active: Any = True) -> None:
        """Add a packet to a record: of 2, 4, 8 or 16 floats, for others Dr.Jit takes several times as long."""
        if self.copies is not None:
            index = dr.fma(self.copy, self.copies.records, index)
        dr.scatter_add(self.buffer, record, index, active, mode=self.mode)

    def total(self) -> Any:
        """The sums of all copies, one after the other."""
        if self.copies is None:
            return self.buffer
        real, place = type(self.buffer), self.copies.lane
        total = dr.gather(real, self.buffer, place)
        for _ in range(1, self.copies.count):
            place = place + self.copies.floats
            total += dr.gather(real, self.buffer, place)
        return total


def raise_to(backend: Backend, numbers: Any, value: Any, place: int) -> None:
    """Raise one of some numbers to the greatest value that any lane has."""
    mode = dr.ReduceMode.Expand if backend.name == "llvm" else dr.ReduceMode.Auto
    dr.scatter_reduce(dr.ReduceOp.Max, numbers, value, backend.UInt(place), mode=mode)
