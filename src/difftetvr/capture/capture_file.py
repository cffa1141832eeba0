"""Captures in files: one .npz archive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from difftetvr.archive import read_arrays
from difftetvr.capture.packed import Images, MixedImages, PackedImages, shapes_of
from difftetvr.errors import CameraError, CaptureError
from difftetvr.files import atomic_write
from difftetvr.rendering.cameras.lens import LensCamera
from difftetvr.rendering.cameras.pinhole import Camera

# Version 1 knew no encoding (all was linear), no bytes, no points and no masks, version 2 no surroundings, version 3
# no images of several sizes, version 4 no lenses. The first version that knows all of a capture is what is written.
_VERSION, _VERSION_OF_PINHOLES, _VERSION_OF_ONE_SIZE = 5, 4, 3
_NEEDED = ("version", "images", "test", "bounds", "name", "density_unit", "world_to_camera", "intrinsics")
_OPTIONAL = ("alphas", "valid", "points", "point_colors")
_PER_PIXEL = ("images", "alphas", "valid")
_LENS = ("lens_models", "lens_coefficients")
_KNOWN = (*_NEEDED, *_OPTIONAL, *_LENS, "encoding", "surroundings", "sizes")


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
    is_mixed, lenses = isinstance(images, MixedImages), _lens_arrays(cameras)
    without_lenses = _VERSION_OF_PINHOLES if is_mixed else _VERSION_OF_ONE_SIZE
    content: dict[str, Any] = {
        "version": np.array(_VERSION if lenses else without_lenses),
        "images": _array(images),
        "test": fields["test"].numpy(),
        "bounds": fields["bounds"].numpy(),
        "name": np.array(fields["name"]),
        "density_unit": np.array(fields["density_unit"]),
        "world_to_camera": torch.stack([c.world_to_camera.detach().cpu() for c in cameras]).numpy(),
        "intrinsics": np.array([(c.fx, c.fy, c.cx, c.cy) for c in cameras]),
        "encoding": np.array(fields["encoding"]),
        "surroundings": np.array(fields["surroundings"]),
        **lenses,
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
        return {
            "cameras": _cameras(poses, content, sizes),
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


def _lens_arrays(cameras: Sequence[Camera]) -> dict[str, np.ndarray]:
    """Models of the cameras' lenses, "" for a pinhole's, and (N, K) coefficients, filled up with NaN; {} for pinholes.

    Coefficients are finite, so what is none is known.
    """
    models = [camera.model if isinstance(camera, LensCamera) else "" for camera in cameras]
    if not any(models):
        return {}
    given = [camera.coefficients.tolist() if isinstance(camera, LensCamera) else [] for camera in cameras]
    most = max(map(len, given))
    padded = [values + [np.nan] * (most - len(values)) for values in given]
    return dict(zip(_LENS, (np.array(models), np.array(padded)), strict=True))


def _cameras(poses: torch.Tensor, content: Mapping[str, np.ndarray], sizes: list[tuple[int, int]]) -> list[Camera]:
    """The cameras of (N, 4, 4) poses, with the lenses that :func:`_lens_arrays` wrote.

    Raises:
        ValueError: There is not one of everything for each of them.
    """
    cameras: list[Camera] = []
    lenses = _lenses(content, len(poses))
    for pose, pinhole, size, (model, coefficients) in zip(poses, content["intrinsics"], sizes, lenses, strict=True):
        fx, fy, cx, cy = map(float, pinhole)
        numbers = (pose, fx, fy, cx, cy, size[1], size[0])
        cameras.append(LensCamera(*numbers, model=model, coefficients=coefficients) if model else Camera(*numbers))
    return cameras


def _lenses(content: Mapping[str, np.ndarray], count: int) -> list[tuple[str, torch.Tensor]]:
    """Model and coefficients of each camera's lens, "" and none for a pinhole.

    Raises:
        ValueError: What the file says of lenses does not fit together.
    """
    if not any(key in content for key in _LENS):
        return [("", torch.empty(0))] * count
    models, rows = (content.get(key, np.empty(0)) for key in _LENS)
    known = ~np.isnan(rows)
    counts = known.sum(axis=-1, keepdims=True)
    if rows.ndim != 2 or models.shape != rows.shape[:1] or (known != (np.arange(rows.shape[1]) < counts)).any():
        raise ValueError("the lenses do not fit together")
    return [(str(model), torch.from_numpy(row[: int(n)])) for model, row, n in zip(models, rows, counts[:, 0])]


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
