"""What files say about lenses, and the intrinsics that follow for an image."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch

from difftetvr.errors import CameraError, CaptureError
from difftetvr.rendering.cameras.intrinsics import Intrinsics
from difftetvr.rendering.cameras.lens import LensCamera
from difftetvr.rendering.cameras.lenses.distortion import Distortion
from difftetvr.rendering.cameras.pinhole import Camera

_FARTHEST = 1e12  # pixels, and more than any distortion: what is farther overflows later


@dataclass(frozen=True)
class Lens:
    """What a file says about a camera; what it leaves out follows from the image's size.

    Attributes:
        fx: Focal length in pixels along x.
        fy: Focal length in pixels along y.
        cx: Principal point in pixels along x; None stands for the image's centre.
        cy: Principal point in pixels along y; None stands for the image's centre.
        angle_x: Horizontal field of view in radians, where there is no focal length.
        angle_y: Vertical field of view in radians, where there is no focal length.
        width: Pixels of a row that the numbers are meant for; None stands for the image's.
        height: Pixels of a column that the numbers are meant for; None stands for the image's.
        distortion: What the lens does beyond a pinhole.
    """

    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    angle_x: float | None = None
    angle_y: float | None = None
    width: int | None = None
    height: int | None = None
    distortion: Distortion = field(default_factory=Distortion)

    def on(self, width: int, height: int, where: str) -> Intrinsics:
        """The intrinsics for an image of that size.

        Raises:
            CaptureError: There is no focal length, or a value is out of range.
        """
        fx = self.fx if self.fx is not None else _focal_length(self.angle_x, width, where)
        fy = self.fy if self.fy is not None else _focal_length(self.angle_y, height, where)
        fx = fx if fx is not None else fy
        fy = fy if fy is not None else fx
        if fx is None or fy is None:
            raise CaptureError(f"The camera of {where} has no focal length; give one.")
        if not (0 < fx <= _FARTHEST and 0 < fy <= _FARTHEST):
            raise CaptureError(
                f"The focal lengths of {where} are ({fx:g}, {fy:g}) pixels; both must be greater than 0, and no more "
                "than a lens has."
            )
        cx = self.cx if self.cx is not None else 0.5 * width
        cy = self.cy if self.cy is not None else 0.5 * height
        if not all(abs(v) <= _FARTHEST for v in (cx, cy, *self.distortion.coefficients)):
            raise CaptureError(
                f"The principal point or distortion of {where} is not finite or far too large; correct the file."
            )
        return Intrinsics(fx, fy, cx, cy, width, height, self.distortion)


def make_camera(intrinsics: Intrinsics, pose: torch.Tensor, where: str) -> Camera:
    """A camera: a `LensCamera` where the lens distorts, else a pinhole.

    Args:
        intrinsics: Its lens and size.
        pose: (4, 4) world-to-camera.
        where: What it belongs to, for messages.

    Raises:
        CaptureError: A value is out of range.
    """
    i, lens = intrinsics, intrinsics.distortion
    numbers = (pose, i.fx, i.fy, i.cx, i.cy, i.width, i.height)
    try:
        if lens.is_none:
            return Camera(*numbers)
        coefficients = torch.tensor(lens.coefficients, dtype=torch.float64)
        return LensCamera(*numbers, model=lens.model, coefficients=coefficients)
    except CameraError as error:
        raise CaptureError(f"The camera of {where} is not valid: {error}") from None


def _focal_length(angle: float | None, size: int, where: str) -> float | None:
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise CaptureError(f"The field of view of {where} is {angle} radians; it must lie between 0 and pi.")
    return 0.5 * size / math.tan(0.5 * angle)
