"""How a default camera is turned to what can be seen."""

from __future__ import annotations

import torch

from difftetvr.rendering import Camera

DIRECTION = (0.55, -1.0, 0.55)
"""Where it stands, seen from the middle: in front, to the right, above."""

UP, FOV = (0.0, 0.0, 1.0), 53.13
"""What is upwards in its pictures, and the degrees that it sees."""

FILLED = 0.94
"""Part of the picture that is filled, as far as nothing else has to be there."""

_FAINT = 0.02  # opacity up to which haze is let go beyond the picture
_LOOK = 128  # pixels of the longer side of a picture that tells what can be seen
_MOST = 4.0  # a lens may be as many times as long, for what fills next to nothing


def glance(camera: Camera) -> Camera:
    """The same camera with few pixels."""
    scale = min(1.0, _LOOK / max(camera.width, camera.height))
    return camera.with_size(max(1, round(scale * camera.width)), max(1, round(scale * camera.height)))


def zoomed(camera: Camera, alpha: torch.Tensor, room: tuple[float, float] = (0.0, 0.0)) -> Camera:
    """A camera at the same place with so long a lens that what is seen fills the picture, in its middle.

    Args:
        camera: The camera, which sees all of it.
        alpha: (h, w) opacity of what it sees, of any size in these proportions.
        room: Shares of the picture on its right, and on every side, that are left free.
    """
    seen = alpha.detach().cpu() > _FAINT
    rows, columns = (torch.nonzero(seen.any(axis)).flatten() for axis in (1, 0))
    if not len(rows):
        return camera
    height, width = alpha.shape
    ends = [
        (float(places[0]) / size, float(places[-1] + 1) / size) for places, size in ((columns, width), (rows, height))
    ]
    (left, right), (top, bottom) = ends
    free = FILLED - 2.0 * room[1]
    factor = min((1.0 - room[0]) * free / (right - left), free / (bottom - top), _MOST)
    if factor <= 1.0:
        return camera
    middle = 0.5 * (1.0 - room[0]) * camera.width, 0.5 * camera.height
    cx = middle[0] + factor * (camera.cx - 0.5 * (left + right) * camera.width)
    cy = middle[1] + factor * (camera.cy - 0.5 * (top + bottom) * camera.height)
    return Camera(camera.world_to_camera, factor * camera.fx, factor * camera.fy, cx, cy, camera.width, camera.height)
