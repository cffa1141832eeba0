"""Arrays of integers as text in a page: differences, split into bytes, deflated, in base64 (NumPy)."""

from __future__ import annotations

import base64
import json
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]


@dataclass
class Pack:
    """Arrays by name, and what a script has to know of them.

    Attributes:
        header: What becomes JSON, besides the arrays.
        arrays: What becomes JSON for each array.
        parts: Their bytes, in order.
    """

    header: dict[str, Any]
    arrays: list[dict[str, Any]] = field(default_factory=list)
    parts: list[bytes] = field(default_factory=list)

    def add(self, name: str, values: Integers, width: int, *, differences: bool = False, **notes: Any) -> None:
        """Adds an array.

        The bytes of a column are all lowest ones, then all second ones and so on, which deflate packs better.

        Args:
            name: How the script calls it.
            values: (N,) or (N, C) integers in [0, 256^width).
            width: Bytes of a value.
            differences: Store the difference of each value from the one above, those that are not negative as even
                numbers and the others as odd ones. They take a byte more, which is zero nearly everywhere.
            notes: What else the script has to know of it.
        """
        columns = values.reshape(len(values), -1).T
        stored_width = width
        if differences:
            steps = np.diff(columns, axis=1, prepend=0)
            columns, stored_width = np.where(steps < 0, -2 * steps - 1, 2 * steps), width + 1
        entry = {"name": name, "rows": len(values), "columns": len(columns), "width": stored_width}
        self.arrays.append({**entry, "differences": differences, **notes})
        for column in columns:
            for byte in range(stored_width):
                self.parts.append(((column >> (8 * byte)) & 0xFF).astype(np.uint8).tobytes())

    def text(self) -> str:
        """All of it: deflated (zlib) in base64. Four bytes hold the length of the JSON that comes first."""
        header = json.dumps({**self.header, "arrays": self.arrays}, allow_nan=False).encode()
        content = b"".join([len(header).to_bytes(4, "little"), header, *self.parts])
        return base64.b64encode(zlib.compress(content, 9)).decode("ascii")
