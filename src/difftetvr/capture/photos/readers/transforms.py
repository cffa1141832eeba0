"""Captures described by transforms.json: NeRF-synthetic, nerfstudio and instant-ngp.

Sources: the data of NeRF (Mildenhall et al. 2020), https://docs.nerf.studio/quickstart/data_conventions.html and
docs/nerf_dataset_tips.md of instant-ngp. All three store camera-to-world in OpenGL axes.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from difftetvr.capture.photos.lens import Lens
from difftetvr.capture.photos.photo_set import (
    CaptureWarning,
    PhotoSet,
    View,
    image_place,
    list_of_objects,
    number_of,
    numbers_of,
    pixels_of,
    read_json,
    text_of,
)
from difftetvr.capture.photos.poses import from_opengl
from difftetvr.capture.photos.readers.ply_points import read_ply_points
from difftetvr.errors import CaptureError, shown
from difftetvr.rendering.cameras.lenses.distortion import Distortion
from difftetvr.rendering.cameras.lenses.models import LENS_MODELS, TRANSFORMS_CAMERAS, FileCamera
from difftetvr.trust import file_beside

_FISHEYE = "OPENCV_FISHEYE"  # what is_fisheye of instant-ngp stands for
_READ = {kind.model for kinds in TRANSFORMS_CAMERAS.values() for kind in kinds}
# Of any lens that such a file is read with, or that its distortion may be taken for.
_COEFFICIENTS = sorted(
    {name for model in (*_READ, "thin-prism-fisheye", "fov") for name in LENS_MODELS[model].coefficients}
)
# What changes nothing here, although the file says it.
_UNUSED = {
    "depth_file_path": "depth maps (depth_file_path)",
    "depth_path": "depth maps (depth_path)",
    "rolling_shutter": "a rolling shutter",
}
# instant-ngp maps positions p to 0.33 p + (0.5, 0.5, 0.5), and its box is a cube of side aabb_scale around the 0.5s.
_NGP_SCALE, _NGP_OFFSET, _NGP_CENTER = 0.33, 0.5, 0.5


def read_nerf_synthetic(folder: Path) -> PhotoSet:
    """A folder with transforms_train.json and, for the held-out views, transforms_test.json or transforms_val.json.

    Views for validation are used only where no image for testing is present. All images for training must exist; of
    those for testing, which are often handed on in part, absent ones are skipped with a warning.

    Raises:
        CaptureError: A file is missing or not valid.
    """
    training = folder / "transforms_train.json"
    train = _views(training, read_json(training), is_test=False)
    for view in train:
        if view.file(1) is None:
            raise CaptureError(
                f"The training image {view.label} is missing, and a NeRF-synthetic capture needs all of them; "
                "get the capture anew."
            )
    test = _held_out(folder)
    return PhotoSet(folder.resolve().name, train + test, has_split=bool(test))


def read_transforms(path: Path) -> PhotoSet:
    """A transforms.json of nerfstudio or instant-ngp.

    Intrinsics may stand at the top or, overriding that, in each frame. Distortion is k1, k2, k3, k4, p1, p2, that of
    fisheyes OpenCV's k1, k2, k3, k4, or nerfstudio's list of ``distortion_params``.
    nerfstudio's lists of ``train_filenames`` and ``test_filenames`` (or ``val_filenames``) are kept to.
    The points of its ``ply_file_path`` are the sparse points.
    Where there is an ``aabb_scale``, the bounds are instant-ngp's unit cube, by its ``scale`` and ``offset``.
    Listed images may be absent, as instant-ngp allows.

    Args:
        path: The file, or its folder.

    Raises:
        CaptureError: The file is not valid, or the camera model is not supported.
    """
    file = path / "transforms.json" if path.is_dir() else path
    folder, content = file.parent, read_json(file)
    views = sorted(_views(file, content, is_test=False), key=lambda view: view.name)
    places = [_place(view.root / view.name) for view in views]
    held_out = _named(content, "test_filenames", file) or _named(content, "val_filenames", file)
    used = (_named(content, "train_filenames", file) | held_out) or set(places)
    views = [
        replace(view, is_test=place in held_out) for view, place in zip(views, places, strict=True) if place in used
    ]
    if not views:
        raise CaptureError(f"The file names that '{file}' lists for training and testing are none of its frames.")
    points, colors = _sparse_points(content, file)
    _warn_of_unused(content, file)
    return PhotoSet(
        folder.resolve().name,
        views,
        has_split=bool(held_out),
        may_miss=True,
        points=points,
        point_colors=colors,
        rough_bounds=_box(content, f"'{file}'"),
    )


def _held_out(folder: Path) -> list[View]:
    for name in ("transforms_test.json", "transforms_val.json"):
        file = folder / name
        if not file.is_file():
            continue
        views = _views(file, read_json(file), is_test=True)
        present = [view for view in views if view.file(1) is not None]
        if len(present) < len(views):
            missing = len(views) - len(present)
            warnings.warn(
                f"{missing} of the {len(views)} images that '{file}' lists are missing; they are left out.",
                CaptureWarning,
                stacklevel=2,
            )
        if present:
            return present
    return []


def _views(file: Path, content: dict[str, Any], is_test: bool) -> list[View]:
    views = []
    for index, frame in enumerate(list_of_objects(content, "frames", file)):
        where = f"frame {index} of '{file}'"
        root, name = image_place(file, text_of(frame, "file_path", where), where)
        pose = from_opengl(frame.get("transform_matrix"), where)
        mask = file_beside(file, text_of(frame, "mask_path", where), CaptureError) if frame.get("mask_path") else None
        views.append(View(file, root, name, pose, _lens(_values_of(content, frame), where), is_test, mask))
    return views


def _values_of(content: dict[str, Any], frame: dict[str, Any]) -> dict[str, Any]:
    """What holds for a frame: its own values before those at the top, coefficients of its own before a list there."""
    values = {**content, **frame}
    if "distortion_params" not in frame and any(key in frame for key in _COEFFICIENTS):
        values.pop("distortion_params", None)
    return values


def _lens(values: dict[str, Any], where: str) -> Lens:
    model = values.get("camera_model") or ""
    if not isinstance(model, str) or model.upper() not in TRANSFORMS_CAMERAS:
        raise CaptureError(
            f"The camera model of {where} is {shown(model)}, which is not known; undistort its images to a pinhole "
            "first."
        )
    kinds = TRANSFORMS_CAMERAS[model.upper()]
    if values.get("is_fisheye") and not LENS_MODELS[kinds[-1].model].is_fisheye:
        kinds = TRANSFORMS_CAMERAS[_FISHEYE]

    def number(key: str) -> float | None:
        return number_of(values, key, where)

    given = _distortion_params(values, kinds[-1], where)
    if given is None:
        given = {key: number(key) or 0.0 for key in _COEFFICIENTS}
    distorting = sorted(key for key, value in given.items() if value)
    kind = next((kind for kind in kinds if set(distorting) <= set(kind.parameters)), None)
    if kind is None:
        other = next(key for key in distorting if key not in kinds[-1].parameters)
        raise CaptureError(
            f"{where[0].upper()}{where[1:]} has the distortion {other}, which the lens model '{kinds[-1].model}' is "
            "not read with; undistort it first."
        )
    return Lens(
        fx=number("fl_x"),
        fy=number("fl_y"),
        cx=number("cx"),
        cy=number("cy"),
        angle_x=number("camera_angle_x"),
        angle_y=number("camera_angle_y"),
        width=pixels_of(values, "w", where),
        height=pixels_of(values, "h", where),
        distortion=Distortion.named(kind.model, {key: given.get(key, 0.0) for key in kind.parameters}),
    )


def _distortion_params(values: dict[str, Any], kind: FileCamera, where: str) -> dict[str, float] | None:
    """Coefficients by name that nerfstudio's ``distortion_params`` lists; None where there are none."""
    listed = values.get("distortion_params")
    if listed is None:
        return None
    is_plain = isinstance(listed, list) and all(type(value) in (int, float) for value in listed)
    numbers = numbers_of(listed if is_plain else None)
    names = max(kind.parameters, LENS_MODELS["nerfstudio"].coefficients, key=len)
    if numbers.shape != (len(names),) or not np.isfinite(numbers).all():
        raise CaptureError(
            f"The distortion_params of {where} are {shown(listed)}, not {len(names)} finite numbers; correct them."
        )
    return dict(zip(names, numbers.tolist(), strict=True))


