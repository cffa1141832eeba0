"""Options of how vertices move."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

from difftetvr.fitting.options import LARGEST_COUNT, OptionGroup
from difftetvr.mesh.limits import MotionLimits


@dataclass(frozen=True)
class VertexOptimizerConfig(OptionGroup):
    """How vertices move. No option has a unit of length: steps are counted in altitudes.

    The altitude of a vertex is the smallest altitude of all cells around it.
    """

    rate: float = 0.1
    """Length of the first steps in altitudes, for a vertex whose gradient keeps its direction."""
    final_rate: float = 0.01
    """Length of the last steps; in between it falls log-linearly."""
    betas: tuple[float, float] = (0.9, 0.99)
    """Decay of the first and second moments of the gradient."""
    barrier: float = 0.03
    """Weight of the shape barrier, the sum of -log Q over all cells, in units of the rate; 0: none."""
    wall: float = 0.1
    """Weight of the same for cells close to the guard's floor, where it grows steeply; 0: none. With it, the
    guard hardly ever has to refuse a move, and the barrier need not spoil cells that do well to be thin."""
    cap: float = 0.15
    """Longest step in altitudes, below 0.25: then no step can invert a cell even without the guard."""
    boundary: Literal["fixed", "slide"] = "fixed"
    """Whether vertices on the boundary stay, or slide in their plane or along their crease."""
    coplanarity: float = 1e-4
    """Largest sine of the angle between boundary faces that count as one plane to slide in."""
    limits: MotionLimits = field(default_factory=MotionLimits)
    """What the guard lets no cell fall under."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("rate", "final_rate"):
            value = getattr(self, name)
            self._require(value > 0 and math.isfinite(value), name, "greater than 0 and finite")
        self._require(all(0 <= beta < 1 for beta in self.betas), "betas", "at least 0 and below 1")
        for name in ("barrier", "wall"):
            value = getattr(self, name)
            self._require(value >= 0 and math.isfinite(value), name, "at least 0 and finite")
        self._require(0 < self.cap < 0.25, "cap", "between 0 and 0.25")
        self._require(0 <= self.coplanarity < 1, "coplanarity", "at least 0 and below 1")
        self._require(self.boundary in ("fixed", "slide"), "boundary", "fixed or slide")

    def rate_at(self, progress: float) -> float:
        """Rate of a step.

        Args:
            progress: Share of the run that is done, in [0, 1].
        """
        return self.rate * (self.final_rate / self.rate) ** progress


@dataclass(frozen=True)
class Motion(VertexOptimizerConfig):
    """How vertices move in a run; unlike `VertexOptimizer` alone, it lets those on the boundary slide by default."""

    prefix = "motion."

    barrier: float = 0.01
    """Weight of the shape barrier, the sum of -log Q over all cells, in units of the rate; 0: none."""
    boundary: Literal["fixed", "slide"] = "slide"
    """Whether vertices on the boundary stay, or slide in their plane or along their crease."""
    every: int = 2
    """Iterations whose gradients make one move."""
    until: float = 0.95
    """Share of the run after which vertices stay."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require(1 <= self.every <= LARGEST_COUNT, "every", f"at least 1 and at most {LARGEST_COUNT}")
        self._require(0 < self.until <= 1, "until", "greater than 0 and at most 1")
