"""Files of camera paths: our own, and those that nerfstudio's viewer writes.

    {
      "format": "difftetvr-camera-path",
      "cameras": [{"world_to_camera": [[...], ...], "fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0,
                   "width": 640, "height": 480}, ...],
      "frames": 120,
      "loop": false,
      "fps": 24
    }

Cameras are those of single files, see `difftetvr.rendering.cameras.camera_file`. With ``frames`` they are keys that a
spline runs through in so many frames; without, each is a frame. ``loop`` closes the path, ``fps`` are frames a second.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from difftetvr.capture.camera_paths.spline import interpolated
from difftetvr.capture.photos.poses import from_opengl
from difftetvr.errors import CameraError, CaptureError, shown
from difftetvr.files import atomic_write
from difftetvr.inputs import require_type
from difftetvr.rendering.cameras.camera_file import camera_from, content_of
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.trust import require_regular

PATH_FORMAT = "difftetvr-camera-path"
_MOST_FRAMES = 1_000_000
_HINT = f"give a file of the format '{PATH_FORMAT}', or a camera path of nerfstudio"


@dataclass(frozen=True)
class CameraPath:
    """Cameras of a film.

    Attributes:
        cameras: One for each frame, or the keys that a spline runs through.
        frames: Frames of the spline; None: each camera is a frame.
        loop: Whether the spline returns to the first camera.
        fps: Frames a second; None: not said.
    """

    cameras: list[Camera]
    frames: int | None = None
    loop: bool = False
    fps: float | None = None

    def cameras_of_frames(self, frames: int | None = None) -> list[Camera]:
        """One camera for each frame.

        Args:
            frames: How many; None: as the path says.
        """
        count = frames or self.frames
        return list(self.cameras) if count is None else interpolated(self.cameras, count, self.loop)


def load_camera_path(path: str | Path) -> CameraPath:
    """Reads a camera path: a file of our own format, or what nerfstudio's viewer exports as a camera path.

    nerfstudio's poses are those of its own scene, which are those of the capture only where it was trained with
    ``--orientation-method none --center-method none --auto-scale-poses False``. Each of its cameras is a frame.

    Args:
        path: The file, JSON.

    Raises:
        CameraError: The file is missing, of another kind, or one of its values is not valid.
    """
    require_type(path, (str, Path), "The file of the camera path", "pass its path", CameraError)
    require_regular(Path(path), CameraError)
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise CameraError(f"Cannot read the camera path '{path}': {error.strerror or error}.") from None
    except (ValueError, RecursionError):
        raise CameraError(f"The camera path '{path}' is not valid JSON; {_HINT}.") from None
    content = content if isinstance(content, dict) else {}
    is_own = content.get("format") == PATH_FORMAT
    if not is_own and "camera_path" not in content:
        raise CameraError(f"'{path}' is no camera path; {_HINT}.")
    entries = content.get("cameras" if is_own else "camera_path")
    read: Callable[[Any, str], Camera] = camera_from if is_own else _Nerfstudio(path, content)
    if not isinstance(entries, list) or not entries:
        raise CameraError(f"The camera path '{path}' has no cameras; give one or more.")
    cameras = [read(entry, f"camera {index} of the path '{path}'") for index, entry in enumerate(entries)]
    frames = _number(path, content, "frames") if is_own else None
    loop = content.get("loop", False) if is_own else False
    if not isinstance(loop, bool):
        raise CameraError(f"'loop' of the camera path '{path}' is {shown(loop)}; give true or false.")
    return CameraPath(cameras, None if frames is None else max(1, round(frames)), loop, _number(path, content, "fps"))


def _number(path: str | Path, content: dict[str, Any], name: str) -> float | None:
    """A positive number of a file, None where it has none.

    Raises:
        CameraError: It is something else.
    """
    value = content.get(name)
    if value is None:
        return None
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not is_number or not (math.isfinite(value) and 0 < value <= _MOST_FRAMES):
        raise CameraError(f"'{name}' of the camera path '{path}' is {shown(value)}; give a number greater than 0.")
    return float(value)


def save_camera_path(path: str | Path, content: CameraPath) -> None:
    """Writes a camera path in our own format, which `load_camera_path` reads back to the bit.

    Args:
        path: File to write.
        content: The path, of pinhole cameras without a lens.

    Raises:
        CameraError: A camera is another one, or the file cannot be written.
    """
    values: dict[str, Any] = {"format": PATH_FORMAT, "cameras": [content_of(camera) for camera in content.cameras]}
    given = {"frames": content.frames, "loop": content.loop or None, "fps": content.fps}
    values |= {name: value for name, value in given.items() if value is not None}
    with atomic_write(path, CameraError) as temporary:
        temporary.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")


class _Nerfstudio:
    """Makes cameras of the entries of a nerfstudio camera path: ``camera_to_world`` (OpenGL axes), ``fov`` in degrees.

    The field of view is vertical, as its viewer has it; the size is that of the whole path.
    """

    def __init__(self, path: str | Path, content: dict[str, Any]) -> None:
        if content.get("camera_type", "perspective") != "perspective":
            kind = shown(content["camera_type"])
            raise CameraError(f"The camera path '{path}' is of {kind} cameras; only perspective ones are read.")
        sizes = [content.get(name) for name in ("render_width", "render_height")]
        numbers = [size for size in sizes if isinstance(size, int) and not isinstance(size, bool)]
        if len(numbers) < 2:
            raise CameraError(f"The camera path '{path}' has no render_width and render_height; give both, in pixels.")
        self._width, self._height = numbers

    def __call__(self, entry: Any, name: str) -> Camera:
        entry = entry if isinstance(entry, dict) else {}
        values, fov = entry.get("camera_to_world"), entry.get("fov")
        if isinstance(values, list) and len(values) == 16:
            values = [values[4 * row : 4 * row + 4] for row in range(4)]
        if not isinstance(fov, int | float) or not 0.0 < fov < 180.0:
            raise CameraError(f"The fov of {name} is {shown(fov)}; give degrees between 0 and 180.")
        try:
            pose = torch.from_numpy(from_opengl(values, name))
        except CaptureError as error:
            raise CameraError(str(error)) from None
        width, height = self._width, self._height
        focal = 0.5 * height / math.tan(0.5 * math.radians(fov))
        try:
            return Camera(pose, focal, focal, 0.5 * width, 0.5 * height, width, height)
        except CameraError as error:
            raise CameraError(f"The {name} is not valid: {error}") from None
