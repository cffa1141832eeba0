"""Captures rendered from a scalar volume and a transfer function."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Literal

import torch

from difftetvr.capture.camera_set import CameraSet
from difftetvr.capture.capture import Capture
from difftetvr.capture.orbit import DEFAULT_FOV_Y, fibonacci_orbit, random_orbit
from difftetvr.capture.volumes.value_range import range_text
from difftetvr.capture.volumes.volume import Volume
from difftetvr.capture.volumes.volume_renderer import Progress, VolumeRenderer
from difftetvr.declared import require_declared
from difftetvr.errors import CameraError, CaptureError, counted, shown
from difftetvr.optics.transfer_function import TransferFunction
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.trust import require_free

TOOTH = "tooth"
TOOTH_VOLUME = "tooth_103x94x161_uint8.raw.xz"
_TOOTH_TRANSFER_FUNCTION = "tooth3gauss.json"
# What would be stored as 0 in every picture of 8 bits.
_LEAST_SEEN = 0.5 / 255.0
_MOST = 2**31 - 1  # of what is counted
# Colour and alpha as they are rendered, and once more apart from each other; a camera.
_BYTES_PER_PIXEL, _BYTES_PER_VIEW = 32, 2000


@dataclass(frozen=True)
class VolumeCapture:
    """A volume, its transfer function and the views to render; the defaults are the standard Tooth benchmark.

    Attributes:
        path: Volume file, or ``tooth`` for the packaged scan.
        shape: (nx, ny, nz) of a ``.raw`` file that has no header.
        dtype: NumPy type of a ``.raw`` file that has no header, e.g. ``uint8``.
        spacing: Distances of samples along (x, y, z); overrides the file's.
        transfer_function: ``.json`` or ``.xml`` file; the packaged tooth has one of its own.
        attenuation: Density of opacity 1, per unit of length; the box's longest side is 1.
        views: Number of views.
        width: Image width in pixels.
        height: Image height in pixels.
        radius: Distance of the cameras from the box's centre.
        fov_y: Vertical field of view in radians.
        steps_per_unit: Ray-marching steps per unit of length.
        test_every: One of so many views is held out; 0 holds out none.
        test_offset: Index of the first held-out view.
        seed: Seed of a random orbit.
        orbit: Whether the cameras lie on a Fibonacci spiral or at random places of the sphere.
        value_range: Values that stand for 0 and 1 of the transfer function; None: 0 and 255 for uint8, else the least
            and the greatest one.
    """

    path: str = TOOTH
    shape: tuple[int, int, int] | None = None
    dtype: str | None = None
    spacing: tuple[float, float, float] | None = None
    transfer_function: str | None = None
    attenuation: float = 25.0
    views: int = 80
    width: int = 128
    height: int = 128
    radius: float = 1.2
    fov_y: float = DEFAULT_FOV_Y
    steps_per_unit: float = 2500.0
    test_every: int = 5
    test_offset: int = 2
    seed: int = 0
    orbit: Literal["fibonacci", "random"] = "fibonacci"
    value_range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        require_declared(self, CaptureError)

    def build(self, progress: Progress | None = None, device: str | torch.device | None = None) -> Capture:
        """Read the volume, place the cameras and render the views.

        Args:
            progress: Called with the number of rendered views and of all views.
            device: PyTorch device to render on; None takes the fastest. The images are on the CPU in any case.

        Raises:
            CaptureError: A file or a value is not valid, or all views are black.
            BackendError: No back end works on the device.
        """
        self._require_memory()
        test = self._test_mask()
        cameras = self.cameras()
        volume, transfer_function = self.load_volume()
        if not self.attenuation > 0:
            raise CaptureError(f"The attenuation is {shown(self.attenuation)}; it must be greater than 0.")
        renderer = VolumeRenderer(volume, transfer_function, self.attenuation, self.steps_per_unit, device)
        images, alphas = renderer.render(cameras, progress)
        if float(images.max()) < _LEAST_SEEN:
            raise CaptureError(
                f"All views of '{self.path}' are black: the transfer function '{transfer_function.name}' shows nothing "
                f"of it where values {range_text(volume.value_range)} stand for 0 to 1; change the one, the other "
                "(value_range, --value-range) or the attenuation."
            )
        return Capture(cameras, images, alphas, test, volume.bounds, self.name, self.attenuation)

    def load_volume(self) -> tuple[Volume, TransferFunction]:
        """The volume and its transfer function.

        Raises:
            CaptureError: A file is not valid, or the transfer function is missing.
        """
        if self.path == TOOTH:
            if self.shape is not None or self.dtype is not None:
                raise CaptureError("The packaged tooth says itself what it holds; leave out the shape and the dtype.")
            with packaged(TOOTH_VOLUME) as volume_file, packaged(_TOOTH_TRANSFER_FUNCTION) as function_file:
                volume = Volume.load(volume_file, None, None, self.spacing, self.value_range)
                return volume, TransferFunction.load(self.transfer_function or function_file)
        if self.transfer_function is None:
            raise CaptureError(f"The volume '{self.path}' needs a transfer function; give one as .json or .xml.")
        volume = Volume.load(self.path, self.shape, self.dtype, self.spacing, self.value_range)
        return volume, TransferFunction.load(self.transfer_function)

    def cameras(self) -> list[Camera]:
        """The views' cameras.

        Raises:
            CaptureError: A value is out of range.
        """
        center = (0.0, 0.0, 0.0)
        try:
            if self.orbit == "fibonacci":
                return fibonacci_orbit(self.views, center, self.radius, self.fov_y, self.width, self.height)
            return random_orbit(self.views, center, self.radius, self.fov_y, self.width, self.height, self.seed)
        except CameraError as error:
            raise CaptureError(f"The views cannot be placed: {error}") from None

    def camera_set(self) -> CameraSet:
        """The views' cameras and which of them are held out, without the volume.

        Raises:
            CaptureError: A value is out of range.
        """
        return CameraSet(self.cameras(), self._test_mask(), self.name)

    @property
    def name(self) -> str:
        """What to call the capture."""
        return self.path if self.path == TOOTH else Path(self.path).name.split(".")[0]

    def _require_memory(self) -> None:
        for name in ("views", "width", "height"):
            if (value := getattr(self, name)) > _MOST:
                raise CaptureError(f"The {name} is {shown(value)}; it must be at most {_MOST}.")
        pixels = max(self.width, 0) * max(self.height, 0)
        require_free(
            max(self.views, 0) * (_BYTES_PER_VIEW + _BYTES_PER_PIXEL * pixels),
            f"{counted(self.views, 'view')} of {self.width:,} x {self.height:,} pixels",
            "ask for fewer or smaller ones with --views, --width and --height",
            CaptureError,
        )

    def _test_mask(self) -> torch.Tensor:
        if self.test_every == 0:
            return torch.zeros(max(self.views, 0), dtype=torch.bool)
        if self.test_every < 2 or not 0 <= self.test_offset < self.test_every:
            raise CaptureError(
                f"Every {shown(self.test_every)}th view from {shown(self.test_offset)} cannot be held out; test_every "
                "must be 0 or at least 2, and test_offset at least 0 and less than test_every."
            )
        held_out = [view % self.test_every == self.test_offset for view in range(max(self.views, 0))]
        return torch.tensor(held_out, dtype=torch.bool)


@contextmanager
def packaged(name: str) -> Iterator[Path]:
    """Context in which a file that the package carries has a path."""
    with resources.as_file(resources.files("difftetvr") / "data" / name) as path:
        yield path
