"""From what a camera saw to a picture on paper: over a background or none, with axes and a colour bar."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image

from difftetvr.rendering.cameras.pinhole import Camera
from difftetvr.view.frames.axes import AxesBox, ProjectedBox
from difftetvr.view.frames.color_bar import ColorScale, draw_color_bar
from difftetvr.view.frames.lettering import Ink, Layer
from difftetvr.view.pictures import to_picture


@dataclass(frozen=True, eq=False)
class FrameStyle:
    """What is around a volume.

    Attributes:
        background: R G B behind it, as the picture's colours are; None: nothing, the picture is transparent there.
        scale: Colours to draw a bar of, if any.
        box: Axes to draw, if any.
    """

    background: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    scale: ColorScale | None = None
    box: AxesBox | None = None


def framed(color: torch.Tensor, alpha: torch.Tensor, camera: Camera, style: FrameStyle) -> Image.Image:
    """A picture of what a camera saw.

    The axes' box lies behind the volume, numbers and colour bar before it. A box that is not wholly in front of the
    camera is left out.

    Args:
        color: (H, W, 3) premultiplied over black.
        alpha: (H, W) opacity.
        camera: What it was seen by.
        style: What is around it.

    Returns:
        An RGB picture; RGBA where there is no background.
    """
    color, alpha = color.detach().cpu(), alpha.detach().cpu()
    ink = Ink.on(style.background)
    box = None if style.box is None else ProjectedBox(style.box, camera)
    box = box if box is not None and box.is_in_front else None
    behind = None
    if box is not None:
        layer = Layer(camera.width, camera.height, ink)
        box.draw_behind(layer)
        behind = layer.drawn()
    picture = _over_nothing(color, alpha, behind) if style.background is None else None
    if picture is None:
        picture = to_picture(color + (1.0 - alpha[..., None]) * _base(style.background, camera, behind).to(color))
    if box is None and style.scale is None:
        return picture
    layer = Layer(camera.width, camera.height, ink)
    if style.scale is not None:
        draw_color_bar(layer, style.scale)
    if box is not None:
        box.draw_numbers(layer)
    whole = Image.alpha_composite(picture.convert("RGBA"), layer.drawn())
    return whole if style.background is None else whole.convert("RGB")


def _base(background: tuple[float, float, float] | None, camera: Camera, behind: Image.Image | None) -> torch.Tensor:
    """(H, W, 3) or (3,) what lies behind the volume."""
    base = torch.tensor(background, dtype=torch.float32)
    if behind is None:
        return base
    drawn = torch.from_numpy(np.array(behind)).float() / 255.0
    return torch.lerp(base.expand(camera.height, camera.width, 3), drawn[..., :3], drawn[..., 3:])


def _over_nothing(color: torch.Tensor, alpha: torch.Tensor, behind: Image.Image | None) -> Image.Image:
    """An RGBA picture, of straight alpha as PNG has it."""
    straight = color / alpha.clamp(min=torch.finfo(torch.float32).tiny)[..., None]
    values = torch.cat([straight.clamp(0.0, 1.0), alpha[..., None].to(straight)], 2)
    picture = to_picture(values)
    return picture if behind is None else Image.alpha_composite(behind, picture)
