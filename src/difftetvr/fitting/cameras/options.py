"""Options of how cameras are refined."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from difftetvr.fitting.options import LARGEST_COUNT, OptionGroup


@dataclass(frozen=True)
class CameraRefinement(OptionGroup):
    """How poses and intrinsics move where they are refined. No option has a unit of length."""

    prefix: ClassVar[str] = "cameras."

    rate: float = 2e-2
    """Greatest length of the first steps of a pose: radians, and half sides of the capture's box."""
    final_rate: float = 2e-3
    """Greatest length of the last steps; in between it falls log-linearly."""
    intrinsics_rate: float = 2e-4
    """Length of the steps of intrinsics at first, in parts of the focal length and of the image's width; it falls as
    that of poses does."""
    align_steps: int = 12
    """Steps by which the pose of each held-out view is found on its own image, the reconstruction held still, before it
    is compared; 0: compare at the poses as given."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("rate", "final_rate", "intrinsics_rate"):
            value = getattr(self, name)
            self._require(value > 0 and math.isfinite(value), name, "greater than 0 and finite")
        self._require(0 <= self.align_steps <= LARGEST_COUNT, "align_steps", "at least 0")

    def rate_at(self, progress: float) -> float:
        """Greatest length of a pose's step.

        Args:
            progress: Share of the run that is done, in [0, 1].
        """
        return self.rate * (self.final_rate / self.rate) ** progress
