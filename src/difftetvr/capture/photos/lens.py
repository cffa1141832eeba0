"""What a lens does: pinhole intrinsics, and the distortion model of OpenCV and COLMAP with its inverse."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field, replace

import numpy as np

from difftetvr.errors import CaptureError

_FARTHEST = 1e12  # pixels, and more than any distortion: what is farther overflows later
_NEWTON_STEPS = 30
_NEWTON_TOLERANCE = 1e-10


@dataclass(frozen=True)
class Distortion:
    """Radial (rational) and tangential distortion of normalised image coordinates.

    With r2 = x^2 + y^2 and g = (1 + k1 r2 + k2 r2^2 + k3 r2^3) / (1 + k4 r2 + k5 r2^2 + k6 r2^3):

        x' = g x + 2 p1 x y + p2 (r2 + 2 x^2),      y' = g y + p1 (r2 + 2 y^2) + 2 p2 x y

    Source: OpenCV's camera calibration manual; COLMAP's models SIMPLE_RADIAL to FULL_OPENCV are special cases.

    Attributes:
        k1: Radial, numerator, as are k2 and k3.
        k2: See above.
        p1: Tangential, as is p2.
        p2: See above.
        k3: See above.
        k4: Radial, denominator, as are k5 and k6.
        k5: See above.
        k6: See above.
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    @property
    def is_none(self) -> bool:
        """Whether the lens is a pinhole."""
        return not any(astuple(self))

    def distort(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) distorted from undistorted normalised coordinates."""
        return self._distort_with_jacobian(points)[0]

    def keeps_orientation(self, points: np.ndarray) -> np.ndarray:
        """(...) bool, whether the mapping is locally one-to-one and not mirrored at undistorted coordinates."""
        _, (a, b, c, d) = self._distort_with_jacobian(points)
        return a * d - b * c > 0

    def undistort(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) undistorted from distorted normalised coordinates, by Newton's method.

        Points that the lens cannot have made are NaN.
        """
        guess = points.copy()
        # Distortions that no lens has run away; what they end at is told apart below.
        with np.errstate(all="ignore"):
            for _ in range(_NEWTON_STEPS):
                image, (a, b, c, d) = self._distort_with_jacobian(guess)
                residual, determinant = image - points, a * d - b * c
                step_x = (d * residual[..., 0] - b * residual[..., 1]) / determinant
                step_y = (a * residual[..., 1] - c * residual[..., 0]) / determinant
                guess = guess - np.stack([step_x, step_y], axis=-1)
                if np.abs(residual).max() < _NEWTON_TOLERANCE:
                    break
            found = np.abs(self.distort(guess) - points).max(axis=-1) < 1e-6
            found &= self.keeps_orientation(guess)
        return np.where(found[..., None], guess, np.nan)

    def _distort_with_jacobian(
        self, points: np.ndarray
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]]:
        """Distorted points and the derivatives dx'/dx, dx'/dy, dy'/dx, dy'/dy."""
        x, y = points[..., 0], points[..., 1]
        r2 = x * x + y * y
        above = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        below = 1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        above_slope = self.k1 + r2 * (2 * self.k2 + r2 * 3 * self.k3)
        below_slope = self.k4 + r2 * (2 * self.k5 + r2 * 3 * self.k6)
        g = above / below
        slope = 2 * (above_slope - g * below_slope) / below
        p1, p2 = self.p1, self.p2
        distorted = np.stack(
            [
                g * x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
                g * y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
            ],
            axis=-1,
        )
        mixed = slope * x * y + 2 * (p1 * x + p2 * y)
        across = g + slope * x * x + 2 * p1 * y + 6 * p2 * x
        down = g + slope * y * y + 6 * p1 * y + 2 * p2 * x
        return distorted, (across, mixed, mixed, down)


@dataclass(frozen=True)
class Intrinsics:
    """A lens in front of a sensor of known size; pixel (i, j) has its centre at (i + 0.5, j + 0.5).

    Attributes:
        fx: Focal length in pixels along x.
        fy: Focal length in pixels along y.
        cx: Principal point in pixels along x.
        cy: Principal point in pixels along y.
        width: Pixels of a row.
        height: Pixels of a column.
        distortion: What the lens does beyond a pinhole.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: Distortion = field(default_factory=Distortion)

    def resized(self, width: int, height: int) -> Intrinsics:
        """The same field of view on another number of pixels."""
        return self._scaled(width / self.width, height / self.height, width, height)

    def shrunk(self, factor: int) -> Intrinsics:
        """After averaging blocks of ``factor`` x ``factor`` pixels, from the upper left; incomplete blocks are lost."""
        return self._scaled(1 / factor, 1 / factor, self.width // factor, self.height // factor)

    def _scaled(self, x: float, y: float, width: int, height: int) -> Intrinsics:
        return replace(self, fx=self.fx * x, fy=self.fy * y, cx=self.cx * x, cy=self.cy * y, width=width, height=height)

    def to_normalised(self, pixels: np.ndarray) -> np.ndarray:
        """(..., 2) coordinates in the plane at distance 1, distortion included, of positions in pixels."""
        return (pixels - (self.cx, self.cy)) / (self.fx, self.fy)

    def to_pixels(self, normalised: np.ndarray) -> np.ndarray:
        """(..., 2) positions in pixels of coordinates in the plane at distance 1, distortion included."""
        return normalised * (self.fx, self.fy) + (self.cx, self.cy)

    def project(self, points: np.ndarray) -> np.ndarray:
        """(..., 2) pixels where (..., 3) points in camera space, in front of the camera, are seen."""
        return self.to_pixels(self.distortion.distort(points[..., :2] / points[..., 2:]))


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
        if not all(abs(v) <= _FARTHEST for v in (cx, cy, *astuple(self.distortion))):
            raise CaptureError(
                f"The principal point or distortion of {where} is not finite or far too large; correct the file."
            )
        return Intrinsics(fx, fy, cx, cy, width, height, self.distortion)


def _focal_length(angle: float | None, size: int, where: str) -> float | None:
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise CaptureError(f"The field of view of {where} is {angle} radians; it must lie between 0 and pi.")
    return 0.5 * size / math.tan(0.5 * angle)
