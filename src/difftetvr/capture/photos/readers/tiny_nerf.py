"""The small archives of NeRF's tutorials ("tiny NeRF"): images, poses and one focal length in a .npz file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from difftetvr.archive import array_names, read_arrays
from difftetvr.capture.photos.lens import Lens
from difftetvr.capture.photos.poses import from_opengl
from difftetvr.errors import CaptureError
from difftetvr.rendering.cameras.intrinsics import Intrinsics
from difftetvr.trust import require_modest

_KEYS = ("images", "poses", "focal")
# Values of integers that stand for 1.
_MOST = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}


@dataclass(frozen=True, eq=False)
class TinyNerf:
    """What such an archive holds.

    Attributes:
        images: (N, H, W, 3) float32 as stored, premultiplied over black.
        alphas: (N, H, W) float32, None where the images have none.
        poses: N world-to-camera transforms, (4, 4) float64, OpenCV axes.
        intrinsics: Of all views.
    """

    images: torch.Tensor
    alphas: torch.Tensor | None
    poses: list[np.ndarray]
    intrinsics: Intrinsics


def is_tiny_nerf(path: Path) -> bool:
    """Whether a file is an archive of that kind; false for what cannot be read."""
    names = array_names(path)
    return names.issuperset(_KEYS) and "version" not in names


def read_tiny_nerf(path: Path, downscale: int = 1) -> TinyNerf:
    """Read an archive with ``images`` (N, H, W, 3 or 4), ``poses`` (N, 4, 4; OpenGL axes) and ``focal`` in pixels.

    Args:
        path: The .npz file.
        downscale: Pixels along x and y that are averaged to one.

    Raises:
        CaptureError: An array is missing or not valid.
    """
    content = read_arrays(path, CaptureError, lambda name, _: name in _KEYS)
    for key in _KEYS:
        if key not in content or content[key].dtype.kind not in "fui":
            raise CaptureError(f"'{path}' has no numbers '{key}'; a tiny NeRF archive has {', '.join(_KEYS)}.")
    images, poses, focal = (content[key] for key in _KEYS)
    if images.ndim != 4 or images.shape[3] not in (3, 4) or poses.shape[:1] != images.shape[:1] or focal.size != 1:
        raise CaptureError(
            f"'{path}' has images of shape {images.shape}, poses of {poses.shape} and {focal.size} focal lengths; "
            "give (N, H, W, 3), (N, 4, 4) and one number."
        )
    kind = images.dtype.newbyteorder("=")
    if kind.kind != "f" and kind not in _MOST:
        raise CaptureError(f"The images of '{path}' are {images.dtype}; store uint8, uint16 or floats from 0 to 1.")
    require_modest(path, 4 * images.size, "images as float32", CaptureError)
    height, width = images.shape[1] // downscale, images.shape[2] // downscale
    if min(height, width) < 1:
        raise CaptureError(f"The images of '{path}' are too small to shrink by {downscale}.")
    values = images.astype(np.float32) / _MOST.get(kind, 1.0)
    has_alpha = values.shape[3] == 4
    if has_alpha:
        values[..., :3] *= values[..., 3:]
    shape = (len(values), height, downscale, width, downscale, -1)
    means = values[:, : height * downscale, : width * downscale].reshape(shape).mean(axis=(2, 4), dtype=np.float32)
    tensor = torch.from_numpy(np.ascontiguousarray(means))
    lens = Lens(fx=float(focal.reshape(())))
    return TinyNerf(
        tensor[..., :3].contiguous(),
        tensor[..., 3].contiguous() if has_alpha else None,
        [from_opengl(pose, f"view {index} of '{path}'") for index, pose in enumerate(poses)],
        lens.on(images.shape[2], images.shape[1], f"'{path}'").shrunk(downscale),
    )
