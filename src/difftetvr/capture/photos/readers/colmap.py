"""Captures with a sparse model of COLMAP."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from difftetvr.capture.photos.photo_set import CaptureWarning, PhotoSet, View
from difftetvr.capture.photos.readers import colmap_binary, colmap_text
from difftetvr.capture.photos.readers.colmap_model import ColmapModel, ColmapPoints
from difftetvr.errors import CaptureError, counted
from difftetvr.trust import file_beside

_MASK_FOLDER = "masks"
_MODEL_FOLDERS = ("sparse", ".", "colmap/sparse")
# A model whose points lie farther than this from what they explain belongs to other files.
_WORST_ERROR = 0.05


def colmap_models(folder: Path) -> list[Path]:
    """The folders of a capture's sparse models, which COLMAP numbers where it cannot join the images to one."""
    for name in _MODEL_FOLDERS:
        base = folder / name
        numbered = sorted((name for name in _names_in(base) if name.isdecimal()), key=int)
        models = [base / name for name in numbered if _is_model(base / name)]
        if models or _is_model(base):
            return models or [base]
    return []


def _names_in(folder: Path) -> list[str]:
    try:
        return os.listdir(folder)
    except OSError:
        return []


def _is_model(folder: Path) -> bool:
    return any(all((folder / f"{part}{end}").is_file() for part in ("cameras", "images")) for end in (".bin", ".txt"))


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

    Of several models, ``sparse/0``, ``sparse/1``, ..., that with the most images is read.
    Smaller copies in ``images_2``, ``images_4``, ... are used where they fit the downscaling, and masks in ``masks``:
    that of ``images/a.jpg`` is ``masks/a.jpg.png``, ``masks/a.jpg`` or ``masks/a.png``.

    Raises:
        CaptureError: There is no model or no folder of images, or the model is damaged.
    """
    models = colmap_models(folder)
    if not models:
        raise CaptureError(
            f"'{folder}' holds no sparse model of COLMAP (cameras and images, .bin or .txt, in sparse/0 or sparse); "
            "give a folder that does."
        )
    model = read_colmap_model(models[0] if len(models) == 1 else _largest(models))
    root = _image_folder(folder)
    masks = _masks(root.parent, [image.name for image in model.images])
    views = [
        View(root.parent, root, i.name, i.world_to_camera, model.cameras[i.camera_id], mask=masks.get(i.name))
        for i in model.images
    ]
    finite = np.isfinite(model.points.positions).all(axis=1)
    points, colors = model.points.positions[finite], model.points.colors[finite] / 255.0
    known = len(points) > 0
    name = root.parent.resolve().name
    return PhotoSet(
        name, views, may_miss=True, points=points if known else None, point_colors=colors if known else None
    )


def _largest(models: Sequence[Path]) -> Path:
    """The model with the most images, the first of these; the others are named."""
    counts = [_image_count(model) for model in models]
    best = counts.index(max(counts))
    others = ", ".join(f"'{m}' ({n})" for i, (m, n) in enumerate(zip(models, counts, strict=True)) if i != best)
    warnings.warn(
        f"Of {len(models)} sparse models, '{models[best]}' with {counted(counts[best], 'image')} is read; not "
        f"{others}.",
        CaptureWarning,
        stacklevel=3,
    )
    return models[best]


def _image_count(model: Path) -> int:
    """How many images a model has; 0 for one that cannot be read."""
    source, suffix = (colmap_binary, ".bin") if (model / "images.bin").is_file() else (colmap_text, ".txt")
    try:
        return source.count_images(model / f"images{suffix}")
    except CaptureError:
        return 0


def _masks(folder: Path, names: Sequence[str]) -> dict[str, Path]:
    """Files of masks by the names of the images that have one, as COLMAP names them, or plainer."""
    root = folder / _MASK_FOLDER
    if not root.is_dir():
        return {}
    found = {}
    for name in filter(lambda name: Path(name).name, names):
        for candidate in (root / f"{name}.png", root / name, (root / name).with_suffix(".png")):
            if os.path.isfile(candidate):
                file_beside(folder, os.path.abspath(candidate), CaptureError)
                found[name] = candidate
                break
    if len(found) < len(names):
        what = f"{len(names) - len(found)} of the {len(names)} images have no mask in '{root}', such as {names[0]}.png"
        warnings.warn(f"{what}; all their pixels are used.", CaptureWarning, stacklevel=3)
    return found


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
