"""Photographs from files: decoded no larger than needed, and only as what they are meant to be."""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageFile, UnidentifiedImageError
from PIL.BmpImagePlugin import BmpImageFile
from PIL.JpegImagePlugin import JpegImageFile
from PIL.PngImagePlugin import PngImageFile
from PIL.TiffImagePlugin import BITSPERSAMPLE, SAMPLEFORMAT, ImageFileDirectory_v2, TiffImageFile
from PIL.WebPImagePlugin import WebPImageFile

from difftetvr.errors import CaptureError
from difftetvr.trust import require_modest, require_regular

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
# Of those that Pillow knows, others are nobody's photographs, and PostScript is for another program to run.
_FORMATS = tuple(str(kind.format) for kind in (PngImageFile, JpegImageFile, WebPImageFile, TiffImageFile, BmpImageFile))
_LONGEST_SIGNATURE = 16
# Scales that a JPEG can be decoded at without decoding all of it.
_JPEG_SCALES = (8, 4, 2)
_JPEG_FORMATS = ("JPEG", "MPO")
# What decoders need, in bytes a pixel: Pillow keeps images in 4, the others' own copies come on top.
_BYTES, _BYTES_OF_DECODERS = 4, {"WEBP": 16, "TIFF": 12}
_BYTES_OF_COEFFICIENTS = 6  # which progressive JPEG files need in full, however small they are decoded
_BAND_PIXELS = 2**22
_MOST_16_BITS = 65535.0
# What Pillow says of intact files that it does not know how to read.
_UNSUPPORTED = re.compile("unknown (pixel mode|data organization)|cannot handle|[Uu]nsupported|not available")
_SAMPLE_FORMATS = {1: "integers", 2: "signed integers", 3: "floats"}


@dataclass(frozen=True)
class ImageHeader:
    """What the beginning of an image's file says.

    Attributes:
        width: Pixels of a row.
        height: Pixels of a column.
        format: Pillow's name of the kind of file.
        has_16_bits: Whether a channel has more than the 8 bits that are kept.
        is_progressive: Whether a JPEG file comes whole, but coarse first.
    """

    width: int
    height: int
    format: str
    has_16_bits: bool
    is_progressive: bool

    @staticmethod
    def of(image: Image.Image) -> ImageHeader:
        """The header of an image that is not decoded yet."""
        is_progressive = bool(image.info.get("progressive"))
        return ImageHeader(image.width, image.height, image.format or "", _has_16_bits(image), is_progressive)

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self.width, self.height

    def decoding_bytes(self, shrink: int = 1) -> int:
        """Memory that :func:`read_image` takes for an image before it is shrunk."""
        pixels = self.width * self.height
        needed = _BYTES_OF_DECODERS.get(self.format, _BYTES) * pixels
        if self.format in _JPEG_FORMATS:
            needed //= max((scale for scale in _JPEG_SCALES if shrink % scale == 0), default=1) ** 2
            needed += _BYTES_OF_COEFFICIENTS * pixels if self.is_progressive else 0
        return needed


def image_header(path: Path) -> ImageHeader:
    """Size and depth of an image, which is not decoded.

    Raises:
        CaptureError: It cannot be read as an image.
    """
    with _opened(path) as image:
        return ImageHeader.of(image)


def read_image(path: Path, shrink: int = 1) -> torch.Tensor:
    """An image with its values as they are stored (sRGB-encoded in photographs), averaged over blocks.

    Orientation tags are ignored, as by COLMAP: cameras describe the stored pixels.

    Args:
        path: PNG, JPEG, WebP, TIFF or BMP file of 8 or 16 bits a channel; grey values and palettes become RGB. Of the
            16 bits of a colour the upper 8 are used.
        shrink: Pixels along x and y that are averaged to one; incomplete blocks at the right and bottom are lost.
            JPEG files are decoded at a reduced scale right away, which is several times faster.

    Returns:
        (H, W, 3) float32 in [0, 1]; where the file has alpha (H, W, 4), premultiplied.

    Raises:
        CaptureError: It cannot be read as an image, has other depths, or takes more memory than allowed.
    """
    with _opened(path) as image:
        width, height = image.width // shrink, image.height // shrink
        if min(width, height) < 1:
            raise CaptureError(f"'{path}' has {image.width} x {image.height} pixels, too few to shrink by {shrink}.")
        header = ImageHeader.of(image)
        require_modest(path, header.decoding_bytes(shrink), "an image", CaptureError)
        remaining = shrink
        if image.format in _JPEG_FORMATS:
            remaining = _decode_at_scale(image, shrink)
        has_alpha = image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info
        is_deep = image.mode[0] in "IF"
        if is_deep and (has_alpha or not header.has_16_bits):
            raise CaptureError(f"'{path}' has neither 8 nor plain 16 bits a channel; save it with 8 bits.")
        convert = _deep_grey if is_deep else _with_alpha if has_alpha else _without_alpha
        return torch.from_numpy(_block_means(image, convert, width, height, remaining))


