"""What is measured of each pixel, and which colour that has: the modes of the viewer."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image

from difftetvr.capture import Capture
from difftetvr.rendering import Camera
from difftetvr.view.heatmap import Scale, heat_colors
from difftetvr.view.live.scene import Scene
from difftetvr.view.live.settings import Mode, Settings

_LEAST_QUALITY = 1e-3
_LEAST_OPACITY = 1.0 / 255.0  # of pixels whose depth says something
_TAILS = 0.01  # of the depths at either end that do not stretch the scale
_MOST_ERROR = 0.25
_IN_PLACE = 0.01  # of the distance to what is looked at that a camera may be off its place
_MOST_AT_ONCE = 1 << 20  # pixels


@dataclass(frozen=True, eq=False)
class Painted:
    """A picture.

    Attributes:
        pixels: (H, W, 3) uint8.
        scale: Which number has which colour; None where colours are colours.
    """

    pixels: np.ndarray
    scale: Scale | None = None


@dataclass(frozen=True)
class Quantity:
    """Something that is measured of pixels.

    Attributes:
        measure: (H, W, C) float32 of what a camera sees of a scene, whichever part of a window it looks at.
        scale: Scale of the measured numbers of a whole picture; None: they are red, green, blue and opacity.
    """

    measure: Callable[[Scene, Settings, Camera], torch.Tensor]
    scale: Callable[[torch.Tensor], Scale] | None = None


def measured(scene: Scene, settings: Settings, camera: Camera) -> torch.Tensor:
    """(H, W, C) float32 numbers, on the CPU, of which `painted` makes a picture once all rows are there."""
    if scene.content is None:
        return _photograph(scene, camera)
    with torch.no_grad():
        return QUANTITIES[settings.mode].measure(scene, settings, camera).float().cpu()


def painted(values: torch.Tensor, settings: Settings) -> Painted:
    """The picture of a window.

    Args:
        values: (H, W, C) what was measured.
        settings: How it was.
    """
    find_scale = QUANTITIES[settings.mode].scale
    if find_scale is None:
        behind = torch.tensor(settings.background)
        return Painted(_bytes(values[..., :3] + (1.0 - values[..., 3:]) * behind))
    numbers = values[..., 0]
    scale = find_scale(numbers)
    return Painted(_bytes(heat_colors(numbers, scale)), scale)


def picture_of(scene: Scene, settings: Settings, camera: Camera) -> Image.Image:
    """What a camera sees, in full; of large pictures no more rows at a time than memory is sure to hold."""
    rows = max(1, _MOST_AT_ONCE // camera.width)
    bands = [band(camera, first, min(rows, camera.height - first)) for first in range(0, camera.height, rows)]
    values = torch.cat([measured(scene, settings, part) for part in bands])
    return Image.fromarray(painted(values, settings).pixels)


def band(camera: Camera, first: int, count: int) -> Camera:
    """The camera of some rows of another one: its rays are theirs."""
    return dataclasses.replace(camera, cy=camera.cy - first, height=count)


def _bytes(colors: torch.Tensor) -> np.ndarray:
    return (colors.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8).numpy()


def _color(scene: Scene, settings: Settings, camera: Camera) -> torch.Tensor:
    assert scene.content is not None
    image = scene.content.seen_by(camera, settings)
    return torch.cat((image.color, image.alpha[..., None]), -1)


def _opacity(scene: Scene, settings: Settings, camera: Camera) -> torch.Tensor:
    assert scene.content is not None
    return scene.content.seen_by(camera, settings).alpha[..., None]


def _depth(scene: Scene, settings: Settings, camera: Camera) -> torch.Tensor:
    assert scene.content is not None
    image = scene.content.seen_by(camera, settings)
    return torch.where(image.alpha >= _LEAST_OPACITY, image.depth, torch.nan)[..., None]


def _quality(scene: Scene, settings: Settings, camera: Camera) -> torch.Tensor:
    assert scene.content is not None
    return scene.content.met_by(camera, settings).worst_quality[..., None]


def _complexity(scene: Scene, settings: Settings, camera: Camera) -> torch.Tensor:
    assert scene.content is not None
    return scene.content.met_by(camera, settings).depth_complexity[..., None]


def _error(scene: Scene, settings: Settings, camera: Camera) -> torch.Tensor:
    """How far what is seen differs from what the nearest photograph shows there; NaN where it shows nothing.

    Each pixel is looked up where the photograph shows the point at its expected depth: from the photograph's own
    camera its own pixel, from elsewhere the more roughly the farther that is and the less opaque what is seen.
    """
    assert scene.content is not None and scene.views is not None and scene.views.capture is not None
    image, capture = scene.content.seen_by(camera, settings), scene.views.capture
    view = scene.views.nearest_to(camera, scene.focus)
    middle = (scene.focus - camera.position.detach().cpu().double()).norm()
    depth = torch.where(image.alpha >= 0.5, image.depth, middle.to(image.depth)).double().cpu()
    truth, is_known = _seen_in(capture, view, camera, depth)
    seen = image.color.cpu() + (1.0 - image.alpha.cpu()[..., None]) * _behind(capture.alphas, settings)
    return torch.where(is_known, (seen - truth).abs().mean(-1), torch.nan)[..., None]


def _photograph(scene: Scene, camera: Camera) -> torch.Tensor:
    """(H, W, 4) the photograph of which a camera stands in the place, and nothing from anywhere else."""
    nothing = torch.zeros((camera.height, camera.width, 4))
    if scene.views is None or scene.views.capture is None:
        return nothing
    view, place = scene.views.nearest_to(camera, scene.focus), camera.position.detach().cpu().double()
    distance = (scene.focus - place).norm()
    aside = (scene.views.cameras[view].position.detach().cpu().double() - place).norm()
    if aside > _IN_PLACE * distance:
        return nothing
    depth = distance.expand(camera.height, camera.width)
    image, is_known = _seen_in(scene.views.capture, view, camera, depth)
    return torch.cat((image * is_known[..., None], is_known[..., None].float()), -1)


def _seen_in(capture: Capture, view: int, camera: Camera, depth: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(H, W, 3) what a photograph shows of points at (H, W) depths before a camera, and (H, W) whether it does."""
    points = camera.rays().to("cpu", torch.float64).at(depth).detach()
    places, enlarged = capture.cameras[view].project(points.reshape(-1, 3))
    photograph = capture.images[view].float()
    height, width = photograph.shape[:2]
    column, row = places.unbind(-1)
    is_known = (enlarged > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    if capture.valid is not None:
        is_known &= capture.valid[view][row.clamp(0, height - 1).long(), column.clamp(0, width - 1).long()]
    return _looked_up(photograph, column, row).reshape(*depth.shape, 3), is_known.reshape(depth.shape)


def _behind(alphas: object, settings: Settings) -> torch.Tensor:
    """What is behind a photograph: black where it is cut out, as it is kept over black."""
    return torch.zeros(3) if alphas is not None else torch.tensor(settings.background)


def _looked_up(image: torch.Tensor, column: torch.Tensor, row: torch.Tensor) -> torch.Tensor:
    """(N, 3) an (H, W, 3) image at places in pixels, interpolated between their centres."""
    height, width = image.shape[:2]
    place = torch.stack((2.0 * column / width - 1.0, 2.0 * row / height - 1.0), -1).float()
    found = torch.nn.functional.grid_sample(
        image.permute(2, 0, 1)[None], place[None, None], padding_mode="border", align_corners=False
    )
    return found[0, :, 0].T


def _scale_of_depth(values: torch.Tensor) -> Scale:
    known = values[~values.isnan()]
    if not known.numel():
        return Scale("depth", 0.0, 1.0)
    low, high = (float(end) for end in np.quantile(known.numpy(), (_TAILS, 1.0 - _TAILS)))
    return Scale("depth", low, high if high > low else low + max(abs(low), 1.0) * 1e-6)


def _scale_of_complexity(values: torch.Tensor) -> Scale:
    return Scale("cells crossed", 0.0, max(float(values.max()), 1.0))


QUANTITIES: dict[Mode, Quantity] = {
    "color": Quantity(_color),
    "depth": Quantity(_depth, _scale_of_depth),
    "opacity": Quantity(_opacity, lambda values: Scale("opacity", 0.0, 1.0)),
    "cell quality": Quantity(_quality, lambda values: Scale("worst quality Q", _LEAST_QUALITY, 1.0, True)),
    "depth complexity": Quantity(_complexity, _scale_of_complexity),
    "error": Quantity(_error, lambda values: Scale("error", 0.0, _MOST_ERROR)),
}
"""What is measured for each mode."""
