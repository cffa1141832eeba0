"""COLMAP's text files: cameras.txt, images.txt, points3D.txt.

Source: https://colmap.github.io/format.html.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from difftetvr.capture.photos.lens import Lens
from difftetvr.capture.photos.poses import from_quaternion
from difftetvr.capture.photos.readers.colmap_model import ColmapImage, ColmapPoints, damaged, lens_of
from difftetvr.errors import CaptureError
from difftetvr.trust import require_regular

_LARGEST_ID = 2.0**53  # float64 counts no further


def read_cameras(path: Path) -> dict[int, Lens]:
    """Lenses by key.

    Raises:
        CaptureError: The file is damaged, or a camera model is not supported.
    """
    lenses = {}
    for number, line in _lines(path):
        with _sound(path, number):
            key, model, width, height, *values = line.split()
            size = (int(width), int(height))
            lenses[int(key)] = lens_of(model, size, np.array(values, dtype=np.float64), f"camera {key} of '{path}'")
    return lenses


def count_images(path: Path) -> int:
    """How many images a file registers.

    Raises:
        CaptureError: It cannot be read, or is damaged.
    """
    return len(read_images(path))


def read_images(path: Path) -> list[ColmapImage]:
    """The registered images.

    Raises:
        CaptureError: The file is damaged.
    """
    images = []
    lines = _lines(path, keep_empty=True)
    for number, line in lines:
        if not line:
            continue
        # The line after an image's lists its features, and is empty where there are none.
        _, features = next(lines, (number, ""))
        with _sound(path, number):
            _, *pose, camera, name = line.split(maxsplit=9)
            quaternion, translation = (np.array(part, dtype=np.float64) for part in (pose[:4], pose[4:]))
            keypoints = np.array(features.split(), dtype=np.float64).reshape(-1, 3)
            rigid = from_quaternion(quaternion, translation, f"image '{name}' of '{path}'")
            images.append(ColmapImage(name, int(camera), rigid, keypoints[:, :2], _point_ids(keypoints[:, 2])))
    return images


def _point_ids(values: np.ndarray) -> np.ndarray:
    """Numbers of sparse points, -1 for none."""
    if not (np.abs(values) < _LARGEST_ID).all():
        raise ValueError
    return values.astype(np.int64)


def read_points(path: Path) -> ColmapPoints:
    """The sparse points.

    Raises:
        CaptureError: The file is damaged.
    """
    ids, positions, colors = [], [], []
    for number, line in _lines(path):
        with _sound(path, number):
            key, *values = line.split()[:7]
            ids.append(int(key))
            positions.append([float(value) for value in values[:3]])
            red, green, blue = (int(value) for value in values[3:])
            colors.append((red, green, blue))
            if not all(0 <= value <= 255 for value in colors[-1]):
                raise ValueError
    return ColmapPoints(
        np.array(ids, dtype=np.int64),
        np.array(positions, dtype=np.float64).reshape(-1, 3),
        np.array(colors, dtype=np.uint8).reshape(-1, 3),
    )


def _lines(path: Path, keep_empty: bool = False) -> Iterator[tuple[int, str]]:
    """Numbers and contents of the lines that are no comments."""
    require_regular(path, CaptureError)
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise CaptureError(f"Cannot read '{path}': {error.strerror or error}; check the model's folder.") from None
    except UnicodeDecodeError:
        raise damaged(path, "it is no text") from None
    for number, line in enumerate(text.split("\n"), 1):
        line = line.strip()
        if not line.startswith("#") and (line or keep_empty):
            yield number, line


@contextmanager
def _sound(path: Path, number: int) -> Iterator[None]:
    try:
        yield
    except (ValueError, OverflowError):
        raise damaged(path, f"line {number} cannot be read") from None
