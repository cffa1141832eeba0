"""Where the object of a tomograph may be at all: all else is known to be empty before any view is looked at."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import torch

from difftetvr.capture.projections.geometry import ProjectionGeometry
from difftetvr.capture.volumes.voxels import load_volume
from difftetvr.errors import CaptureError, CaptureWarning

CYLINDER = "cylinder"
"""Name of the support that is the largest cylinder around the axis in the box to reconstruct."""


@dataclass(frozen=True, eq=False)
class OutsideSupport:
    """Space in which the object is known not to be.

    Attributes:
        bounds: (2, 3) corners of the box to reconstruct.
        inside: (X, Y, Z) bool, voxels that fill the box, true where the object may be; None for the cylinder.
    """

    bounds: torch.Tensor
    inside: torch.Tensor | None

    @staticmethod
    def of(support: str, geometry: ProjectionGeometry, device: torch.device) -> OutsideSupport:
        """What a support leaves outside.

        Args:
            support: ``cylinder``, the largest one around the z axis in the box; or the file of a volume whose voxels
                fill the box: the object may be where it exceeds its least value.
            geometry: Of the views; tells the box.
            device: Where places are that are asked for.

        Raises:
            CaptureError: The volume cannot be read or has one value everywhere, or the z axis is not in the box.
        """
        if support == CYLINDER:
            low, high = geometry.bounds[:, :2]
            if not bool(((low < 0) & (high > 0)).all()):
                raise CaptureError(
                    "The box to reconstruct does not hold the axis, so there is no cylinder around it; give a volume."
                )
            return OutsideSupport(geometry.bounds.to(device), None)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", CaptureWarning)
            values = load_volume(support).values
        inside = values > values.min()
        if not bool(inside.any()):
            raise CaptureError(f"'{support}' has one value everywhere, so it tells no support; leave it out.")
        return OutsideSupport(geometry.bounds.to(device), inside.to(device))

    def contains(self, places: torch.Tensor) -> torch.Tensor:
        """(N,) bool, which of (N, 3) places are outside of the support."""
        low, high = self.bounds.to(places)
        if self.inside is None:
            radius = torch.minimum(-low, high)[:2].min()
            return places[:, 0].square() + places[:, 1].square() > radius.square()
        counts = torch.tensor(self.inside.shape, device=places.device)
        # A place on the box's far side belongs to the last voxel.
        at = ((places - low) / (high - low) * counts).long().clamp(min=0).minimum(counts - 1)
        return ~self.inside[at[:, 0], at[:, 1], at[:, 2]]
