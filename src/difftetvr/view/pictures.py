"""Pictures: PNG files of linear images, and truth beside reconstruction."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont

from difftetvr.errors import CaptureError
from difftetvr.files import atomic_write
from difftetvr.fitting.metrics import psnr

_DIFFERENCE_GAIN = 4
_LEAST_PANEL = 256
_LABEL_HEIGHT = 26
_FONT_SIZE = 15
_GAP = 4


def save_png(path: str | Path, image: torch.Tensor) -> None:
    """Writes an image as an 8-bit PNG, whole or not at all.

    Values are clipped to [0, 1] and rounded to the nearest of 256 levels as they are, without a gamma curve.

    Args:
        path: File to write.
        image: (H, W, 3) or (H, W) image.

    Raises:
        CaptureError: The file cannot be written, or its name does not end in .png.
    """
    save_picture(path, to_picture(image))


def comparison(
    truth: torch.Tensor, reconstruction: torch.Tensor, name: str = "truth", share: float = 1.0
) -> Image.Image:
    """Truth | reconstruction | difference side by side, labelled with the PSNR.

    The difference is absolute, per channel and four times as bright. Small images are enlarged by repeating pixels.

    Args:
        truth: (H, W, 3) true image.
        reconstruction: (H, W, 3) rendered image.
        name: Label of the first panel.
        share: Part of the pixels that count for the PSNR; both images are the same in the others.
    """
    difference = _DIFFERENCE_GAIN * (reconstruction - truth).abs()
    panels = [
        (name, truth),
        (f"reconstruction, {psnr(reconstruction, truth, share):.2f} dB", reconstruction),
        (f"difference x {_DIFFERENCE_GAIN}", difference),
    ]
    return beside([labelled(to_picture(image), label) for label, image in panels])


def save_comparisons(path: str | Path, rows: list[tuple[str, torch.Tensor, torch.Tensor, float]]) -> None:
    """Writes a PNG with one `comparison` below the other.

    Args:
        path: File to write.
        rows: Name, (H, W, 3) truth, (H, W, 3) reconstruction and share of valid pixels of each view; at least one.

    Raises:
        CaptureError: The file cannot be written, or its name does not end in .png.
    """
    pictures = [comparison(truth, reconstruction, name, share) for name, truth, reconstruction, share in rows]
    save_picture(path, below(pictures))


def _to_bytes(image: torch.Tensor) -> np.ndarray:
    return (image.detach().cpu().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()


def to_picture(image: torch.Tensor) -> Image.Image:
    """The picture that :func:`save_png` writes."""
    return Image.fromarray(_to_bytes(image))


def labelled(picture: Image.Image, label: str) -> Image.Image:
    """A panel of a sheet: a picture under its label; small pictures are enlarged by repeating pixels."""
    enlargement = max(1, -(-_LEAST_PANEL // min(picture.size)))
    size = (picture.width * enlargement, picture.height * enlargement)
    panel = Image.new("RGB", (size[0], size[1] + _LABEL_HEIGHT), "white")
    panel.paste(picture.resize(size, Image.Resampling.NEAREST), (0, _LABEL_HEIGHT))
    font = ImageFont.load_default(size=_FONT_SIZE)
    ImageDraw.Draw(panel).text((6, 4), label, fill="black", font=font)
    return panel


def beside(panels: list[Image.Image]) -> Image.Image:
    """Pictures in a row."""
    width = sum(p.width for p in panels) + _GAP * (len(panels) - 1)
    row = Image.new("RGB", (width, max(p.height for p in panels)), "white")
    left = 0
    for panel in panels:
        row.paste(panel, (left, 0))
        left += panel.width + _GAP
    return row


def below(rows: list[Image.Image]) -> Image.Image:
    """Pictures one below the other."""
    height = sum(p.height for p in rows) + _GAP * (len(rows) - 1)
    sheet = Image.new("RGB", (max(p.width for p in rows), height), "white")
    top = 0
    for row in rows:
        sheet.paste(row, (0, top))
        top += row.height + _GAP
    return sheet


def require_png(path: Path) -> None:
    """Checks the name of a picture, before the time to make it is spent.

    Raises:
        CaptureError: It does not end in .png.
    """
    if path.suffix.lower() != ".png":
        raise CaptureError(f"Pictures are written as PNG, but {path} does not end in .png; rename it.")


def save_picture(path: str | Path, picture: Image.Image) -> None:
    """Writes a picture as PNG, whole or not at all.

    Args:
        path: File to write.
        picture: What to write.

    Raises:
        CaptureError: The file cannot be written, or its name does not end in .png.
    """
    path = Path(path)
    require_png(path)
    with atomic_write(path, CaptureError) as temporary:
        picture.save(temporary, format="PNG")
