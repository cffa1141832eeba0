"""Where things are in a browser: its scene has the size of one unit, whatever unit of length the world has."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from difftetvr.capture.viewing import Floats, pose_of
from difftetvr.rendering import Camera

_LEAST_PIXELS, _MOST_PIXELS = 8, 4096  # of a window's sides
_NARROWEST, _WIDEST = math.radians(0.5), math.radians(170.0)


@dataclass(frozen=True, eq=False)
class Placement:
    """From the world to the scene of a browser, and back: a shift and a scale.

    Attributes:
        center: (3,) float64 point of the world that is the origin there.
        size: Length in the world that is 1 there, > 0.
    """

    center: Floats
    size: float

    @staticmethod
    def of(bounds: torch.Tensor) -> Placement:
        """The one that puts a (2, 3) box around the origin, its longest side 1."""
        corners = bounds.detach().double().cpu().numpy()
        return Placement(corners.mean(0), float((corners[1] - corners[0]).max()) or 1.0)

    def inward(self, points: Any) -> Floats:
        """(..., 3) points of the world, in the browser."""
        return (np.asarray(points, dtype=np.float64) - self.center) / self.size

    def outward(self, points: Any) -> Floats:
        """(..., 3) points of the browser, in the world."""
        return np.asarray(points, dtype=np.float64) * self.size + self.center

    def pose(self, camera: Camera) -> tuple[Floats, Floats]:
        """(4,) quaternion w, x, y, z from a camera's axes to the world's, and (3,) its position in the browser."""
        pose = pose_of(camera)
        x, y, z, w = Rotation.from_matrix(pose[:3, :3].T).as_quat()
        return np.array([w, x, y, z]), self.inward(-pose[:3, :3].T @ pose[:3, 3])

    def camera(self, wxyz: Any, position: Any, fov_y: float, size: tuple[int, int]) -> Camera:
        """The camera of a window.

        Args:
            wxyz: (4,) quaternion from its axes, those of OpenCV, to the world's.
            position: (3,) where it is in the browser.
            fov_y: Vertical field of view in radians.
            size: Width and height of the window in pixels; of larger ones the picture is coarser.
        """
        w, x, y, z = (float(value) for value in wxyz)
        turn = Rotation.from_quat([x, y, z, w]).as_matrix().T
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.from_numpy(turn)
        pose[:3, 3] = torch.from_numpy(-turn @ self.outward(position))
        scale = min(1.0, _MOST_PIXELS / max(size))
        width, height = (max(_LEAST_PIXELS, round(scale * side)) for side in size)
        focal = 0.5 * height / math.tan(0.5 * min(max(fov_y, _NARROWEST), _WIDEST))
        return Camera(pose, focal, focal, 0.5 * width, 0.5 * height, width, height)


def fov_that_holds(camera: Camera, aspect: float) -> float:
    """Vertical field of view in radians of a window that shows all that a camera sees.

    Args:
        camera: The camera.
        aspect: Width of the window over its height.
    """
    across = max(camera.cx, camera.width - camera.cx) / camera.fx
    along = max(camera.cy, camera.height - camera.cy) / camera.fy
    return 2.0 * math.atan(max(along, across / aspect))