def read_mask(path: Path, size: tuple[int, int], shrink: int = 1) -> torch.Tensor | None:
    """(H, W) bool mask, true where a file is neither black nor transparent; after shrinking, where no pixel of the
    block is.

    Of a file whose visible pixels are all black, alpha alone is the mask.

    Args:
        path: File of any of the kinds that :func:`read_image` knows.
        size: Width and height that the mask must have after shrinking.
        shrink: Pixels along x and y that become one.

    Returns:
        The mask; None where the file has another size.

    Raises:
        CaptureError: It cannot be read as an image, or takes more memory than allowed.
    """
    with _opened(path) as image:
        if (image.width // shrink, image.height // shrink) != size:
            return None
        require_modest(path, ImageHeader.of(image).decoding_bytes(), "an image", CaptureError)
        lit, opaque = np.moveaxis(_block_means(image, _lit_and_opaque, *size, shrink) == 1.0, 2, 0)
    shown = lit & opaque
    return torch.from_numpy(opaque.copy() if not shown.any() and not opaque.all() else shown)


def _with_alpha(band: Image.Image) -> np.ndarray:
    values = np.asarray(band.convert("RGBA"), dtype=np.float32) / 255.0
    values[..., :3] *= values[..., 3:]
    return values


def _without_alpha(band: Image.Image) -> np.ndarray:
    return np.asarray(band.convert("RGB"), dtype=np.float32) / 255.0


def _deep_grey(band: Image.Image) -> np.ndarray:
    values = np.asarray(band).astype(np.float32) / _MOST_16_BITS
    return np.broadcast_to(values[..., None], (*values.shape, 3))


def _lit_and_opaque(band: Image.Image) -> np.ndarray:
    """(H, W, 2) float32, 1 where a mask is not black, and where it is not transparent."""
    if band.mode[0] in "IF":
        values = np.asarray(band)
        return np.stack([values != 0, np.ones(values.shape, dtype=np.bool_)], axis=-1).astype(np.float32)
    values = np.asarray(band.convert("RGBA")) > 0
    return np.stack([values[..., :3].any(axis=-1), values[..., 3]], axis=-1).astype(np.float32)


def _has_16_bits(image: Image.Image) -> bool:
    """Whether an image that is not decoded yet has 16 bits a channel."""
    # Pillow tells only its decoders that it takes the upper 8 of 16 bits. ";16" stands for these in its raw modes.
    if not isinstance(image, ImageFile.ImageFile) or not image.tile:
        return False
    arguments: Any = image.tile[0][3]
    raw_mode = arguments if isinstance(arguments, str) else arguments[0] if arguments else ""
    return ";16" in str(raw_mode) and ";16S" not in str(raw_mode)


def _decode_at_scale(image: Image.Image, shrink: int) -> int:
    """Asks the decoder for the coarsest scale that divides ``shrink``; returns what is left to shrink."""
    full = image.width
    for scale in _JPEG_SCALES:
        if shrink % scale == 0:
            image.draft(None, (image.width // scale, image.height // scale))
            break
    return shrink // round(full / image.width)


def _block_means(
    image: Image.Image, convert: Callable[[Image.Image], np.ndarray], width: int, height: int, factor: int
) -> np.ndarray:
    """(height, width, C) means over blocks of an image's (H, W, C) values, which never exist as a whole if large."""
    rows = max(1, _BAND_PIXELS // (image.width * factor))
    bands = []
    for top in range(0, height, rows):
        bottom = min(top + rows, height)
        band = image.crop((0, top * factor, width * factor, bottom * factor))
        values = convert(band)
        if factor > 1:
            blocks = values.reshape(bottom - top, factor, width, factor, -1)
            values = blocks.mean(axis=(1, 3), dtype=np.float32)
        bands.append(values)
    return np.ascontiguousarray(bands[0] if len(bands) == 1 else np.concatenate(bands))


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    require_regular(path, CaptureError)
    try:
        with path.open("rb") as file, _identified(file, path) as image:
            yield image
    except UnidentifiedImageError:
        raise CaptureError(f"'{path}' is no image that can be read; save it as PNG or JPEG.") from None
    except (OSError, SyntaxError) as error:
        if isinstance(error, SyntaxError) or _UNSUPPORTED.search(str(error)):
            raise _unreadable(path, str(error)) from None
        reason = (error.strerror or str(error)).rstrip(".")
        raise CaptureError(f"Cannot read the image '{path}': {reason}; get the file anew.") from None
    except MemoryError:
        raise CaptureError(f"There is not enough memory for the image '{path}'; make it smaller.") from None
    except (ValueError, EOFError, IndexError, KeyError, TypeError, struct.error, zlib.error):
        raise CaptureError(f"The image '{path}' is damaged; get the file anew.") from None


def _unreadable(path: Path, reason: str) -> CaptureError:
    """What to say of a file that Pillow does not open: that of a kind it does not know is not damaged."""
    if not _UNSUPPORTED.search(reason):
        return CaptureError(f"The image '{path}' is damaged; get the file anew.")
    kind = _tiff_samples(path) or f"what cannot be read ({reason[:60].rstrip('.')})"
    return CaptureError(f"'{path}' holds {kind}, neither 8 nor plain 16 bits a channel; save it with 8 bits.")


def _tiff_samples(path: Path) -> str | None:
    """Kind and depth of the channels of a TIFF file in words; None of others."""
    try:
        with path.open("rb") as file:
            directory = ImageFileDirectory_v2(file.read(8))
            file.seek(directory.next)
            directory.load(file)
            bits, (kind, *_) = directory[BITSPERSAMPLE], directory.get(SAMPLEFORMAT, (1,))
            return f"{_SAMPLE_FORMATS.get(kind, 'samples')} of {max(bits)} bits"
    # Whatever is wrong with it has been found before.
    except (OSError, SyntaxError, ValueError, KeyError, TypeError, struct.error):
        return None


def _identified(file: Any, path: Path) -> Image.Image:
    """The image in a file, as `PIL.Image.open` finds it, but for Pillow's limit of pixels: ours is the one of memory.

    Raises:
        UnidentifiedImageError: It has none of the formats that are meant.
    """
    signature = file.read(_LONGEST_SIGNATURE)
    for name in _FORMATS:
        factory, accepts = Image.OPEN[name]
        if accepts is None or accepts(signature) is True:
            file.seek(0)
            return factory(file, str(path))
    raise UnidentifiedImageError(str(path))
