"""Geometries of TIGRE as dictionaries: what ``vars(geo)`` holds with the angles, arrays as lists.

All are in TIGRE's orders: [z, y, x] of volumes, [v, u] of detectors, radians, and the lowest row first.

Source: https://github.com/CERN/TIGRE, ``Python/tigre/utilities/geometry.py`` and ``Common/CUDA/Siddon_projection.cu``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from difftetvr.capture.projections.descriptions.circular import Circular
from difftetvr.capture.projections.descriptions.described import Parts
from difftetvr.capture.projections.descriptions.entries import Entries, as_numbers
from difftetvr.errors import CaptureError

Floats = NDArray[np.float64]


def is_tigre(values: Any) -> bool:
    """Whether a description in JSON is one of TIGRE."""
    return isinstance(values, Mapping) and "nDetector" in values


def parse_tigre(values: Any, source: str) -> Parts:
    """The geometry that a dictionary of TIGRE tells; its entries about reconstruction are passed over.

    Raises:
        CaptureError: An entry is missing or out of range.
    """
    entries = Entries(values, source)
    scan = scan_of(entries, _angles(entries))
    size = _sides(entries, "sVoxel", "nVoxel", "dVoxel", 3)[::-1]
    offset = _per_view(entries, "offOrigin", 3, len(scan.angles))[:, ::-1]
    if (offset != offset[0]).any():
        entries.refuse("offOrigin", "give one for all views, since the volume is to stay where it is")
    bounds = offset[0] + np.array([[-0.5], [0.5]]) * size
    degrees = np.rad2deg(scan.angles) if scan.angles.ndim == 1 else None
    return Parts(scan.detector(), bounds, entries.text("unit"), degrees)


def scan_of(entries: Entries, angles: Floats, *, upward: bool = True) -> Circular:
    """The scanner that entries with TIGRE's names tell.

    Args:
        entries: The description.
        angles: (V,) or (V, 3) radians.
        upward: Whether the first row is the lowest one.

    Raises:
        CaptureError: An entry is missing or out of range.
    """
    count = len(angles)
    mode = entries.text("mode", ("cone", "parallel")) or "cone"
    height, width = _whole(entries, "nDetector")
    sides = _sides(entries, "sDetector", "nDetector", "dDetector", 2)[::-1]
    distances: dict[str, Any] = {}
    if mode == "cone":
        source, detector = (_each(entries, name, count) for name in ("DSO", "DSD"))
        if not (detector > source).all() or not (source > 0).all():
            raise CaptureError(
                f"{entries.source} has DSD {detector[0]:g} and DSO {source[0]:g}, so that its detector is not behind "
                "the axis; DSD is the distance from source to detector, and greater than DSO."
            )
        distances = {"source_distance": source, "detector_distance": detector}
    turns = _per_view(entries, "rotDetector", 3, count)[:, ::-1]  # roll around z, pitch around y, yaw around x
    return Circular(
        angles,
        width,
        height,
        sides / np.array([width, height]),
        offset=_per_view(entries, "offDetector", 2, count)[:, ::-1],
        tilt=turns,
        axis_offset=_each(entries, "COR", count, 0.0),
        upward=upward,
        **distances,
    )


def _angles(entries: Entries) -> Floats:
    found = as_numbers(entries.required("angles"))
    if (
        found is None
        or not found.size
        or found.ndim not in (1, 2)
        or (found.ndim == 2 and found.shape[1] not in (1, 3))
    ):
        entries.refuse("angles", "give radians, one for each view, or three of them as TIGRE has")
    if found.ndim == 2 and (found.shape[1] == 1 or not found[:, 1:].any()):
        found = found[:, 0]
    return found


def _whole(entries: Entries, name: str) -> tuple[int, int]:
    numbers = entries.numbers(name, (2,), positive=True)
    if (numbers != np.round(numbers)).any():
        entries.refuse(name, "give whole numbers of rows and of columns")
    return int(numbers[0]), int(numbers[1])


def _sides(entries: Entries, whole: str, number: str, step: str, count: int) -> Floats:
    """Lengths along all axes, given as such, or as numbers of steps and their lengths."""
    if whole in entries:
        return entries.numbers(whole, (count,), positive=True)
    return entries.numbers(number, (count,), positive=True) * entries.numbers(step, (count,), positive=True)


def _per_view(entries: Entries, name: str, width: int, count: int) -> Floats:
    """(V, width) numbers that may be given once; 0 where there are none. A third one of a detector's offset is 0."""
    if name not in entries:
        return np.zeros((count, width))
    numbers = as_numbers(entries.values[name])
    if numbers is None or numbers.ndim not in (1, 2) or (numbers.ndim == 2 and len(numbers) not in (1, count)):
        entries.refuse(name, f"give {width} finite numbers, or as many for each view")
    if numbers.shape[-1] == width + 1 and not numbers[..., width:].any():
        numbers = numbers[..., :width]
    if numbers.shape[-1] != width:
        entries.refuse(name, f"give {width} finite numbers, or as many for each view")
    return np.broadcast_to(numbers, (count, width))


def _each(entries: Entries, name: str, count: int, default: float | None = None) -> Floats:
    """(V,) numbers that may be given once."""
    numbers = entries.numbers(name, (1, count), None if default is None else (default,))
    return np.broadcast_to(numbers, (count,))
