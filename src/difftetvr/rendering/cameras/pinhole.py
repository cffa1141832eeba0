"""Pinhole cameras in OpenCV axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import torch

from difftetvr.errors import CameraError, shown
from difftetvr.inputs import as_reals, handed_over
from difftetvr.rendering.cameras.checks import number, pixels, require_places, take_pose, take_size
from difftetvr.rendering.cameras.lenses.distortion import Distortion, through_plane
from difftetvr.rendering.cameras.rigid import pencil, transformed

if TYPE_CHECKING:
    from difftetvr.backend import Backend
    from difftetvr.rendering.rays import Rays
    from difftetvr.rendering.traversal.rays import ImageRays

_FAR = 16.0  # distances of camera and target from the origin, in their distance from each other
_LEAST_SINGLE, _MOST_SINGLE = 1e-30, 1e30  # distances that float32 holds with all digits, and sums of them

Vector = Sequence[float] | torch.Tensor


@dataclass(frozen=True)
class Camera:
    """A pinhole camera; +x points right, +y down and +z forward (OpenCV axes).

    The ray of pixel (i, j), column i and row j, goes through its centre (i + 0.5, j + 0.5).

    Attributes:
        world_to_camera: (4, 4) rigid transform, the extrinsics. Images are differentiable in it.
        fx: Focal length in pixels along x, > 0.
        fy: Focal length in pixels along y, > 0.
        cx: Principal point in pixels along x.
        cy: Principal point in pixels along y.
        width: Image width in pixels.
        height: Image height in pixels.
        intrinsics: (4,) fx, fy, cx and cy as a tensor that images are differentiable in; None where none of them
            requires a gradient. One that is passed replaces the four numbers; where one of these is a tensor that
            requires a gradient, it is made of them.

    Raises:
        CameraError: A value is out of range or no number, or the extrinsics are no rigid transform.
    """

    world_to_camera: torch.Tensor
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    intrinsics: torch.Tensor | None = None

    def __post_init__(self) -> None:
        self._gather_intrinsics()
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(self, name, number(name, getattr(self, name)))
        if not all(math.isfinite(v) for v in (self.fx, self.fy, self.cx, self.cy)):
            raise CameraError("A focal length or principal point is not finite; give finite pixel values.")
        if self.fx <= 0 or self.fy <= 0:
            raise CameraError(f"Focal lengths are ({self.fx}, {self.fy}) pixels; both must be greater than 0.")
        take_size(self)
        take_pose(self)

    def _gather_intrinsics(self) -> None:
        names = ("fx", "fy", "cx", "cy")
        given, values = self.intrinsics, [getattr(self, name) for name in names]
        learned = [value for value in values if isinstance(value, torch.Tensor) and value.requires_grad]
        if given is None and learned:
            numbers = [as_reals(v, f"The camera's {n}", CameraError) for n, v in zip(names, values, strict=True)]
            for name, value in zip(names, numbers, strict=True):
                if value.numel() != 1:
                    raise CameraError(f"The camera's {name} has the shape {tuple(value.shape)}; pass one number.")
            given = torch.stack([handed_over(value.reshape(()), learned[0], torch.float64) for value in numbers])
        if given is None:
            return
        given = as_reals(given, "The camera's intrinsics", CameraError)
        if given.shape != (4,):
            raise CameraError(f"The camera's intrinsics have shape {tuple(given.shape)}; pass fx, fy, cx and cy, (4,).")
        for name, value in zip(names, given.tolist(), strict=True):
            object.__setattr__(self, name, value)
        object.__setattr__(self, "intrinsics", given if given.requires_grad else None)

    @staticmethod
    def look_at(
        eye: Vector,
        target: Vector,
        up: Vector = (0.0, 0.0, 1.0),
        fov_y: float = 0.927,
        width: int = 512,
        height: int = 512,
    ) -> Camera:
        """Camera at ``eye`` that looks at ``target``, with square pixels and a centred principal point.

        Args:
            eye: (3,) position in world space.
            target: (3,) point that projects to the image centre.
            up: (3,) direction that projects to the image's upward direction.
            fov_y: Vertical field of view in radians, in (0, pi).
            width: Image width in pixels.
            height: Image height in pixels.

        Returns:
            The camera; its extrinsics are float64 if it is so far from the origin that float32 would not tell where it
            is, or distances are too large or too small for float32, and else float32.

        Raises:
            CameraError: The points coincide, ``up`` is parallel to the view, or a value is out of range.
        """
        fov_y, width, height = number("fov_y", fov_y), pixels("width", width), pixels("height", height)
        if not 0.0 < fov_y < math.pi:
            raise CameraError(f"fov_y is {fov_y} radians; it must lie between 0 and pi.")
        vectors = {"eye": eye, "target": target, "up": up}
        origin, center, upward = (
            as_reals(v, name, CameraError, torch.float64, "pass a vector").double().reshape(-1)
            for name, v in vectors.items()
        )
        if any(v.numel() != 3 for v in (origin, center, upward)):
            raise CameraError("eye, target and up must each have three components.")
        if not all(bool(torch.isfinite(v).all()) for v in (origin, center, upward)):
            raise CameraError("A component of eye, target or up is not finite; give finite world-space values.")
        forward = center - origin
        right = torch.linalg.cross(forward, upward)
        if not right.norm() > 1e-9 * forward.norm() * upward.norm():
            raise CameraError("eye and target coincide, or up is parallel to the view; choose another up vector.")
        forward, right = forward / forward.norm(), right / right.norm()
        rotation = torch.stack([right, torch.linalg.cross(forward, right), forward])
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = rotation
        pose[:3, 3] = -rotation @ origin
        ends = torch.stack((origin, center)).detach()
        farthest = float(ends.abs().max())
        if _LEAST_SINGLE < farthest < min(_FAR * float((ends[1] - ends[0]).norm()), _MOST_SINGLE):
            pose = pose.to(torch.float32)
        focal = 0.5 * height / math.tan(0.5 * fov_y)
        return Camera(pose, focal, focal, 0.5 * width, 0.5 * height, width, height)

    @property
    def position(self) -> torch.Tensor:
        """(3,) position of the camera in world space."""
        pose = self.world_to_camera
        return -(pose[:3, :3] * pose[:3, 3:]).sum(0)  # no matrix product, which torch.autocast would round

    @property
    def camera_to_world(self) -> torch.Tensor:
        """(4, 4) inverse of the extrinsics."""
        pose = torch.eye(4, dtype=self.world_to_camera.dtype, device=self.world_to_camera.device)
        pose[:3, :3] = self.world_to_camera[:3, :3].T
        pose[:3, 3] = self.position
        return pose

    def to_camera_space(self, points: torch.Tensor) -> torch.Tensor:
        """(N, 3) world-space points in camera space; differentiable in the points and the extrinsics."""
        if not isinstance(points, torch.Tensor) or not points.is_floating_point() or points.shape[1:] != (3,):
            raise CameraError(f"The points are {shown(points)}; pass a tensor of shape (N, 3).")
        pose = self.world_to_camera.to(points)
        return transformed(points, pose[:3, :3], pose[:3, 3])

    def ray_directions(self) -> torch.Tensor:
        """(H, W, 3) unit directions of the pixels' rays in camera space, float64; differentiable in the intrinsics.

        They are where the extrinsics are, if that knows float64.
        """
        return through_plane(self.plane_points())

    def plane_points(self) -> torch.Tensor:
        """(H, W, 2) where the pixels' centres lie in the plane at distance 1, float64; likewise."""
        device = self._double_device
        fx, fy, cx, cy = self._pinhole(torch.float64, device)
        x = (torch.arange(self.width, dtype=torch.float64, device=device) + 0.5 - cx) / fx
        y = (torch.arange(self.height, dtype=torch.float64, device=device) + 0.5 - cy) / fy
        rows, columns = torch.meshgrid(y, x, indexing="ij")
        return torch.stack([columns, rows], dim=-1)

    def project(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Where points are seen; differentiable in them and in all parameters.

        Beside the image, where the formulas of a lens may fold, what it does at the image's rim goes on in proportion;
        derivatives there leave out that the rim moves.

        Args:
            points: (N, 3) in world space.

        Returns:
            (N, 2) pixels, which may lie outside of the image; and (N,) how many pixels a step of length 1 across the
            line of sight covers there. Where that is not greater than 0, points are behind the camera and not seen.
        """
        flat, enlarged = self._flattened(self.to_camera_space(points))
        fx, fy, cx, cy = self._pinhole(flat.dtype, flat.device)
        x, y = flat.unbind(-1)
        return torch.stack([x * fx + cx, y * fy + cy], dim=-1), enlarged * max(self.fx, self.fy)

    def _flattened(self, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """(N, 2) where places in camera space are seen in the plane at distance 1, and (N,) by how much enlarged."""
        return Distortion().coordinates(places)

    @property
    def _double_device(self) -> torch.device:
        """Where the extrinsics are, if that knows float64, else the CPU."""
        device = self.world_to_camera.device
        return device if device.type == "cuda" else torch.device("cpu")

    def _pinhole(self, dtype: torch.dtype, device: torch.device | str) -> Sequence[Any]:
        """fx, fy, cx and cy: numbers, or tensors where images are differentiable in them."""
        if self.intrinsics is None:
            return self.fx, self.fy, self.cx, self.cy
        return self.intrinsics.to(device, dtype).unbind()

    def rays(self) -> Rays:
        """The rays of all pixels in world space, (H, W); differentiable in extrinsics and intrinsics."""
        from difftetvr.rendering.rays import Rays  # late: it needs cameras' errors, not cameras

        directions, far = self._sight()
        return Rays(*pencil(self.world_to_camera, directions), 0.0, far)

    def rays_of(self, pixels: torch.Tensor) -> Rays:
        """The rays of some pixels, likewise: for views of which only these are looked at.

        Args:
            pixels: (N,) int64, row * W + column.

        Returns:
            (N,) rays.

        Raises:
            CameraError: These are no pixels of the image; looked over on the CPU alone.
        """
        from difftetvr.rendering.rays import Rays  # late, as above

        require_places(pixels, self.width * self.height)
        directions, far = self._sight()
        pixels = pixels.to(directions.device)
        directions = directions.reshape(-1, 3).index_select(0, pixels)
        far = far.reshape(-1).index_select(0, pixels) if isinstance(far, torch.Tensor) else far
        return Rays(*pencil(self.world_to_camera, directions), 0.0, far)

    def _sight(self) -> tuple[torch.Tensor, torch.Tensor | float]:
        """(H, W, 3) directions of the pixels' rays in camera space, and how far each of them goes."""
        return self.ray_directions(), math.inf

    def kernel_rays(self, backend: Backend) -> ImageRays:
        """The camera's rays for kernels of a back end."""
        from difftetvr.rendering.cameras.pinhole_rays import PinholeRays  # late: cameras are there without kernels

        return PinholeRays.of(backend, self)

    def with_size(self, width: int, height: int) -> Camera:
        """The same view at another resolution."""
        width, height = pixels("width", width), pixels("height", height)
        sx, sy = width / self.width, height / self.height
        own = None if self.intrinsics is None else self.intrinsics * self.intrinsics.new_tensor([sx, sy, sx, sy])
        fx, fy, cx, cy = self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy
        return replace(self, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height, intrinsics=own)

    def relative_to(self, origin: Sequence[float]) -> Camera:
        """The same view of a world whose origin lies at a point of this one; differentiable in the extrinsics.

        Args:
            origin: (3,) that point, in world space.
        """
        if not any(origin):
            return self
        pose = self.world_to_camera.double()
        shift = torch.tensor([*origin, 0.0], dtype=torch.float64, device=pose.device)
        moved = torch.cat((pose[:, :3], (pose[:, 3] + pose @ shift)[:, None]), dim=1)
        return self.with_pose(moved)

    def with_pose(self, world_to_camera: torch.Tensor) -> Camera:
        """The same intrinsics with other extrinsics."""
        return replace(self, world_to_camera=world_to_camera)
