"""From the files of a photo capture to images in memory and the cameras that took them."""

from __future__ import annotations

import os
import warnings
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch

from difftetvr.capture.packed import Images, Masks, MixedImages, PackedImages
from difftetvr.capture.photos.image_file import ImageHeader, image_header, read_image, read_mask
from difftetvr.capture.photos.lens import make_camera
from difftetvr.capture.photos.photo_set import CaptureWarning, PhotoSet, View
from difftetvr.capture.photos.undistort import known_pixels, pinhole_of, undistorted, undistorted_mask
from difftetvr.errors import CaptureError
from difftetvr.rendering.cameras.intrinsics import Intrinsics
from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.trust import UNPACKED_BYTES, free_memory, require_free

_MOST_WORKERS = 8
_BYTES_OF_UNDISTORTING = 100  # a pixel: the grid in float64 and what it is made of, the image and its linear light
_BYTES_OF_READING = 32  # a pixel: the image as float32, its bytes, its mask
_SMALLEST_COPY = 64  # of the smaller copies that are looked for
# Sides that differ by less are cropped: COLMAP's undistorter gives every image a size of its own.
_CROPPED_SHARE, _CROPPED_PIXELS = 0.01, 2


_Arrays: TypeAlias = np.ndarray | list[np.ndarray]


@dataclass(frozen=True, eq=False)
class Photos:
    """Images in memory, with their cameras.

    Attributes:
        cameras: N cameras: pinholes, or those of the lenses that were kept.
        images: (N, H, W, 3) as stored in the files, premultiplied over black, or of several sizes.
        alphas: (N, H, W) likewise, None where all images are opaque.
        valid: (N, H, W) bool likewise, None where no pixel is masked.
    """

    cameras: list[Camera]
    images: Images
    alphas: Images | None
    valid: Masks | None


@dataclass(frozen=True, eq=False)
class _Plan:
    """How one image becomes a view: its file, averaged over blocks, and what it is then seen through.

    Attributes:
        view: The view.
        shrink: Pixels of the file along x and y that are averaged to one.
        mask_shrinks: By how much its mask may have to be shrunk.
        lens: What the image was taken with.
        seen: What the view has: the same, or a pinhole instead.
        known: (H, W) bool, pixels that a lens that is kept can have made; None for all.
        file: The image's file.
        header: Its header.
    """

    view: View
    shrink: int
    mask_shrinks: tuple[int, ...]
    lens: Intrinsics
    seen: Intrinsics
    known: torch.Tensor | None
    file: Path
    header: ImageHeader

    @property
    def working_bytes(self) -> int:
        """Memory that loading it takes for a while."""
        pixels = self.lens.width * self.lens.height
        per_pixel = _BYTES_OF_READING if self.lens == self.seen else _BYTES_OF_UNDISTORTING
        return self.header.decoding_bytes(self.shrink) + per_pixel * pixels


def load_photos(photo_set: PhotoSet, downscale: int, keep_lens: bool = False) -> Photos:
    """Decode the images in parallel, shrink and undistort them.

    Args:
        photo_set: What a reader found; its views must all have a file.
        downscale: Pixels of the original along x and y that become one.
        keep_lens: Whether they are left distorted. Pixels that their lens cannot have made are masked then.

    Raises:
        CaptureError: An image cannot be read, sizes do not fit, or there is not enough memory.
    """
    plans = [_plan(view, downscale, keep_lens) for view in photo_set.views]
    _warn_of_16_bits(plans, photo_set)
    _warn_of_unknown(plans, photo_set)
    cameras = _cameras(plans, photo_set)
    sizes = [(camera.width, camera.height) for camera in cameras]
    channels = 3 + (0 if all(plan.view.mask is None and plan.known is None for plan in plans) else 1)
    pixels = sum(width * height for width, height in sizes)
    advice = "shrink them more with a larger downscale"
    require_free(channels * pixels, f"The images of '{photo_set.name}'", advice, CaptureError)
    images = _arrays(sizes, 3, 0)
    alphas: _Arrays | None = None
    valid: _Arrays | None = None
    for index, (values, mask) in enumerate(_loaded(plans)):
        width, height = sizes[index]
        images[index][...] = values[:height, :width, :3]
        if values.shape[2] == 4:
            alphas = _arrays(sizes, 0, 255) if alphas is None else alphas
            alphas[index][...] = values[:height, :width, 3]
        if mask is not None:
            valid = _arrays(sizes, 0, 1) if valid is None else valid
            valid[index][...] = mask[:height, :width]
    if alphas is not None and all((alpha == 255).all() for alpha in alphas):
        alphas = None
    return Photos(cameras, _packed(images), None if alphas is None else _packed(alphas), _as_masks(valid))


