"""Captures described by a cameras.json of our own: the plainest way to hand over images and cameras.

    {
      "format": "difftetvr-cameras",
      "cameras": [
        {
          "image": "images/front.png",
          "world_to_camera": [[...], [...], [...], [0, 0, 0, 1]],
          "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0,
          "test": false
        },
        ...
      ],
      "bounds": [[-1, -1, -1], [1, 1, 1]]
    }

Paths are relative to the file. Axes are OpenCV's (+x right, +y down, +z forward), focal lengths and principal points in
pixels, the centre of the first pixel at (0.5, 0.5). ``test`` and ``bounds`` may be left out.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.capture.photos.lens import Lens
from difftetvr.capture.photos.photo_set import (
    PhotoSet,
    View,
    image_place,
    list_of_objects,
    number_of,
    numbers_of,
    read_json,
    text_of,
)
from difftetvr.capture.photos.poses import pose_matrix
from difftetvr.errors import CaptureError, shown

CAMERAS_FORMAT = "difftetvr-cameras"


def read_camera_list(path: Path) -> PhotoSet:
    """A cameras.json; all images must exist.

    Args:
        path: The file, or its folder.

    Raises:
        CaptureError: The file is missing or not valid.
    """
    file = path / "cameras.json" if path.is_dir() else path
    content = read_json(file)
    if content.get("format") != CAMERAS_FORMAT:
        raise CaptureError(
            f"'{file}' does not have the format '{CAMERAS_FORMAT}'; see docs/captures.md for what it needs."
        )
    cameras = list_of_objects(content, "cameras", file)
    views = sorted(
        (_view(file, index, camera) for index, camera in enumerate(cameras)),
        key=lambda view: str(view.root / view.name),
    )
    has_split = any(view.is_test for view in views) or all("test" in camera for camera in cameras)
    return PhotoSet(file.parent.resolve().name, views, has_split=has_split, bounds=_bounds(content, file))


def _view(file: Path, index: int, camera: dict[str, Any]) -> View:
    where = f"camera {index} of '{file}'"
    root, name = image_place(file, text_of(camera, "image", where), where)
    fx, fy, cx, cy = (number_of(camera, key, where) for key in ("fx", "fy", "cx", "cy"))
    if None in (fx, fy, cx, cy):
        raise CaptureError(f"{where[0].upper()}{where[1:]} lacks one of fx, fy, cx and cy; give all four in pixels.")
    is_test = camera.get("test", False)
    if not isinstance(is_test, bool):
        raise CaptureError(f"'test' of {where} is {shown(is_test)}; give true or false.")
    pose = pose_matrix(camera.get("world_to_camera"), where)
    return View(file, root, name, pose, Lens(fx, fy, cx, cy), is_test)


def _bounds(content: dict[str, Any], file: Path) -> np.ndarray | None:
    if content.get("bounds") is None:
        return None
    bounds = numbers_of(content["bounds"])
    if bounds.shape != (2, 3):
        raise CaptureError(f"'bounds' of '{file}' must be a lower and an upper corner, three numbers each.")
    return bounds
