"""A sparse model of COLMAP in memory, what its camera models mean, and whether it agrees with itself.

Source: https://colmap.github.io/format.html and https://colmap.github.io/cameras.html. Pixel positions are COLMAP's:
the centre of the first pixel is at (0.5, 0.5), as here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from difftetvr.capture.photos.lens import Distortion, Lens
from difftetvr.errors import CaptureError

# Names by the number that binary files use, and what each model's parameters are.
MODEL_NAMES = (
    "SIMPLE_PINHOLE",
    "PINHOLE",
    "SIMPLE_RADIAL",
    "RADIAL",
    "OPENCV",
    "OPENCV_FISHEYE",
    "FULL_OPENCV",
    "FOV",
    "SIMPLE_RADIAL_FISHEYE",
    "RADIAL_FISHEYE",
    "THIN_PRISM_FISHEYE",
    "RAD_TAN_THIN_PRISM_FISHEYE",
)
_PARAMETERS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
}


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A registered image.

    Attributes:
        name: Path of its file inside the folder of images.
        camera_id: Key of its camera.
        world_to_camera: (4, 4) float64, OpenCV axes.
        keypoints: (K, 2) float64 pixels where features were found.
        point_ids: (K,) int64 keys of the points that the features show, -1 for none.
    """

    name: str
    camera_id: int
    world_to_camera: np.ndarray
    keypoints: np.ndarray
    point_ids: np.ndarray


@dataclass(frozen=True, eq=False)
class ColmapPoints:
    """The sparse points.

    Attributes:
        ids: (P,) int64 keys.
        positions: (P, 3) float64.
        colors: (P, 3) uint8.
    """

    ids: np.ndarray
    positions: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A sparse model.

    Attributes:
        cameras: Lenses by key.
        images: The registered images, by name.
        points: The sparse points.
    """

    cameras: dict[int, Lens]
    images: list[ColmapImage]
    points: ColmapPoints

    def reprojection_errors(self) -> np.ndarray:
        """(M,) distances in pixels between the features seen and the points they show, over all images.

        Points behind a camera have an infinite distance.
        """
        order = np.argsort(self.points.ids)
        ids, positions = self.points.ids[order], self.points.positions[order]
        errors = [np.empty(0)]
        for image in self.images:
            place = np.searchsorted(ids, image.point_ids).clip(0, max(len(ids) - 1, 0))
            known = (ids[place] == image.point_ids) if len(ids) else np.zeros(len(image.point_ids), dtype=bool)
            pose, lens = image.world_to_camera, self.cameras[image.camera_id]
            intrinsics = lens.on(lens.width or 1, lens.height or 1, f"'{image.name}'")
            with np.errstate(all="ignore"):
                points = positions[place[known]] @ pose[:3, :3].T + pose[:3, 3]
                distances = np.linalg.norm(intrinsics.project(points) - image.keypoints[known], axis=1)
            errors.append(np.where((points[:, 2] > 0) & np.isfinite(distances), distances, np.inf))
        return np.concatenate(errors)


def parameter_count(model: str, where: str) -> int:
    """How many numbers a camera model has.

    Raises:
        CaptureError: The model is not supported.
    """
    if model not in _PARAMETERS:
        raise CaptureError(
            f"The model of {where} is {model}, which is not supported; undistort the images first "
            "(colmap image_undistorter)."
        )
    return len(_PARAMETERS[model])


def lens_of(model: str, size: tuple[int, int], values: np.ndarray, where: str) -> Lens:
    """The lens of a camera.

    Args:
        model: Name of COLMAP's camera model.
        size: Width and height in pixels.
        values: The model's numbers.
        where: What they belong to, for messages.

    Raises:
        CaptureError: The model is not supported, or a value is out of range.
    """
    count = parameter_count(model, where)
    if len(values) != count:
        raise CaptureError(f"The {model} model of {where} has {len(values)} numbers, not {count}; get the model anew.")
    if min(size) < 1 or max(size) > 2**20:
        raise CaptureError(
            f"The size of {where} is {size[0]} x {size[1]} pixels, which is no image; get the model anew."
        )
    named = dict(zip(_PARAMETERS[model], map(float, values), strict=True))
    focal = named.pop("f", None)
    fx, fy = named.pop("fx", focal), named.pop("fy", focal)
    cx, cy = named.pop("cx"), named.pop("cy")
    lens = Lens(fx, fy, cx, cy, width=size[0], height=size[1], distortion=Distortion(**named))
    lens.on(*size, where)
    return lens


def damaged(path: Path, why: str) -> CaptureError:
    """The error for a file of a model that cannot be read."""
    return CaptureError(f"'{path}' is damaged or no file of COLMAP ({why}); get the model anew.")
