"""What a reconstruction starts from: images, their cameras, and which of them are held out."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import Any

import torch

from difftetvr.capture.capture_file import read_capture, write_capture
from difftetvr.capture.free_space import FreeSpace
from difftetvr.capture.hull import silhouettes
from difftetvr.capture.packed import Images, Masks, MixedImages, PackedImages, shapes_of
from difftetvr.declared import require_declared
from difftetvr.errors import CaptureError, shown
from difftetvr.inputs import as_number, as_reals, require_type
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.srgb import Encoding

# The attenuation of the published volume experiments, for a box whose longest side is 1.
_DEFAULT_ATTENUATION = 25.0


@dataclass(eq=False)
class Capture:
    """Images of an object with known cameras.

    Radiance is whatever the images hold, and rendering blends it as it is. Captures of volumes hold linear light.
    Photographs, and the NeRF-synthetic images, keep the sRGB-encoded values of their files: alpha composites in that
    space there, and published PSNR and SSIM are measured in it. ``encoding`` says which, so that results are neither
    encoded twice nor compared across spaces.

    Attributes:
        cameras: N cameras, each of its image's size: pinholes, or `LensCamera` where a lens distorts.
        images: (N, H, W, 3) float32 RGB, premultiplied over black, on the CPU. Photographs are kept as bytes, and
            unpacked to the same view by view when they are taken by index: ``images[view]``. Images of several sizes
            are :class:`~difftetvr.capture.MixedImages`, of which there is no more than that.
        alphas: (N, H, W) in [0, 1], kept as the images are, or None where they are unknown; the background is black
            then.
        test: (N,) bool, views that training never sees. At least one view must be left for training.
        bounds: (2, 3) float32 lower and upper corner of the box that holds the object, in world space.
        surroundings: How many times as large a box around the same centre holds what is seen behind the object, too; 1
            where nothing is.
        name: What to call the capture.
        density_unit: Typical density per world unit, a scale for optimisers; 0 stands for 25 / longest side of the box.
        encoding: Whether the images hold linear light (``linear``) or sRGB-encoded values (``srgb``).
        valid: (N, H, W) bool, false for pixels that masks of the capture exclude and that no loss should count; as
            MixedImages where the images are. None where all are valid.
        points: (P, 3) float32 points on the scene's surfaces, in world space, or None where none are known.
        point_colors: (P, 3) float32 colours of the points in [0, 1], encoded as the images are, or None.

    Raises:
        CaptureError: Shapes do not match or a value is not valid; names the first offending view.
    """

    cameras: list[Camera]
    images: Images
    alphas: Images | None
    test: torch.Tensor
    bounds: torch.Tensor
    name: str
    density_unit: float = 0.0
    encoding: Encoding = "linear"
    valid: Masks | None = None
    points: torch.Tensor | None = None
    point_colors: torch.Tensor | None = None
    surroundings: float = 1.0

    def __post_init__(self) -> None:
        require_declared(self, CaptureError, "capture's ", ("name", "encoding", "density_unit", "surroundings"))
        self._check_images()
        self._check_optional()
        self._check_cameras()
        is_mask = isinstance(self.test, torch.Tensor)
        if not is_mask or self.test.shape != (len(self.cameras),) or self.test.dtype != torch.bool:
            raise CaptureError(
                f"The test mask of '{self.name}' must hold one bool for each of {len(self.cameras)} views."
            )
        if bool(self.test.all()):
            raise CaptureError(f"All views of '{self.name}' are held out for testing; leave some for training.")
        self._check_bounds()
        if not (math.isfinite(self.density_unit) and self.density_unit >= 0):
            raise CaptureError(
                f"The density unit of '{self.name}' is {shown(self.density_unit)}; it must not be negative."
            )
        if self.density_unit == 0:
            self.density_unit = _DEFAULT_ATTENUATION / float((self.bounds[1] - self.bounds[0]).max())

    def _check_bounds(self) -> None:
        advice = "give the lower and the upper corner"
        bounds = as_reals(self.bounds, f"The box of bounds of '{self.name}'", CaptureError, advice=advice)
        self.bounds = bounds.to("cpu", torch.float32)
        if self.bounds.shape != (2, 3) or not bool((self.bounds[0] < self.bounds[1]).all()):
            raise CaptureError(
                f"The bounds of '{self.name}' must be a lower and, greater in all axes, an upper corner."
            )
        if not bool(torch.isfinite(self.bounds).all()):
            raise CaptureError(f"The bounds of '{self.name}' are not finite; give the corners of a box.")
        if not (math.isfinite(self.surroundings) and self.surroundings >= 1.0):
            raise CaptureError(
                f"The surroundings of '{self.name}' are {shown(self.surroundings)}; they must be at least 1."
            )

    def _as_views(self, name: str, values: Any) -> Images:
        """Values of views on which to look, a tensor or packed."""
        if not isinstance(values, PackedImages | MixedImages):
            values = as_reals(values, f"The array of {name} of '{self.name}'", CaptureError, torch.float32)
        return values

    def _check_images(self) -> None:
        self.images = self._as_views("images", self.images)
        shapes = shapes_of(self.images)
        wrong = next((shape for shape in shapes or [()] if len(shape) != 3 or shape[2] != 3 or 0 in shape), None)
        if wrong is not None:
            raise CaptureError(
                f"The images of '{self.name}' have shape {(len(shapes), *wrong)}; they need (N, H, W, 3), none of "
                "them 0."
            )
        self.images = self._checked(
            self.images, lambda v: ~torch.isfinite(v) | (v < 0), "a colour that is negative or not finite"
        )
        if self.alphas is None:
            return
        self.alphas = self._as_views("alphas", self.alphas)
        self._check_shapes("alphas", self.alphas)
        self.alphas = self._checked(self.alphas, lambda v: ~((v >= 0) & (v <= 1)), "an alpha outside [0, 1]")

    def _check_shapes(self, name: str, values: Images) -> None:
        """One value for each pixel."""
        mine, wanted = shapes_of(values), [shape[:2] for shape in shapes_of(self.images)]
        if isinstance(values, MixedImages) != isinstance(self.images, MixedImages):
            raise CaptureError(
                f"The {name} of '{self.name}' must be MixedImages where, and only where, the images are."
            )
        if mine == wanted:
            return
        if not isinstance(values, MixedImages):
            shape = (len(wanted), *wanted[0])
            raise CaptureError(f"The {name} of '{self.name}' have shape {tuple(values.shape)}, not {shape}.")
        view = next((view for view, (one, other) in enumerate(zip(mine, wanted)) if one != other), len(mine))
        raise CaptureError(
            f"The {name} of '{self.name}' do not fit its images in view {view}; give one for each pixel."
        )

    def _check_optional(self) -> None:
        if self.valid is not None:
            kinds = (torch.Tensor, MixedImages)
            require_type(self.valid, kinds, f"The valid of '{self.name}'", "pass a tensor of bools", CaptureError)
            self._check_shapes("valid pixels", self.valid)
            parts = self.valid.data if isinstance(self.valid, MixedImages) else (self.valid,)
            if any(part.dtype != torch.bool for part in parts):
                raise CaptureError(f"The valid pixels of '{self.name}' must be bools, one for each pixel.")
        for name in ("points", "point_colors"):
            values = getattr(self, name)
            if values is None:
                continue
            values = as_reals(values, f"The array of {name} of '{self.name}'", CaptureError)
            if values.ndim != 2 or values.shape[1] != 3 or not bool(torch.isfinite(values).all()):
                raise CaptureError(f"The {name} of '{self.name}' must be (P, 3) finite numbers.")
            setattr(self, name, values.to("cpu", torch.float32))
        if self.point_colors is not None and (self.points is None or len(self.points) != len(self.point_colors)):
            raise CaptureError(f"'{self.name}' needs a point for each of its point_colors; give as many of both.")

    def _checked(self, values: Images, is_wrong: Callable[[torch.Tensor], torch.Tensor], what: str) -> Images:
        """Images on the CPU, as float32 where they are no bytes, which cannot be wrong."""
        if isinstance(values, PackedImages):
            return values
        if isinstance(values, torch.Tensor):
            values = values.to("cpu", torch.float32)
            self._refuse(is_wrong(values).flatten(1).any(dim=1), what)
            return values
        views = [v if v.dtype == torch.uint8 else v.to("cpu", torch.float32) for v in values.data]
        self._refuse(torch.tensor([v.dtype != torch.uint8 and bool(is_wrong(v).any()) for v in views]), what)
        return MixedImages(tuple(views))

    def _refuse(self, views: torch.Tensor, what: str) -> None:
        if bool(views.any()):
            raise CaptureError(f"View {int(views.nonzero()[0])} of '{self.name}' has {what}; correct the image.")

    def _check_cameras(self) -> None:
        is_list = isinstance(self.cameras, list | tuple)
        if not is_list or not all(isinstance(camera, Camera) for camera in self.cameras):
            raise CaptureError(f"The cameras of '{self.name}' are {shown(self.cameras)}; pass a list of Camera.")
        sizes = [(width, height) for height, width, _ in shapes_of(self.images)]
        if len(self.cameras) != len(sizes):
            raise CaptureError(
                f"'{self.name}' has {len(sizes)} images but {len(self.cameras)} cameras; give one for each."
            )
        for index, (camera, (width, height)) in enumerate(zip(self.cameras, sizes, strict=True)):
            if (camera.width, camera.height) != (width, height):
                raise CaptureError(
                    f"Camera {index} of '{self.name}' is for {camera.width} x {camera.height} pixels but its image has "
                    f"{width} x {height}; scale one of them."
                )

    @property
    def image_sizes(self) -> list[tuple[int, int]]:
        """Width and height of each view in pixels."""
        return [(camera.width, camera.height) for camera in self.cameras]

    @property
    def train_indices(self) -> torch.Tensor:
        """int64 indices of the views that training uses."""
        return (~self.test).nonzero().flatten()

    @property
    def test_indices(self) -> torch.Tensor:
        """int64 indices of the held-out views."""
        return self.test.nonzero().flatten()

    @property
    def outer_bounds(self) -> torch.Tensor:
        """(2, 3) float32 corners of the box of the surroundings."""
        if self.surroundings == 1.0:
            return self.bounds  # to the bit
        middle, half = self.bounds.mean(0), 0.5 * (self.bounds[1] - self.bounds[0])
        return torch.stack((middle - self.surroundings * half, middle + self.surroundings * half))

    def density_units_at(self, points: torch.Tensor) -> torch.Tensor:
        """Typical densities at places, scales for optimisers.

        Inside the bounds, and everywhere without surroundings, that is ``density_unit``. Beyond, it falls as the
        distance from their centre grows, as what is farther off is seen, and reconstructed, more coarsely.

        Args:
            points: (N, 3) positions in world space.

        Returns:
            (N,) densities per world unit, > 0, of the dtype and on the device of ``points``.
        """
        if self.surroundings == 1.0:
            return points.new_full((len(points),), self.density_unit)
        lower, upper = self.bounds.to(points)
        distance = (2.0 * points - lower - upper).abs() / (upper - lower)
        return self.density_unit / distance.amax(1).clamp_min(1.0)

    def free_space(self, share: float) -> FreeSpace:
        """Where nothing is, in front of the training cameras.

        Args:
            share: Share of the way from a camera to the scene, in [0, 1).

        Raises:
            CaptureError: The share is out of range.
        """
        share = as_number(share, "The share", CaptureError)
        cameras = [self.cameras[view] for view in self.train_indices.tolist()]
        return FreeSpace.of(cameras, self.bounds, self.scene_points, share)

    @property
    def scene_points(self) -> torch.Tensor | None:
        """(P', 3) those of the points that lie within the outer bounds, or None where there are none."""
        if self.points is None:
            return None
        outer = self.outer_bounds
        inside = self.points[((self.points > outer[0]) & (self.points < outer[1])).all(1)]
        return inside if len(inside) else None

    @cached_property
    def silhouettes(self) -> list[torch.Tensor] | None:
        """(H, W) bool of each training view, where it may show the object: where alpha is not 0, or in a black border.

        None where nothing tells the object from its background.
        """
        return silhouettes(self.images, self.alphas, self.train_indices.tolist(), self.valid)

    @property
    def is_cut_out(self) -> bool:
        """Whether alpha tells the object from its background."""
        return self.alphas is not None and self.silhouettes is not None

    def save(self, path: str | Path) -> None:
        """Write the capture to one ``.npz`` file, which :meth:`load` reads back to the bit.

        Raises:
            CaptureError: The name does not end in ``.npz``, or the file cannot be written.
        """
        write_capture(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @staticmethod
    def load(path: str | Path) -> Capture:
        """Read what :meth:`save` wrote, in this version or an earlier one.

        Raises:
            CaptureError: The file is missing, damaged, or no capture.
        """
        require_type(path, (str, PathLike), "The path of the capture", "give the name of a file", CaptureError)
        return Capture(**read_capture(path))
