"""Captures of two apps for telephones, whose files say what a transforms.json does: Polycam and Record3D.

Sources: the raw data of Polycam ("developer mode") and the shareable format of Record3D ("EXR + RGB"), as nerfstudio
converts them (nerfstudio/process_data/polycam_utils.py and record3d_utils.py). Both store camera-to-world in the axes
of ARKit, which are those of OpenGL.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from difftetvr.capture.photos.lens import Lens
from difftetvr.capture.photos.photo_set import (
    CaptureWarning,
    PhotoSet,
    View,
    number_of,
    numbers_of,
    pixels_of,
    read_json,
)
from difftetvr.capture.photos.poses import from_opengl
from difftetvr.errors import CaptureError


def is_polycam(folder: Path) -> bool:
    """Whether a folder holds raw data of Polycam."""
    return any((folder / "keyframes" / name).is_dir() for name in ("corrected_cameras", "cameras"))


def read_polycam(folder: Path) -> PhotoSet:
    """Raw data of Polycam: ``keyframes`` with a file in ``cameras`` for each of its ``images``.

    Poses that the app has corrected after the recording are preferred, with the images that belong to them.

    Raises:
        CaptureError: There is no such data, or a file is not valid.
    """
    frames = folder / "keyframes"
    prefix = "corrected_" if (frames / "corrected_cameras").is_dir() else ""
    files = sorted((frames / f"{prefix}cameras").glob("*.json"))
    if not files:
        raise CaptureError(f"'{folder}' has no keyframes/cameras/*.json; export the raw data of Polycam anew.")
    root = frames / f"{prefix}images"
    views = [_polycam_view(folder, root, file) for file in files]
    _warn_of_depth(folder, frames / "depth")
    return PhotoSet(folder.resolve().name, views, may_miss=True)


def is_record3d(folder: Path) -> bool:
    """Whether a folder holds what Record3D exports."""
    return (folder / "metadata.json").is_file() and (folder / "rgb").is_dir()


def read_record3d(folder: Path) -> PhotoSet:
    """An export of Record3D: ``metadata.json``, and the images ``rgb/0.jpg``, ``rgb/1.jpg``, ...

    Raises:
        CaptureError: There is none, or a file is not valid.
    """
    file = folder / "metadata.json"
    content = read_json(file)
    poses = numbers_of(content.get("poses"))
    if poses.ndim != 2 or poses.shape[1] != 7 or not len(poses) or not np.isfinite(poses).all():
        raise CaptureError(f"'poses' of '{file}' is no list of seven numbers for each image; export it anew.")
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(poses[:, :4], axis=1)
    if not (np.abs(lengths - 1.0) < 0.01).all():
        raise CaptureError(f"Pose {int(np.abs(lengths - 1.0).argmax())} of '{file}' is no rotation; export it anew.")
    matrices = np.concatenate([Rotation.from_quat(poses[:, :4]).as_matrix(), poses[:, 4:, None]], axis=2)
    own = numbers_of(content.get("perFrameIntrinsicCoeffs"))
    shared = numbers_of(content.get("K"))
    if own.shape != (len(poses), 4):
        if shared.size != 9:
            raise CaptureError(f"'{file}' has no intrinsics: neither perFrameIntrinsicCoeffs nor K; export it anew.")
        # K is stored column by column.
        own = np.broadcast_to(shared.reshape(9)[[0, 4, 6, 7]], (len(poses), 4))
    size = (pixels_of(content, "w", f"'{file}'"), pixels_of(content, "h", f"'{file}'"))
    views = [
        View(folder, folder / "rgb", str(index), from_opengl(matrix, f"pose {index} of '{file}'"), _lens(values, size))
        for index, (matrix, values) in enumerate(zip(matrices, own.tolist(), strict=True))
    ]
    _warn_of_depth(folder, folder / "depth")
    return PhotoSet(folder.resolve().name, views, may_miss=True)


def _polycam_view(folder: Path, root: Path, file: Path) -> View:
    content, where = read_json(file), f"'{file}'"
    values = [number_of(content, key, where) for key in ("fx", "fy", "cx", "cy")]
    pose = [[number_of(content, f"t_{row}{column}", where) for column in range(4)] for row in range(3)]
    known = [value for value in values if value is not None]
    if len(known) < len(values) or any(None in row for row in pose):
        raise CaptureError(f"{where} lacks one of fx, fy, cx, cy and t_00 to t_23; export the raw data anew.")
    size = (pixels_of(content, "width", where), pixels_of(content, "height", where))
    return View(folder, root, file.stem, from_opengl(pose, where), _lens(known, size))


def _lens(values: Sequence[float], size: tuple[int | None, int | None]) -> Lens:
    fx, fy, cx, cy = values
    return Lens(fx, fy, cx, cy, width=size[0], height=size[1])


def _warn_of_depth(folder: Path, depth: Path) -> None:
    if depth.is_dir():
        warnings.warn(f"The depth maps of '{folder}' are not used.", CaptureWarning, stacklevel=2)
