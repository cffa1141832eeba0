"""Derivatives of an image's squared error by hat functions of a scalar behind a transfer function (Dr.Jit kernel).

A pixel responds with (D_r, D_g, D_b) to one unit of a hat's scalar. On each piece of a crossing the transfer function
counts as linear, with the slope between its values at the piece's ends: knots within a piece, and jumps, are bridged.
"""

from __future__ import annotations

from typing import Any

import drjit as dr

from difftetvr.rendering.kernels.hats.kernel import (
    PLACES,
    SAMPLES,
    HatRay,
    HatSums,
    Response,
    gathered_records,
)
from difftetvr.rendering.kernels.hats.light import HatImage, ImageHats, pass_piece
from difftetvr.rendering.kernels.hats.space import HatRecords, HatSpace
from difftetvr.rendering.kernels.hats.tables import HatTables
from difftetvr.rendering.traversal.crossing import Tracer
from difftetvr.rendering.traversal.rays import Lanes
from difftetvr.rendering.traversal.transfer import Piece

RECORD = 2
"""Floats a hat: first and second derivative of the loss by its scalar."""

_NARROWEST = 1.0 / 512.0
"""Half of the least range of scalars that a slope is taken over: rounding decides that of a narrower one."""


def scalar_hat_records(tracer: Tracer, image: HatImage, space: HatSpace, in_order: bool = False) -> HatRecords:
    """Sums over the rays of a view for every vertex, edge and face; of faces those of their steps, if there are any.

    Args:
        tracer: The view, to be walked through; its scalars live on vertices.
        image: The rendered image, and the derivative of the loss with respect to it.
        space: What there are hats of, of which `RECORD` floats are known.
        in_order: Whether sums over rays have a certain order, see :mod:`difftetvr.rendering.kernels.shares`.
    """
    return gathered_records(_ScalarHats, tracer, image, space, in_order)


class _ScalarHats(ImageHats):
    """Responses of radiance: (D_r, D_g, D_b) to one unit of the scalar."""

    slots = 3

    def __init__(self, tracer: Tracer, rays: Lanes, tables: HatTables, records: HatSums, image: HatImage) -> None:
        super().__init__(tracer, rays, tables, records, image)
        self.transfer: Any = tracer.view.transfer

    def sample(self, entry: list[Any], leaving: list[Any], ray: HatRay) -> tuple[list[Response], Any, list[Any]]:
        length = dr.fmax(leaving[0] - entry[0], 0.0) * (1.0 / SAMPLES)
        half = dr.fmax(dr.abs(leaving[1] - entry[1]) * (0.5 / SAMPLES), _NARROWEST)
        light = ray.transmittance, ray.rest
        responses = []
        for x in PLACES:
            middle = dr.fma(x, leaving[1] - entry[1], entry[1])
            low, high = (self.transfer.at(middle + sign * half) for sign in (-1.0, 1.0))
            density, *color = (0.5 * (a + b) for a, b in zip(low, high, strict=True))
            slope = [(b - a) / (2.0 * half) for a, b in zip(low, high, strict=True)]
            seen, dims, light = pass_piece(length, density, color, light)
            responses.append([dr.fma(seen, s, slope[0] * d) for s, d in zip(slope[1:], dims, strict=True)])
        return responses, *self._behind(entry, leaving, ray)

    def _behind(self, entry: list[Any], leaving: list[Any], ray: HatRay) -> tuple[Any, list[Any]]:
        """Transmittance and rest behind a crossing, exactly: errors of the pieces do not add up along the ray."""

        def passed(piece: Piece, state: tuple[Any, list[Any]]) -> tuple[Any, list[Any]]:
            transmittance, rest = state
            (t0, density0, *color0), (t1, density1, *color1) = piece.start_values, piece.end_values
            w0, w1, through = self.view.optics.weights(dr.fmax(t1 - t0, 0.0), density0, density1)
            w0, w1 = w0 * transmittance, w1 * transmittance
            rest = [r - dr.fma(w0, c0, w1 * c1) for c0, c1, r in zip(color0, color1, rest, strict=True)]
            return transmittance * through, rest

        behind: tuple[Any, list[Any]] = self.transfer.cut(entry, leaving, passed, (ray.transmittance, ray.rest))
        return behind

    def record(self, response: Response) -> list[Any]:
        slope, square = (
            dr.fma(one[0], response[0], dr.fma(one[1], response[1], one[2] * response[2]))
            for one in (self.gradient, response)
        )
        return [slope, square]

    def step_record(self, face: Any, response: Response) -> list[Any]:
        step = dr.gather(self.view.backend.Float, self.face_steps, face)
        return self.record([step * r for r in response])
