"""Panoramas: all directions in one image."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from difftetvr.rendering.cameras.checks import take_pose, take_size
from difftetvr.rendering.cameras.pinhole import Camera, Vector
from difftetvr.rendering.cameras.rigid import pencil

if TYPE_CHECKING:
    from difftetvr.rendering.rays import Rays


@dataclass(frozen=True)
class PanoramicCamera:
    """A camera that sees all around (equirectangular projection).

    Columns run through the longitudes from -pi to pi, where 0 is the camera's +z axis and pi / 2 its +x axis; rows
    through the latitudes from straight up (-y) to straight down.

    Attributes:
        world_to_camera: (4, 4) rigid transform. Images are differentiable in it.
        width: Image width in pixels.
        height: Image height in pixels.

    Raises:
        CameraError: A value is out of range or no number, or the extrinsics are no rigid transform.
    """

    world_to_camera: torch.Tensor
    width: int
    height: int

    def __post_init__(self) -> None:
        take_size(self)
        take_pose(self)

    @staticmethod
    def look_at(
        eye: Vector, target: Vector, up: Vector = (0.0, 0.0, 1.0), width: int = 1024, height: int = 512
    ) -> PanoramicCamera:
        """Camera at ``eye`` with ``target`` in the middle of its image; arguments as of :meth:`Camera.look_at`."""
        frame = Camera.look_at(eye, target, up, 1.0, width, height)
        return PanoramicCamera(frame.world_to_camera, frame.width, frame.height)

    def rays(self) -> Rays:
        """The rays of all pixels in world space, (H, W); differentiable in the pose."""
        from difftetvr.rendering.rays import Rays  # late: it needs cameras' errors, not cameras

        device = self.world_to_camera.device
        longitude, latitude = (
            ((torch.arange(count, dtype=torch.float64, device=device) + 0.5) / count - 0.5) * span
            for count, span in ((self.width, 2.0 * math.pi), (self.height, math.pi))
        )
        rows, columns = torch.meshgrid(latitude, longitude, indexing="ij")
        across = torch.cos(rows)
        seen = torch.stack([torch.sin(columns) * across, torch.sin(rows), torch.cos(columns) * across], dim=-1)
        return Rays(*pencil(self.world_to_camera, seen))
