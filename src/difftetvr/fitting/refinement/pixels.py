"""Pixels of several views on which a refinement is judged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
import torch

from difftetvr.capture.capture import Capture
from difftetvr.fitting.records.evaluation import Color, true_image
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import Rays, render
from difftetvr.rendering.gauss_newton import ImageModel, model_image
from difftetvr.rendering.rays import image_order

_CROSSINGS = 40.0
"""How often a cell is crossed, on average, by the rays of all pixels: enough for what is predicted of each of its edges
and faces. A ray crosses about as many cells as the mesh has along one of its sides."""
_LEAST_SHARE = 1e-6  # of the pixels: where all are masked there is no error


@dataclass(frozen=True)
class JudgedPixels:
    """Pixels of views, as one image of a single row.

    Attributes:
        rays: (1, N) their rays.
        truth: (1, N, 3) what they should be.
        valid: (1, N) bool, those that count; None: all.
        background: Linear RGB behind the volume.
    """

    rays: Rays
    truth: torch.Tensor
    valid: torch.Tensor | None
    background: Color

    @property
    def _share(self) -> float:
        """Share of the pixels that count, by which means over all pixels are divided; never 0."""
        return 1.0 if self.valid is None else max(float(self.valid.float().mean()), _LEAST_SHARE)

    def model(self, mesh: TetMesh, field: Field, deterministic: bool) -> ImageModel:
        """Quadratic models of the squared error."""
        return model_image(
            mesh, field, self.rays, self.truth, self.background, deterministic=deterministic, valid=self.valid
        )

    @torch.no_grad()
    def error(self, mesh: TetMesh, field: Field) -> float:
        """Mean squared error."""
        image = render(mesh, field, self.rays, background=torch.tensor(self.background, device=mesh.vertices.device))
        squares = (image.color - self.truth.to(image.color)).square()
        if self.valid is not None:
            squares = squares * self.valid.to(squares.device)[..., None]
        return float(squares.mean()) / self._share


@dataclass(frozen=True)
class Judgement:
    """What refinements are judged on: views' pixels in one bundle, or a bundle for each where colours depend on it."""

    parts: list[JudgedPixels]

    @staticmethod
    def of(
        capture: Capture, views: Sequence[int], mesh: TetMesh, background: Color, generator: np.random.Generator
    ) -> Judgement:
        """Choose pixels: evenly spread, and as many as predictions about the cells of a mesh need.

        Args:
            capture: Cameras and images.
            views: The views.
            mesh: The mesh that is to be refined.
            background: Linear RGB behind the volume.
            generator: Makes the choice.
        """
        wanted = max(1, round(_CROSSINGS * mesh.num_cells ** (2 / 3) / len(views)))
        return Judgement([_pixels_of(capture, view, wanted, background, generator) for view in views])

    def together(self) -> Judgement:
        """All pixels in one bundle."""
        rays, valid = [part.rays for part in self.parts], [part.valid for part in self.parts]
        joined = Rays(torch.cat([r.origins for r in rays], 1), torch.cat([r.directions for r in rays], 1))
        masks = None if valid[0] is None else torch.cat([mask for mask in valid if mask is not None], 1)
        truth = torch.cat([part.truth for part in self.parts], 1)
        return Judgement([JudgedPixels(joined, truth, masks, self.parts[0].background)])

    def model(self, mesh: TetMesh, field: Field, deterministic: bool) -> ImageModel:
        """Mean over the parts of their quadratic models."""
        models = (part.model(mesh, field, deterministic) for part in self.parts)
        return reduce(add, models).scaled(1.0 / len(self.parts))

    def error(self, mesh: TetMesh, field: Field) -> float:
        """Mean over the parts of their mean squared errors."""
        return sum(part.error(mesh, field) for part in self.parts) / len(self.parts)


def _pixels_of(
    capture: Capture, view: int, wanted: int, background: Color, generator: np.random.Generator
) -> JudgedPixels:
    truth = true_image(capture, view, background)
    rays, count = capture.cameras[view].rays(), truth.shape[0] * truth.shape[1]
    # Along a curve through the image, steps of equal length spread over all of it.
    curve = image_order(tuple(truth.shape[:2]))
    number = min(wanted, count)
    places = ((np.arange(number) + generator.random()) * (count / number)).astype(np.int64)
    chosen = torch.from_numpy(places if curve is None else curve[places].astype(np.int64))
    origins, directions = (part.expand(*truth.shape).reshape(-1, 3)[chosen] for part in (rays.origins, rays.directions))
    valid = None if capture.valid is None else capture.valid[view].reshape(-1)[chosen][None]
    return JudgedPixels(Rays(origins[None], directions[None]), truth.reshape(-1, 3)[chosen][None], valid, background)
