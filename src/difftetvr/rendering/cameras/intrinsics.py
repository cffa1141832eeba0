"""A lens in front of a sensor, as numbers: what its pixels see, computed once for all views that it took."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import torch

from difftetvr.rendering.cameras.lenses.distortion import Distortion

_AT_ONCE = 1 << 18  # pixels
_CPU = torch.device("cpu")
_EDGE = 65  # places along each side of an image by which its field of view is measured


@dataclass(frozen=True)
class Intrinsics:
    """A lens in front of a sensor of known size; pixel (i, j) has its centre at (i + 0.5, j + 0.5).

    Attributes:
        fx: Focal length in pixels along x.
        fy: Focal length in pixels along y.
        cx: Principal point in pixels along x.
        cy: Principal point in pixels along y.
        width: Pixels of a row.
        height: Pixels of a column.
        distortion: What the lens does beyond a pinhole; its coefficients are numbers.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: Distortion = field(default_factory=Distortion)

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same field of view on another number of pixels."""
        return self._scaled(width / self.width, height / self.height, width, height)

    def shrunk(self, factor: int) -> Intrinsics:
        """After averaging blocks of ``factor`` x ``factor`` pixels, from the upper left; incomplete blocks are lost."""
        return self._scaled(1 / factor, 1 / factor, self.width // factor, self.height // factor)

    def _scaled(self, x: float, y: float, width: int, height: int) -> Intrinsics:
        return replace(self, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y, width=width, height=height)

    def to_normalised(self, pixels: torch.Tensor) -> torch.Tensor:
        """(..., 2) distorted coordinates of positions in pixels, (..., 2)."""
        return (pixels - pixels.new_tensor([self.cx, self.cy])) / pixels.new_tensor([self.fx, self.fy])

    def to_pixels(self, normalised: torch.Tensor) -> torch.Tensor:
        """(..., 2) positions in pixels of distorted coordinates, (..., 2)."""
        return normalised * normalised.new_tensor([self.fx, self.fy]) + normalised.new_tensor([self.cx, self.cy])

    def pixel_centers(self) -> torch.Tensor:
        """(H, W, 2) positions in pixels, float64."""
        return _grid(*(torch.arange(count, dtype=torch.float64) + 0.5 for count in (self.width, self.height)))


@dataclass(frozen=True, eq=False)
class FieldOfView:
    """What the pixels of a lens see; its tensors are shared, so they must not be changed.

    Attributes:
        directions: (H, W, 3) unit directions in camera space, float64; +z where the lens cannot have made a pixel.
        known: (H, W) bool, where it can.
    """

    directions: torch.Tensor
    known: torch.Tensor


def field_of_view(lens: Intrinsics, device: torch.device = _CPU) -> FieldOfView:
    """Where the rays of all pixels of a lens go, on a device that knows float64."""
    return _on_cpu(lens) if device == _CPU else _on_device(lens, device)


# The photographs of one camera share it; it is large, so few are kept.
@lru_cache(maxsize=4)
def _on_cpu(lens: Intrinsics) -> FieldOfView:
    distorted = lens.to_normalised(lens.pixel_centers())
    # Some rows at a time: what is needed in between takes many times the memory of the result.
    rows = distorted.split(max(1, _AT_ONCE // lens.width))
    directions = torch.cat([lens.distortion.directions(lens.distortion.undistort(part)) for part in rows])
    known = torch.isfinite(directions).all(-1)
    ahead = directions.new_tensor([0.0, 0.0, 1.0])
    return FieldOfView(torch.where(known[..., None], directions, ahead), known)


@lru_cache(maxsize=4)
def _on_device(lens: Intrinsics, device: torch.device) -> FieldOfView:
    view = _on_cpu(lens)
    return FieldOfView(view.directions.to(device), view.known.to(device))


@lru_cache(maxsize=1024)
def widest_radius(lens: Intrinsics) -> float:
    """The greatest length of undistorted coordinates that are seen in the image; 0 where none are."""
    sides = (torch.linspace(0, side, min(side + 1, _EDGE), dtype=torch.float64) for side in (lens.width, lens.height))
    radii = lens.distortion.undistort(lens.to_normalised(_grid(*sides))).norm(dim=-1)
    if not bool(torch.isfinite(radii).all()):
        # The lens ends inside the image, and just there it sees farthest.
        view = field_of_view(lens)
        if not bool(view.known.any()):
            return 0.0
        radii = lens.distortion.coordinates(view.directions[view.known])[0].norm(dim=-1)
    return float(radii.max())


def _grid(across: torch.Tensor, down: torch.Tensor) -> torch.Tensor:
    """(M, N, 2) all pairs of N values and M values, row by row."""
    return torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1)
