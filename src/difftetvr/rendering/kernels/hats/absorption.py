"""Derivatives of the squared error of line integrals by hat functions (Dr.Jit kernel).

A line integral responds to one unit of a hat's density with the hat's own integral along the ray, whatever else the
mesh holds: so the quadratic models are exact, but for the pieces that bent hats are taken in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from difftetvr.rendering.kernels.hats.kernel import (
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

RECORD = 2
"""Floats a hat: first and second derivative of the loss by its density."""


@dataclass
class IntegralErrors:
    """What the kernel reads, flat.

    Attributes:
        slopes: (N,) derivative of the loss with respect to each line integral.
        curvatures: (N,) second derivative.
        face_steps: (M,) the one step of density that is looked at of each face that has a record.
    """

    slopes: Any
    curvatures: Any
    face_steps: Any


def absorption_records(tracer: Tracer, errors: IntegralErrors, space: HatSpace, in_order: bool = False) -> HatRecords:
    """Sums over the rays of a view for every vertex, edge and face; of faces those of their steps.

    Args:
        tracer: The view, to be walked through; its densities live on vertices.
        errors: What is known of its line integrals.
        space: What there are hats of, of which `RECORD` floats are known; of faces those of their steps.
        in_order: Whether sums over rays have a certain order, see :mod:`difftetvr.rendering.kernels.shares`.
    """
    return gathered_records(_AbsorptionHats, tracer, errors, space, in_order)


class _AbsorptionHats(HatKernel):
    """Responses of line integrals: D to one unit of density."""

    slots = 1
    has_steps = True

    def __init__(
        self, tracer: Tracer, rays: Lanes, tables: HatTables, records: HatSums, errors: IntegralErrors
    ) -> None:
        super().__init__(tracer, rays, tables, records)
        self.face_steps = errors.face_steps
        self.slope, self.curvature = (
            dr.gather(self.view.backend.Float, array, rays.pixel, rays.valid)
            for array in (errors.slopes, errors.curvatures)
        )

    def sample(self, entry: list[Any], leaving: list[Any], ray: HatRay) -> tuple[list[Response], Any, list[Any]]:
        piece = dr.fmax(leaving[0] - entry[0], 0.0) * (1.0 / SAMPLES)
        return [[piece] for _ in range(SAMPLES)], ray.transmittance, []

    def record(self, response: Response) -> list[Any]:
        (d,) = response
        return [self.slope * d, self.curvature * d * d]

    def step_record(self, face: Any, response: Response) -> list[Any]:
        step = dr.gather(self.view.backend.Float, self.face_steps, face)
        return self.record([response[0] * step])
