"""Derivatives of an image's squared error by hat functions (Dr.Jit kernel).

A pixel responds with B to one unit of a hat's colour and with (D_r, D_g, D_b) to one unit of its density.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.rendering.kernels.hats.kernel import (
    PLACES,
    SAMPLES,
    HatKernel,
    HatRay,
    HatSums,
    Response,
    gathered_records,
)
from difftetvr.rendering.kernels.hats.space import HatRecords, HatSpace
from difftetvr.rendering.kernels.hats.tables import HatTables
from difftetvr.rendering.traversal.crossing import Tracer
from difftetvr.rendering.traversal.rays import Lanes

RECORD = 10
"""Floats a hat: colour gradient (3), density gradient, sums of B^2, B D (3), D^2, and B."""


@dataclass
class HatImage:
    """What the kernel reads, flat.

    Attributes:
        color: (H, W, 3) radiance over the background.
        gradient: (H, W, 3) derivative of the loss with respect to it.
        face_steps: (M, 4) the one step that is looked at of each face that has a record, or (M,) of hats of scalars;
            None for all.
    """

    color: Any
    gradient: Any
    face_steps: Any | None = None


def hat_records(tracer: Tracer, image: HatImage, space: HatSpace, in_order: bool = False) -> HatRecords:
    """Sums over the rays of a view for every vertex, edge and face; of faces those of their steps, if there are any.

    Args:
        tracer: The view, to be walked through; its field lives on vertices.
        image: The rendered image, and the derivative of the loss with respect to it.
        space: What there are hats of, of which `RECORD` floats are known.
        in_order: Whether sums over rays have a certain order, see :mod:`difftetvr.rendering.kernels.shares`.
    """
    return gathered_records(_LightHats, tracer, image, space, in_order)


def pass_piece(
    length: Any, density: Any, color: list[Any], light: tuple[Any, list[Any]]
) -> tuple[Any, list[Any], tuple[Any, list[Any]]]:
    """Pass a piece of constant density and colour.

    Args:
        length, density, color: Of the piece.
        light: Transmittance up to it, and radiance from there on.

    Returns:
        Responses of the radiance to one unit of its colour, and to one of its density; and the light behind it.
    """
    transmittance, rest = light
    seen = transmittance * (1.0 - dr.exp(-density * length))
    transmittance = transmittance - seen
    rest = [dr.fma(-seen, c, r) for c, r in zip(color, rest, strict=True)]
    # More density here shows more of this piece and dims all that lies behind it.
    dims = [length * dr.fma(transmittance, c, -r) for c, r in zip(color, rest, strict=True)]
    return seen, dims, (transmittance, rest)


class ImageHats(HatKernel):
    """What hats of all kinds do that radiance responds to."""

    def __init__(self, tracer: Tracer, rays: Lanes, tables: HatTables, records: HatSums, image: HatImage) -> None:
        super().__init__(tracer, rays, tables, records)
        self.face_steps, self.has_steps = image.face_steps, image.face_steps is not None
        self.color, self.gradient = (
            [dr.gather(self.view.backend.Float, array, 3 * rays.pixel + k, rays.valid) for k in range(3)]
            for array in (image.color, image.gradient)
        )

    def light(self) -> list[Any]:
        """Radiance of the whole rays."""
        return self.color


class _LightHats(ImageHats):
    """Responses of radiance: B to one unit of colour, and (D_r, D_g, D_b) to one unit of density."""

    slots = 4

    def sample(self, entry: list[Any], leaving: list[Any], ray: HatRay) -> tuple[list[Response], Any, list[Any]]:
        length = dr.fmax(leaving[0] - entry[0], 0.0)
        piece = length * (1.0 / SAMPLES)
        light = ray.transmittance, ray.rest
        responses = []
        for x in PLACES:
            density, *color = (dr.fma(x, v1 - v0, v0) for v0, v1 in zip(entry[1:], leaving[1:], strict=True))
            seen, dims, light = pass_piece(piece, density, color, light)
            responses.append([seen, *dims])
        # The state goes on exactly: errors of the pieces do not add up along the ray.
        w0, w1, through = self.view.optics.weights(length, entry[1], leaving[1])
        w0, w1 = w0 * ray.transmittance, w1 * ray.transmittance
        colors = zip(entry[2:], leaving[2:], ray.rest, strict=True)
        behind = [r - dr.fma(w0, c0, w1 * c1) for c0, c1, r in colors]
        return responses, ray.transmittance * through, behind

    def record(self, response: Response) -> list[Any]:
        b, d, g = response[0], response[1:], self.gradient
        slope = dr.fma(g[0], d[0], dr.fma(g[1], d[1], g[2] * d[2]))
        square = dr.fma(d[0], d[0], dr.fma(d[1], d[1], d[2] * d[2]))
        return [g[0] * b, g[1] * b, g[2] * b, slope, b * b, *(b * v for v in d), square, b]

    def step_record(self, face: Any, response: Response) -> list[Any]:
        *color, density = dr.gather(self.view.backend.Float4, self.face_steps, face)
        changes = [dr.fma(response[0], c, d * density) for c, d in zip(color, response[1:], strict=True)]
        slope, square = (
            dr.fma(one[0], changes[0], dr.fma(one[1], changes[1], one[2] * changes[2]))
            for one in (self.gradient, changes)
        )
        return [slope, square]
