"""Captures with a sparse model of COLMAP."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from difftetvr.capture.photos.photo_set import PhotoSet, View
from difftetvr.capture.photos.readers import colmap_binary, colmap_text
from difftetvr.capture.photos.readers.colmap_model import ColmapModel, ColmapPoints
from difftetvr.errors import CaptureError

_MODEL_FOLDERS = ("sparse/0", "sparse", ".", "colmap/sparse/0")
# A model whose points lie farther than this from what they explain belongs to other files.
_WORST_ERROR = 0.05


def find_colmap_model(folder: Path) -> Path | None:
    """The folder of a capture's sparse model, None where there is none."""
    for name in _MODEL_FOLDERS:
        for suffix in (".bin", ".txt"):
            if all((folder / name / f"{part}{suffix}").is_file() for part in ("cameras", "images")):
                return folder / name
    return None


def read_colmap_model(folder: Path) -> ColmapModel:
    """A sparse model; binary files are preferred to text where both exist, and points may be missing.

    Raises:
        CaptureError: A file is missing or damaged, a camera model is not supported, or the parts do not fit together.
    """
    is_binary = (folder / "images.bin").is_file()
    source, suffix = (colmap_binary, ".bin") if is_binary else (colmap_text, ".txt")
    cameras = source.read_cameras(folder / f"cameras{suffix}")
    images = sorted(source.read_images(folder / f"images{suffix}"), key=lambda image: image.name)
    points_file = folder / f"points3D{suffix}"
    nothing = ColmapPoints(np.empty(0, dtype=np.int64), np.empty((0, 3)), np.empty((0, 3), dtype=np.uint8))
    model = ColmapModel(cameras, images, source.read_points(points_file) if points_file.is_file() else nothing)
    _check(model, folder)
    return model


def read_colmap(folder: Path) -> PhotoSet:
    """A folder with ``images`` and a sparse model in ``sparse/0``, ``sparse`` or beside them, or a model's own folder.

    Smaller copies in ``images_2``, ``images_4``, ... are used where they fit the downscaling.

    Raises:
        CaptureError: There is no model or no folder of images, or the model is damaged.
    """
    model_folder = find_colmap_model(folder)
    if model_folder is None:
        raise CaptureError(
            f"'{folder}' holds no sparse model of COLMAP (cameras and images, .bin or .txt, in sparse/0 or sparse); "
            "give a folder that does."
        )
    model = read_colmap_model(model_folder)
    root = _image_folder(folder)
    views = [View(root.parent, root, i.name, i.world_to_camera, model.cameras[i.camera_id]) for i in model.images]
    finite = np.isfinite(model.points.positions).all(axis=1)
    points, colors = model.points.positions[finite], model.points.colors[finite] / 255.0
    known = len(points) > 0
    name = root.parent.resolve().name
    return PhotoSet(
        name, views, may_miss=True, points=points if known else None, point_colors=colors if known else None
    )


def _image_folder(folder: Path) -> Path:
    """The folder that the images' names are relative to; of its smaller copies any will do."""
    absolute = folder.resolve()
    for base in (absolute, absolute.parent, absolute.parent.parent):
        if (base / "images").is_dir() or any(path.is_dir() for path in base.glob("images_[0-9]*")):
            return base / "images"
    raise CaptureError(f"'{folder}' has no folder 'images' beside its sparse model; put the images there.")


def _check(model: ColmapModel, folder: Path) -> None:
    if not model.images:
        raise CaptureError(f"The sparse model in '{folder}' has no registered image; reconstruct it anew.")
    for image in model.images:
        if image.camera_id not in model.cameras:
            raise CaptureError(
                f"Image '{image.name}' of '{folder}' has the camera {image.camera_id}, which the model lacks; "
                "get the model anew."
            )
    errors = model.reprojection_errors()
    size = max(max(lens.width or 0, lens.height or 0) for lens in model.cameras.values())
    if len(errors) and not np.median(errors) <= _WORST_ERROR * size:
        raise CaptureError(
            f"The points of the sparse model in '{folder}' do not project to where its images see them "
            f"(median {np.median(errors):.0f} pixels); get the model anew."
        )
