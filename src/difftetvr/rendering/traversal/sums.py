"""Sums that many rays add to (Dr.Jit)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from difftetvr.backend import Backend


@dataclass
class Sums:
    """A flat buffer of records.

    Attributes:
        buffer: The records of all copies.
        records: Records of one copy.
        copy: Which copy each lane adds to; None where there is one for all.
        mode: How additions to one record are reduced.
    """

    buffer: Any
    records: int
    copy: Any | None
    mode: dr.ReduceMode

    @staticmethod
    def zeros(backend: Backend, floats: int, records: int, copies: int, mode: dr.ReduceMode) -> Sums:
        """Nothing yet, so many floats and records in each copy."""
        return Sums(dr.zeros(backend.Float, copies * floats), records, None, mode)

    def of_copy(self, copy: Any | None) -> Sums:
        """The same for lanes that each add to a copy of their own."""
        return replace(self, copy=copy)

    def add(self, record: Any, index: Any, active: Any = True) -> None:
        """Add a float or a packet to a record."""
        if self.copy is not None:
            index = self.copy * self.records + index
        dr.scatter_add(self.buffer, record, index, active, mode=self.mode)

    def total(self, lane: Any | None) -> Any:
        """The sums of all copies, one after the other.

        Args:
            lane: Numbers of the floats of one copy; None where there is one.
        """
        if lane is None:
            return self.buffer
        real, floats = type(self.buffer), dr.width(lane)
        total = dr.gather(real, self.buffer, lane)
        for first in range(floats, dr.width(self.buffer), floats):
            total += dr.gather(real, self.buffer, lane + first)
        return total