def _sparse_points(content: dict[str, Any], file: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Positions and colours from the PLY file that nerfstudio names; None where there is none."""
    if content.get("ply_file_path") is None:
        return None, None
    path = file_beside(file, text_of(content, "ply_file_path", f"'{file}'"), CaptureError)
    if not path.exists():
        warnings.warn(
            f"The sparse points '{path}' that '{file}' names are missing; it is read without.",
            CaptureWarning,
            stacklevel=3,
        )
        return None, None
    points, colors = read_ply_points(path)
    return (points, colors) if len(points) else (None, None)


def _warn_of_unused(content: dict[str, Any], file: Path) -> None:
    frames = list_of_objects(content, "frames", file)
    unused = [what for key, what in _UNUSED.items() if key in content or any(key in frame for frame in frames)]
    if unused:
        warnings.warn(f"'{file}' has {' and '.join(unused)}, not used here.", CaptureWarning, stacklevel=3)


def _box(content: dict[str, Any], where: str) -> np.ndarray | None:
    """The unit cube of instant-ngp, where the object should be; None where the file is not for instant-ngp."""
    side = number_of(content, "aabb_scale", where)
    if side is None:
        return None
    scale = number_of(content, "scale", where) or _NGP_SCALE
    offset = content.get("offset", _NGP_OFFSET)
    offsets = numbers_of(offset)
    if side <= 0 or offsets.shape not in ((), (3,)) or not np.isfinite(offsets).all():
        raise CaptureError(
            f"The aabb_scale {side:g} or the offset {shown(offset)} of {where} is not valid; correct them."
        )
    center = (_NGP_CENTER - np.broadcast_to(offsets, (3,))) / scale
    half = 0.5 / abs(scale)
    return np.stack([center - half, center + half])


def _named(content: dict[str, Any], key: str, file: Path) -> set[str]:
    names = content.get(key) or []
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise CaptureError(f"'{key}' of '{file}' is no list of file names; correct or remove it.")
    return {_place(file.parent / name.replace("\\", "/")) for name in names}


def _place(path: Path) -> str:
    """By which the image of a frame and a name in nerfstudio's lists are compared."""
    return os.path.abspath(path)
