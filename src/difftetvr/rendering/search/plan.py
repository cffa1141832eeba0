"""What is looked for along rays before light is gathered: planned by the host, found by kernels, and waited for once.

A plan knows what does not depend on where vertices are, so that laying out a mesh and the search in it are one
recording; what the host has to hear of it comes in one array.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import drjit as dr

from difftetvr.rendering.search.hits import Settle, Visit
from difftetvr.rendering.search.pencils import Pencils
from difftetvr.rendering.search.scene import Scene


class Search(Protocol):
    """Goes through what rays meet."""

    scene: Scene

    def for_each(self, visit: Visit, settle: Settle) -> None:
        """Call ``visit`` for all half-faces that are looked for, ``settle`` after each kernel's worth of them."""
        ...


@dataclass
class Counts:
    """How much there is.

    Attributes:
        count: (N,) of each ray, or each lane.
        half_faces: (N,) one of what each has, which is all where none has more; None where lists are made anyhow.
        most: (1,) the greatest number.
        total: (1,) the sum of the numbers.
    """

    count: Any
    half_faces: Any | None
    most: Any
    total: Any

    @staticmethod
    def of(count: Any, half_faces: Any | None) -> Counts:
        """From what each ray has, of one at least; a total of 2^32 and more runs over."""
        most, total = dr.max(count), dr.sum(count)
        dr.eval(most, total)
        return Counts(count, half_faces, most, total)


@dataclass
class Around:
    """Cells around the one point where rays begin.

    Attributes:
        cells: (capacity,) the cells, in any order.
        count: (1,) their number, which may be greater than the capacity.
    """

    cells: Any
    count: Any

    @property
    def held(self) -> Any:
        """How many of them there was room for."""
        uint, room = type(self.cells), dr.width(self.cells)
        count = dr.gather(uint, self.count, uint(0))
        return dr.select(count < room, count, room)


@dataclass
class Found:
    """What kernels found by a plan.

    Attributes:
        counts: How much it is.
        around: The cells around where rays begin; None where there is no one point.
        boxes: Of the hierarchies that were built.
        sorting: By what cells are sorted, and where they are seen; None where they are not.
        flags: (1,) bits, few, to which the plan gives a meaning; None for none.
        pencils: What neighbouring rays may meet; None where nobody looked for it.
    """

    counts: Counts
    around: Around | None
    boxes: list[Any]
    sorting: tuple[Any, Any] | None = None
    flags: Any | None = None
    pencils: Pencils | None = None


@dataclass(frozen=True)
class Told:
    """What the host hears of it.

    Attributes:
        most: The greatest number that a ray has.
        total: The sum of all numbers.
        around: How many cells there are around where rays begin.
        sees_all: Whether no ray begins or ends near the mesh, so that limits do not matter.
        flags: See :class:`Found`.
    """

    most: int
    total: int
    around: int
    sees_all: bool
    flags: int


class SearchPlan(Protocol):
    """What to look for, and in what."""

    @property
    def capacity(self) -> int:
        """How many cells around the one point there is room for."""
        ...

    @property
    def sees_all(self) -> Any | None:
        """Flags, of which the first is 1 if no ray begins or ends near the mesh, else 0; None if nobody asks."""
        ...

    def find(self, scene: Scene, extent: Any) -> Found:
        """Look for it, for :func:`difftetvr.recording.replayed`, with vertices of some extent."""
        ...

    def settled(self, scene: Scene, found: Found, told: Told) -> Any:
        """What the tracer needs to know of it."""
        ...
