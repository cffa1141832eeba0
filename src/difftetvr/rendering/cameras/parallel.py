"""Parallel projection: what orthographic pictures and parallel-beam detectors see."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from difftetvr.errors import CameraError, shown
from difftetvr.inputs import as_reals
from difftetvr.rendering.cameras.checks import number, take_pose, take_size
from difftetvr.rendering.cameras.pinhole import Camera, Vector

if TYPE_CHECKING:
    from difftetvr.rendering.rays import Rays


@dataclass(frozen=True)
class ParallelCamera:
    """An orthographic camera: all rays run along its +z axis; +x points right and +y down, as for `Camera`.

    Attributes:
        world_to_camera: (4, 4) rigid transform. Images are differentiable in it.
        pixel_size: Width and height of a pixel in world units: a number, or (2,); differentiable.
        width: Image width in pixels.
        height: Image height in pixels.
        near: Depth in camera space from which on rays see; -infinity for all that lies behind the camera, too.

    Raises:
        CameraError: A value is out of range or no number, or the extrinsics are no rigid transform.
    """

    world_to_camera: torch.Tensor
    pixel_size: float | torch.Tensor
    width: int
    height: int
    near: float = 0.0

    def __post_init__(self) -> None:
        take_size(self)
        take_pose(self)
        size = as_reals(self.pixel_size, "The camera's pixel_size", CameraError, torch.float64, "pass a number")
        if size.numel() not in (1, 2) or not bool((torch.isfinite(size.detach()) & (size.detach() > 0)).all()):
            raise CameraError(f"The camera's pixel_size is {shown(self.pixel_size)}; give one or two positive numbers.")
        object.__setattr__(self, "pixel_size", size.reshape(-1).expand(2))
        near = number("near", self.near)
        if math.isnan(near) or near == math.inf:
            raise CameraError(f"The camera's near is {near}; give a depth, or -infinity.")
        object.__setattr__(self, "near", near)

    @staticmethod
    def look_at(
        eye: Vector,
        target: Vector,
        up: Vector = (0.0, 0.0, 1.0),
        extent: float = 2.0,
        width: int = 512,
        height: int = 512,
    ) -> ParallelCamera:
        """Camera at ``eye`` that looks at ``target``, with square pixels.

        Args:
            eye: (3,) position in world space of the image's centre.
            target: (3,) point behind that centre.
            up: (3,) direction that projects to the image's upward direction.
            extent: Height of the image in world units, > 0.
            width: Image width in pixels.
            height: Image height in pixels.

        Raises:
            CameraError: The points coincide, ``up`` is parallel to the view, or a value is out of range.
        """
        frame = Camera.look_at(eye, target, up, 1.0, width, height)
        return ParallelCamera(frame.world_to_camera, number("extent", extent) / frame.height, frame.width, frame.height)

    def rays(self) -> Rays:
        """The rays of all pixels in world space, (H, W); differentiable in pose and pixel size."""
        from difftetvr.rendering.rays import Rays  # late: it needs cameras' errors, not cameras

        pose = self.world_to_camera.double()
        assert isinstance(self.pixel_size, torch.Tensor)
        size = self.pixel_size.to(pose)
        x, y = (
            (torch.arange(count, dtype=torch.float64, device=pose.device) + 0.5 - 0.5 * count) * step
            for count, step in zip((self.width, self.height), size, strict=True)
        )
        rows, columns = torch.meshgrid(y, x, indexing="ij")
        places = torch.stack([columns, rows, torch.zeros_like(rows)], dim=-1)
        # No matrix products, which torch.autocast would round.
        origins = ((places - pose[:3, 3])[..., None] * pose[:3, :3]).sum(-2)
        return Rays(origins, pose[2, :3], self.near)
