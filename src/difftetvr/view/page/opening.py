"""Where a page's eye stands when it opens."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import torch

from difftetvr.rendering import Camera
from difftetvr.view.blank import require_drawable
from difftetvr.view.frames.visible import DIRECTION, FOV, UP


@dataclass(frozen=True)
class Opening:
    """An eye, in the units of a page: from the middle of the mesh's box, the longest side is 1.

    Attributes:
        eye: Where it stands.
        target: What it looks at, and turns around.
        up: What is upwards in the picture.
        fov: Degrees that the shorter side of the window spans.
    """

    eye: tuple[float, float, float]
    target: tuple[float, float, float]
    up: tuple[float, float, float]
    fov: float

    @staticmethod
    def of(center: torch.Tensor, extent: torch.Tensor, camera: Camera | None = None) -> Opening:
        """As a camera stands; without one so that the whole box is seen, from in front and a little above.

        Args:
            center: (3,) middle of the box, float64.
            extent: (3,) its sides, float64.
            camera: A pinhole camera.

        Raises:
            MeshError: The box is too small or too large for squares of lengths.
        """
        size = float(extent.max())
        require_drawable(size, "The mesh")
        if camera is not None:
            return _as_camera(center, size, camera)
        direction = torch.tensor(DIRECTION, dtype=torch.float64)
        distance = 0.5 * float((extent / size).norm()) / math.sin(0.5 * math.radians(FOV))
        return Opening(_three(distance * direction / direction.norm()), (0.0, 0.0, 0.0), UP, FOV)

    def camera(self, center: torch.Tensor, size: float, pixels: int) -> Camera:
        """The camera of a square picture, in the world.

        Args:
            center: (3,) middle of the mesh's box, float64.
            size: Its longest side.
            pixels: Of each side of the picture.
        """
        eye, target = (center + size * torch.tensor(v, dtype=torch.float64) for v in (self.eye, self.target))
        return Camera.look_at(eye, target, self.up, math.radians(self.fov), pixels, pixels)


def _as_camera(center: torch.Tensor, size: float, camera: Camera) -> Opening:
    pose = camera.world_to_camera.detach().cpu().double()
    rotation = pose[:3, :3]
    eye = (-rotation.T @ pose[:3, 3] - center) / size
    # It turns around what lies before it, beside the middle of the mesh.
    ahead = float(-eye @ rotation[2])
    target = eye + (ahead if ahead > 0 else 1.0) * rotation[2]
    pixels, focal = (camera.height, camera.fy) if camera.height <= camera.width else (camera.width, camera.fx)
    return Opening(
        _three(eye), _three(target), _three(-rotation[1]), math.degrees(2.0 * math.atan(0.5 * pixels / focal))
    )


def _three(vector: torch.Tensor) -> Any:
    return tuple(vector.tolist())
