"""Pixels of several views on which a refinement is judged."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add

import numpy as np
import torch

from difftetvr.capture.truth import Color, Truth, counted_share
from difftetvr.fitting.processes import ALONE, Processes
from difftetvr.mesh.field import Field
from difftetvr.mesh.tetmesh import TetMesh
from difftetvr.rendering import Camera, Rays, ScalarField, render
from difftetvr.rendering.gauss_newton import HatChoice, ImageModel, model_image
from difftetvr.rendering.rays import image_order

_CROSSINGS = 400.0
"""How often a cell is crossed, on average, by the rays of all pixels; a ray crosses about as many cells as the mesh has
along one of its sides. On the Tooth at 20 k cells 40 cost 2 dB, 160 cost 0.3 dB of what 270 give: all pixels there."""

_LOOKED_AT = 8
"""Pixels for each that a look at the error takes."""


@dataclass(frozen=True)
class JudgedPixels:
    """All pixels of a view, or pixels of some views as one image of a single row.

    Attributes:
        rays: The view's camera, whose entries are found sooner than those of its rays; or (1, N) rays.
        truth: (H, W, 3) what the pixels should be, with H 1 for rays.
        valid: (H, W) bool, those that count; None: all.
        background: Linear RGB behind the volume.
        views: Views that they are of.
        make_rays: Makes the rays of some of the camera's pixels where the truth is.
    """

    rays: Camera | Rays
    truth: torch.Tensor
    valid: torch.Tensor | None
    background: Color
    views: int = 1
    make_rays: Callable[[torch.Tensor], Rays] | None = None

    @staticmethod
    def of(truth: Truth, view: int, background: Color) -> JudgedPixels:
        """All pixels of a view."""
        shown = truth.image(view, background), truth.valid(view), background
        return JudgedPixels(truth.camera(view), *shown, make_rays=partial(truth.rays, view))

    @property
    def count(self) -> int:
        """Number of the pixels."""
        return self.truth.shape[0] * self.truth.shape[1]

    @property
    def in_a_row(self) -> JudgedPixels:
        """The same as rays, in an order in which neighbours see neighbouring cells."""
        return self if self.make_rays is None else self._at(torch.arange(self.count, device=self.truth.device))

    def spread(self, count: int, begin: float) -> JudgedPixels:
        """About as many as are asked for, in equal steps along their order; ``begin`` is in parts of a step."""
        if count >= self.count:
            return self
        steps = torch.arange(count, dtype=torch.float64, device=self.truth.device)
        return self._at(((steps + begin) * (self.count / count)).long())

    def _at(self, places: torch.Tensor) -> JudgedPixels:
        """Those at some places of their order, as a single row."""
        if self.make_rays is not None:
            order = image_order(tuple(self.truth.shape[:2]), self.truth.device)
            places = places if order is None else order[places].long()
            rays = self.make_rays(places)
        else:
            assert isinstance(self.rays, Rays)
            rays = self.rays.some(places)
        truth = self.truth.reshape(1, -1, 3)[:, places]
        valid = None if self.valid is None else self.valid.reshape(1, -1)[:, places]
        return replace(self, rays=_in_a_row(rays), truth=truth, valid=valid, make_rays=None)

    def model(
        self, mesh: TetMesh, field: Field | ScalarField, deterministic: bool, hats: HatChoice | None = None
    ) -> ImageModel:
        """Quadratic models of the squared error; what says how great it is counts the valid pixels alone."""
        model = model_image(
            mesh,
            field,
            self.rays,
            self.truth,
            self.background,
            deterministic=deterministic,
            valid=self.valid,
            hats=hats,
        )
        return replace(model, error=model.error / counted_share(self.valid))

    @torch.no_grad()
    def error(self, mesh: TetMesh, field: Field | ScalarField) -> float:
        """Mean squared error."""
        image = render(mesh, field, self.rays, background=torch.tensor(self.background))
        squares = (image.color - self.truth.to(image.color)).square()
        if self.valid is not None:
            squares = squares * self.valid.to(squares.device)[..., None]
        return float(squares.mean()) / counted_share(self.valid)


@dataclass(frozen=True)
class Judgement:
    """What refinements are judged on: pixels of some views, in one bundle or one for each view.

    Attributes:
        shares: Bundles that this process renders, in the shares that work is dealt out in.
        views: Number of the views of all processes.
        processes: These.
    """

    shares: list[list[JudgedPixels]]
    views: int
    processes: Processes = ALONE

    @staticmethod
    def of(
        truth: Truth,
        views: Sequence[int],
        mesh: TetMesh,
        background: Color,
        generator: np.random.Generator,
        limit: float = math.inf,
        shares: int = 1,
        processes: Processes = ALONE,
    ) -> Judgement:
        """Choose pixels: evenly spread, and as many as predictions about the cells of a mesh need.

        Args:
            truth: Cameras and images.
            views: The views.
            mesh: The mesh that is to be refined.
            background: Linear RGB behind the volume.
            generator: Makes the choice.
            limit: Most pixels of all these views together, in units of a view's.
            shares: To how many shares the views are dealt out; each is summed up by itself.
            processes: Those that take the shares.
        """
        cameras = [truth.capture.cameras[view] for view in views]
        sizes = [camera.width * camera.height for camera in cameras]
        most = min(_CROSSINGS * mesh.num_cells ** (2 / 3), limit * sum(sizes) / len(sizes))
        wanted = max(1, round(most / len(views)))
        chosen = [(view, generator.random()) for view in views]
        own = [
            [JudgedPixels.of(truth, view, background).spread(wanted, begin) for view, begin in share]
            for share in processes.shares(chosen, shares)
        ]
        return Judgement(own, len(views), processes)

    @property
    def parts(self) -> list[JudgedPixels]:
        """All bundles that this process renders."""
        return [part for share in self.shares for part in share]

    def together(self) -> Judgement:
        """The same with all views of a share in one bundle of rays."""
        return replace(self, shares=[[_joined(share)] for share in self.shares])

    def some(self) -> Judgement:
        """An eighth of the pixels, of bundles or of all views: enough to see what became of the error."""
        few = [
            share[::_LOOKED_AT] if len(share) > 1 else [p.spread(max(1, p.count // _LOOKED_AT), 0.5) for p in share]
            for share in self.shares
        ]
        views = self.processes.sum(float(sum(part.views for share in few for part in share)))
        return replace(self, shares=few, views=round(views))

    def model(
        self, mesh: TetMesh, field: Field | ScalarField, deterministic: bool, hats: HatChoice | None = None
    ) -> ImageModel:
        """Quadratic models of the squared error, means over the views; see `model_image` for the hats."""
        sums = []
        for share in self.shares:
            models = (part.model(mesh, field, deterministic, hats) for part in share)
            sums.append(reduce(add, models).scaled(self._weight(share[0])))  # all of a share have as many views
        # A process may have nothing to do, and still takes part in the sum.
        has_steps = hats is not None and hats.face_steps is not None
        return self.processes.sum(reduce(add, sums) if sums else ImageModel.zero(mesh, has_steps))

    def error(self, mesh: TetMesh, field: Field | ScalarField) -> float:
        """Mean squared error."""
        shares = (sum(self._weight(part) * part.error(mesh, field) for part in share) for share in self.shares)
        return self.processes.sum(float(sum(shares)))

    def _weight(self, part: JudgedPixels) -> float:
        """Of a bundle in the mean over all views."""
        return part.views / self.views


def _joined(parts: list[JudgedPixels]) -> JudgedPixels:
    parts = [part.in_a_row for part in parts]
    masks = [part.valid for part in parts if part.valid is not None]
    rays = _in_a_row(Rays.joined([part.rays for part in parts if isinstance(part.rays, Rays)]))
    truth, valid = torch.cat([part.truth for part in parts], 1), torch.cat(masks, 1) if masks else None
    return JudgedPixels(rays, truth, valid, parts[0].background, sum(part.views for part in parts))


def _in_a_row(rays: Rays) -> Rays:
    """(N,) rays as an image of one row."""
    near, far = (end[None] if isinstance(end, torch.Tensor) else end for end in (rays.near, rays.far))
    return Rays(rays.origins[None], rays.directions[None], near, far)
