"""Where the scene is: the box that a reconstruction fills, from silhouettes, sparse points or the cameras alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from difftetvr.capture.hull import VisualHull
from difftetvr.capture.viewing import Floats, cell_centers, in_image, pose_of, positions_of, project
from difftetvr.errors import CaptureError
from difftetvr.rendering.cameras.pinhole import Camera

_COARSE_GRID, _FINE_GRID = 16, 48
_MOST_CELLS = 500_000
_SETTLED = 0.9
_CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(8, 3)
_MOST_VIEWS = 100
# A cell belongs to the scene only if so many of the views could have ruled it out.
_LEAST_SHARE_OF_VIEWS = 1 / 2
_OUTLIERS = 1.0  # percent of the points at either end of each axis
_POINT_MARGIN = 0.05  # in longest sides of the points' box
_FARTHEST_POINT = 4.0  # in distances of the farthest camera
_SURROUNDINGS = 8.0  # times the box of the scene, at least
_BEHIND = 2.0  # and twice as far as the farthest camera
_FARTHEST = 2000.0  # times its size from the origin: a sixth of a pixel of an image of 1000
_THINNEST = 0.25  # of the longest side, where surroundings are measured
_PARALLEL = 1e-3


def hull_bounds(cameras: Sequence[Camera], masks: Sequence[torch.Tensor] | None) -> Floats:
    """(2, 3) box of the cells of a grid that no silhouette rules out.

    The cells that the visual hull keeps are split until their box has 48 cells along its longest side, and padded by
    half a cell.

    Args:
        cameras: N cameras.
        masks: N silhouettes, (H, W) bool. None: the box of what at least half of the views see.

    Raises:
        CaptureError: Nothing is left, or the cameras do not say where the scene is.
    """
    hull = VisualHull.of(cameras, masks, _MOST_VIEWS)
    box = _box_of_cameras(cameras)
    count = _COARSE_GRID if masks is not None else _FINE_GRID
    cell = (box[1, 0] - box[0, 0]) / count
    centers = cell_centers(box, count)
    while True:
        centers = centers[hull.keeps(centers, cell, _LEAST_SHARE_OF_VIEWS)]
        if not len(centers):
            if masks is None:
                raise CaptureError("No place is seen by half of the cameras; give the bounds of what to reconstruct.")
            raise CaptureError(
                "The silhouettes of the images do not meet anywhere; check the cameras' poses and the images' alpha."
            )
        smaller = np.stack([centers.min(axis=0) - cell, centers.max(axis=0) + cell])
        longest = (smaller[1] - smaller[0]).max()
        # Cells far off that only coarse ones hide would end it too early.
        is_fine = longest >= _FINE_GRID * cell and longest > _SETTLED * (box[1] - box[0]).max()
        box = smaller
        if masks is None or is_fine or len(centers) > _MOST_CELLS:
            return box
        cell *= 0.5
        centers = (centers[:, None] + 0.5 * cell * _CORNERS).reshape(-1, 3)


def point_bounds(points: Floats, cameras: Sequence[Camera]) -> Floats:
    """(2, 3) box of the sparse points without outliers.

    Points far beyond the cameras (of sky, or matched wrongly) are left out first: those farther from the median point
    than four times the farthest camera.

    Args:
        points: (P, 3) positions.
        cameras: Cameras that see them.
    """
    middle = np.median(points, axis=0)
    farthest = np.linalg.norm(positions_of(cameras) - middle, axis=1).max()
    with np.errstate(over="ignore"):  # what is too far to square is too far
        near = points[np.linalg.norm(points - middle, axis=1) <= _FARTHEST_POINT * farthest]
    lower, upper = np.percentile(near if len(near) else points, (_OUTLIERS, 100 - _OUTLIERS), axis=0)
    margin = _POINT_MARGIN * float(max((upper - lower).max(), 1e-3 * farthest))
    return np.stack([lower - margin, upper + margin])


def surroundings_of(bounds: Floats, cameras: Sequence[Camera]) -> float:
    """How many times as large a box holds what is seen behind the scene, too: 8, and well beyond all cameras.

    Args:
        bounds: (2, 3) box of the scene.
        cameras: Cameras that see it.
    """
    sides = bounds[1] - bounds[0]
    # Cameras above a flat scene need not be inside: nothing is behind them that they see.
    sides = np.maximum(sides, _THINNEST * sides.max())
    farthest = (np.abs(2.0 * positions_of(cameras) - bounds.sum(axis=0)) / sides).max()
    return float(max(_SURROUNDINGS, _BEHIND * farthest))


def require_resolved(bounds: Floats, name: str) -> None:
    """Checks that the box is not so far from the origin that float32 blurs it.

    Raises:
        CaptureError: It is, as where poses are in geographic coordinates.
    """
    distance = np.abs(bounds).max() / (bounds[1] - bounds[0]).max()
    if distance > _FARTHEST:
        raise CaptureError(
            f"The scene of '{name}' lies {distance:,.0f} times its size away from the origin, too far for single "
            "precision; subtract its centre from the positions of cameras and points."
        )


def require_seen(bounds: Floats, cameras: Sequence[Camera], name: str, most_blind: float = 0.5) -> None:
    """Checks that enough cameras see something of the box.

    Raises:
        CaptureError: More than a share ``most_blind`` of them see nothing of it.
    """
    points = cell_centers(bounds, _COARSE_GRID)
    blind = [camera for camera in cameras if not in_image(*project(points, camera), camera).any()]
    if len(blind) > most_blind * len(cameras):
        lower, upper = (np.array2string(corner, precision=3) for corner in bounds)
        raise CaptureError(
            f"{len(blind)} of the {len(cameras)} cameras of '{name}' see nothing of the scene's box {lower} to "
            f"{upper}; check the axes of the poses, or give other bounds."
        )


def _box_of_cameras(cameras: Sequence[Camera]) -> Floats:
    """Cube around the point nearest to all optical axes, as far as the farthest camera."""
    if len(cameras) < 2:
        raise CaptureError(
            "One training view does not say how far the scene is; give bounds, or hold no views out (test_every 0)."
        )
    positions = positions_of(cameras)
    directions = np.stack([pose_of(camera)[2, :3] for camera in cameras])
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < _PARALLEL * len(cameras):
        raise CaptureError(
            "The cameras look the same way, so they do not say how far the scene is; give sparse points or bounds."
        )
    focus = np.linalg.solve(total, (across @ positions[:, :, None]).sum(axis=0)[:, 0])
    reach = np.linalg.norm(positions - focus, axis=1).max()
    return np.stack([focus - reach, focus + reach])
