"""Rays of all training views with what is seen along them, in tiles of neighbouring pixels."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from difftetvr.capture import Capture

TILE = (2, 4)
"""Rows and columns of a tile: neighbours read the same cells, and eight lanes are a packet with AVX2."""


@dataclass(frozen=True)
class TrainingRays:
    """Rays, tile after tile.

    Attributes:
        origin: (views, 4) position of each camera, and nothing.
        direction: (N, 4) unit direction, and number of the camera.
        truth: (N, 4) colour over black, and alpha.
    """

    origin: torch.Tensor
    direction: torch.Tensor
    truth: torch.Tensor

    @staticmethod
    def of(capture: Capture) -> TrainingRays:
        """Those of a capture's training views; 1 for alpha where it is unknown.

        A pixel more stands at the edges of images that whole tiles do not fill.
        """
        origins, directions, truths = [], [], []
        for number, view in enumerate(capture.train_indices.tolist()):
            rays, image = capture.cameras[view].rays(), capture.images[view]
            alpha = torch.ones(image.shape[:2]) if capture.alphas is None else capture.alphas[view]
            tiles = _tiles(*image.shape[:2])
            origins.append(rays.origins.reshape(-1, 3)[0])
            camera = torch.full((len(tiles), 1), float(number))
            directions.append(torch.cat((rays.directions.reshape(-1, 3)[tiles].float(), camera), dim=1))
            truths.append(torch.cat((image.reshape(-1, 3), alpha.reshape(-1, 1)), dim=1)[tiles])
        origin = torch.nn.functional.pad(torch.stack(origins).float(), (0, 1))
        return TrainingRays(origin, torch.cat(directions), torch.cat(truths))


def _tiles(height: int, width: int) -> torch.Tensor:
    """Numbers of an image's pixels, tile after tile."""
    rows, columns = (torch.arange(-(-n // t) * t).clamp_max(n - 1) for n, t in zip((height, width), TILE))
    pixels = rows[:, None] * width + columns
    return pixels.reshape(-1, TILE[0], pixels.shape[1] // TILE[1], TILE[1]).transpose(1, 2).reshape(-1)
