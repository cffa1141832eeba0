"""Captures in files: one .npz archive."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difftetvr.archive import read_arrays
from difftetvr.capture.packed import Images, MixedImages, PackedImages, shapes_of
from difftetvr.errors import CameraError, CaptureError
from difftetvr.files import atomic_write
from difftetvr.rendering.cameras.pinhole import Camera

# Version 1 knew no encoding (all was linear), no bytes, no points and no masks, version 2 no surroundings, version 3
# no images of several sizes; where they are of one size, version 3 is still what is written.
_VERSION, _VERSION_OF_ONE_SIZE = 4, 3
_NEEDED = ("version", "images", "test", "bounds", "name", "density_unit", "world_to_camera", "intrinsics")
_OPTIONAL = ("alphas", "valid", "points", "point_colors")
_PER_PIXEL = ("images", "alphas", "valid")
_KNOWN = (*_NEEDED, *_OPTIONAL, "encoding", "surroundings", "sizes")


def write_capture(path: str | Path, fields: Mapping[str, Any]) -> None:
    """Write the fields of a capture to one ``.npz`` file, which :func:`read_capture` reads back to the bit.

    Args:
        path: File to write.
        fields: All fields of a :class:`~difftetvr.Capture` by name.

    Raises:
        CaptureError: The name does not end in ``.npz``, or the file cannot be written.
    """
    if Path(path).suffix.lower() != ".npz":
        raise CaptureError(f"A capture is saved as .npz; '{path}' ends otherwise.")
    cameras, images = fields["cameras"], fields["images"]
    is_mixed = isinstance(images, MixedImages)
    content: dict[str, Any] = {
        "version": np.array(_VERSION if is_mixed else _VERSION_OF_ONE_SIZE),
        "images": _array(images),
        "test": fields["test"].numpy(),
        "bounds": fields["bounds"].numpy(),
        "name": np.array(fields["name"]),
        "density_unit": np.array(fields["density_unit"]),
        "world_to_camera": torch.stack([c.world_to_camera.detach().cpu() for c in cameras]).numpy(),
        "intrinsics": np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras]),
        "encoding": np.array(fields["encoding"]),
        "surroundings": np.array(fields["surroundings"]),
    }
    if is_mixed:
        content["sizes"] = np.array([shape[:2] for shape in shapes_of(images)])
    for key in _OPTIONAL:
        value = fields[key]
        if value is not None:
            content[key] = _array(value)
    with atomic_write(path, CaptureError) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **content)


def read_capture(path: str | Path) -> dict[str, Any]:
    """The fields of a saved capture, of any version so far.

    Raises:
        CaptureError: The file is missing, damaged, or no capture.
    """
    content = read_arrays(path, CaptureError, lambda name, _: name in _KNOWN)
    missing = [key for key in _NEEDED if key not in content]
    if missing:
        raise CaptureError(f"'{path}' is no saved capture: it has no array '{missing[0]}'.")
    try:
        if not 1 <= int(content["version"]) <= _VERSION:
            raise CaptureError(f"'{path}' has the version {content['version']}; update difftetvr to read it.")
        tensors = {key: torch.from_numpy(content[key]) for key in ("images", "test", "bounds", "world_to_camera")}
        tensors |= {key: torch.from_numpy(content[key]) for key in _OPTIONAL if key in content}
        poses = tensors.pop("world_to_camera")
        sizes = _sizes(content, len(poses))
        cameras = [
            Camera(pose, float(fx), float(fy), float(cx), float(cy), width, height)
            for pose, (fx, fy, cx, cy), (height, width) in zip(poses, content["intrinsics"], sizes, strict=True)
        ]
        return {
            "cameras": cameras,
            "alphas": None,
            "name": str(content["name"]),
            "density_unit": float(content["density_unit"]),
            "encoding": str(content.get("encoding", "linear")),
            "surroundings": float(content.get("surroundings", 1.0)),
            **{key: _restored(key, tensor, sizes if "sizes" in content else None) for key, tensor in tensors.items()},
        }
    except CameraError as error:
        raise CaptureError(f"A camera in '{path}' is not valid: {error}") from None
    except (TypeError, ValueError, OverflowError):
        raise CaptureError(f"An array in '{path}' has the wrong shape or type; get the file anew.") from None


def _array(values: Images) -> np.ndarray:
    """The values of all views; where these have several sizes, those of all pixels one after the other."""
    if isinstance(values, MixedImages):
        return np.concatenate([view.flatten(0, 1).numpy() for view in values.data])
    return (values.data if isinstance(values, PackedImages) else values).numpy()


def _sizes(content: Mapping[str, np.ndarray], count: int) -> list[tuple[int, int]]:
    """Height and width of each view.

    Raises:
        ValueError: The sizes are none, or do not fit the pixels.
    """
    if "sizes" not in content:
        height, width = content["images"].shape[1:3]
        return [(height, width)] * count
    sizes = [(int(height), int(width)) for height, width in content["sizes"]]
    pixels = sum(height * width for height, width in sizes)
    lengths = {len(content[key]) for key in _PER_PIXEL if key in content}
    if any(min(size) < 1 for size in sizes) or lengths != {pixels}:
        raise ValueError("the sizes do not fit the pixels")
    return sizes


def _restored(key: str, tensor: torch.Tensor, sizes: list[tuple[int, int]] | None) -> Images:
    if key not in _PER_PIXEL:
        return tensor
    if sizes is not None:
        views = tensor.split([height * width for height, width in sizes])
        return MixedImages(tuple(v.unflatten(0, size) for v, size in zip(views, sizes, strict=True)))
    return PackedImages(tensor) if key != "valid" and tensor.dtype == torch.uint8 else tensor
