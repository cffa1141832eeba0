"""Options of fitting a transfer function."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from difftetvr.declared import require_declared
from difftetvr.errors import FitError, shown
from difftetvr.fitting.options import RunOptions


@dataclass(frozen=True)
class TransferConfig(RunOptions):
    """How a transfer function is fitted; the defaults are those of the benchmark.

    Attributes:
        knots: Number of knots, >= 2; the first and the last one stay at 0 and 1.
        move_knots: Whether the others may change their places, too.
        iterations: Steps of the optimiser, >= 1.
        rate: Its learning rate at the beginning, > 0; it falls to a hundredth along a cosine.
        position_rate: Learning rate of places in multiples of that, >= 0.
        smoothness: Weight of the mean squared difference of neighbouring knots' values, >= 0: decides knots that no
            image shows.
        batch_views: Views of an iteration; 0: all of them.
        attenuation: Density of opacity 1, where the mesh's longest side is 1, > 0.
        value_range: Scalars that stand for 0 and 1; None: the least and the greatest one.
        seed: Seed of the random values to begin with.
        checkpoint_seconds: Seconds between checkpoints.

    Raises:
        FitError: A value is of the wrong kind or out of range.
    """

    free: ClassVar[frozenset[str]] = frozenset({"checkpoint_seconds"})

    knots: int = 32
    move_knots: bool = True
    iterations: int = 200
    rate: float = 0.2
    position_rate: float = 0.3
    smoothness: float = 1e-3
    batch_views: int = 0
    attenuation: float = 25.0
    value_range: tuple[float, float] | None = None
    seed: int = 0
    checkpoint_seconds: float = 60.0

    def __post_init__(self) -> None:
        require_declared(self, FitError)
        least = {"knots": 2, "iterations": 1, "batch_views": 0, "seed": 0}
        for name, low in least.items():
            if getattr(self, name) < low:
                raise FitError(f"{name} is {shown(getattr(self, name))}; it must be at least {low}.")
        for name in ("rate", "attenuation", "checkpoint_seconds"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise FitError(f"{name} is {shown(getattr(self, name))}; it must be finite and greater than 0.")
        for name in ("position_rate", "smoothness"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise FitError(f"{name} is {shown(getattr(self, name))}; it must be finite and not negative.")
        if self.value_range is not None and not -math.inf < self.value_range[0] < self.value_range[1] < math.inf:
            raise FitError(f"value_range is {shown(self.value_range)}; give two finite numbers, the smaller first.")

    @property
    def steps(self) -> int:
        """Number of optimisation steps."""
        return self.iterations

    def rate_at(self, iteration: int) -> float:
        """The learning rate of an iteration."""
        along = iteration / self.iterations
        return self.rate * (0.01 + 0.99 * 0.5 * (1.0 + math.cos(math.pi * along)))
