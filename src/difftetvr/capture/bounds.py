"""Where the scene is: the box that a reconstruction fills, from silhouettes, sparse points or the cameras alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from difftetvr.capture.packed import PackedImages
from difftetvr.errors import CaptureError
from difftetvr.render.camera import Camera

_COARSE_GRID, _FINE_GRID = 16, 48
_MOST_CELLS = 500_000
_SETTLED = 0.9
_CORNERS = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(8, 3)
_MOST_VIEWS = 100
# A cell belongs to the scene only if so many of the views could have ruled it out.
_LEAST_SHARE_OF_VIEWS = 1 / 2
_SILHOUETTE_PIXELS = 200  # of the shorter side, after coarsening
_LEAST_ALPHA = 0.02
_LEAST_RADIANCE = 0.02
_BLACK_BORDER = 0.95
_OUTLIERS = 1.0  # percent of the points at either end of each axis
_POINT_MARGIN, _LARGEST_MARGIN, _MARGIN_STEPS = 0.05, 8.0, 10  # in longest sides of the points' box
_COVERED = 0.98  # share of the images' rays that meet the box
_RAYS_PER_SIDE = 24
_FARTHEST_POINT = 4.0  # in distances of the farthest camera
_PARALLEL = 1e-3


def silhouettes(images: torch.Tensor | PackedImages, alphas: torch.Tensor | PackedImages | None) -> torch.Tensor | None:
    """(N, H, W) bool, where the object may be seen: where alpha is not 0, or where black surrounds what is not black.

    Args:
        images: (N, H, W, 3) images over black.
        alphas: (N, H, W), or None where they are unknown.

    Returns:
        The masks, or None where nothing tells the object from its background.
    """
    if alphas is not None:
        masks = torch.stack([alphas[view] > _LEAST_ALPHA for view in range(len(alphas))])
        return None if bool(masks.all()) else masks
    found, border = [], []
    for view in range(len(images)):
        mask = (images[view] > _LEAST_RADIANCE).any(dim=-1)
        found.append(mask)
        border.append(float((~torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]])).float().mean()))
        # Most captures are ruled out by their first views, which saves unpacking the others.
        if np.mean(border) < _BLACK_BORDER / 2:
            return None
    if np.mean(border) < _BLACK_BORDER:
        return None
    # What is black inside the object belongs to it.
    filled = [ndimage.binary_fill_holes(mask.numpy()) for mask in found]
    return torch.from_numpy(np.stack(filled))


def hull_bounds(cameras: Sequence[Camera], masks: torch.Tensor | None) -> np.ndarray:
    """(2, 3) float64 box of the cells of a grid that no silhouette rules out.

    A cell is ruled out by a view whose image holds its centre but nothing of the silhouette where the cell is seen,
    and by being outside most images. What is left is split until the box has 48 cells along its longest side, and
    padded by half a cell.

    Args:
        cameras: N cameras.
        masks: (N, H, W) bool silhouettes. None: the box of what at least half of the views see.

    Raises:
        CaptureError: Nothing is left, or the cameras do not say where the scene is.
    """
    step = -(-len(cameras) // _MOST_VIEWS)
    chosen = list(cameras)[::step]
    shapes = [None] * len(chosen) if masks is None else [_Silhouette.of(mask) for mask in masks[::step]]
    box = _box_of_cameras(cameras)
    count = _COARSE_GRID if masks is not None else _FINE_GRID
    cell = (box[1, 0] - box[0, 0]) / count
    centers = _cell_centers(box, count)
    while True:
        centers = _survivors(centers, cell, list(zip(chosen, shapes, strict=True)))
        if not len(centers):
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


def point_bounds(points: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """(2, 3) float64 box of the sparse points without outliers, grown until the images show hardly anything else.

    Points far beyond the cameras (of sky, or matched wrongly) are left out first: those farther from the median point
    than four times the farthest camera. What surrounds the object often has no points, but a photograph can only be
    explained where its rays meet the box; so the box grows by equal margins until nearly all do.

    Args:
        points: (P, 3) positions.
        cameras: Cameras that see them.
    """
    middle = np.median(points, axis=0)
    farthest = np.linalg.norm(_positions(cameras) - middle, axis=1).max()
    near = points[np.linalg.norm(points - middle, axis=1) <= _FARTHEST_POINT * farthest]
    lower, upper = np.percentile(near if len(near) else points, (_OUTLIERS, 100 - _OUTLIERS), axis=0)
    longest = float(max((upper - lower).max(), 1e-3 * farthest))
    origins, directions = _rays(cameras)
    least, most = _POINT_MARGIN, _LARGEST_MARGIN
    for _ in range(_MARGIN_STEPS):
        margin = 0.5 * (least + most) * longest
        if _share_of_rays(np.stack([lower - margin, upper + margin]), origins, directions) < _COVERED:
            least = margin / longest
        else:
            most = margin / longest
    return np.stack([lower - most * longest, upper + most * longest])


def require_seen(bounds: np.ndarray, cameras: Sequence[Camera], name: str) -> None:
    """Checks that most cameras see something of the box.

    Raises:
        CaptureError: More than half of them see nothing of it.
    """
    points = _cell_centers(bounds, _COARSE_GRID)
    blind = [camera for camera in cameras if not _in_image(*_project(points, camera), camera).any()]
    if 2 * len(blind) > len(cameras):
        lower, upper = (np.array2string(corner, precision=3) for corner in bounds)
        raise CaptureError(
            f"{len(blind)} of the {len(cameras)} cameras of '{name}' see nothing of the scene's box {lower} to "
            f"{upper}; check the axes of the poses, or give other bounds."
        )


def _box_of_cameras(cameras: Sequence[Camera]) -> np.ndarray:
    """Cube around the point nearest to all optical axes, as far as the farthest camera."""
    positions = _positions(cameras)
    directions = np.stack([_pose(camera)[2, :3] for camera in cameras])
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    total = across.sum(axis=0)
    if np.linalg.eigvalsh(total)[0] < _PARALLEL * len(cameras):
        raise CaptureError(
            "The cameras look the same way, so they do not say how far the scene is; give sparse points or bounds."
        )
    focus = np.linalg.solve(total, (across @ positions[:, :, None]).sum(axis=0)[:, 0])
    reach = np.linalg.norm(positions - focus, axis=1).max()
    return np.stack([focus - reach, focus + reach])


def _rays(cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """(N, 1, 3) origins and (N, R, 3) directions in world space of rays through a grid over each image."""
    places = (np.arange(_RAYS_PER_SIDE) + 0.5) / _RAYS_PER_SIDE
    grid = np.stack(np.meshgrid(places, places), axis=-1).reshape(-1, 2)
    directions = []
    for camera in cameras:
        pixels = grid * (camera.width, camera.height)
        plane = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
        directions.append(np.concatenate([plane, np.ones((len(plane), 1))], axis=1) @ _pose(camera)[:3, :3])
    return _positions(cameras)[:, None], np.stack(directions)


def _share_of_rays(box: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> float:
    """Share of rays that meet a box, by slabs."""
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (box[0] - origins) / directions, (box[1] - origins) / directions
    enter, leave = np.fmin(first, second).max(axis=-1), np.fmax(first, second).min(axis=-1)
    return float((leave > np.maximum(enter, 0.0)).mean())


def _positions(cameras: Sequence[Camera]) -> np.ndarray:
    poses = [_pose(camera) for camera in cameras]
    return np.stack([-pose[:3, :3].T @ pose[:3, 3] for pose in poses])


def _pose(camera: Camera) -> np.ndarray:
    """(4, 4) float64 world-to-camera."""
    return camera.world_to_camera.detach().cpu().double().numpy()


def _cell_centers(box: np.ndarray, count: int) -> np.ndarray:
    """(count^3, 3) centres of the cells of a grid over a box."""
    places = (np.arange(count) + 0.5) / count
    axes = [box[0, axis] + places * (box[1, axis] - box[0, axis]) for axis in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _survivors(centers: np.ndarray, cell: float, views: Sequence[tuple[Camera, _Silhouette | None]]) -> np.ndarray:
    """(S, 3) centres of the cells that are seen often enough and not ruled out.

    Args:
        centers: (C, 3) centres of the cells.
        cell: Side of a cell.
        views: Cameras and, where there are any, their silhouettes.
    """
    alive = np.arange(len(centers))
    seen = np.zeros(len(centers), dtype=np.int32)
    radius = 0.5 * math.sqrt(3.0) * cell
    for camera, silhouette in views:
        pixels, depth = _project(centers[alive], camera)
        with np.errstate(divide="ignore"):
            reach = radius * max(camera.fx, camera.fy) / depth
        centered = _in_image(pixels, depth, camera)
        # Only cells that will be split need the benefit of the doubt.
        seen[alive] += centered if silhouette is None else _in_image(pixels, depth, camera, reach)
        if silhouette is not None:
            alive = alive[~centered | silhouette.touches(pixels, reach)]
    return centers[alive[seen[alive] >= _LEAST_SHARE_OF_VIEWS * len(views)]]


def _project(points: np.ndarray, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """(C, 2) pixels and (C,) depths of points in world space."""
    pose = _pose(camera)
    local = points @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        return local[:, :2] / depth[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy), depth


def _in_image(pixels: np.ndarray, depth: np.ndarray, camera: Camera, reach: np.ndarray | float = 0.0) -> np.ndarray:
    """(C,) bool, whether pixels lie in the image, or so near to it, in front of the camera."""
    x, y = pixels.T
    across = (x >= -reach) & (x < camera.width + reach)
    return (depth > 0) & across & (y >= -reach) & (y < camera.height + reach)


@dataclass(frozen=True, eq=False)
class _Silhouette:
    """A mask that knows at once whether a rectangle holds any of it.

    Attributes:
        sums: (h + 1, w + 1) int64 sums over all pixels of the coarsened mask above and left of each corner.
        factor: Pixels of the image along a pixel of the coarsened mask.
    """

    sums: np.ndarray
    factor: int

    @staticmethod
    def of(mask: torch.Tensor) -> _Silhouette:
        """The silhouette of an (H, W) bool mask."""
        factor = max(1, min(mask.shape) // _SILHOUETTE_PIXELS)
        coarse = torch.nn.functional.max_pool2d(mask.float()[None, None], factor, ceil_mode=True)[0, 0].numpy()
        sums = np.pad(coarse.astype(np.int64).cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        return _Silhouette(sums, factor)

    def touches(self, pixels: np.ndarray, reach: np.ndarray) -> np.ndarray:
        """(C,) bool, whether the squares around (C, 2) pixels, that far to each side, hold any of it."""
        limits = (self.sums.shape[1] - 1, self.sums.shape[0] - 1)
        # What projects to infinity is behind the camera, and its answer is not asked for.
        centers, half = np.nan_to_num(pixels), np.nan_to_num(reach)[:, None]
        left, top = np.floor((centers - half) / self.factor).clip(0, limits).astype(np.int64).T
        right, bottom = np.ceil((centers + half) / self.factor).clip(0, limits).astype(np.int64).T
        sums = self.sums
        return sums[bottom, right] - sums[top, right] - sums[bottom, left] + sums[top, left] > 0
