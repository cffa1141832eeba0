"""Cameras with lenses that bend straight lines: photographs need not be resampled."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch

from difftetvr.errors import CameraError, shown
from difftetvr.inputs import as_reals
from difftetvr.rendering.cameras.intrinsics import FieldOfView, Intrinsics, field_of_view, widest_radius
from difftetvr.rendering.cameras.lenses.distortion import Distortion
from difftetvr.rendering.cameras.lenses.models import LENS_MODELS
from difftetvr.rendering.cameras.pinhole import Camera


@dataclass(frozen=True)
class LensCamera(Camera):
    """A camera whose lens distorts, of the models of OpenCV, COLMAP and nerfstudio.

    A direction (x, y, z) of camera space has the undistorted coordinates (u, v) = (x / z, y / z); with a fisheye's
    (u, v) = theta (x, y) / rho, theta being its angle with the axis and rho the length of (x, y). With
    r2 = u^2 + v^2 and

        g = (1 + k1 r2 + k2 r2^2 + ... + k6 r2^6) / (1 + d1 r2 + d2 r2^2 + d3 r2^3)

    it is seen at the pixel (fx u' + cx, fy v' + cy), where

        u' = g u + 2 p1 u v + p2 (r2 + 2 u^2) + s1 r2 + s2 r2^2
        v' = g v + p1 (r2 + 2 v^2) + 2 p2 u v + s3 r2 + s4 r2^2

    The order of the coefficients is that of the model's own source:

    - ``"opencv"``: k1, k2, p1, p2, k3, then d1, d2, d3 (called k4, k5, k6 there), s1 to s4, and the two angles tau_x
      and tau_y, in radians, by which the sensor is tilted behind all this; 2, 4, 5, 8, 12 or 14 of them. COLMAP's
      SIMPLE_RADIAL, RADIAL, OPENCV and FULL_OPENCV are such.
    - ``"nerfstudio"``: k1, k2, k3, k4, p1, p2; the first 2 or all.
    - ``"fov"``: omega, with g = atan(2 r tan(omega / 2)) / (r omega), r^2 being r2.
    - ``"division"``: k, with g = 2 / (1 + sqrt(1 - 4 k r2)).
    - ``"eucm"``: alpha and beta, with g = 1 / (alpha sqrt(1 + beta r2) + 1 - alpha).
    - ``"fisheye"``: none, or 1, 2 or 4 of k1 to k4.
    - ``"thin-prism-fisheye"``: k1, k2, p1, p2, k3, k4, sx1 (here s1), sy1 (s3).
    - ``"rad-tan-thin-prism-fisheye"``, also called Fisheye624: k0 to k5 (here k1 to k6), p0, p1 (p2, p1), s0 to s3
      (s1 to s4); all that is not g is of g u and g v instead of u and v.

    Lenses that are no fisheyes see nothing at right angles to the axis or behind.

    Sources: OpenCV's manual, modules calib3d and fisheye; https://colmap.github.io/cameras.html and COLMAP's
    sensor/models; cameras/camera_utils.py of nerfstudio.

    Attributes:
        model: One of those above.
        coefficients: (N,) as above; images are differentiable in them.

    Raises:
        CameraError: As of `Camera`, or the model is unknown, or has another number of coefficients, or omega is out of
            range.
    """

    model: str = "opencv"
    coefficients: torch.Tensor = field(default_factory=lambda: torch.zeros(2))

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.model, str) or self.model not in LENS_MODELS:
            raise CameraError(f"There is no lens model {shown(self.model)}; choose one of {', '.join(LENS_MODELS)}.")
        values = as_reals(self.coefficients, "The lens's coefficients", CameraError).reshape(-1)
        counts = LENS_MODELS[self.model].counts
        if len(values) not in counts:
            given = " or ".join(str(count) for count in counts)
            raise CameraError(f"The lens has {len(values)} coefficients; the model '{self.model}' takes {given}.")
        if not bool(torch.isfinite(values.detach()).all()):
            raise CameraError("A coefficient of the lens is not finite; give finite numbers.")
        if self.model == "fov" and not bool(values.detach().abs() < math.pi):
            raise CameraError(f"The field of view omega is {float(values[0])} radians; it must lie between -pi and pi.")
        object.__setattr__(self, "coefficients", values)

    def ray_directions(self) -> torch.Tensor:
        """(H, W, 3) unit directions of the pixels' rays in camera space, float64; differentiable in all parameters.

        They are where the extrinsics are, if that knows float64, and NaN where the lens cannot have made a pixel.
        """
        view = self._field_of_view()
        return torch.where(view.known[..., None], view.directions, torch.nan)

    def _sight(self) -> tuple[torch.Tensor, torch.Tensor | float]:
        """As of all cameras; of pixels that the lens cannot have made nothing is seen."""
        view = self._field_of_view()
        return view.directions, torch.where(view.known, math.inf, 0.0).to(view.directions.device)

    def _field_of_view(self) -> FieldOfView:
        if self.intrinsics is None and not self.coefficients.requires_grad:
            return field_of_view(self._numbers, self._double_device)
        lens = Distortion(self.model, tuple(self.coefficients.to(self._double_device, torch.float64).unbind()))
        directions = lens.directions(lens.undistort(self.plane_points()))
        known = torch.isfinite(directions.detach()).all(-1)
        ahead = torch.eye(3, dtype=directions.dtype, device=directions.device)[2]
        return FieldOfView(torch.where(known[..., None], directions, ahead), known)

    def _flattened(self, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        lens = Distortion(self.model, tuple(self.coefficients.to(places).unbind()))
        undistorted, enlarged = lens.coordinates(places)
        # Beyond the image the formulas may fold back into it: what lies there is seen in proportion.
        widest = max(widest_radius(self._numbers), torch.finfo(places.dtype).tiny)
        beyond = (undistorted.norm(dim=-1) / widest).clamp(min=1.0)
        within = undistorted / beyond[:, None]
        a, b, c, d = lens.jacobian(within)
        stretch = torch.maximum(a.abs() + b.abs(), c.abs() + d.abs())
        return lens.distort(within) * beyond[:, None], enlarged * stretch

    @property
    def _numbers(self) -> Intrinsics:
        lens = Distortion(self.model, tuple(self.coefficients.tolist()))
        return Intrinsics(self.fx, self.fy, self.cx, self.cy, self.width, self.height, lens)
