"""From the files of a photo capture to images in memory and the cameras that took them."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from difftetvr.capture.packed import PackedImages
from difftetvr.capture.photos.image_file import image_size, read_image, read_mask
from difftetvr.capture.photos.lens import Intrinsics
from difftetvr.capture.photos.photo_set import CaptureWarning, PhotoSet, View
from difftetvr.capture.photos.undistort import pinhole_of, undistorted, undistorted_mask
from difftetvr.errors import CameraError, CaptureError
from difftetvr.rendering.cameras.pinhole import Camera

_MOST_WORKERS = 8
_SMALLEST_COPY = 64  # of the smaller copies that are looked for
# Sides that differ by less are cropped: COLMAP's undistorter gives every image a size of its own.
_CROPPED_SHARE, _CROPPED_PIXELS = 0.01, 2


@dataclass(frozen=True, eq=False)
class Photos:
    """Images in memory, all of one size, with their cameras.

    Attributes:
        cameras: N pinhole cameras.
        images: (N, H, W, 3) as stored in the files, premultiplied over black.
        alphas: (N, H, W), None where all images are opaque.
        valid: (N, H, W) bool, None where no pixel is masked.
    """

    cameras: list[Camera]
    images: PackedImages
    alphas: PackedImages | None
    valid: torch.Tensor | None


@dataclass(frozen=True, eq=False)
class _Plan:
    """How one image becomes a view: its file, averaged over blocks, seen through a pinhole instead of its lens."""

    view: View
    shrink: int
    mask_shrink: int
    lens: Intrinsics
    pinhole: Intrinsics
    file: Path


def load_photos(photo_set: PhotoSet, downscale: int) -> Photos:
    """Decode the images in parallel, shrink and undistort them.

    Args:
        photo_set: What a reader found; its views must all have a file.
        downscale: Pixels of the original along x and y that become one.

    Raises:
        CaptureError: An image cannot be read, or sizes do not fit.
    """
    plans = [_plan(view, downscale) for view in photo_set.views]
    width, height = _common_size([plan.pinhole for plan in plans], photo_set)
    cameras = [_camera(plan, width, height) for plan in plans]
    images = np.empty((len(plans), height, width, 3), dtype=np.uint8)
    alphas, valid = None, None
    workers = min(_MOST_WORKERS, os.cpu_count() or 1)
    # Images are the unit of parallel work: torch's own threads would only fight for the same cores.
    with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        try:
            for index, (values, mask) in enumerate(pool.map(_load, plans)):
                images[index] = values[:height, :width, :3]
                if values.shape[2] == 4:
                    alphas = np.full(images.shape[:3], 255, dtype=np.uint8) if alphas is None else alphas
                    alphas[index] = values[:height, :width, 3]
                if mask is not None:
                    valid = np.ones(images.shape[:3], dtype=np.bool_) if valid is None else valid
                    valid[index] = mask[:height, :width]
        finally:
            # After an error nobody waits for the other images.
            pool.shutdown(cancel_futures=True)
    if alphas is not None and (alphas == 255).all():
        alphas = None
    return Photos(
        cameras,
        PackedImages(torch.from_numpy(images)),
        None if alphas is None else PackedImages(torch.from_numpy(alphas)),
        None if valid is None else torch.from_numpy(valid),
    )


def present_views(photo_set: PhotoSet, downscale: int) -> list[View]:
    """The views whose image exists.

    Raises:
        CaptureError: Images are missing that the format does not allow to be absent, or more than half of them.
    """
    views = photo_set.views
    absent = [view for view in views if view.file(downscale) is None]
    if not absent:
        return views
    first = absent[0]
    copies = sorted(first.root.parent.glob(f"{first.root.name}_[0-9]*"))
    advice = f"give a downscale that '{copies[0].name}' fits" if copies else "get the capture anew"
    if not photo_set.may_miss:
        raise CaptureError(f"The image {first.label} is missing; {advice}.")
    verb = "is" if len(absent) == 1 else "are"
    found = f"{len(absent)} of the {len(views)} images of '{photo_set.name}' {verb} missing, such as {first.label}"
    if 2 * len(absent) > len(views):
        raise CaptureError(f"{found}; {advice}.")
    warnings.warn(f"{found}; left out.", CaptureWarning, stacklevel=2)
    return [view for view in views if view not in absent]


def fitting_downscale(photo_set: PhotoSet, longest_side: int) -> int:
    """The least downscale with which the first image there is has at most so many pixels along its longer side.

    Args:
        photo_set: What a reader found.
        longest_side: Pixels, >= 1.

    Raises:
        CaptureError: The image cannot be read.
    """
    for view in photo_set.views:
        for downscale in range(1, _SMALLEST_COPY + 1):
            found = view.file(downscale)
            if found is None:
                continue
            file, factor = found
            least = -(-factor * max(image_size(file)) // longest_side)
            # Smaller copies may be all there is, and only serve multiples of their factor.
            return downscale * max(1, -(-least // downscale))
    return 1


def make_camera(intrinsics: Intrinsics, pose: torch.Tensor, where: str) -> Camera:
    """A camera.

    Raises:
        CaptureError: A value is out of range.
    """
    i = intrinsics
    try:
        return Camera(pose.to(torch.float32), i.fx, i.fy, i.cx, i.cy, i.width, i.height)
    except CameraError as error:
        raise CaptureError(f"The camera of {where} is not valid: {error}") from None


def _plan(view: View, downscale: int) -> _Plan:
    found = view.file(downscale)
    if found is None:
        raise CaptureError(f"The image {view.label} is missing; get the capture anew.")
    file, factor = found
    size = image_size(file)
    full = (view.lens.width or size[0] * factor, view.lens.height or size[1] * factor)
    # A smaller copy's size is rounded one way or the other.
    if any(abs(stored * factor - meant) >= factor for stored, meant in zip(size, full, strict=True)):
        raise CaptureError(
            f"The image '{file}' has {size[0]} x {size[1]} pixels but its camera {full[0]} x {full[1]}"
            f"{f', shrunk by {factor}' if factor > 1 else ''}; give the image that the camera was calibrated for."
        )
    shrink = downscale // factor
    if min(size) < shrink:
        raise CaptureError(f"The image '{file}' has {size[0]} x {size[1]} pixels, too few to shrink by {shrink}.")
    lens = view.lens.on(*full, view.label).resized(*size).shrunk(shrink)
    return _Plan(view, shrink, downscale, lens, pinhole_of(lens, view.label), file)


def _load(plan: _Plan) -> tuple[np.ndarray, np.ndarray | None]:
    """(H, W, 3 or 4) uint8 values of a view, and its (H, W) mask, if it has one."""
    image = read_image(plan.file, plan.shrink)
    mask = None if plan.view.mask is None else _load_mask(plan)
    if plan.lens != plan.pinhole:
        image = undistorted(image, plan.lens, plan.pinhole)
        mask = None if mask is None else undistorted_mask(mask, plan.lens, plan.pinhole)
    return (image * 255.0).round_().to(torch.uint8).numpy(), None if mask is None else mask.numpy()


def _load_mask(plan: _Plan) -> torch.Tensor:
    assert plan.view.mask is not None
    mask = read_mask(plan.view.mask, plan.mask_shrink)
    if mask.shape != (plan.lens.height, plan.lens.width):
        raise CaptureError(
            f"The mask '{plan.view.mask}' has another size than its image {plan.view.label}; make them equal."
        )
    return mask


def _common_size(sizes: Sequence[Intrinsics], photo_set: PhotoSet) -> tuple[int, int]:
    """Width and height that all images are cropped to."""
    common = []
    for side in ("width", "height"):
        pixels = [getattr(size, side) for size in sizes]
        least, most = min(pixels), max(pixels)
        if most - least > max(_CROPPED_PIXELS, _CROPPED_SHARE * most):
            one, other = (photo_set.views[pixels.index(value)].label for value in (least, most))
            raise CaptureError(
                f"The images of '{photo_set.name}' have different sizes: {one} has a {side} of {least} pixels, {other} "
                f"of {most}; give images of one size."
            )
        common.append(least)
    cropped = sum((size.width, size.height) != tuple(common) for size in sizes)
    if cropped:
        warnings.warn(
            f"The images of '{photo_set.name}' differ in size by a few pixels; {cropped} are cropped at the right and "
            f"bottom to {common[0]} x {common[1]}.",
            CaptureWarning,
            stacklevel=2,
        )
    return common[0], common[1]


def _camera(plan: _Plan, width: int, height: int) -> Camera:
    cropped = replace(plan.pinhole, width=width, height=height)
    return make_camera(cropped, torch.from_numpy(plan.view.world_to_camera), plan.view.label)
