"""A sparse model of COLMAP in memory, what its camera models mean, and whether it agrees with itself.

Source: https://colmap.github.io/format.html and https://colmap.github.io/cameras.html. Pixel positions are COLMAP's:
the centre of the first pixel is at (0.5, 0.5), as here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from difftetvr.capture.photos.lens import Lens, make_camera
from difftetvr.errors import CaptureError
from difftetvr.rendering.cameras.lenses.distortion import Distortion
from difftetvr.rendering.cameras.lenses.models import COLMAP_CAMERAS

# By the number that binary files use.
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
    "SIMPLE_DIVISION",
    "DIVISION",
    "SIMPLE_FISHEYE",
    "FISHEYE",
    "EUCM",
    "EQUIRECTANGULAR",
)


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
            lens, where = self.cameras[image.camera_id], f"'{image.name}'"
            intrinsics = lens.on(lens.width or 1, lens.height or 1, where)
            camera = make_camera(intrinsics, torch.from_numpy(image.world_to_camera), where)
            pixels, enlarged = (part.numpy() for part in camera.project(torch.from_numpy(positions[place[known]])))
            with np.errstate(all="ignore"):
                distances = np.linalg.norm(pixels - image.keypoints[known], axis=1)
            errors.append(np.where((enlarged > 0) & np.isfinite(distances), distances, np.inf))
        return np.concatenate(errors)


def parameter_count(model: str, where: str) -> int:
    """How many numbers a camera model has.

    Raises:
        CaptureError: The model is not supported.
    """
    if model not in COLMAP_CAMERAS:
        raise CaptureError(
            f"The model of {where} is {model}, which is not supported; undistort the images first "
            "(colmap image_undistorter)."
        )
    return len(COLMAP_CAMERAS[model].parameters)


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
    kind = COLMAP_CAMERAS[model]
    named = dict(zip(kind.parameters, map(float, values), strict=True))
    focal = named.pop("f", None)
    fx, fy = named.pop("fx", focal), named.pop("fy", focal)
    cx, cy = named.pop("cx"), named.pop("cy")
    lens = Lens(fx, fy, cx, cy, width=size[0], height=size[1], distortion=Distortion.named(kind.model, named))
    lens.on(*size, where)
    return lens


def damaged(path: Path, why: str) -> CaptureError:
    """The error for a file of a model that cannot be read."""
    return CaptureError(f"'{path}' is damaged or no file of COLMAP ({why}); get the model anew.")
