"""COLMAP's binary files: cameras.bin, images.bin, points3D.bin, little endian.

Source: https://colmap.github.io/format.html. rigs.bin and frames.bin of newer versions repeat what images.bin says.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from difftetvr.capture.photos.lens import Lens
from difftetvr.capture.photos.poses import from_quaternion
from difftetvr.capture.photos.readers.colmap_model import (
    MODEL_NAMES,
    ColmapImage,
    ColmapPoints,
    damaged,
    lens_of,
    parameter_count,
)
from difftetvr.errors import CaptureError
from difftetvr.trust import require_regular

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_IMAGE = struct.Struct("<I7dI")
_POINT = struct.Struct("<q3d3BdQ")
_TRACK_ELEMENT_BYTES = 8
_KEYPOINT = np.dtype([("position", "<f8", 2), ("point", "<i8")])


class _Reader:
    """Takes records off the start of a file's bytes."""

    def __init__(self, path: Path, most: int = -1) -> None:
        self.path = path
        require_regular(path, CaptureError)
        try:
            with path.open("rb") as file:
                self.data = file.read(most)
        except OSError as error:
            raise CaptureError(f"Cannot read '{path}': {error.strerror or error}; check the model's folder.") from None
        self.position = 0

    def record(self, layout: struct.Struct) -> tuple:
        """The next record."""
        self.require(layout.size)
        values = layout.unpack_from(self.data, self.position)
        self.position += layout.size
        return values

    def count(self, least_bytes: int) -> int:
        """How many records follow, each of at least so many bytes."""
        (count,) = self.record(_COUNT)
        self.require(count * least_bytes)
        return count

    def array(self, dtype: np.dtype, count: int) -> np.ndarray:
        """The next records as an array."""
        self.require(count * dtype.itemsize)
        values = np.frombuffer(self.data, dtype, count, self.position)
        self.position += count * dtype.itemsize
        return values

    def text(self) -> str:
        """The next text, up to its closing zero byte."""
        end = self.data.find(b"\0", self.position)
        if end < 0:
            raise damaged(self.path, "a name does not end")
        text = self.data[self.position : end]
        self.position = end + 1
        try:
            return text.decode("utf-8")
        except UnicodeDecodeError:
            raise damaged(self.path, "a name is not UTF-8") from None

    def skip(self, count: int) -> None:
        """Passes over bytes."""
        self.require(count)
        self.position += count

    def require(self, count: int) -> None:
        if count > len(self.data) - self.position:
            raise damaged(self.path, "it is cut short")

    def finish(self) -> None:
        """Checks that all was read."""
        if self.position != len(self.data):
            raise damaged(self.path, "it goes on after its last record")


def read_cameras(path: Path) -> dict[int, Lens]:
    """Lenses by key.

    Raises:
        CaptureError: The file is damaged, or a camera model is not supported.
    """
    reader, lenses = _Reader(path), {}
    for _ in range(reader.count(_CAMERA.size)):
        key, model, width, height = reader.record(_CAMERA)
        where = f"camera {key} of '{path}'"
        name = MODEL_NAMES[model] if 0 <= model < len(MODEL_NAMES) else f"number {model}"
        values = reader.array(np.dtype("<f8"), parameter_count(name, where))
        lenses[key] = lens_of(name, (width, height), values, where)
    reader.finish()
    return lenses


def count_images(path: Path) -> int:
    """How many images a file registers, of which no more is read.

    Raises:
        CaptureError: It cannot be read.
    """
    return int(_Reader(path, _COUNT.size).record(_COUNT)[0])


def read_images(path: Path) -> list[ColmapImage]:
    """The registered images.

    Raises:
        CaptureError: The file is damaged.
    """
    reader, images = _Reader(path), []
    for _ in range(reader.count(_IMAGE.size)):
        _, *pose, camera = reader.record(_IMAGE)
        name = reader.text()
        keypoints = reader.array(_KEYPOINT, reader.count(_KEYPOINT.itemsize))
        rigid = from_quaternion(np.array(pose[:4]), np.array(pose[4:]), f"image '{name}' of '{path}'")
        images.append(ColmapImage(name, camera, rigid, keypoints["position"], keypoints["point"].astype(np.int64)))
    reader.finish()
    return images


def read_points(path: Path) -> ColmapPoints:
    """The sparse points.

    Raises:
        CaptureError: The file is damaged.
    """
    reader = _Reader(path)
    count = reader.count(_POINT.size)
    ids, positions = np.empty(count, dtype=np.int64), np.empty((count, 3))
    colors = np.empty((count, 3), dtype=np.uint8)
    for index in range(count):
        ids[index], *values, _, track = reader.record(_POINT)
        positions[index], colors[index] = values[:3], values[3:]
        reader.skip(track * _TRACK_ELEMENT_BYTES)
    reader.finish()
    return ColmapPoints(ids, positions, colors)
