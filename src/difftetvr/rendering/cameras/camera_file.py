"""Single pinhole cameras as files.

    {
      "format": "difftetvr-camera",
      "world_to_camera": [[...], [...], [...], [0, 0, 0, 1]],
      "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0,
      "width": 640, "height": 480
    }

Axes are OpenCV's, focal lengths and principal points in pixels, as everywhere.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch

from difftetvr.errors import CameraError
from difftetvr.files import atomic_write
from difftetvr.inputs import require_type
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.trust import require_regular

CAMERA_FORMAT = "difftetvr-camera"
_NUMBERS = ("fx", "fy", "cx", "cy")
_SIZES = ("width", "height")


def save_camera(path: str | Path, camera: Camera) -> None:
    """Writes a camera as JSON.

    :func:`difftetvr.rendering.load_camera` and ``difftetvr render --camera`` read it back to the bit.

    Args:
        path: File to write.
        camera: A pinhole camera, without a lens.

    Raises:
        CameraError: It is another camera, or the file cannot be written.
    """
    content = {"format": CAMERA_FORMAT, **content_of(camera)}
    with atomic_write(path, CameraError) as temporary:
        Path(temporary).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def load_camera(path: str | Path) -> Camera:
    """Reads a camera that :func:`difftetvr.rendering.save_camera` wrote.

    Args:
        path: The file.

    Raises:
        CameraError: The file is missing, no camera, or one of its values is not valid.
    """
    require_type(path, (str, Path), "The file of the camera", "pass its path", CameraError)
    require_regular(Path(path), CameraError)
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise CameraError(f"Cannot read the camera '{path}': {error.strerror or error}.") from None
    except (ValueError, RecursionError):
        raise CameraError(f"The camera '{path}' is not valid JSON; give a file that save_camera wrote.") from None
    if not isinstance(content, dict) or content.get("format") != CAMERA_FORMAT:
        raise CameraError(f"'{path}' does not have the format '{CAMERA_FORMAT}'; give a file that save_camera wrote.")
    return camera_from(content, f"camera '{path}'")


def content_of(camera: Camera) -> dict[str, Any]:
    """What a file says of a camera, the inverse of `camera_from`.

    Raises:
        CameraError: It is no pinhole camera, or has a lens.
    """
    if type(camera) is not Camera:
        raise CameraError("Only pinhole cameras are saved one by one; save the capture of others.")
    pose = camera.world_to_camera.detach().cpu().double().tolist()
    return {"world_to_camera": pose, **{name: getattr(camera, name) for name in (*_NUMBERS, *_SIZES)}}


def camera_from(content: Any, name: str) -> Camera:
    """A camera from what a file says of it.

    Args:
        content: ``world_to_camera`` and the numbers of the camera, by name.
        name: What to call it in messages: camera 'best.json'.

    Raises:
        CameraError: One of these is missing or not valid.
    """
    needed = ("world_to_camera", *_NUMBERS, *_SIZES)
    missing = [key for key in needed if not isinstance(content, dict) or key not in content]
    if missing:
        raise CameraError(f"The {name} has no '{missing[0]}'; give a file that save_camera wrote.")
    try:
        pose = torch.tensor(content["world_to_camera"], dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        raise CameraError(f"'world_to_camera' of the {name} is no matrix of numbers; correct it.") from None
    single = pose.float()
    if torch.equal(single.double(), pose):
        pose = single
    try:
        return Camera(pose, *(content[key] for key in (*_NUMBERS, *_SIZES)))
    except CameraError as error:
        raise CameraError(f"The {name} is not valid: {error}") from None
