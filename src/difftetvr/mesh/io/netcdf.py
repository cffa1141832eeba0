"""Whether a classic NetCDF file is whole: its library reads zeros where one was cut off.

NetCDF Classic Format Specification, Unidata: the header lists dimensions, attributes and variables, and where they
begin.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import BinaryIO

from difftetvr.mesh.io.content import damaged

_TYPE_SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 4, 6: 8, 7: 1, 8: 2, 9: 4, 10: 8, 11: 8}
_LIST_TAGS = (0, 10, 11, 12)


def require_whole(path: Path) -> None:
    """Checks that all variables of a classic file lie in it.

    Args:
        path: A file that begins with CDF.

    Raises:
        MeshError: It is cut off, or its header is damaged.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        try:
            end = _Header(file).end
        except (ValueError, LookupError, OverflowError, OSError) as error:
            raise damaged(path, "its header is damaged") from error
    if end > size:
        raise damaged(path, f"it announces {end} bytes but has only {size}")


class _Header:
    """The header of a classic file.

    Attributes:
        end: Where the last variable ends.
    """

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        version = file.read(4)[3]
        self._count_bytes, self._offset_bytes = {1: (4, 4), 2: (4, 8), 5: (8, 8)}[version]
        records = self._number(self._count_bytes)
        if records == 256**self._count_bytes - 1:  # written by a program that did not know
            records = 0
        lengths = [self._dimension() for _ in range(self._list())]
        self._attributes()
        fixed, in_records = [0], []
        for _ in range(self._list()):
            begin, shape, item = self._variable(lengths)
            if shape[:1] == [0]:
                in_records.append((begin, math.prod(shape[1:]) * item))
            else:
                fixed.append(begin + math.prod(shape) * item)
        step = sum(-(-own // 4) * 4 for _, own in in_records) if len(in_records) > 1 else sum(s for _, s in in_records)
        self.end = max(fixed + [begin + (records - 1) * step + own for begin, own in in_records if records])

    def _number(self, size: int) -> int:
        data = self._file.read(size)
        if len(data) < size:
            raise ValueError("the header ends")
        return int.from_bytes(data, "big")

    def _skip(self, size: int) -> None:
        self._file.seek(-(-size // 4) * 4, 1)

    def _list(self) -> int:
        """Number of things in a list that begins."""
        if self._number(4) not in _LIST_TAGS:
            raise ValueError("there is no list")
        return self._number(self._count_bytes)

    def _dimension(self) -> int:
        self._skip(self._number(self._count_bytes))
        return self._number(self._count_bytes)

    def _attributes(self) -> None:
        for _ in range(self._list()):
            self._skip(self._number(self._count_bytes))
            item = _TYPE_SIZES[self._number(4)]
            self._skip(item * self._number(self._count_bytes))

    def _variable(self, lengths: list[int]) -> tuple[int, list[int], int]:
        """Where a variable begins, its shape, and the size of a number in it."""
        self._skip(self._number(self._count_bytes))
        shape = [lengths[self._number(self._count_bytes)] for _ in range(self._number(self._count_bytes))]
        self._attributes()
        item = _TYPE_SIZES[self._number(4)]
        self._number(self._count_bytes)  # its size, which is too small a number for large ones
        return self._number(self._offset_bytes), shape, item
