"""Detectors that stand anywhere: what tomographs have."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from difftetvr.errors import CameraError, shown
from difftetvr.inputs import as_reals
from difftetvr.rendering.cameras.checks import take_size

if TYPE_CHECKING:
    from difftetvr.rendering.rays import Rays

_VECTORS = ("source", "direction", "center", "columns", "rows")


@dataclass(frozen=True)
class Detector:
    """A flat detector, seen by a point source or by parallel rays; one view, or B of them, each with its geometry.

    Pixel (i, j) lies at center + (i + 0.5 - width / 2) columns + (j + 0.5 - height / 2) rows. Images are differentiable
    in all vectors.

    Attributes:
        center: (3,) or (B, 3) middle of the detector in world space.
        columns: (3,) or (B, 3) step from a pixel to the next one of its row, in world units.
        rows: (3,) or (B, 3) step from a pixel to the one below it.
        width: Pixels of a row.
        height: Number of rows.
        source: (3,) or (B, 3) where rays start; they are looked at as far as the detector. None for parallel rays.
        direction: (3,) or (B, 3) where parallel rays go; they are lines without an end. None for those of a source.

    Raises:
        CameraError: Shapes do not fit, a value is not finite, or there is not one of source and direction.
    """

    center: torch.Tensor
    columns: torch.Tensor
    rows: torch.Tensor
    width: int
    height: int
    source: torch.Tensor | None = None
    direction: torch.Tensor | None = None

    def __post_init__(self) -> None:
        take_size(self)
        if (self.source is None) == (self.direction is None):
            raise CameraError("A detector needs either a source or a direction of its rays; pass one of them.")
        views, devices = set(), set()
        given = {name: getattr(self, name) for name in _VECTORS if getattr(self, name) is not None}
        for name, value in given.items():
            vector = as_reals(value, f"The detector's {name}", CameraError, torch.float64)
            if vector.shape[-1:] != (3,) or vector.ndim > 2 or not bool(torch.isfinite(vector.detach()).all()):
                raise CameraError(f"The detector's {name} is {shown(value)}; pass finite vectors, (3,) or (B, 3).")
            views.add(vector.shape[:-1])
            devices |= {vector.device} if isinstance(value, torch.Tensor) else set()
            object.__setattr__(self, name, vector)
        if len(devices) > 1:
            names = " and ".join(sorted(f"'{device}'" for device in devices))
            raise CameraError(f"The detector's vectors are on {names}; move them to one device.")
        for device in devices:  # vectors that were no tensors go to that of the others
            for name in given:
                object.__setattr__(self, name, getattr(self, name).to(device))
        if len(views - {torch.Size([])}) > 1:
            counts = ", ".join(str(shape[0]) for shape in sorted(views - {torch.Size([])}))
            raise CameraError(
                f"The detector's vectors are given for {counts} views; give each for one number of views."
            )

    def rays(self) -> Rays:
        """The rays to the middle of each pixel in world space, (H, W) or (B, H, W)."""
        from difftetvr.rendering.rays import Rays  # late: it needs cameras' errors, not cameras

        like = self.center.device
        i, j = (
            torch.arange(count, dtype=torch.float64, device=like) + 0.5 - 0.5 * count
            for count in (self.width, self.height)
        )
        center, columns, rows = (part.double()[..., None, None, :] for part in (self.center, self.columns, self.rows))
        pixels = center + i[None, :, None] * columns + j[:, None, None] * rows
        if self.direction is not None:
            return Rays(pixels, self.direction.double()[..., None, None, :], -math.inf)
        assert self.source is not None
        source = self.source.double()[..., None, None, :]
        return Rays(source, pixels - source, 0.0, (pixels - source).norm(dim=-1))