def photo_cameras(photo_set: PhotoSet, downscale: int, keep_lens: bool = False) -> list[Camera]:
    """The cameras that `load_photos` finds, of which it takes no more than the headers of the images.

    Args:
        photo_set: As for `load_photos`, as all others.
        downscale: Pixels of the original along x and y that become one.
        keep_lens: Whether lenses are kept.

    Raises:
        CaptureError: An image has no header that can be read, or sizes do not fit.
    """
    return _cameras([_plan(view, downscale, keep_lens) for view in photo_set.views], photo_set)


def _cameras(plans: Sequence[_Plan], photo_set: PhotoSet) -> list[Camera]:
    sizes = _sizes([plan.seen for plan in plans], photo_set)
    return [_camera(plan, size) for plan, size in zip(plans, sizes, strict=True)]


def _loaded(plans: Sequence[_Plan]) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
    """What :func:`_load` gives of each plan, in order; as many at a time as cores and memory allow."""
    largest = max(plan.working_bytes for plan in plans)
    decoded = max(plan.header.decoding_bytes(plan.shrink) for plan in plans)
    room = min(free_memory() // 2 // largest, UNPACKED_BYTES // decoded)
    workers = max(1, min(_MOST_WORKERS, os.cpu_count() or 1, room))
    # Images are the unit of parallel work: torch's own threads would only fight for the same cores.
    with ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        try:
            # How far files are trusted is known to the caller's context only, and one thread may be in a context.
            waiting = deque(pool.submit(copy_context().run, _load, plan) for plan in plans)
            while waiting:
                yield waiting.popleft().result()
        finally:
            # After an error nobody waits for the other images.
            pool.shutdown(cancel_futures=True)


def _arrays(sizes: Sequence[tuple[int, int]], channels: int, fill: int) -> _Arrays:
    """Bytes of all views: one array where these have one size, else one for each; without channels, of pixels."""
    shapes = [(height, width, channels)[: 3 if channels else 2] for width, height in sizes]
    if len(set(shapes)) == 1:
        return np.full((len(shapes), *shapes[0]), fill, dtype=np.uint8)
    return [np.full(shape, fill, dtype=np.uint8) for shape in shapes]


def _packed(arrays: _Arrays) -> PackedImages | MixedImages:
    if isinstance(arrays, np.ndarray):
        return PackedImages(torch.from_numpy(arrays))
    return MixedImages(tuple(map(torch.from_numpy, arrays)))


def _as_masks(arrays: _Arrays | None) -> Masks | None:
    if arrays is None or isinstance(arrays, np.ndarray):
        return None if arrays is None else torch.from_numpy(arrays.view(np.bool_))
    return MixedImages(tuple(torch.from_numpy(array.view(np.bool_)) for array in arrays))


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
    """The least downscale with which all images have at most so many pixels along their longer side.

    Args:
        photo_set: What a reader found.
        longest_side: Pixels, >= 1.

    Raises:
        CaptureError: An image cannot be read.
    """
    # Smaller copies may be all there is, and only serve multiples of their factor.
    for downscale in range(1, _SMALLEST_COPY + 1):
        found = [place for view in photo_set.views if (place := view.file(downscale)) is not None]
        if found:
            most = max(factor * max(image_header(file).size) for file, factor in found)
            return downscale * max(1, -(-most // (longest_side * downscale)))
    return 1


def _plan(view: View, downscale: int, keep_lens: bool) -> _Plan:
    found = view.file(downscale)
    if found is None:
        raise CaptureError(f"The image {view.label} is missing; get the capture anew.")
    file, factor = found
    header = image_header(file)
    size = header.size
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
    # Masks may be of the photographs, or shrunk as their smaller copies are.
    masks = (downscale, shrink)
    if keep_lens:
        return _Plan(view, shrink, masks, lens, lens, known_pixels(lens, view.label), file, header)
    return _Plan(view, shrink, masks, lens, pinhole_of(lens, view.label), None, file, header)


def _load(plan: _Plan) -> tuple[np.ndarray, np.ndarray | None]:
    """(H, W, 3 or 4) uint8 values of a view, and its (H, W) mask, if it has one."""
    image = read_image(plan.file, plan.shrink)
    mask = None if plan.view.mask is None else _load_mask(plan, plan.view.mask)
    if plan.lens != plan.seen:
        image = undistorted(image, plan.lens, plan.seen)
        mask = None if mask is None else undistorted_mask(mask, plan.lens, plan.seen)
    if plan.known is not None:
        mask = plan.known if mask is None else mask & plan.known
    return (image * 255.0).round_().to(torch.uint8).numpy(), None if mask is None else mask.numpy()


def _load_mask(plan: _Plan, path: Path) -> torch.Tensor:
    for shrink in plan.mask_shrinks:
        mask = read_mask(path, (plan.lens.width, plan.lens.height), shrink)
        if mask is not None:
            return mask
    raise CaptureError(f"The mask '{path}' has another size than its image {plan.view.label}; make them equal.")


def _warn_of_16_bits(plans: Sequence[_Plan], photo_set: PhotoSet) -> None:
    deep = [plan.view.label for plan in plans if plan.header.has_16_bits]
    if deep:
        warnings.warn(
            f"{len(deep)} of the images of '{photo_set.name}', such as {deep[0]}, have 16 bits a channel; 8 are kept.",
            CaptureWarning,
            stacklevel=3,
        )


def _warn_of_unknown(plans: Sequence[_Plan], photo_set: PhotoSet) -> None:
    partly = [plan.view.label for plan in plans if plan.known is not None]
    if partly:
        warnings.warn(
            f"{len(partly)} of the images of '{photo_set.name}', such as {partly[0]}, have pixels that their lens "
            "cannot have made, by its parameters; these are masked.",
            CaptureWarning,
            stacklevel=3,
        )


def _sizes(intrinsics: Sequence[Intrinsics], photo_set: PhotoSet) -> list[tuple[int, int]]:
    """Width and height of each view: one that all are cropped to where they nearly agree, else those that they have."""
    sizes = [(lens.width, lens.height) for lens in intrinsics]
    common = (min(width for width, _ in sizes), min(height for _, height in sizes))
    most = (max(width for width, _ in sizes), max(height for _, height in sizes))
    if any(high - low > max(_CROPPED_PIXELS, _CROPPED_SHARE * high) for low, high in zip(common, most, strict=True)):
        return sizes
    cropped = sum(size != common for size in sizes)
    if cropped:
        warnings.warn(
            f"The images of '{photo_set.name}' differ in size by a few pixels; {cropped} are cropped at the right and "
            f"bottom to {common[0]} x {common[1]}.",
            CaptureWarning,
            stacklevel=3,
        )
    return [common] * len(sizes)


def _camera(plan: _Plan, size: tuple[int, int]) -> Camera:
    cropped = replace(plan.seen, width=size[0], height=size[1])
    return make_camera(cropped, torch.from_numpy(plan.view.world_to_camera).float(), plan.view.label)
