"""Scanners that turn around the axis z: where source and detector are at each angle.

At angle 0 the source is at +x, rays run towards -x, columns of the detector run along +y and z is up. Greater angles
turn all of it counter-clockwise around z, seen from above. This is the frame of TIGRE, and with the first row on top
that of the projections of R2-Gaussian.

Source: Biguri, Dosanjh, Hancock, Soleimani, "TIGRE", Biomed. Phys. Eng. Express 2 (2016), and its source code.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from difftetvr.rendering.cameras.detector import Detector

Floats = NDArray[np.float64]

_FULL_TURN = 350.0  # degrees from which on each line through the object is seen from either side


@dataclass(frozen=True)
class Circular:
    """A scan around z; all lengths are in one unit. What is given for each view, or once for all, broadcasts.

    Attributes:
        angles: (V,) radians, or (V, 3) angles around z, y and z again, as TIGRE's.
        width: Pixels of a row.
        height: Number of rows.
        pixel: (2,) distances of columns and of rows.
        source_distance: () or (V,) from the source to the axis; None for parallel rays.
        detector_distance: () or (V,) from the source to the detector; for parallel rays from the axis to it.
        offset: (2,) or (V, 2) shift of the detector along its columns' direction and upwards.
        tilt: (3,) or (V, 3) radians by which the detector is turned around x, then y, then z at angle 0.
        axis_offset: () or (V,) shift of source and detector along the columns' direction, TIGRE's COR.
        pitch: How far the scanner rises in a turn.
        upward: Whether the first row is the lowest one.
    """

    angles: Floats
    width: int
    height: int
    pixel: Floats
    source_distance: Any = None
    detector_distance: Any = 0.0
    offset: Any = (0.0, 0.0)
    tilt: Any = (0.0, 0.0, 0.0)
    axis_offset: Any = 0.0
    pitch: float = 0.0
    upward: bool = False

    def detector(self) -> Detector:
        """All views."""
        turned = self._rotations()
        count = len(turned)
        shift = np.stack([np.zeros(count), np.broadcast_to(self.axis_offset, count), np.zeros(count)], axis=-1)
        rise = np.zeros((count, 3))
        rise[:, 2] = self._rise()
        center = shift.copy()
        source = None
        if self.source_distance is None:
            center[:, 0] -= self.detector_distance
        else:
            center[:, 0] -= np.asarray(self.detector_distance) - np.asarray(self.source_distance)
            source = shift.copy()
            source[:, 0] += self.source_distance
        center[:, 1:] += self.offset
        own = _rotation_xyz(np.broadcast_to(np.asarray(self.tilt, dtype=np.float64), (count, 3)))
        row = np.array([0.0, 0.0, self.pixel[1] if self.upward else -self.pixel[1]])
        vectors = {
            "center": _turn(turned, center) + rise,
            "columns": _turn(turned, _turn(own, np.array([0.0, self.pixel[0], 0.0]))),
            "rows": _turn(turned, _turn(own, row)),
        }
        if source is None:
            vectors["direction"] = _turn(turned, np.array([-1.0, 0.0, 0.0]))
        else:
            vectors["source"] = _turn(turned, source) + rise
        tensors = {name: torch.from_numpy(np.ascontiguousarray(value)) for name, value in vectors.items()}
        return Detector(width=self.width, height=self.height, **tensors)

    def field_of_view(self) -> Floats:
        """(2, 3) box around the cylinder that all views see whole; around a full turn, each from one side at least.

        It may be empty.
        """
        half = 0.5 * np.array([self.width, self.height]) * self.pixel
        offset = np.broadcast_to(self.offset, (len(self.angles), 2))
        ends = np.array([np.min(half - offset, axis=0), np.min(half + offset, axis=0)])  # right and up; left and down
        turn = np.rad2deg(np.ptp(self.angles if self.angles.ndim == 1 else self.angles[:, 0]))
        spacing = turn / max(len(self.angles) - 1, 1)
        reach = ends[:, 0].max() if turn + spacing >= _FULL_TURN else ends[:, 0].min()
        radius, (low, high) = max(reach, 0.0), (-ends[1, 1], ends[0, 1])
        if self.source_distance is not None:
            source, detector = np.min(self.source_distance), np.max(self.detector_distance)
            radius = source * radius / np.hypot(radius, detector)
            nearest = (source - radius) / detector
            low, high = low * nearest, high * nearest
        rise = self._rise()
        return np.array([[-radius, -radius, low + rise.min()], [radius, radius, high + rise.max()]])

    def _rise(self) -> Floats:
        """(V,) how far each view is above the middle one."""
        angles = self.angles if self.angles.ndim == 1 else self.angles[:, 0]
        return self.pitch * (angles - 0.5 * (angles[0] + angles[-1])) / (2.0 * np.pi)

    def _rotations(self) -> Floats:
        if self.angles.ndim == 1:
            return _around(self.angles, 2)
        first, second, third = self.angles.T
        return _around(first, 2) @ _around(second, 1) @ _around(third, 2)


def _rotation_xyz(angles: Floats) -> Floats:
    """(V, 3, 3) turns around x, then y, then z."""
    x, y, z = angles.T
    return _around(z, 2) @ _around(y, 1) @ _around(x, 0)


def _around(angle: Floats, axis: int) -> Floats:
    """(V, 3, 3) counter-clockwise turns around an axis."""
    turns = np.zeros((len(angle), 3, 3))
    one, two = (axis + 1) % 3, (axis + 2) % 3
    turns[:, axis, axis] = 1.0
    turns[:, one, one] = turns[:, two, two] = np.cos(angle)
    turns[:, two, one] = np.sin(angle)
    turns[:, one, two] = -np.sin(angle)
    return turns


def _turn(turns: Floats, vectors: Floats) -> Floats:
    turned: Floats = np.einsum("vij,...j->vi" if vectors.ndim == 1 else "vij,vj->vi", turns, vectors)
    return turned
