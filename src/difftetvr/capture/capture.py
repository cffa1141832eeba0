"""What a reconstruction starts from: images, their cameras, and which of them are held out."""

from __future__ import annotations

import math
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difftetvr.errors import CameraError, CaptureError
from difftetvr.files import atomic_write
from difftetvr.render.camera import Camera

_FILE_VERSION = 1
# The attenuation of the published volume experiments, for a box whose longest side is 1.
_DEFAULT_ATTENUATION = 25.0


@dataclass(eq=False)
class Capture:
    """Images of an object with known cameras.

    Attributes:
        cameras: N cameras, all of the images' size.
        images: (N, H, W, 3) float32 linear RGB, premultiplied over black, on the CPU.
        alphas: (N, H, W) float32 in [0, 1], or None where they are unknown; the background is black then.
        test: (N,) bool, views that training never sees. At least one view must be left for training.
        bounds: (2, 3) float32 lower and upper corner of the box that holds the object, in world space.
        name: What to call the capture.
        density_unit: Typical density per world unit, a scale for optimisers; 0 stands for 25 / longest side of the box.

    Raises:
        CaptureError: Shapes do not match or a value is not valid; names the first offending view.
    """

    cameras: list[Camera]
    images: torch.Tensor
    alphas: torch.Tensor | None
    test: torch.Tensor
    bounds: torch.Tensor
    name: str
    density_unit: float = 0.0

    def __post_init__(self) -> None:
        self._check_images()
        self._check_cameras()
        if self.test.shape != (len(self.cameras),) or self.test.dtype != torch.bool:
            raise CaptureError(
                f"The test mask of '{self.name}' must hold one bool for each of {len(self.cameras)} views."
            )
        if bool(self.test.all()):
            raise CaptureError(f"All views of '{self.name}' are held out for testing; leave some for training.")
        self.bounds = torch.as_tensor(self.bounds, dtype=torch.float32)
        if self.bounds.shape != (2, 3) or not bool((self.bounds[0] < self.bounds[1]).all()):
            raise CaptureError(
                f"The bounds of '{self.name}' must be a lower and, greater in all axes, an upper corner."
            )
        if not bool(torch.isfinite(self.bounds).all()):
            raise CaptureError(f"The bounds of '{self.name}' are not finite; give the corners of a box.")
        if not (math.isfinite(self.density_unit) and self.density_unit >= 0):
            raise CaptureError(f"The density unit of '{self.name}' is {self.density_unit}; it must not be negative.")
        if self.density_unit == 0:
            self.density_unit = _DEFAULT_ATTENUATION / float((self.bounds[1] - self.bounds[0]).max())

    def _check_images(self) -> None:
        shape = tuple(self.images.shape)
        if len(shape) != 4 or shape[3] != 3 or 0 in shape:
            raise CaptureError(
                f"The images of '{self.name}' have shape {shape}; they need (N, H, W, 3), none of them 0."
            )
        self.images = self.images.to("cpu", torch.float32)
        self._check_views(~torch.isfinite(self.images) | (self.images < 0), "a colour that is negative or not finite")
        if self.alphas is None:
            return
        if self.alphas.shape != shape[:3]:
            raise CaptureError(f"The alphas of '{self.name}' have shape {tuple(self.alphas.shape)}, not {shape[:3]}.")
        self.alphas = self.alphas.to("cpu", torch.float32)
        self._check_views(~((self.alphas >= 0) & (self.alphas <= 1)), "an alpha outside [0, 1]")

    def _check_views(self, wrong: torch.Tensor, what: str) -> None:
        views = wrong.flatten(1).any(dim=1)
        if bool(views.any()):
            raise CaptureError(f"View {int(views.nonzero()[0])} of '{self.name}' has {what}; correct the image.")

    def _check_cameras(self) -> None:
        count, height, width = self.images.shape[:3]
        if len(self.cameras) != count:
            raise CaptureError(f"'{self.name}' has {count} images but {len(self.cameras)} cameras; give one for each.")
        for index, camera in enumerate(self.cameras):
            if (camera.width, camera.height) != (width, height):
                raise CaptureError(
                    f"Camera {index} of '{self.name}' is for {camera.width} x {camera.height} pixels but its image has "
                    f"{width} x {height}; scale one of them."
                )

    @property
    def train_indices(self) -> torch.Tensor:
        """int64 indices of the views that training uses."""
        return (~self.test).nonzero().flatten()

    @property
    def test_indices(self) -> torch.Tensor:
        """int64 indices of the held-out views."""
        return self.test.nonzero().flatten()

    def save(self, path: str | Path) -> None:
        """Write the capture to one ``.npz`` file, which :meth:`load` reads back to the bit.

        Raises:
            CaptureError: The name does not end in ``.npz``, or the file cannot be written.
        """
        if Path(path).suffix.lower() != ".npz":
            raise CaptureError(f"A capture is saved as .npz; '{path}' ends otherwise.")
        content: dict[str, Any] = {
            "version": np.array(_FILE_VERSION),
            "images": self.images.numpy(),
            "test": self.test.numpy(),
            "bounds": self.bounds.numpy(),
            "name": np.array(self.name),
            "density_unit": np.array(self.density_unit),
            "world_to_camera": torch.stack([c.world_to_camera.detach().cpu() for c in self.cameras]).numpy(),
            "intrinsics": np.array([(c.fx, c.fy, c.cx, c.cy) for c in self.cameras]),
        }
        if self.alphas is not None:
            content["alphas"] = self.alphas.numpy()
        with atomic_write(path, CaptureError) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, **content)

    @staticmethod
    def load(path: str | Path) -> Capture:
        """Read what :meth:`save` wrote.

        Raises:
            CaptureError: The file is missing, damaged, or no capture.
        """
        content = _read_arrays(path)
        needed = ("version", "images", "test", "bounds", "name", "density_unit", "world_to_camera", "intrinsics")
        missing = [key for key in needed if key not in content]
        if missing:
            raise CaptureError(f"'{path}' is no saved capture: it has no array '{missing[0]}'.")
        try:
            if int(content["version"]) != _FILE_VERSION:
                raise CaptureError(f"'{path}' has the version {content['version']}; update difftetvr to read it.")
            tensors = {key: torch.from_numpy(content[key]) for key in ("images", "test", "bounds", "world_to_camera")}
            height, width = (int(n) for n in content["images"].shape[1:3])
            cameras = [
                Camera(pose, float(fx), float(fy), float(cx), float(cy), width, height)
                for pose, (fx, fy, cx, cy) in zip(tensors["world_to_camera"], content["intrinsics"], strict=True)
            ]
            alphas = torch.from_numpy(content["alphas"]) if "alphas" in content else None
            unit = float(content["density_unit"])
        except CameraError as error:
            raise CaptureError(f"A camera in '{path}' is not valid: {error}") from None
        except (TypeError, ValueError):
            raise CaptureError(f"An array in '{path}' has the wrong shape or type; get the file anew.") from None
        return Capture(
            cameras, tensors["images"], alphas, tensors["test"], tensors["bounds"], str(content["name"]), unit
        )


def _read_arrays(path: str | Path) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ValueError
            return {key: archive[key] for key in archive.files}
    except OSError as error:
        raise CaptureError(f"Cannot read the capture '{path}': {error.strerror or error}.") from None
    except (
        ValueError,
        EOFError,
        KeyError,
        TypeError,
        SyntaxError,
        NotImplementedError,
        zipfile.BadZipFile,
        zlib.error,
    ):
        raise CaptureError(f"'{path}' is damaged or no capture saved by difftetvr; get the file anew.") from None
