"""Photographs from files: decoded no larger than needed."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError

from difftetvr.errors import CaptureError

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
# Scales that a JPEG can be decoded at without decoding all of it.
_JPEG_SCALES = (8, 4, 2)


def image_size(path: Path) -> tuple[int, int]:
    """Width and height in pixels, from the file's header.

    Raises:
        CaptureError: It cannot be read as an image.
    """
    with _opened(path) as image:
        return image.size


def read_image(path: Path, shrink: int = 1) -> torch.Tensor:
    """An image with its values as they are stored (sRGB-encoded in photographs), averaged over blocks.

    Orientation tags are ignored, as by COLMAP: cameras describe the stored pixels.

    Args:
        path: File of 8 bits a channel; grey values and palettes become RGB.
        shrink: Pixels along x and y that are averaged to one; incomplete blocks at the right and bottom are lost.
            JPEG files are decoded at a reduced scale right away, which is several times faster.

    Returns:
        (H, W, 3) float32 in [0, 1]; where the file has alpha (H, W, 4), premultiplied.

    Raises:
        CaptureError: It cannot be read as an image, or has more than 8 bits a channel.
    """
    with _opened(path) as image:
        width, height = image.width // shrink, image.height // shrink
        if min(width, height) < 1:
            raise CaptureError(f"'{path}' has {image.width} x {image.height} pixels, too few to shrink by {shrink}.")
        remaining = shrink
        if image.format in ("JPEG", "MPO"):
            remaining = _decode_at_scale(image, shrink)
        if image.mode[0] in "IF":
            raise CaptureError(f"'{path}' has more than 8 bits a channel; save it with 8 bits.")
        has_alpha = image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info
        values = np.asarray(image.convert("RGBA" if has_alpha else "RGB"), dtype=np.float32) / 255.0
    if has_alpha:
        values[..., :3] *= values[..., 3:]
    return torch.from_numpy(_block_means(values, width, height, remaining))


def read_mask(path: Path, shrink: int = 1) -> torch.Tensor:
    """(H, W) bool mask, true where a file is not black; after shrinking, where all pixels of the block are not.

    Raises:
        CaptureError: It cannot be read as an image.
    """
    with _opened(path) as image:
        values = np.asarray(image.convert("L")) > 0
    height, width = values.shape[0] // shrink, values.shape[1] // shrink
    return torch.from_numpy(_block_means(values.astype(np.float32)[..., None], width, height, shrink)[..., 0] == 1.0)


def _decode_at_scale(image: Image.Image, shrink: int) -> int:
    """Asks the decoder for the coarsest scale that divides ``shrink``; returns what is left to shrink."""
    full = image.width
    for scale in _JPEG_SCALES:
        if shrink % scale == 0:
            image.draft(None, (image.width // scale, image.height // scale))
            break
    return shrink // round(full / image.width)


def _block_means(values: np.ndarray, width: int, height: int, factor: int) -> np.ndarray:
    """(height, width, C) means over blocks of (H, W, C) values."""
    if factor == 1:
        return np.ascontiguousarray(values[:height, :width])
    blocks = values[: height * factor, : width * factor].reshape(height, factor, width, factor, -1)
    return blocks.mean(axis=(1, 3), dtype=np.float32)


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    try:
        with Image.open(path) as image:
            yield image
    except UnidentifiedImageError:
        raise CaptureError(f"'{path}' is no image that can be read; save it as PNG or JPEG.") from None
    except Image.DecompressionBombError:
        raise CaptureError(f"'{path}' has too many pixels; make it smaller.") from None
    except OSError as error:
        reason = (error.strerror or str(error)).rstrip(".")
        raise CaptureError(f"Cannot read the image '{path}': {reason}; get the file anew.") from None
    except (ValueError, SyntaxError, EOFError, IndexError, KeyError, TypeError, struct.error, zlib.error):
        raise CaptureError(f"The image '{path}' is damaged; get the file anew.") from None
