"""The visual hull: the part of space that no silhouette rules out."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage

from difftetvr.capture.packed import Images, Masks
from difftetvr.capture.viewing import in_image, project
from difftetvr.rendering.cameras.pinhole import Camera

_SILHOUETTE_PIXELS = 200  # of the shorter side, after coarsening
_LEAST_ALPHA = 0.02
_LEAST_RADIANCE = 0.02
_BLACK_BORDER = 0.95
# Of all pixels: undistorted photographs may be transparent along their borders.
_LEAST_TRANSPARENT = 0.1


def silhouettes(
    images: Images, alphas: Images | None, views: Sequence[int], valid: Masks | None = None
) -> list[torch.Tensor] | None:
    """Where the object may be seen: where alpha is not 0, or where black surrounds what is not black.

    Args:
        images: (N, H, W, 3) images over black, or of several sizes.
        alphas: (N, H, W) likewise, or None where they are unknown.
        views: The views to look at.
        valid: (N, H, W) bool likewise, the pixels that say anything; None for all. Others may show the object.

    Returns:
        (H, W) bool masks of the views, or None where nothing tells the object from its background: few pixels are
        transparent, or it is not black around the object.
    """
    if alphas is not None:
        masks = [_or_invalid(alphas[view] > _LEAST_ALPHA, view, valid) for view in views]
        transparent = sum(int((~mask).sum()) for mask in masks)
        return masks if transparent >= _LEAST_TRANSPARENT * sum(mask.numel() for mask in masks) else None
    found: list[torch.Tensor] = []
    border: list[float] = []
    for view in views:
        mask = (images[view] > _LEAST_RADIANCE).any(dim=-1)
        found.append(mask)
        known = _border(mask) if valid is None else _border(mask)[_border(valid[view])]
        border += [float((~known).float().mean())] if len(known) else []
        # Most captures are ruled out by their first views, which saves unpacking the others.
        if border and np.mean(border) < _BLACK_BORDER / 2:
            return None
    if not border or np.mean(border) < _BLACK_BORDER:
        return None
    # What is black inside the object belongs to it.
    filled = (torch.from_numpy(ndimage.binary_fill_holes(mask.numpy())) for mask in found)
    return [_or_invalid(mask, view, valid) for mask, view in zip(filled, views, strict=True)]


def _border(mask: torch.Tensor) -> torch.Tensor:
    """(N,) the pixels along the edges."""
    return torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]])


def _or_invalid(mask: torch.Tensor, view: int, valid: Masks | None) -> torch.Tensor:
    return mask if valid is None else mask | ~valid[view]


@dataclass(frozen=True, eq=False)
class VisualHull:
    """Views that can rule out parts of space.

    Attributes:
        cameras: Cameras of the views.
        shapes: The silhouette of each, or None for one that only says what it sees.
    """

    cameras: list[Camera]
    shapes: list[Silhouette | None]

    @staticmethod
    def of(cameras: Sequence[Camera], masks: Sequence[torch.Tensor] | None, most: int | None = None) -> VisualHull:
        """The hull of N views, or of evenly chosen ones.

        Args:
            cameras: N cameras.
            masks: N silhouettes, see :func:`silhouettes`; None: the views rule nothing out.
            most: How many views to use at most; None: all.
        """
        step = 1 if most is None else -(-len(cameras) // most)
        chosen = list(cameras)[::step]
        shapes: list[Silhouette | None] = [None] * len(chosen)
        if masks is not None:
            # A blank image among others would rule out everything that it could see.
            shows_any = any(bool(mask.any()) for mask in masks)
            shapes = [None if shows_any and not mask.any() else Silhouette.of(mask) for mask in masks[::step]]
        return VisualHull(chosen, shapes)

    def keeps(self, centers: NDArray[np.float64], cell: float, least_share: float) -> NDArray[np.bool_]:
        """Which cubes may hold something of the object.

        A cube is ruled out by a view whose image holds its centre but nothing of the silhouette where the cube is
        seen, and by being outside most images.

        Args:
            centers: (C, 3) centres of the cubes.
            cell: Side of a cube.
            least_share: Share of the views that must see a cube, at least.

        Returns:
            (C,) bool.
        """
        alive = np.arange(len(centers))
        seen = np.zeros(len(centers), dtype=np.int32)
        radius = 0.5 * math.sqrt(3.0) * cell
        for camera, silhouette in zip(self.cameras, self.shapes, strict=True):
            pixels, enlarged = project(centers[alive], camera)
            reach = radius * enlarged
            centered = in_image(pixels, enlarged, camera)
            # Only cells that will be split need the benefit of the doubt.
            seen[alive] += centered if silhouette is None else in_image(pixels, enlarged, camera, reach)
            if silhouette is not None:
                alive = alive[~centered | silhouette.touches(pixels, reach)]
        kept = np.zeros(len(centers), dtype=bool)
        kept[alive] = seen[alive] >= least_share * len(self.cameras)
        return kept


@dataclass(frozen=True, eq=False)
class Silhouette:
    """A mask that knows at once whether a rectangle holds any of it.

    Attributes:
        sums: (h + 1, w + 1) int64 sums over all pixels of the coarsened mask above and left of each corner.
        factor: Pixels of the image along a pixel of the coarsened mask.
    """

    sums: NDArray[np.int64]
    factor: int

    @staticmethod
    def of(mask: torch.Tensor) -> Silhouette:
        """The silhouette of an (H, W) bool mask."""
        factor = max(1, min(mask.shape) // _SILHOUETTE_PIXELS)
        coarse = torch.nn.functional.max_pool2d(mask.float()[None, None], factor, ceil_mode=True)[0, 0].numpy()
        sums = np.pad(coarse.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        return Silhouette(sums, factor)

    def touches(self, pixels: NDArray[np.float64], reach: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(C,) bool, whether the squares around (C, 2) pixels, that far to each side, hold any of it."""
        limits = (self.sums.shape[1] - 1, self.sums.shape[0] - 1)
        # What projects to infinity is behind the camera, and its answer is not asked for.
        centers, half = np.nan_to_num(pixels), np.nan_to_num(reach)[:, None]
        left, top = np.floor((centers - half) / self.factor).clip(0, limits).astype(np.int64).T
        right, bottom = np.ceil((centers + half) / self.factor).clip(0, limits).astype(np.int64).T
        sums = self.sums
        return sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] > 0
