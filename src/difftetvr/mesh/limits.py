"""Sizes and shapes that no mesh may exceed: plain numbers, which options are checked against without PyTorch."""

from __future__ import annotations

from dataclasses import dataclass

from difftetvr.errors import MeshError

MAX_CELLS = 2**29 - 1
"""Largest number of cells: half-faces 4 * cell + k and incidence offsets fit int32."""

CELLS_PER_CUBE = 6
"""Tetrahedra that a cube of a grid is cut into."""

MAX_DEGREE = 3
"""Highest band of spherical harmonics that colours may have."""


@dataclass(frozen=True)
class MotionLimits:
    """What no cell may fall under when vertices move.

    Attributes:
        volume_ratio: A cell keeps at least this fraction of its volume in one move, in (0, 1).
        quality: No cell's quality Q falls below this, in [0, 1); cells that are below it already may only rise.
        halvings: How often a move is halved before it is refused altogether, 0 to 60.

    Raises:
        MeshError: A limit is out of range.
    """

    volume_ratio: float = 0.1
    quality: float = 0.05
    halvings: int = 6

    def __post_init__(self) -> None:
        if not (0 < self.volume_ratio < 1 and 0 <= self.quality < 1 and 0 <= self.halvings <= 60):
            raise MeshError(
                f"{self} is out of range; pass a volume_ratio between 0 and 1, a quality of at least 0 and below 1, "
                "and 0 to 60 halvings."
            )
